"""When bodies of a MuJoCo model count as resting, and friction where scenes are laid out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from envs.mujoco_bodies import MujocoTable, settle
from utils.config import load_config


@pytest.mark.parametrize(
    ("rates", "rested"),
    [([1.2, 0.08, 1.3] * 4 + [0.05] * 5, True), ([1.2, 0.08, 1.3] * 20, False)],
    ids=["comes to rest", "rocks"],
)
def test_a_body_that_turns_round_while_it_rocks_does_not_rest(rates, rested):
    """Turn rates in rad/s, 0.05 s apart; a body counts as resting below 0.1 rad/s."""
    config = load_config(None, [f"scene.settle_seconds={0.05 * len(rates)}"])
    data, left = SimpleNamespace(qvel=np.zeros(12)), iter(rates)

    def step(count: int) -> None:
        assert count == 12
        data.qvel[10] = next(left)

    assert settle(data, [0, 6], config, step) == rested
    assert not list(left)


@pytest.mark.parametrize("frequency", [60, 240, 2000])
def test_rest_is_counted_in_seconds(frequency):
    """Five checks in a row, 0.05 s apart, however many steps that are."""
    config, taken = load_config(None, [f"sim.frequency={frequency}"]), []
    assert settle(SimpleNamespace(qvel=np.zeros(6)), [0], config, taken.append)
    assert sum(taken) / frequency == pytest.approx(0.25)


def test_frictions_where_scenes_are_laid_out_are_pybullets(box_set):
    """PyBullet multiplies: an object's 0.3 by the table's 1, and by another's 0.3."""
    box = replace(box_set[0], friction=0.3)
    with MujocoTable(load_config(), [box, box]) as table:
        for side in (-0.1, 0.1):
            table.put(box, np.array([0.5, side, 0.05]), np.array([0.0, 0.0, 0.0, 1.0]))
        model = table._model
        assert model.npair == 2
        assert model.pair_friction[:, :2] == pytest.approx(0.3)
        things = [model.body(name).geomadr[0] for name in ("body0", "body1")]
        assert model.geom_friction[things, 0] == pytest.approx(0.09)
