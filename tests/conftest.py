"""Fixtures shared by the tests: a config whose generated files go to one cache for the run."""

from __future__ import annotations

import pytest

from utils.config import Config, load_config


@pytest.fixture(scope="session")
def config() -> Config:
    """The defaults, rendered by the CPU so that pictures are the same everywhere."""
    return load_config(None, ["sim.renderer=tiny"])


@pytest.fixture(scope="session")
def box_set(config: Config):
    """The object set of the tutorial's cube."""
    from envs.objects import load_object_set

    return load_object_set("box", cache_dir=config.cache_folder)
