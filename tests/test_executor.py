"""Calls in an executor: their results, the limit on those under way, and an early end."""

import time
from concurrent.futures import ThreadPoolExecutor
from itertools import takewhile

import pytest

from utils.executor import completed, process_pool

SET_UP = None


def set_up(value):
    global SET_UP
    SET_UP = value


def plus_set_up(number):
    return number + SET_UP


def test_processes_are_set_up_first():
    with process_pool(2, set_up, 100) as pool:
        assert sorted(completed(pool, plus_set_up, range(3), limit=2)) == [100, 101, 102]


def test_no_more_items_are_read_than_the_limit():
    """Of an endless supply, in any executor with the interface of concurrent.futures."""
    read, stop = [], []

    def supply():
        while True:
            read.append(len(read))
            yield read[-1]

    with ThreadPoolExecutor(4) as pool:
        results = []
        for result in completed(pool, abs, takewhile(lambda _: not stop, supply()), limit=2):
            results.append(result)
            assert len(read) - len(results) <= 2
            if len(results) == 5:
                stop.append(True)
    assert sorted(results) == list(range(len(results))) and len(results) <= 7


def test_results_arrive_as_they_are_finished():
    def nap(seconds):
        time.sleep(seconds)
        return seconds

    with ThreadPoolExecutor(2) as pool:
        assert list(completed(pool, nap, [0.3, 0.0], limit=2)) == [0.0, 0.3]


def test_an_error_of_a_call_is_raised():
    with ThreadPoolExecutor(1) as pool, pytest.raises(ZeroDivisionError):
        list(completed(pool, lambda x: 1 / x, [0], limit=1))
