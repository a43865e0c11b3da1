"""Disks that are full or read-only, where this process may mount one."""

from contextlib import ExitStack
from threading import Event

import pytest

from benchmarks.soak_processes import WRITTEN, small_disk, soak_disk
from utils.errors import UserError


def test_what_is_written_to_a_full_or_read_only_disk_is_not_lost():
    with ExitStack() as stack:
        try:
            stack.enter_context(small_disk())
        except UserError as error:
            pytest.skip(str(error))
    tallies = list(soak_disk(0.01, 0, Event()))
    assert len(tallies) == 2 * len(WRITTEN)
    for tally in tallies:
        assert tally.tried == tally.survived == 5 and tally.lost == 0, tally
