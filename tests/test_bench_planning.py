"""The benchmark of planning times: it reports every planner and its aim, and takes medians."""

import json

import pytest

from benchmarks import bench_planning
from tests.helpers.box_frames import boxes_frame

TWO_BOXES = [((0.05, 0.05, 0.06), 0.0, (0.45, 0.0)), ((0.04, 0.08, 0.04), 0.5, (0.55, 0.05))]


def test_every_planner_is_timed_in_every_pile(tmp_path, monkeypatch):
    """In both of two boxes here, whatever they are called."""
    counts = bench_planning.AIMED_AT, 2
    monkeypatch.setattr(bench_planning, "COUNTS", counts)
    monkeypatch.setattr(bench_planning, "frames_of", lambda *_: [boxes_frame(TWO_BOXES)])
    file = tmp_path / "planning.json"
    bench_planning.main(["--quick", "--json", str(file)])
    measured = json.loads(file.read_text())
    planners = bench_planning.PLANNERS
    assert set(measured) == {f"{name}, pile of {count}" for name in planners for count in counts}
    assert all(one["unit"] == "ms" and one["value"] > 0 for one in measured.values())
    assert {name: one["target"] for name, one in measured.items() if one["target"]} == {
        "graspnet_direct, pile of 5": "<= 20", "graspnet, pile of 5": "<= 25",
        f"{bench_planning.FAN}, pile of 5": "<= 500",
    }  # fmt: skip


def test_the_time_of_a_plan_is_the_median_after_a_pass_that_does_not_count(monkeypatch):
    """Of 2, 4 and 9 ms, after plans of 10 s and more."""
    now, lasting = [100.0], iter([10.0, 20.0, 30.0, 0.009, 0.002, 0.004])
    monkeypatch.setattr(bench_planning, "perf_counter", lambda: now[0])
    seen = []

    def plan(frame):
        seen.append(frame)
        now[0] += next(lasting)
        return []

    assert bench_planning.median_ms(plan, "abc") == pytest.approx(4.0)
    assert seen == list("abcabc")
