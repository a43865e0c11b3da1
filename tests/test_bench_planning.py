"""The benchmark of planning times runs, and reports every planner in both piles."""

import json

import pytest

from benchmarks.bench_planning import COUNTS, PLANNERS, main


@pytest.mark.slow
def test_times_of_every_planner(tmp_path):
    main(["--quick", "--json", str(tmp_path / "planning.json")])
    measured = json.loads((tmp_path / "planning.json").read_text())
    assert set(measured) == {f"{name}, pile of {count}" for name in PLANNERS for count in COUNTS}
    assert all(one["unit"] == "ms" and one["value"] > 0 for one in measured.values())
