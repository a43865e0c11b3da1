"""Measurements against peers: `python -m benchmarks.bench_env` and its neighbours."""
