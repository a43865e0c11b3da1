"""A Dask cluster of this machine for one test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from utils.executor import event_loop


@contextmanager
def local_cluster(count: int, threads: int = 1) -> Iterator[Any]:
    """A `distributed.LocalCluster` of `count` workers with as many threads each; skips the test
    where Dask is missing."""
    distributed = pytest.importorskip("distributed", reason="pip install distributed")
    import dask

    # This class alone (`dask worker` does not) gives a worker up for good where none has taken its
    # place 15 s after it was lost, as it happens to workers that die often on a busy machine.
    patient = {"distributed.deploy.lost-worker-timeout": "1h"}
    with (
        dask.config.set(patient),
        distributed.LocalCluster(
            count, threads_per_worker=threads, dashboard_address=None, loop=event_loop()
        ) as cluster,
    ):
        yield cluster
