"""Measurements against peers: `python -m benchmarks.bench_env` and its neighbours."""

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing
