"""Figures of an evaluation against hand computation, and the files that show them."""

import csv
import json
import math
import re
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import yaml

from utils.config import load_config
from utils.errors import UserError
from utils.image_overlay import FAILURE_COLOR, SUCCESS_COLOR, draw_grasp
from utils.report import GalleryItem, write_report
from utils.result_records import AttemptRecord, RoundRecord, contestant
from utils.results import (
    compare,
    format_table,
    interruption,
    planned_rounds,
    print_comparisons,
    print_stop_reasons,
    print_table,
    stop_reasons,
    summarise,
    write_csv,
    write_results,
)
from utils.runs import environment, git_state, new_run_folder, write_json_atomic
from utils.transforms import ImageGrasp


def stopped(reason: str, detail: str) -> AttemptRecord:
    return AttemptRecord(False, reason, 0.01, 5.0, turn_ms=14.0, detail=detail, turn_ms_mean=8.0)


def attempt(reason: str, plan: float = 0.01, sim: float = 5.0) -> AttemptRecord:
    return AttemptRecord(reason == "success", reason, plan, sim)


def a_round(policy, seed, total, cleared, attempts, ended="failures", scenario="pile"):
    return RoundRecord(policy, scenario, "box", seed, total, cleared, tuple(attempts), ended)


ROUNDS = [
    a_round(
        "heuristic",
        0,
        5,
        2,
        [
            attempt("success", 0.010, 6),
            attempt("missed", 0.020, 4),
            attempt("success", 0.030, 6),
            attempt("slipped", 0.040, 5),
            attempt("dropped", 0.050, 3),
        ],
    ),
    a_round(
        "heuristic",
        1,
        5,
        1,
        [attempt("success", 0.060, 6), attempt("no_plan", 0.100, 0)],
        "no_plan",
    ),
    a_round("random", 0, 5, 0, [attempt("ik", sim=0), attempt("collision", sim=2)]),
    a_round("random", 1, 5, 0, [attempt("no_plan", sim=0)], "no_plan"),
]
CONFIG = load_config(
    None,
    ["evaluate.policies=heuristic,random", "evaluate.scenarios=pile", "evaluate.rounds=2"]
    + ["evaluate.object_sets=box"],
)


def test_summary_by_hand():
    heuristic, random = summarise(ROUNDS, seed=7)
    assert (heuristic.policy, heuristic.scenario, heuristic.objects) == ("heuristic", "pile", "box")
    assert (heuristic.seed, heuristic.rounds) == (7, 2)
    assert (heuristic.attempts, heuristic.successes) == (6, 3)  # the no_plan is no attempt
    assert (heuristic.objects_total, heuristic.objects_cleared) == (10, 3)
    assert heuristic.success_rate == pytest.approx(0.5)
    # z^2 = 3.841459: 0.5 -+ z sqrt(0.25 / 6 + z^2 / 144) / (1 + z^2 / 6) = 0.5 -+ 0.312384
    assert heuristic.success_ci95 == pytest.approx((0.187616, 0.812384), abs=1e-5)
    assert heuristic.cleared_rate == pytest.approx(0.3)
    # (0.3 + z^2/20 -+ z sqrt(0.021 + z^2/400)) / (1 + z^2/10)
    assert heuristic.cleared_ci95 == pytest.approx((0.107789, 0.603222), abs=1e-5)
    assert heuristic.plan_ms_median == pytest.approx(40)  # of 10 20 30 40 50 60 100
    assert heuristic.sim_seconds_per_pick == pytest.approx(30 / 3)
    assert heuristic.picks_per_hour == pytest.approx(360)
    assert heuristic.failures == {
        "no_plan": 1, "ik": 0, "lost": 0, "stopped": 0, "collision": 0, "missed": 1,
        "slipped": 1, "dropped": 1, "physics": 0,
    }  # fmt: skip
    assert (random.attempts, random.successes, random.success_rate) == (2, 0, 0.0)
    assert random.sim_seconds_per_pick is None and random.picks_per_hour is None
    assert random.failures["no_plan"] == 1 and random.failures["ik"] == 1


def test_rounds_without_an_attempt_still_count_as_not_cleared():
    (row,) = summarise([ROUNDS[1], replace(ROUNDS[3], policy="heuristic")], seed=0)
    assert row.cleared_rate == pytest.approx(1 / 10)


def test_nothing_but_no_plan_is_undefined_not_zero():
    (row,) = summarise([ROUNDS[3]], seed=0)
    assert row.attempts == 0 and row.success_rate is None and row.success_ci95 == (0.0, 1.0)
    assert summarise([], seed=0) == []


def test_comparison_pairs_rounds_by_seed():
    (pair,) = compare([ROUNDS[1], ROUNDS[0], *ROUNDS[2:]], seed=0)  # order must not matter
    assert (pair.first, pair.second) == ("random", "heuristic")
    assert pair.success.value == pytest.approx(0 / 2 - 3 / 6)
    assert pair.cleared.value == pytest.approx(0 / 10 - 3 / 10)
    # Resamples of cleared: -2/5 twice the first round, -1/5 twice the second, -3/10 both.
    assert (pair.cleared.low, pair.cleared.high) == pytest.approx((-0.4, -0.2))
    (partial,) = compare(ROUNDS[:3], seed=0)  # random has not come to seed 1
    assert partial.cleared.rounds == 1
    (none,) = compare([ROUNDS[1], ROUNDS[2]], seed=0)
    assert none.success is None and none.cleared is None


def test_comparison_adds_all_of_clutter(capsys):
    packed = [replace(r, scenario="packed") for r in (ROUNDS[0], ROUNDS[2])]  # seed 0 of each
    isolated = [replace(r, scenario="isolated") for r in ROUNDS]
    *single, together = compare([*ROUNDS, *packed, *isolated], seed=0)
    assert [pair.scenario for pair in single] == ["pile", "packed", "isolated"]
    assert (together.scenario, together.objects) == ("pile + packed", "box")
    assert together.cleared.rounds == 3  # both seeds of pile and one of packed
    first, second = ROUNDS[0].objects_cleared, ROUNDS[1].objects_cleared
    assert together.cleared.value == pytest.approx(0 / 15 - (2 * first + second) / 15)
    print_comparisons([together])
    assert f"{-100 * (2 * first + second) / 15:+.1f} [" in capsys.readouterr().out


@pytest.mark.parametrize(
    "make",
    [
        lambda: AttemptRecord(True, "missed", 0, 0),
        lambda: AttemptRecord(False, "success", 0, 0),
        lambda: AttemptRecord(False, "bored", 0, 0),
        lambda: a_round("x", 0, 5, 6, []),
        lambda: a_round("x", 0, 5, 0, [], "bored"),
        lambda: a_round("x", 0, 5, 0, [attempt("missed")], "no_plan"),
        lambda: a_round("x", 0, 5, 0, [attempt("no_plan")], "failures"),
    ],
)
def test_contradictory_records_are_refused(make):
    with pytest.raises(ValueError):
        make()


def test_interruption():
    assert planned_rounds(CONFIG) == 4
    assert interruption(4, CONFIG) is None
    assert interruption(3, CONFIG) == "interrupted: 3 of 4 rounds"


def test_results_json_is_strict_and_complete(tmp_path):
    path = tmp_path / "results.json"
    rows = summarise(ROUNDS, seed=0)
    write_results(path, rows, CONFIG, "CPU", complete=True)

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert (content["schema"], content["complete"]) == (1, True)
    assert content["commit"] == git_state().commit
    assert content["versions"]["numpy"] == np.__version__
    assert content["device"] == "CPU" and content["config"]["evaluate"]["rounds"] == 2
    fields = """policy scenario objects seed rounds attempts successes objects_total
        objects_cleared success_rate success_ci95 cleared_rate cleared_ci95 plan_ms_median
        sim_seconds_per_pick picks_per_hour"""
    loops = {"controller", "turn_ms_p95", "turn_ms_mean"}
    assert set(content["rows"][0]) == {*fields.split(), "failures"} | loops
    assert content["rows"][1]["picks_per_hour"] is None
    bad = replace(rows[0], plan_ms_median=math.nan)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        write_results(path, [bad], CONFIG, "CPU", complete=True)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_closed_loop_is_a_contestant_of_its_own():
    assert contestant("heuristic", "open_loop") == "heuristic"
    assert contestant("heuristic", "ibvs") == "heuristic+ibvs"
    turns = [10.0, 30.0, 20.0]
    attempts = tuple(replace(attempt("success"), turn_ms=ms) for ms in turns)
    record = RoundRecord(
        "heuristic+ibvs", "moved", "box", 0, 3, 3, attempts, "cleared", controller="ibvs"
    )
    (row,) = summarise([record], seed=0)
    assert (row.policy, row.controller, row.turn_ms_p95) == ("heuristic+ibvs", "ibvs", 20.0)
    assert summarise(ROUNDS, seed=0)[0].turn_ms_p95 is None
    four = load_config(None, ["evaluate.controllers=open_loop,ibvs", "evaluate.scenarios=moved",
                              "evaluate.policies=heuristic", "evaluate.rounds=7"])  # fmt: skip
    assert planned_rounds(four) == 14


def test_csv(tmp_path):
    write_csv(tmp_path / "rows.csv", summarise(ROUNDS, seed=0))
    with (tmp_path / "rows.csv").open(encoding="utf-8", newline="") as file:
        first, second = csv.DictReader(file)
    assert first["policy"] == "heuristic" and float(first["success_ci95_low"]) < 0.19
    assert first["failures_missed"] == "1" and second["picks_per_hour"] == ""
    write_csv(tmp_path / "none.csv", [])
    assert (tmp_path / "none.csv").read_text() == ""


def test_table(capsys):
    print_table(summarise(ROUNDS, seed=0))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["policy", "scenario", "objects"]
    assert "50 % [19, 81] 3/6" in lines[2] and "30 % [11, 60] 3/10" in lines[2]
    assert "40.0" in lines[2] and "360" in lines[2]
    assert lines[2].endswith("1 no plan, 1 missed, 1 slipped, 1 dropped")
    assert lines[3].endswith("1 no plan, 1 IK, 1 collision on approach")
    assert format_table([]).startswith("policy")


def report(tmp_path, rounds=ROUNDS, **more) -> str:
    path = tmp_path / "report.html"
    write_report(path, summarise(rounds, 0), rounds, CONFIG, **more)
    return path.read_text(encoding="utf-8")


def test_report_is_self_contained(tmp_path):
    image = np.full((40, 40, 3), 90, np.uint8)
    iio.imwrite(tmp_path / "round.gif", np.stack([image, image + 50]))
    page = report(
        tmp_path,
        gallery=[GalleryItem(image, "a <b>caption</b>", True), GalleryItem(image, "two", False)],
        videos=[(tmp_path / "round.gif", "round 0")],
        device="CPU",
    )
    assert not re.search(r"https?://|//cdn|@import|<script|<link", page)
    for source in re.findall(r"(?:src|href)=\"([^\"]*)", page):
        assert source.startswith("data:")
    assert page.count("data:image/png;base64") == 2 and page.count("data:image/gif;base64") == 1
    assert "a &lt;b&gt;caption&lt;/b&gt;" in page and "<b>caption" not in page
    assert "interrupted" not in page
    assert "evaluate.rounds=2" in page and "python evaluate.py" in page
    assert "heuristic: 3 of 6" in page and "1 collision on approach" in page
    assert "few rounds" in page  # two rounds give no verdict


def test_report_of_an_interrupted_run(tmp_path):
    assert "interrupted: 3 of 4 rounds" in report(tmp_path, ROUNDS[:3])
    page = report(tmp_path, [])
    assert "interrupted: 0 of 4 rounds" in page and "nothing to show yet" in page


@pytest.mark.parametrize("name, controller", [("oracle", "open_loop"), ("oracle+ibvs", "ibvs")])
def test_oracle_is_a_bound_not_the_headline(tmp_path, name, controller):
    oracle = a_round(name, 0, 1, 1, [attempt("success")], "cleared")
    page = report(tmp_path, [*ROUNDS, replace(oracle, controller=controller)])
    assert "succeed with <strong>heuristic" in page
    assert f"{name}, which knows the true scene: 100 %" in page


def test_report_refuses_bad_videos(tmp_path):
    with pytest.raises(UserError, match=r"\.gif, \.mp4"):
        report(tmp_path, videos=[(tmp_path / "a.avi", "")])
    with pytest.raises(UserError, match="cannot read"):
        report(tmp_path, videos=[(tmp_path / "a.gif", "")])


K = np.array([[200.0, 0, 50], [0, 200, 50], [0, 0, 1]])


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_overlay_plates_stand_at_half_the_width(angle):
    image = np.full((101, 101, 3), 128, np.uint8)
    grasp = ImageGrasp(np.array([50.0, 50.0]), angle, depth=0.5, width=0.1, quality=1.0)
    drawn = draw_grasp(image, grasp, K, success=True)
    half = 0.1 / 2 * 200 / 0.5  # 20 pixels
    for side in (-1, 1):
        u = round(50 + side * half * math.cos(angle))
        v = round(50 + side * half * math.sin(angle))
        assert tuple(drawn[v, u]) == SUCCESS_COLOR
    rows, columns = np.nonzero((drawn != 128).any(axis=2))
    along, across = (columns, rows) if angle == 0 else (rows, columns)
    assert 40 <= np.ptp(along) <= 48 and 8 <= np.ptp(across) <= 16  # 40 and 8, plus line widths
    assert (image == 128).all()  # the given image is left alone


def test_overlay_colours_and_bad_input():
    image = np.zeros((101, 101, 3), np.uint8)
    grasp = ImageGrasp(np.array([50.0, 50.0]), 0.0, 0.5, 0.05, 1.0)
    # A plate, 0.05 / 2 * 200 / 0.5 = 10 pixels right of the centre.
    plate = {c: tuple(draw_grasp(image, grasp, K, success=c)[50, 60]) for c in (False, None)}
    assert plate == {False: FAILURE_COLOR, None: (255, 255, 255)}
    assert tuple(draw_grasp(image, grasp, K, (1, 2, 3), True)[50, 60]) == (1, 2, 3)
    with pytest.raises(ValueError, match="uint8"):
        draw_grasp(image.astype(float), grasp, K)
    with pytest.raises(ValueError, match="depth"):
        draw_grasp(image, replace(grasp, depth=0.0), K)


def test_run_folder(tmp_path):
    first = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    second = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    assert first != second and first.parent == second.parent == tmp_path / "evaluate"
    assert re.fullmatch(r"\d{8}-\d{6}-pile(-2)?", second.name)
    assert load_config(first / "config.yaml") == CONFIG
    assert yaml.safe_load((first / "config.yaml").read_text())["evaluate"]["rounds"] == 2
    facts = json.loads((first / "environment.json").read_text())
    assert facts["packages"]["numpy"] == np.__version__ and facts["cpu_count"] >= 1
    assert re.fullmatch(r"\d{8}-\d{6}", new_run_folder("evaluate", None, CONFIG, tmp_path).name)


def test_run_folder_errors(tmp_path):
    for name in ("../x", "a/b", ".x", "a b", "-x"):
        with pytest.raises(UserError, match="run name"):
            new_run_folder("evaluate", name, CONFIG, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot make a run folder"):
        new_run_folder("evaluate", None, CONFIG, tmp_path / "file")


def test_git_state_outside_a_repository(tmp_path):
    assert git_state(tmp_path) == (None, None)
    assert set(environment()) >= {"commit", "dirty", "platform", "packages", "cpu_count"}


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError):
        write_json_atomic(tmp_path / "x.json", {"a": math.inf})
    assert list(tmp_path.iterdir()) == []


OLD = "stopped: what was seen last is {} ms old, the watchdog allows 100 ms"
STOPS = [
    a_round("heuristic+ibvs", 7, 1, 0, [stopped("stopped", OLD.format(104))]),
    a_round("heuristic+ibvs", 8, 1, 0, [stopped("collision", "stopped: contact with 12.0 N")]),
    a_round("heuristic+ibvs", 9, 1, 0, [stopped("stopped", OLD.format(108))]),
]


def test_what_stopped_the_arm_is_told_and_counted(capsys, tmp_path):
    assert stop_reasons(ROUNDS) == []
    stops = stop_reasons([*ROUNDS, *STOPS])
    assert [(s.count, s.reason, s.sentence, s.seed) for s in stops] == [
        (2, "stopped", OLD.format(104), 7),
        (1, "collision", "stopped: contact with 12.0 N", 8),
    ]
    print_stop_reasons(stops)
    assert (
        f"   2 x heuristic+ibvs, pile, box: {OLD.format(104)} (scene 7)" in capsys.readouterr().out
    )
    print_stop_reasons([])
    assert capsys.readouterr().out == ""

    def page(rounds):
        write_report(tmp_path / "r.html", summarise(rounds, 0), rounds, load_config(None))
        return (tmp_path / "r.html").read_text()

    told = page([*ROUNDS, *STOPS])
    assert "What stopped the arm" in told and OLD.format(104) in told and "8.0, 14.0" in told
    untold = page(ROUNDS)
    assert "What stopped the arm" not in untold and "turn, ms" not in untold


def test_a_stop_with_an_object_in_the_hand_names_it(capsys):
    carried = replace(stopped("stopped", "stopped: the workspace ends here"), held="mug_0012")
    print_stop_reasons(stop_reasons([a_round("heuristic", 4, 1, 0, [carried])]))
    assert "(scene 4, mug_0012 in the hand)" in capsys.readouterr().out


def test_a_loops_turns_are_told_where_there_are_any():
    table = format_table(summarise([*ROUNDS, *STOPS], 0)).splitlines()
    assert "turn ms, 95 %" in table[0]
    assert "8.0, 14.0" in table[-1] and "8.0" not in table[2]
    assert "turn ms" not in format_table(summarise(ROUNDS, 0))
