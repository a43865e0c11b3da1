"""Figures of an evaluation against hand computation."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.records import CONFIG, OLD, ROUNDS, STOPS, a_round, attempt
from utils.config import dump_config, load_config
from utils.errors import UserError
from utils.result_formats import firm_in_words
from utils.result_records import RoundRecord, append_round, policy_name
from utils.results import compare, compare_runs, hardest_objects, stop_reasons, summarise
from utils.statistics import paired_difference_interval


def test_summary_by_hand():
    heuristic, random = summarise(ROUNDS, seed=7)
    assert (heuristic.policy, heuristic.scenario) == ("heuristic", "pile")
    assert (heuristic.seed, heuristic.rounds) == (7, 2)
    assert (heuristic.attempts, heuristic.successes) == (6, 3)  # the no_plan is no attempt
    assert (heuristic.objects_total, heuristic.objects_cleared) == (10, 3)
    assert heuristic.success_rate == pytest.approx(0.5)
    # z^2 = 3.841459: 0.5 -+ z sqrt(0.25 / 6 + z^2 / 144) / (1 + z^2 / 6) = 0.5 -+ 0.312384
    assert heuristic.success_ci95 == pytest.approx((0.187616, 0.812384), abs=1e-5)
    assert heuristic.cleared_rate == pytest.approx(0.3)
    # (0.3 + z^2/20 -+ z sqrt(0.021 + z^2/400)) / (1 + z^2/10): 2 and 1 of 5 differ less by round
    # than independent objects do, which counts as independence.
    assert heuristic.cleared_ci95 == pytest.approx((0.107789, 0.603222), abs=1e-5)
    assert heuristic.plan_ms_median == pytest.approx(40)  # of 10 20 30 40 50 60 100
    assert heuristic.sim_seconds_per_pick == pytest.approx(30 / 3)
    assert heuristic.picks_per_hour == pytest.approx(360)
    assert heuristic.failures == {
        "no_plan": 1, "planner_error": 0, "ik": 0, "lost": 0, "stopped": 0, "collision": 0,
        "missed": 1, "slipped": 1, "dropped": 1, "turned": 0, "slid": 0, "physics": 0,
    }  # fmt: skip
    assert (random.attempts, random.successes, random.success_rate) == (2, 0, 0.0)
    assert random.sim_seconds_per_pick is None and random.picks_per_hour is None
    assert random.failures["no_plan"] == 1 and random.failures["ik"] == 1


def test_rounds_without_an_attempt_still_count_as_not_cleared():
    (row,) = summarise([ROUNDS[1], replace(ROUNDS[3], policy="heuristic")], seed=0)
    assert row.cleared_rate == pytest.approx(1 / 10)


def test_what_moves_in_the_hand_is_no_firm_success():
    """Of four successes one turns by 16 degrees, one slides by 11 mm, one does both; 14 degrees and
    9 mm are firm. A failure is not firm, however little it moved."""
    moves = [(16, 0.0), (0, 0.011), (16, 0.011), (14, 0.009)]
    attempts = [
        replace(attempt("success"), turned=np.radians(turned), slid=slid) for turned, slid in moves
    ]
    attempts.append(replace(attempt("dropped"), turned=0.0, slid=0.0))
    (row,) = summarise([a_round("heuristic", 0, 5, 4, attempts)], seed=0)
    assert (row.successes, row.turned, row.slid, row.firm) == (4, 2, 2, 1)
    assert firm_in_words(row) == "20 %"


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


def test_comparison_adds_all_of_clutter():
    packed = [replace(r, scenario="packed") for r in (ROUNDS[0], ROUNDS[2])]  # seed 0 of each
    isolated = [replace(r, scenario="isolated") for r in ROUNDS]
    *single, together = compare([*ROUNDS, *packed, *isolated], seed=0)
    assert [pair.scenario for pair in single] == ["pile", "packed", "isolated"]
    assert (together.scenario, together.objects) == ("pile + packed", "box")
    assert together.cleared.rounds == 3  # both seeds of pile and one of packed
    first, second = ROUNDS[0].objects_cleared, ROUNDS[1].objects_cleared
    assert together.cleared.value == pytest.approx(0 / 15 - (2 * first + second) / 15)


def test_what_both_share_of_clutter_names_the_row_that_adds_it_up():
    """The first has packed scenes besides, which the second has not played."""
    packed = replace(ROUNDS[0], scenario="packed")
    pairs = compare([*ROUNDS, packed], seed=0)
    assert [(pair.scenario, pair.success.rounds) for pair in pairs] == [("pile", 2)]
    third = [replace(record, policy="oracle") for record in (ROUNDS[0], packed)]
    found = {(one.first, one.second, one.scenario) for one in compare([*ROUNDS, packed, *third], 0)}
    others = [("oracle", "heuristic"), ("oracle", "random"), ("random", "heuristic")]
    together = ("oracle", "heuristic", "pile + packed")
    assert found == {
        *((*pair, "pile") for pair in others), ("oracle", "heuristic", "packed"), together
    }  # fmt: skip


def test_policies_are_compared_within_the_same_depth_noise():
    """The noisy heuristic clears nothing; clutter is added up for each noise alone."""
    lost = [replace(r, depth_noise="kinect", objects_cleared=0) for r in ROUNDS]
    pairs = compare([*lost, *ROUNDS], seed=0)
    assert [(pair.depth_noise, pair.cleared.value) for pair in pairs] == [
        ("kinect", 0.0), ("none", pytest.approx(-0.3)),
    ]  # fmt: skip
    packed = [replace(r, scenario="packed") for r in lost]
    together = compare([*lost, *ROUNDS, *packed], seed=0)[-1]
    assert (together.scenario, together.depth_noise) == ("pile + packed", "kinect")
    assert together.cleared.rounds == 4
    rows = summarise([*lost, *ROUNDS], seed=0)
    assert [row.depth_noise for row in rows] == ["kinect", "kinect", "none", "none"]


def test_a_closed_loop_is_a_policy_of_its_own():
    assert policy_name("heuristic", "open_loop") == "heuristic"
    assert policy_name("heuristic", "ibvs") == "heuristic+ibvs"
    turns = [10.0, 30.0, 20.0]
    attempts = tuple(replace(attempt("success"), turn_ms=ms) for ms in turns)
    record = RoundRecord(
        "heuristic+ibvs", "moved", "box", 0, 3, 3, attempts, "cleared", controller="ibvs"
    )
    (row,) = summarise([record], seed=0)
    assert (row.policy, row.controller, row.turn_ms_p95) == ("heuristic+ibvs", "ibvs", 20.0)
    assert summarise(ROUNDS, seed=0)[0].turn_ms_p95 is None


def test_failures_of_one_kind_are_counted_together():
    stops = stop_reasons(STOPS)
    assert [(s.count, s.reason, s.sentence, s.seed) for s in stops] == [
        (2, "stopped", OLD.format(104), 7),
        (1, "collision", "stopped: contact with 12.0 N", 8),
    ]


def test_a_plan_without_a_reason_had_no_grasps():
    stops = stop_reasons(ROUNDS)
    assert [(s.policy, s.count, s.reason, s.sentence, s.seed) for s in stops] == [
        (policy, 1, "no_plan", "the planner returned no grasp", 1)
        for policy in ("heuristic", "random")
    ]
    why = replace(attempt("no_plan"), detail="abstained: the best quality is 0.3, under 0.5")
    (stop,) = stop_reasons([a_round("x", 2, 5, 0, [why], "no_plan")])
    assert stop.sentence == why.detail


def test_rounds_whose_last_objects_fell_off_are_told():
    fell = [a_round("heuristic", seed, 2, 1, [attempt("success")], "fell_off") for seed in (3, 4)]
    (stop,) = stop_reasons(fell)
    assert (stop.count, stop.reason, stop.seed) == (2, None, 3) and "fell off" in stop.sentence


def test_an_attempt_belongs_to_what_was_held_or_else_to_what_it_aimed_at():
    """Of three attempts at the mug one failed with the bowl in the hand; older files lack it."""
    at_mug = replace(attempt("success"), aimed="mug")
    missed = replace(attempt("missed"), aimed="mug")
    other = replace(attempt("slipped"), aimed="mug", held="bowl")
    rounds = [
        a_round("heuristic", 0, 5, 1, [at_mug, missed, other]),
        a_round("graspnet", 0, 5, 1, [missed, missed, replace(at_mug, aimed="box"), at_mug]),
        a_round("random", 0, 5, 0, [attempt("missed"), attempt("no_plan")], "no_plan"),
    ]
    mug, bowl = hardest_objects(rounds, 10)
    assert (mug.objects, mug.name, mug.failures) == ("box", "mug", 3)
    assert mug.outcomes == {"heuristic": (1, 2), "graspnet": (2, 3)}
    assert (bowl.name, bowl.outcomes) == ("bowl", {"heuristic": (1, 1)})
    assert hardest_objects(rounds, 1) == [mug] and hardest_objects(ROUNDS, 10) == []


# --- Two runs -----------------------------------------------------------------------------------


def a_run(folder, rounds, config=CONFIG):
    folder.mkdir()
    (folder / "config.yaml").write_text(dump_config(config))
    for record in rounds:
        append_round(folder / "rounds.jsonl", record)
    return folder


def test_two_runs_are_compared_on_their_common_scenes(tmp_path):
    """The second run clears 1 of 5 and 1 of 5 with 2 of 4 grasps, the first 2 of 5 and 1 of 5 with
    3 of 6; a third scene of the second run alone does not count."""
    after = [
        a_round("heuristic", 0, 5, 1, [attempt("success"), attempt("missed"), attempt("missed")]),
        a_round("heuristic", 1, 5, 1, [attempt("success"), attempt("no_plan")], "no_plan"),
        a_round("heuristic", 2, 5, 0, [attempt("missed"), attempt("missed")]),
    ]
    runs = a_run(tmp_path / "before", ROUNDS), a_run(tmp_path / "after", after)
    (pair,) = compare_runs(*runs)
    assert (pair.first, pair.second) == ("heuristic (before)", "heuristic (after)")
    assert (pair.scenario, pair.objects, pair.success.rounds) == ("pile", "box", 2)
    assert pair.success.value == pytest.approx(3 / 6 - 2 / 4)
    # Resamples: twice scene 0 (2/5 - 1/3), twice scene 1 (1/1 - 1/1), both (3/6 - 2/4).
    assert (pair.success.low, pair.success.high) == pytest.approx((0.0, 2 / 5 - 1 / 3))
    assert pair.cleared.value == pytest.approx(3 / 10 - 2 / 10)
    assert (pair.cleared.low, pair.cleared.high) == pytest.approx((0.0, 1 / 5))
    (back,) = compare_runs(*reversed(runs))
    assert back.cleared.value == pytest.approx(-pair.cleared.value)


@pytest.mark.parametrize("change", ["gripper.max_opening=0.06", "scene.count=3"])
def test_runs_of_other_scenes_are_not_compared(tmp_path, change):
    key = change.partition("=")[0]
    other = load_config(None, [change])
    runs = (
        a_run(tmp_path / "a", ROUNDS, load_config(None, [])), a_run(tmp_path / "b", ROUNDS, other)
    )  # fmt: skip
    section = key if key.startswith("gripper") else "scene"
    with pytest.raises(UserError, match=f"scenes do not match, because {section} differs"):
        compare_runs(*runs)


def test_runs_of_different_policies_are_compared_in_every_pair(tmp_path):
    other = [replace(record, policy="graspnet") for record in ROUNDS[:2]]
    runs = a_run(tmp_path / "a", ROUNDS), a_run(tmp_path / "b", other)
    names = [(pair.first, pair.second) for pair in compare_runs(*runs)]
    assert names == [("heuristic (a)", "graspnet (b)"), ("random (a)", "graspnet (b)")]


def test_runs_with_one_depth_noise_each_show_its_effect(tmp_path):
    noisy = [replace(record, depth_noise="kinect", objects_cleared=0) for record in ROUNDS[:2]]
    runs = a_run(tmp_path / "noisy", noisy), a_run(tmp_path / "clean", ROUNDS[:2])
    (pair,) = compare_runs(*runs)
    assert (pair.depth_noise, pair.cleared.value) == ("kinect - none", pytest.approx(-0.3))
    (same,) = compare_runs(a_run(tmp_path / "both", [*noisy, *ROUNDS[:2]]), runs[0])
    assert (same.depth_noise, same.cleared.value) == ("kinect", 0.0)


def test_the_rounds_of_an_older_run_have_the_noise_of_its_config(tmp_path):
    config = load_config(None, ["camera.depth_noise=kinect"])
    old, new = a_run(tmp_path / "old", ROUNDS[:2], config), a_run(tmp_path / "new", [])
    journal = (old / "rounds.jsonl").read_text()
    (old / "rounds.jsonl").write_text(journal.replace(', "depth_noise": "none"', ""))
    for record in ROUNDS[:2]:
        append_round(new / "rounds.jsonl", replace(record, depth_noise="kinect"))
    (pair,) = compare_runs(old, new)
    assert (pair.depth_noise, pair.cleared.value) == ("kinect", 0.0)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("scene: null", "scene is None, so that it is not the config of a run"),
        ("objects: [1]", r"objects is \[1\], so that"),
        ("sim: 3", "sim is 3, so that"),
        ("camera: none", "camera is 'none', so that"),
        ("seed: -5", "holds no seed"),
    ],
)
def test_a_damaged_config_is_named(tmp_path, line, message):
    whole, damaged = a_run(tmp_path / "whole", ROUNDS), a_run(tmp_path / "damaged", ROUNDS)
    text = "seed: 0\n" * (not line.startswith("seed")) + line
    (damaged / "config.yaml").write_text(text)
    with pytest.raises(UserError, match=f"damaged/config.yaml: {message}"):
        compare_runs(whole, damaged)


def test_runs_whose_scenes_do_not_match_are_refused(tmp_path):
    before = a_run(tmp_path / "before", ROUNDS)
    crowded = load_config(None, ["scene.count=15"])
    with pytest.raises(UserError, match="because scene differs in their configs"):
        compare_runs(before, a_run(tmp_path / "crowded", ROUNDS, crowded))
    finer = load_config(None, ["sim.frequency=480"])
    with pytest.raises(UserError, match="because sim.frequency differs in their configs"):
        compare_runs(before, a_run(tmp_path / "finer", ROUNDS, finer))
    drawn = load_config(None, ["sim.renderer=tiny"])
    assert compare_runs(before, a_run(tmp_path / "drawn", ROUNDS, drawn)), "the same scenes"
    later = [replace(record, seed=record.seed + 100_000) for record in ROUNDS]
    wide = load_config(None, ["gripper.opens_fully=true"])
    assert compare_runs(before, a_run(tmp_path / "wide", ROUNDS, wide)), "the same scenes"
    # What the hand can take decides which object is wanted.
    wanted = [replace(record, target_in_hand=True, scenario="retrieve") for record in ROUNDS]
    runs = a_run(tmp_path / "usual", wanted), a_run(tmp_path / "other hand", wanted, wide)
    with pytest.raises(UserError, match="because gripper differs in their configs"):
        compare_runs(*runs)
    with pytest.raises(UserError, match="no scene in common"):
        compare_runs(before, a_run(tmp_path / "later", later))
    with pytest.raises(UserError, match="not the folder of an evaluation"):
        compare_runs(before, tmp_path)


def test_rounds_of_several_object_sets_with_the_same_seeds_count_apart():
    """Together they are as many rounds as in both sets; `seed` is that of the bootstrap."""
    rng = np.random.default_rng(0)
    rounds, counts = [], {"random": [], "heuristic": []}
    for objects in ("box", "toys"):
        for policy in ("heuristic", "random"):
            for number in range(12):
                wins, tries = rng.integers(0, 4), 5
                made = [attempt("success")] * wins + [attempt("missed")] * (tries - wins)
                record = a_round(policy, number, 5, wins, made)
                rounds.append(replace(record, objects=objects))
                counts[policy].append((wins, tries))
    together = compare(rounds, seed=7)[-1]
    assert (together.scenario, together.objects) == ("pile", "box + toys")
    expected = paired_difference_interval(*counts.values(), seed=7)
    assert together.success == expected and expected.rounds == 24
    assert expected != paired_difference_interval(*counts.values(), seed=0)
    # In the order in which busy workers may have finished them, too.
    in_a_row = [*rounds[12:24], *rounds[::-1]]
    assert compare(in_a_row, seed=7, pairs=[("random", "heuristic")])[-1].success == expected


def test_picks_to_a_target_are_a_mean():
    rounds = [
        replace(
            a_round(
                "heuristic", seed, 9, picks, [attempt("success")] * picks, "target", "retrieve"
            ),
            target_in_hand=True,
        )
        for seed, picks in enumerate((1, 2, 6))
    ]
    (row,) = summarise(rounds, seed=0)
    assert row.picks_to_target == 3.0


def test_planning_takes_time_without_a_success_too():
    missed = [attempt("missed", plan=seconds) for seconds in (0.01, 0.01, 0.01, 2.0, 3.0)]
    (row,) = summarise([a_round("x", 0, 5, 0, missed)], seed=0)
    assert row.plan_ms_median == pytest.approx(10) and row.picks_per_hour is None
    (row,) = summarise([a_round("x", 0, 5, 0, missed[1:])], seed=0)
    assert row.plan_ms_median is None  # half of them are the first of a worker


def test_a_success_needs_no_reason():
    seen = [replace(attempt("success"), detail="a second look showed 20 cm3")]
    assert stop_reasons([a_round("x", 0, 5, 1, seen)]) == []
