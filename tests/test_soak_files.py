"""Damaged files of every kind: each gives something or one sentence, and changes no other file."""

from __future__ import annotations

import math
import mmap
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from benchmarks.soak_files import COUNTS_PEAKS, KINDS, Kind, damaged, problem
from utils.errors import UserError

BY_NAME = {kind.name: kind for kind in KINDS}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A sound file of each kind, in a folder of its own."""
    paths = {}
    for kind in KINDS:
        paths[kind.name] = tmp_path_factory.mktemp(kind.name.replace(".", "_")) / kind.name
        kind.write(paths[kind.name])
    return paths


@pytest.mark.parametrize("name", BY_NAME)
def test_a_sound_file_is_read(sound, name):
    BY_NAME[name].read(sound[name])


@pytest.mark.parametrize("name", BY_NAME)
@hypothesis.settings(
    max_examples=25, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_one_sentence_or_works(sound, name, seed):
    content = sound[name].read_bytes()
    path = sound[name].with_name(f"damaged-{name}")
    path.write_bytes(damaged(content, np.random.default_rng(seed)))
    # A busy machine may take any time; one that hangs is ended by the time limit of the tests.
    assert problem(BY_NAME[name], path, longest=math.inf) is None
    assert sound[name].read_bytes() == content


@pytest.mark.skipif(not COUNTS_PEAKS, reason="this system does not count peaks of the memory")
def test_memory_that_is_given_back_counts(tmp_path):
    def read(path):  # of the system, not of the heap, which may have as much left over
        with mmap.mmap(-1, int(120e6)) as held:
            np.frombuffer(held, np.uint8)[:] = 1

    bomb, nothing = Kind("bomb", Path.touch, read), Kind("nothing", Path.touch, Path.exists)
    assert problem(bomb, tmp_path, 100e6, math.inf) == "it takes too much memory"
    assert problem(bomb, tmp_path, 140e6, math.inf) is None
    assert problem(nothing, tmp_path, 100e6, math.inf) is None


def test_a_file_that_takes_longer_than_it_may_is_told_of(tmp_path):
    nothing = Kind("nothing", Path.touch, Path.exists)
    assert problem(nothing, tmp_path, longest=0.0) == "it takes too long"


@pytest.mark.parametrize("name", ["colour.png", "depth.npy", "shard.h5", "network.pt", "parts.npz"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_a_file_that_is_cut_short_is_refused(sound, name, share):
    content = sound[name].read_bytes()
    path = sound[name].with_name(f"cut-{name}")
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError):
        BY_NAME[name].read(path)
