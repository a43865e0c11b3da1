"""`utils.random_streams`: no two draws from one seed share random numbers."""

import numpy as np

from envs.cell_scenes import LAYOUTS
from models.planners import make_planner
from tests.helpers.box_frames import boxes_frame
from utils.geometry import GripperGeometry, Workspace
from utils.random_streams import Stream, planner_seed


def first_numbers(*key: int) -> tuple[float, ...]:
    return tuple(np.random.default_rng(key).random(3))


def test_numpy_fills_keys_up_with_zeros() -> None:
    """Why `Stream` begins at 1: the trap that it is there for."""
    assert first_numbers(5) == first_numbers(5, 0) == first_numbers(5, 0, 0)


def test_no_two_draws_from_one_seed_are_alike() -> None:
    keys = [(5, layout) for layout in range(len(LAYOUTS))]
    keys += [(5, stream) for stream in Stream if stream >= Stream.SIDE_VIEW]
    keys += [(5, frame, stream) for frame in range(20) for stream in Stream]
    assert len({first_numbers(*key) for key in keys}) == len(keys)


def test_a_random_planner_draws_other_numbers_than_the_scene() -> None:
    """An isolated scene takes its object, as a random planner its pixel, with the first number."""
    frame = boxes_frame([((0.06, 0.06, 0.05), 0.0, (0.5, 0.0))])
    points = frame.points().reshape(-1, 3)
    top = np.sort(points[points[:, 2] > 0.02][:, 0])
    ranks = []
    for seed in range(200):
        plan = make_planner("random", GripperGeometry(), Workspace(), 0)
        plan.reset(planner_seed(seed))
        rank = np.searchsorted(top, plan(frame)[0].position[0]) / len(top)
        scene = np.random.default_rng([seed, LAYOUTS.index("isolated")])
        ranks.append((rank, scene.integers(900)))
    # 0.999 with the same stream; 200 independent pairs exceed 0.25 once in 3000 times.
    assert abs(np.corrcoef(np.transpose(ranks))[0, 1]) < 0.25
