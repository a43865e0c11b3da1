"""The transfer report: its figures by hand, its table, its picture."""

import json
from io import BytesIO

import imageio.v3 as iio
import numpy as np
import pytest

from utils.config_schema import TransferPolicy
from utils.result_records import AttemptRecord, RoundRecord
from utils.statistics import clustered_interval, wilson_interval
from utils.transfer import (
    Column,
    Score,
    TransferLine,
    agreements,
    draw_transfer,
    format_transfer,
    score_of,
    transfer_content,
    transfer_notes,
)

COLUMNS = {
    "pybullet": Column("PyBullet"),
    "mujoco": Column("MuJoCo", simulation="pybullet"),
    "cornell": Column("Cornell photographs", if_empty="add transfer.cornell=path/to/cornell"),
}


def round_of(policy: str, *reasons: str) -> RoundRecord:
    attempts = tuple(AttemptRecord(r == "success", r, 0.01, 5.0) for r in reasons)
    cleared = sum(attempt.success for attempt in attempts)
    ended = "no_plan" if reasons[-1] == "no_plan" else "cleared"
    return RoundRecord(policy, "pile", "box", 0, 5, cleared, attempts, ended)


def test_a_score_counts_executed_grasps():
    rounds = [
        round_of("a", "success", "missed", "success"),
        round_of("a", "success", "no_plan"),
        round_of("b", "missed"),
    ]
    assert score_of(rounds, "a") == Score(3, 4, ((2, 3), (1, 1)))
    assert score_of(rounds, "c") == Score(0, 0, ()) and score_of(rounds, "c").ci95 == (0, 1)


def test_the_grasps_of_one_scene_are_not_taken_as_independent():
    """Half of the scenes succeed as a whole, so that 20 grasps tell no more than 4 scenes do."""
    rounds = [round_of("a", *[reason] * 5) for reason in ("success", "missed") * 2]
    low, high = score_of(rounds, "a").ci95
    assert (low, high) == clustered_interval([(5, 5), (0, 5)] * 2)
    assert high - low > np.subtract(*wilson_interval(10, 20)[::-1]) + 0.2
    assert Score(10, 20).ci95 == wilson_interval(10, 20)


@pytest.fixture
def lines():
    """Three policies in two columns, a network on photographs, and one that is not trained."""

    def line(name, training, **scores):
        return TransferLine(TransferPolicy(name, training, name, None, None), "pile", scores)

    missing = TransferPolicy("net", "physics", "runs/none.pt", None, "python train.py --weights x")
    return [
        line("blind", "-", pybullet=Score(20, 100), mujoco=Score(10, 100)),
        line("good", "-", pybullet=Score(80, 100), mujoco=Score(90, 100)),
        line("net", "vision", pybullet=Score(90, 100), mujoco=Score(85, 100), cornell=Score(4, 8)),
        TransferLine(missing, "pile", {}, trained=False),
    ]


def test_columns_agree_as_far_as_they_do(lines):
    (one,) = agreements(lines, COLUMNS)
    assert (one.real, one.simulation, one.policies) == ("mujoco", "pybullet", 3)
    assert one.pearson_r == pytest.approx(np.corrcoef([20, 80, 90], [10, 90, 85])[0, 1])
    # "good" and "net" change places; in MuJoCo they differ by 0.05.
    assert one.mmrv == pytest.approx((0 + 0.05 + 0.05) / 3)


def test_policies_are_compared_on_the_same_scenes_alone(lines):
    """One more policy, on other scenes, has no policy to be compared with; two more have."""

    def boxes(name, *rates):
        scores = {column: Score(n, 100) for column, n in zip(("pybullet", "mujoco"), rates)}
        who = TransferPolicy(name, "-", name, ("isolated", "box"), None)
        return TransferLine(who, "isolated of box", scores)

    with_one = [*lines, boxes("a", 100, 0)]
    assert agreements(with_one, COLUMNS) == agreements(lines, COLUMNS)
    piles, alone = agreements([*with_one, boxes("b", 50, 50)], COLUMNS)
    assert piles == agreements(lines, COLUMNS)[0]
    assert (alone.scenes, alone.policies) == ("isolated of box", 2)
    assert alone.pearson_r == pytest.approx(-1.0)
    assert alone.mmrv == pytest.approx(0.5)  # the two, 0.5 apart, change places


def test_the_table_says_what_is_missing(lines):
    table = format_transfer(lines, COLUMNS).splitlines()
    assert "80 % [71, 87] 80/100" in table[3]
    assert "50 % [22, 78] 4/8" in table[4] and "not trained" in table[5]
    notes = transfer_notes(lines, COLUMNS)
    assert any("python train.py --weights x" in note for note in notes)
    assert not any("transfer.cornell" in note for note in notes)
    assert any("transfer.cornell" in note for note in transfer_notes(lines[:2], COLUMNS))


def test_a_rate_below_one_is_not_printed_as_100_percent(lines):
    scores = {"pybullet": Score(249, 250)}
    table = format_transfer([TransferLine(lines[0].row, "pile", scores)], COLUMNS)
    assert "99.6 % [98, 100] 249/250" in table and "100 %" not in table


def test_results_and_picture(lines):
    content = json.loads(json.dumps(transfer_content(lines, COLUMNS), allow_nan=False))
    assert content["rows"][1]["columns"]["mujoco"]["success_rate"] == 0.9
    assert content["rows"][3]["trained"] is False
    assert content["agreement"][0]["policies"] == 3


def test_the_picture_has_one_panel_more_for_each_column(lines):
    sizes = []
    for names in (("pybullet",), ("pybullet", "mujoco"), tuple(COLUMNS)):
        columns = {name: COLUMNS[name] for name in names}
        picture = iio.imread(BytesIO(draw_transfer(lines, columns)))
        assert picture.std() > 10, "not an empty sheet"
        sizes.append(picture.shape)
    for before, after in zip(sizes, sizes[1:]):
        assert after[1] > before[1] + 150 and after[0] == before[0]
