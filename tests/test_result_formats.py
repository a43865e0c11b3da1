"""Files and tables that show the figures of an evaluation."""

import csv
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.records import CONFIG, OLD, RETRIEVED, ROUNDS, STOPS, a_round, stopped
from utils import result_formats
from utils.report import write_report
from utils.result_formats import (
    TableColumn,
    format_comparisons,
    format_scores,
    format_stop_reasons,
    format_table,
    write_comparisons_csv,
    write_comparisons_latex,
    write_csv,
    write_results,
)
from utils.results import compare, stop_reasons, summarise
from utils.runs import git_state


def test_results_json_is_strict_and_complete(tmp_path):
    path = tmp_path / "results.json"
    rows, pairs = summarise(ROUNDS, seed=0), compare(ROUNDS, seed=0)
    write_results(path, rows, pairs, CONFIG, "CPU", complete=True)

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert (content["schema"], content["complete"]) == (1, True)
    assert content["commit"] == git_state().commit
    assert content["versions"]["numpy"] == np.__version__
    assert content["device"] == "CPU" and content["config"]["evaluate"]["rounds"] == 2
    fields = """policy scenario objects depth_noise seed rounds attempts successes objects_total
        objects_cleared success_rate success_ci95 cleared_rate cleared_ci95 plan_ms_median
        sim_seconds_per_pick picks_per_hour"""
    loops = {"controller", "turn_ms_p95", "turn_ms_mean"}
    held = {"turned", "slid", "firm"}
    fitting = {"graspable_attempts", "graspable_successes", "graspable_total"}
    others = {"failures", "calibration_error", "targets", "targets_in_hand"}
    others |= {"target_in_hand_rate", "target_in_hand_ci95", "picks_to_target"}
    assert set(content["rows"][0]) == {*fields.split()} | others | loops | held | fitting
    assert content["rows"][1]["picks_per_hour"] is None
    (pair,) = content["comparisons"]
    assert (pair["first"], pair["second"]) == ("random", "heuristic")
    assert pair["cleared"] == {"value": -0.3, "low": -0.4, "high": -0.2, "rounds": 2}
    bad = replace(rows[0], plan_ms_median=math.nan)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        write_results(path, [bad], [], CONFIG, "CPU", complete=True)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_what_is_printed_explains_its_columns():
    rows, pairs = summarise(ROUNDS, seed=0), compare(ROUNDS, seed=0)
    table, why, differences = format_scores(rows, stop_reasons(ROUNDS), pairs).split("\n\n")
    legend = table.splitlines()[-1]
    for told in ("firm: ", "more than 15 degrees", "more than 1 cm", "plan ms: ", "picks/h: "):
        assert told in legend
    assert why.startswith("why") and differences.splitlines()[-1].endswith("-: undefined")
    assert format_scores(rows, [], []) == table


def test_csv(tmp_path):
    write_csv(tmp_path / "rows.csv", summarise(ROUNDS, seed=0))
    with (tmp_path / "rows.csv").open(encoding="utf-8", newline="") as file:
        first, second = csv.DictReader(file)
    assert first["policy"] == "heuristic" and float(first["success_ci95_low"]) < 0.19
    assert first["failures_missed"] == "1" and second["picks_per_hour"] == ""
    write_csv(tmp_path / "none.csv", [])
    header = (tmp_path / "rows.csv").read_text().splitlines()[0]
    assert (tmp_path / "none.csv").read_text() == f"{header}\n"


def test_table():
    lines = format_table(summarise(ROUNDS, seed=0)).splitlines()
    assert lines[0].split()[:3] == ["policy", "scenario", "objects"]
    assert "50 % [19, 81] 3/6" in lines[2] and "30 % [11, 60] 3/10" in lines[2]
    assert "40.0" in lines[2] and "360" in lines[2]
    assert lines[2].endswith("1 no plan, 1 missed, 1 slipped, 1 dropped")
    assert lines[3].endswith("1 no plan, 1 IK, 1 collision on approach")
    assert format_table([]).startswith("policy")


def test_a_closed_loop_s_turns_have_a_column():
    table = format_table(summarise([*ROUNDS, *STOPS], 0)).splitlines()
    assert "turn ms, 95 %" in table[0]
    assert "8.0, 14.0" in table[-1] and "8.0" not in table[2]
    assert "turn ms" not in format_table(summarise(ROUNDS, 0))


def test_the_target_has_columns_where_one_was_wanted():
    row = summarise(RETRIEVED, 0)[0]
    assert (row.targets, row.targets_in_hand, row.picks_to_target) == (3, 2, 2.5)
    table = format_table([row]).splitlines()
    assert re.split("  +", table[0])[3:6] == ["target in hand", "picks to it", "success"]
    assert "67 % [21, 94] 2/3" in table[2] and "2.5" in table[2]
    assert "cleared" not in table[0], "a round ends once the target is in hand"
    both = format_table([row, *summarise(ROUNDS, 0)]).splitlines()
    assert "cleared" in both[0] and "6/15" not in both[2] and "30 % [11, 60] 3/10" in both[3]
    assert "target" not in format_table(summarise(ROUNDS, 0))
    assert summarise(ROUNDS, 0)[0].target_in_hand_rate is None


def test_a_depth_noise_has_a_column_where_there_is_any(tmp_path):
    noisy = [replace(record, depth_noise="realsense") for record in [*ROUNDS, *STOPS]]
    rounds = [*noisy, *ROUNDS]
    lines = format_table(summarise(rounds, 0)).splitlines()
    assert lines[0].split()[:4] == ["policy", "scenario", "objects", "depth"]
    assert [line.split()[3] for line in lines[2:]] == 3 * ["realsense"] + 2 * ["none"]
    assert "depth" not in format_table(summarise(ROUNDS, 0))
    assert "pile, box, realsense depth: stopped" in format_stop_reasons(stop_reasons(rounds))
    pairs = compare(noisy[:4] + ROUNDS, seed=0)
    text = format_comparisons(pairs).splitlines()
    assert text[0].split()[4] == "depth" and text[2].split()[5:6] == ["realsense"]
    assert "depth" not in format_comparisons(pairs[1:])
    write_comparisons_latex(tmp_path / "pairs.tex", pairs)
    tex = (tmp_path / "pairs.tex").read_text()
    assert r"{llllrrr}" in tex and "Difference & Scenario & Objects & Depth & Success" in tex
    assert "& box & realsense &" in tex and "& box & none &" in tex


def test_a_new_column_is_an_entry_of_the_list(monkeypatch, tmp_path):
    """The printed table and the page show it without any other change."""
    new = TableColumn("seed of the run", lambda row: str(row.seed), number=True)
    monkeypatch.setattr(result_formats, "COLUMNS", (*result_formats.COLUMNS, new))
    rows = summarise(ROUNDS, seed=77)
    assert all(line.endswith("77") for line in format_table(rows).splitlines()[2:])
    write_report(tmp_path / "report.html", rows, ROUNDS, [], CONFIG)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<th class="n">seed of the run</th>' in page and page.count(">77</td>") == len(rows)


def test_reasons_of_failures_are_lines_with_their_scene():
    text = format_stop_reasons(stop_reasons([*ROUNDS, *STOPS]))
    assert f"   2 x heuristic+ibvs, pile, box, clean depth: {OLD.format(104)} (scene 7)" in text
    carried = replace(stopped("stopped", "stopped: the workspace ends here"), held="mug_0012")
    text = format_stop_reasons(stop_reasons([a_round("heuristic", 4, 1, 0, [carried])]))
    assert "(scene 4, mug_0012 in the hand)" in text
    assert format_stop_reasons([]) == ""


def test_comparisons_as_text_csv_and_latex(tmp_path):
    pairs = compare(ROUNDS, seed=0)
    text = format_comparisons(pairs).splitlines()
    assert text[2].startswith("random - heuristic  pile      box")
    assert text[2].endswith("-30.0 (under 20 rounds)  2")
    many = [replace(one, cleared=replace(one.cleared, rounds=20)) for one in pairs]
    assert format_comparisons(many).splitlines()[2].endswith("-30.0 [-40.0, -20.0]  2")
    assert format_comparisons([]) == ""
    write_comparisons_csv(tmp_path / "pairs.csv", pairs)
    with (tmp_path / "pairs.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["first"] == "random" and row["cleared_low"] == row["cleared_high"] == ""
    assert (row["success_value"], row["success_rounds"]) == ("-0.5", "2")
    write_comparisons_csv(tmp_path / "many.csv", many)
    with (tmp_path / "many.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["cleared_low"]) == pytest.approx(-0.4) and row["success_low"] == ""
    header = (tmp_path / "pairs.csv").read_text().splitlines()[0]
    write_comparisons_csv(tmp_path / "one_policy.csv", [])
    assert (tmp_path / "one_policy.csv").read_text() == f"{header}\n"
    undefined = compare([ROUNDS[1], ROUNDS[2]], seed=0)  # no scene in common
    write_comparisons_csv(tmp_path / "none.csv", undefined)
    assert (tmp_path / "none.csv").read_text().splitlines()[
        1
    ] == "random,heuristic,pile,box,none" + "," * 8
    renamed = [replace(pairs[0], objects="random_urdfs")]
    write_comparisons_latex(tmp_path / "pairs.tex", renamed)
    lines = (tmp_path / "pairs.tex").read_text().splitlines()
    assert lines[4].startswith(
        r"random $-$ heuristic & pile & random\_urdfs & -50.0 (under 20 rounds) & "
    )
    assert lines[4].endswith(r"& -30.0 (under 20 rounds) & 2 \\") and lines[-1] == r"\end{tabular}"
    paths = [replace(pairs[0], objects=r"~\{m}^")]
    write_comparisons_latex(tmp_path / "pairs.tex", paths)
    escaped = r"\textasciitilde{}\textbackslash{}\{m\}\textasciicircum{}"
    assert f"& {escaped} &" in (tmp_path / "pairs.tex").read_text()
