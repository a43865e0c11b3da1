"""Planners on scenes whose best grasp is known by construction."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from models.planner_candidates import Candidates
from models.planners import PLANNERS, make_planner, needs_truth, reset_planner
from tests.helpers.box_frames import bin_walls, boxes_frame
from utils.errors import UserError
from utils.geometry import ConvexSolid, GripperGeometry, Workspace
from utils.grasp_labels import dense_labels
from utils.runs import REPOSITORY
from utils.transforms import Grasp, RGBDFrame, angle_difference

HAND = GripperGeometry()
DELIBERATE = ("heuristic", "oracle")


def planner(name: str, seed: int = 0):
    return make_planner(name, GripperGeometry(), Workspace(), seed)


def test_unknown_planner_is_refused_with_the_allowed_names() -> None:
    allowed = "graspnet6d, graspnet_direct, heuristic, heuristic6d, module:name, oracle, oracle6d"
    with pytest.raises(ValueError, match=f"'grasp'.*{allowed}, random"):
        planner("grasp")


@pytest.mark.parametrize("name", ["ppo", "ppo:mine.pt", "sb3:mine.zip"])
def test_a_policy_that_acts_is_no_planner(name: str) -> None:
    with pytest.raises(UserError, match=f"planner: {name} is a policy.* evaluate.policies={name}"):
        planner(name)


def test_a_candidates_opening_changes_without_its_width() -> None:
    rough = Candidates.rough(
        np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.full(2, 0.04), np.ones(2)
    )
    rough.opening[0] = 0.08
    assert rough.width.tolist() == [0.04, 0.04] and rough.opening.tolist() == [0.08, 0.04]


def grasp_of_the_middle(frame: RGBDFrame) -> list[Grasp]:
    """A planner of one's own as a plain function."""
    return [Grasp(frame.truth.objects[0].centre_of_mass, 0.0, 0.06, 1.0)]


class WithMemory:
    """A planner of one's own that knows the cell and is prepared for each scene."""

    needs_truth = True

    def __init__(self, gripper, workspace, seed):
        self.gripper, self.workspace = gripper, workspace
        self.reset(seed)

    def reset(self, seed):
        self.seed = seed

    def __call__(self, frame):
        return [Grasp((*self.workspace.centre, 0.03), 0.0, self.gripper.max_opening, self.seed)]


def test_a_planner_of_ones_own_is_made_by_its_import_path() -> None:
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.0, (0.5, 0.0))])
    function = planner("tests.test_planners:grasp_of_the_middle")
    assert function(frame)[0].position[2] == pytest.approx(0.025)
    assert not needs_truth(function)
    reset_planner(function, 3)  # nothing to prepare
    made = planner("tests.test_planners:WithMemory", seed=5)
    assert needs_truth(made) and made(frame)[0].quality == 5
    assert made(frame)[0].width == GripperGeometry().max_opening
    reset_planner(made, 7)
    assert made(frame)[0].quality == 7


def make_one(gripper, workspace, seed):
    """A function that makes a planner."""
    return WithMemory(gripper, workspace, seed) if seed else 3


def test_a_function_with_the_three_parameters_makes_the_planner() -> None:
    assert planner("tests.test_planners:make_one", seed=5).seed == 5
    with pytest.raises(UserError, match="make_one' made a int, expected a planner"):
        planner("tests.test_planners:make_one", seed=0)
    with pytest.raises(UserError, match="'pathlib:PurePath' raised TypeError: .*; it is called"):
        planner("pathlib:PurePath")


def sees_nothing(frame):
    return []


sees_nothing.calibration = 3


def test_what_is_no_calibration_is_refused_before_any_work() -> None:
    with pytest.raises(UserError, match=r"`calibration` of .*sees_nothing' is 3, expected a utils"):
        planner("tests.test_planners:sees_nothing")


def test_oracle_without_truth_says_what_is_missing() -> None:
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.0, (0.5, 0.0))])
    with pytest.raises(ValueError, match="frame.truth"):
        planner("oracle")(frame.without_truth())


@pytest.mark.parametrize("name", DELIBERATE)
@pytest.mark.parametrize("degrees", [*range(0, 180, 15), 5, 85, 95, 175, 178, 182, 270, 355])
def test_a_box_is_grasped_across_its_short_side(name: str, degrees: int) -> None:
    yaw = np.deg2rad(degrees)
    frame = boxes_frame([((0.04, 0.10, 0.05), yaw, (0.52, -0.04))])
    best = planner(name)(frame)[0]
    assert np.rad2deg(angle_difference(best.angle, yaw)) < 5
    assert np.linalg.norm(best.position[:2] - (0.52, -0.04)) < 0.003
    # 5 cm high: the tips, 7.2 mm below the position, stay off the table and reach under the middle.
    assert 0.003 < best.position[2] - 0.0072 < 0.025
    assert 0.04 < best.width <= 0.08


@pytest.mark.parametrize("name", DELIBERATE)
def test_no_finger_goes_into_a_one_centimetre_gap(name: str) -> None:
    frame = boxes_frame(
        [((0.04, 0.06, 0.05), 0.0, (0.475, 0.0)), ((0.04, 0.06, 0.05), 0.0, (0.525, 0.0))]
    )
    grasps = planner(name)(frame)
    assert grasps
    for grasp in grasps:
        for side in (-1, 1):
            finger = grasp.position + side * (grasp.width / 2 + 0.007) * grasp.closing_direction
            in_gap = abs(finger[0] - 0.5) < 0.012 and abs(finger[1]) < 0.03
            assert not in_gap or grasp.position[2] - 0.0072 > 0.05


@pytest.mark.parametrize("name", DELIBERATE)
@pytest.mark.parametrize(("gap", "height"), [(0.01, 0.045), (0.035, 0.075)])
def test_no_finger_goes_into_a_narrow_gap_at_a_wall_and_none_grasps_the_wall(
    name: str, gap: float, height: float
) -> None:
    """A finger is 14 mm thick: beside a wall 10 mm away it closes along the wall, which is 10 cm
    high. Beside one 35 mm away there is room on all sides, and at the top of the wall as well."""
    box = ((0.045, 0.06, height), 0.0, (0.5 + 0.15 - gap - 0.0225, 0.0))
    free = planner(name)(boxes_frame([box]))
    assert any(abs(grasp.closing_direction[0]) > 0.9 for grasp in free)
    grasps = planner(name)(boxes_frame([box, *bin_walls()], walls=4))
    assert grasps
    for grasp in grasps:
        assert np.abs(grasp.position[:2] - box[2]).max() < 0.03
        assert gap > 0.02 or abs(grasp.closing_direction[1]) > 0.9


@pytest.mark.parametrize("name", DELIBERATE)
def test_beside_a_wall_the_hand_stands_off_the_centre(name: str) -> None:
    """The palm reaches 104 mm along the closing line, 46 mm over the tips: too far over the middle
    of a bar that lies 92 mm from a wall of 100 mm. Each finger opens by 40 mm."""
    bar = ((0.02, 0.12, 0.04), 0.0, (0.5 + 0.15 - 0.092, 0.0))
    grasps = planner(name)(boxes_frame([bar, *bin_walls()], walls=4))
    assert grasps
    for grasp in grasps:
        reach = abs(grasp.closing_direction[0])
        assert reach > 0.8 and grasp.position[0] + 0.104 * reach < 0.65
        beside = abs(bar[2][0] - grasp.position[0])
        assert 0.005 < beside < grasp.width / 2 - 0.01  # the bar is between the pads


@pytest.mark.parametrize("opens_fully", [False, True])
@pytest.mark.parametrize(("apart", "free"), [(0.071, False), (0.090, True)])
def test_a_hand_off_the_centre_looks_where_its_far_finger_goes(opens_fully, apart, free) -> None:
    """The bar of the test before, and on its other side a block as high, too wide to be grasped.
    20 mm off the centre, the outer edge of the far finger is 74 mm from the bar's middle."""
    x = 0.5 + 0.15 - 0.092
    bar, block = (0.02, 0.12, 0.04), (0.09, 0.20, 0.043)
    scene = [(bar, 0.0, (x, 0.0)), (block, 0.0, (x - apart - block[0] / 2, 0.0))]
    hand = GripperGeometry(opens_fully=opens_fully)
    plan = make_planner("heuristic", hand, Workspace(), 0)
    assert bool(plan(boxes_frame([*scene, *bin_walls()], walls=4))) == free


@pytest.mark.parametrize(("apart", "free"), [(0.015, False), (0.030, True)])
def test_a_hand_that_opens_fully_stands_off_the_centre_beside_a_block(apart, free) -> None:
    """A bar 30 mm wide between fingers 80 mm apart has 25 mm of room on each side. A block as high
    on one side, 30 mm away, leaves a finger that is 14.5 mm thick room only off the centre, and one
    15 mm away none."""
    bar, block = (0.03, 0.12, 0.03), (0.10, 0.20, 0.03)
    beside = bar[0] / 2 + apart + block[0] / 2
    frame = boxes_frame([(bar, 0.0, (0.5, 0.0)), (block, 0.0, (0.5 + beside, 0.0))])
    hand = GripperGeometry(opens_fully=True)
    grasps = make_planner("heuristic", hand, Workspace(), 0)(frame)
    assert bool(grasps) == free
    for grasp in grasps:
        assert 0.5 - grasp.position[0] > 0.009 and grasp.width == 0.08


@pytest.mark.parametrize("degrees", [0, 35, 90])
def test_a_flat_stick_is_held_below_its_top_and_above_the_table(degrees: int) -> None:
    """7 mm high: the usual margins leave no room for fingers, so relaxed ones serve."""
    stick = ((0.006, 0.06, 0.007), np.deg2rad(degrees), (0.5, 0.0))
    best = planner("heuristic")(boxes_frame([stick]))[0]
    assert 0.001 < best.position[2] - 0.0072 < 0.0045
    assert np.linalg.norm(best.position[:2] - (0.5, 0.0)) < 0.012


@pytest.mark.parametrize("name", PLANNERS)
def test_an_empty_table_has_nothing_to_grasp(name: str) -> None:
    assert planner(name)(boxes_frame([])) == []


@pytest.mark.parametrize("name", DELIBERATE)
@pytest.mark.parametrize("degrees", [0, 20, 45])
def test_a_box_wider_than_the_gripper_is_left_alone(name: str, degrees: int) -> None:
    frame = boxes_frame([((0.09, 0.10, 0.05), np.deg2rad(degrees), (0.5, 0.0))])
    assert planner(name)(frame) == []


@pytest.mark.parametrize("high, grasped", [(0.010, False), (0.014, True)])
def test_a_critic_alone_holds_no_wide_box_by_a_low_flange(monkeypatch, high, grasped) -> None:
    """The fingers reach 4 or 8 mm below the top of a flange. Its one side is upright and the other
    leans by 55 degrees: no contacts are antipodal, and the pads do not slip off, as the faces rise
    by 27.5 degrees on average. A critic that calls everything certain decides."""
    monkeypatch.setattr("models.planners.shipped_critic", lambda: SimpleNamespace(
        chance=lambda inputs: np.ones(len(inputs.facts))
    ))  # fmt: skip
    frame, lean = boxes_frame([((0.10, 0.10, 0.05), 0.0, (0.5, 0.0))]), np.tan(np.deg2rad(55))
    (box,), width = frame.truth.objects, 0.008
    profile = [(0.0, 0.05), (0.0, 0.05 + high), (width, 0.05 + high), (width + lean * high, 0.05)]
    corners = [(0.48 + x, y, z) for x, z in profile for y in (-0.04, 0.04)]
    flange = ConvexSolid.from_vertices(np.array(corners))
    whole = replace(box, solids=(*box.solids, flange))
    frame = replace(frame, truth=replace(frame.truth, objects=(whole,)))
    assert bool(planner("oracle")(frame)) == grasped


@pytest.mark.parametrize("name", DELIBERATE)
def test_a_wider_hand_grasps_a_wider_box(name: str) -> None:
    hand = replace(HAND, max_opening=0.10)
    frame = boxes_frame([((0.088, 0.12, 0.05), 0.0, (0.5, 0.0))])
    assert planner(name)(frame) == []
    best = make_planner(name, hand, Workspace(), 0)(frame)[0]
    assert 0.088 < best.width <= 0.10
    middle = [dense_labels(frame, gripper, Workspace()).width[:, 111, 111].max()
              for gripper in (hand, HAND)]  # fmt: skip
    assert 0.088 < middle[0] <= 0.10 and middle[1] == 0


@pytest.mark.parametrize("name", ("random", "heuristic"))
def test_unprivileged_planners_do_not_use_the_truth(name: str) -> None:
    frame = boxes_frame(
        [((0.04, 0.10, 0.05), 0.3, (0.45, 0.0)), ((0.03, 0.03, 0.08), 1.0, (0.55, 0.05))]
    )
    described = [repr(planner(name)(seen)) for seen in (frame, frame.without_truth())]
    assert not needs_truth(PLANNERS[name]) and described[0] == described[1]


def test_random_follows_its_own_seed() -> None:
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.3, (0.45, 0.0))])
    plan = planner("random", 3)
    first, second = repr(plan(frame)), repr(plan(frame))
    reset_planner(plan, 3)
    assert first == repr(plan(frame)) and first != second
    for grasp in plan(frame):
        assert grasp.position[2] >= 0.004 + 0.0072 - 1e-9


@pytest.mark.parametrize("name", DELIBERATE)
def test_ranking_is_sorted_and_distinct(name: str) -> None:
    frame = boxes_frame(
        [((0.04, 0.10, 0.05), 0.3, (0.45, 0.0)), ((0.03, 0.03, 0.08), 1.0, (0.55, 0.05))]
    )
    grasps = planner(name)(frame)
    assert 2 <= len(grasps) <= 20
    qualities = [grasp.quality for grasp in grasps]
    assert qualities == sorted(qualities, reverse=True)
    for i, a in enumerate(grasps):
        for b in grasps[:i]:
            apart = np.linalg.norm(a.position[:2] - b.position[:2])
            assert apart >= 0.01 or angle_difference(a.angle, b.angle) >= np.deg2rad(20) - 1e-9


@pytest.mark.parametrize("name", ["heuristic", "graspnet"])
def test_a_crumb_is_nothing_to_grasp(name: str) -> None:
    """4 mm x 6 mm x 12 mm: smaller than what counts as an object in a depth image."""
    assert planner(name)(boxes_frame([((0.004, 0.006, 0.012), 0.0, (0.5, 0.0))])) == []


def printed_without_a_simulator(code: str, folder: Path) -> str:
    """What a program prints in a process of its own, which may import no simulator."""
    check = f"{code}\nassert not {{'pybullet', 'mujoco', 'envs'}} & set(sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", check], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_planners_run_on_a_bare_frame_without_a_simulator(tmp_path) -> None:
    """A script of one's own that has the image of a box: depth, colours, K and T_WC alone."""
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.3, (0.5, 0.0))])
    files = {"depth": frame.depth, "rgb": frame.rgb, "K": frame.K, "T_WC": frame.T_WC}
    np.savez(tmp_path / "frame.npz", **files)
    names = [name for name, kind in PLANNERS.items() if not needs_truth(kind)]
    check = (
        "import sys; import numpy as np\n"
        "from models.planners import make_planner\n"
        "from utils.geometry import GripperGeometry, Workspace\n"
        "from utils.transforms import RGBDFrame\n"
        "frame = RGBDFrame(**np.load('frame.npz'))\n"
        f"for name in {names}:\n"
        "    assert make_planner(name, GripperGeometry(), Workspace(), seed=0)(frame), name"
    )
    printed_without_a_simulator(check, tmp_path)
    assert {"heuristic", "graspnet", "heuristic6d", "graspnet6d"} <= set(names)


def test_the_planner_of_the_docs_runs_without_a_simulator(tmp_path, monkeypatch) -> None:
    """Its box is 4 cm wide along the image's rows, which run along the world's x axis."""
    text = (REPOSITORY / "docs" / "planner.md").read_text(encoding="utf-8")
    code = text.split("```python\n")[1].split("```")[0]
    (tmp_path / "top_object.py").write_text(code, encoding="utf-8")
    check = "import runpy, sys; runpy.run_path('top_object.py', run_name='__main__')"
    printed = printed_without_a_simulator(check, tmp_path)
    assert printed.split() == ["[0.5", "0.", "0.037]", "0", "degrees"]
    monkeypatch.syspath_prepend(tmp_path)
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.4, (0.5, 0.0))])
    best = planner("top_object:TopObject")(frame)[0]
    assert np.rad2deg(angle_difference(best.angle, 0.4)) < 3
