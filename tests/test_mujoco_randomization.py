"""What randomised parameters do in MuJoCo, by closed forms; skipped where MuJoCo is missing."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason='MuJoCo is optional: pip install "mujoco>=3.12,<4"')

import mujoco

from envs.cell_layout import Placement, Scene
from envs.cell_scenes import make_scene
from envs.mujoco_bodies import wake
from envs.mujoco_cell import MujocoCell
from envs.mujoco_randomization import MujocoRandomizable, restitution_of

G = 9.81


@pytest.fixture(scope="module")
def built(config, box_set):
    with MujocoCell(config) as cell:
        cell.scene_of_a_box = make_scene("isolated", box_set, 0, config)
        yield cell


@pytest.fixture
def cell(built):
    """A cell with the cube (0.1 kg, 6 cm, friction 0.5) at rest on the table."""
    built.build(built.scene_of_a_box)
    put(built, 0.03)
    return built


def put(cell: MujocoCell, height: float) -> None:
    """The cube at rest with its centre at a height."""
    T_WO = np.eye(4)
    T_WO[:3, 3] = 0.5, 0.0, height
    cell.carry(0, T_WO, np.zeros(3), 0.0)


def apply(cell: MujocoCell, **changes) -> MujocoRandomizable:
    scene = cell.randomizable()
    scene.apply(changes)
    return scene


def normal_force(cell: MujocoCell) -> float:
    """N between the cube and the table."""
    robot = cell.robot
    pairs = robot._contacts_between(cell.bodies[0], robot.model.body("table").id)
    return sum(robot._normal_force(number) for number, _ in pairs)


@pytest.mark.parametrize(
    ("own", "table"), [(1.0, 1.0), (1.3, 0.8), (0.7, 1.2), (0.7, 0.8), (1.0, 0.5)]
)
def test_a_box_slides_where_the_tilt_exceeds_the_product_of_the_frictions(cell, own, table):
    """Coulomb: it slides as g (sin a - mu cos a) t^2 / 2, or not at all."""
    mu = own * 0.5 * table
    seconds = 0.25
    for tangent, slides in ((0.85 * mu, False), (1.3 * mu, True)):
        cell.build(cell.scene)
        put(cell, 0.03)
        apply(cell, object_friction=("scale", [own]), table_friction=("scale", table))
        cell.step(24)
        start, angle = cell.object_position(0), np.arctan(tangent)
        cell.robot.model.opt.gravity[:] = G * np.sin(angle), 0, -G * np.cos(angle)
        wake(cell.robot.model, cell.robot.data, cell.bodies)
        cell.step(round(seconds / cell.dt))
        way = cell.object_position(0)[0] - start[0]
        expected = G * (np.sin(angle) - mu * np.cos(angle)) * seconds**2 / 2
        assert way == pytest.approx(expected if slides else 0.0, rel=0.1, abs=1e-3)


def test_finger_friction_counts_between_fingers_alone(cell):
    """What the fingers carry, 2 mu F of 10 N each, against the weight of 0.1 kg at 60 m/s^2."""
    held = {}
    for finger in (1.0, 0.5):
        cell.build(cell.scene)
        apply(cell, finger_friction=("scale", finger), gravity=("set", 0.0))
        T_WO = cell.robot.tip_pose()
        T_WO[:3, :3] = np.eye(3)
        cell.carry(0, T_WO, np.zeros(3), 0.0)
        cell.robot.command_gripper(0.0, force=10.0)
        cell.step(120)
        assert cell.robot.holds(cell.bodies[0])
        before = cell.object_position(0)[2]
        apply(cell, finger_friction=("scale", finger), gravity=("set", -60.0))
        cell.step(12)
        held[finger] = before - cell.object_position(0)[2]
    # 10 N carry 6 N; beside 5 N there is 1 N left, which speeds the cube up by 10 m/s^2.
    assert held[1.0] < 2e-3
    assert held[0.5] == pytest.approx(10 * 0.05**2 / 2, rel=0.1)


def test_gravity_and_free_fall(cell):
    apply(cell, gravity=("add", -3.0))
    put(cell, 0.4)
    cell.step(48)
    assert 0.4 - cell.object_position(0)[2] == pytest.approx((G + 3.0) * 0.2**2 / 2, rel=0.01)


def test_a_heavier_object_weighs_more_on_the_table(cell):
    cell.robot.model.opt.enableflags = 0  # a sleeping cube has no contacts
    for factor in (0.5, 1.0, 2.0):
        apply(cell, object_mass=("scale", [factor]))
        cell.step(120)
        assert normal_force(cell) == pytest.approx(factor * 0.1 * G, rel=1e-3)


def test_a_heavier_object_is_harder_to_turn(cell):
    """A torque about the vertical for 50 ms in free fall: w = T t / I, of a cube m a^2 / 6."""
    torque, robot = 1e-4, cell.robot
    for factor in (0.5, 1.0, 2.0):
        apply(cell, object_mass=("scale", [factor]))
        put(cell, 0.5)
        robot.data.xfrc_applied[cell.bodies[0], 5] = torque
        cell.step(12)
        robot.data.xfrc_applied[:] = 0
        rate = robot.data.qvel[robot.model.joint("object0").dofadr[0] + 5]
        assert rate == pytest.approx(torque * 0.05 / (factor * 0.1 * 0.06**2 / 6), rel=1e-3)


@pytest.mark.parametrize("restitution", [0.08, 0.3, 0.6, 0.9])
def test_restitution_is_the_speed_after_over_the_speed_before(cell, restitution):
    apply(cell, restitution=("set", [restitution]))
    put(cell, 0.03 + 0.2)
    speeds = []
    for _ in range(90):
        cell.step()
        speeds.append(cell.robot.data.qvel[cell.robot.model.joint("object0").dofadr[0] + 2])
    # Speeds are read 4.2 ms apart, in which a free body gains 0.04 m/s.
    assert max(speeds) / -min(speeds) == pytest.approx(restitution, abs=0.03)


def test_the_formula_of_restitution():
    """Without damping all of the speed comes back; critically damped, exp(-2); and small ratios
    as of a spring that also pulls, exp(-pi ratio)."""
    assert restitution_of(0.0) == pytest.approx(1.0)
    assert restitution_of(1.0) == pytest.approx(np.exp(-2))
    assert restitution_of(1 - 1e-9) == pytest.approx(restitution_of(1 + 1e-9), rel=1e-4)
    assert restitution_of(0.001) == pytest.approx(np.exp(-0.001 * np.pi), rel=1e-5)
    ratios = [restitution_of(ratio) for ratio in np.linspace(0, 3, 50)]
    assert (np.diff(ratios) < 0).all()


@pytest.mark.parametrize(
    ("own", "change", "expected", "dimensions"),
    [(1e-3, ("scale", [2.0]), 2e-3, {6}), (0.0, ("scale", [2.0]), 1e-4, {3, 4}),
     (0.0, ("set", [3e-3]), 3e-3, {6}), (1e-3, ("set", [0.0]), 0.0, {3, 4})],
)  # fmt: skip
def test_rolling_friction_in_every_contact_of_an_object(
    built, box_set, own, change, expected, dimensions
):
    """An object without it keeps none where it is scaled; MuJoCo's 1e-4 has no effect in contacts
    of three or four dimensions, which have no rolling friction."""
    model = replace(box_set[0], rolling_friction=own)
    at = Placement(model, np.array([0.5, 0.0, 0.03]), np.eye(4)[3])
    built.build(Scene("isolated", 0, (at,)))
    model = built.robot.model
    scene = apply(built, rolling_friction=change)
    shapes = model.geom_bodyid == built.bodies[0]
    assert (model.geom_friction[shapes, 2] == expected).all()
    assert (model.pair_friction[:, 3:] == expected).all()
    assert {*model.pair_dim, *model.geom_condim[shapes]} == dimensions
    scene.apply({})
    assert {*model.pair_dim, *model.geom_condim[shapes]} == ({6} if own else {3, 4})


@pytest.mark.parametrize("change", [("scale", [0.5]), ("set", [0.25]), ("add", [-0.25])])
def test_friction_of_an_object_changes_in_every_contact(cell, change):
    """The cube's is 0.5 and becomes 0.25: half of that on tray, palm and arm, its square on another
    cube."""
    model = cell.robot.model
    scene = apply(cell, object_friction=change)
    whole = {"table", "panda_leftfinger", "panda_rightfinger"}
    for pair, ends in enumerate(zip(model.pair_geom1, model.pair_geom2)):
        names = {model.body(model.geom_bodyid[end]).name for end in ends}
        expected = 0.25 if names & whole else 0.125
        assert model.pair_friction[pair, :2] == pytest.approx(expected), names
    assert model.geom_friction[model.geom_bodyid == cell.bodies[0], 0] == pytest.approx(0.0625)
    scene.apply({})


def test_spinning_friction_brakes_what_turns_between_the_fingers(cell):
    """The model's own numbers: torsional friction of pairs with fingers, not with the table."""
    model = cell.robot.model
    before = model.pair_friction.copy()
    scene = apply(cell, spinning_friction=("scale", 2.0))
    fingers = [model.body(name).id for name in ("panda_leftfinger", "panda_rightfinger")]
    ours = np.isin(model.geom_bodyid[model.pair_geom2], fingers) | np.isin(
        model.geom_bodyid[model.pair_geom1], fingers
    )
    assert ours.any() and not ours.all()
    np.testing.assert_array_equal(model.pair_friction[ours, 2], 2 * before[ours, 2])
    np.testing.assert_array_equal(model.pair_friction[~ours], before[~ours])
    scene.apply({})
    np.testing.assert_array_equal(model.pair_friction, before)


@pytest.mark.parametrize("damping", [0.05, 0.2])
def test_joint_damping_slows_a_free_joint(cell, damping):
    """w falls as exp(-b t / I); 1 / I is what a torque of 1 N m accelerates it by."""
    robot, joint = cell.robot, 6
    apply(cell, joint_damping=("add", [damping] * 7))
    model, data = robot.model, robot.data
    model.actuator_gainprm[joint], model.actuator_biasprm[joint] = 0.0, 0.0
    at = model.joint("panda_joint7").dofadr[0]
    data.qfrc_applied[at] = 1.0
    mujoco.mj_forward(model, data)
    inertia = 1.0 / data.qacc[at]
    data.qfrc_applied[at] = 0.0
    data.qvel[at] = 1.0
    cell.step(24)
    assert data.qvel[at] == pytest.approx(np.exp(-damping * 0.1 / inertia), rel=0.03)


def test_arm_gains(cell):
    """A torque on a joint turns it by torque over stiffness."""
    robot = cell.robot
    at = robot.model.joint("panda_joint1").dofadr[0]
    turned = {}
    for gain in (0.75, 1.0, 1.5):
        robot.place(cell.home)
        apply(cell, arm_position_gain=("scale", gain))
        robot.data.qfrc_applied[at] = 9.0
        cell.step(240)
        turned[gain] = robot.q[0] - cell.home[0]
        robot.data.qfrc_applied[:] = 0
    for gain, angle in turned.items():
        assert angle == pytest.approx(9.0 / (gain * 4500.0), rel=1e-3)


def test_softer_motors_still_follow_a_trajectory(cell):
    """The feed-forward of the velocity belongs to the gains: no lag grows with them."""
    for gains in ((1.0, 1.0), (0.75, 1.0), (1.5, 0.8)):
        robot = cell.robot
        robot.place(cell.home)
        apply(cell, arm_position_gain=("scale", gains[0]), arm_velocity_gain=("scale", gains[1]))
        way = robot.joint_move(cell.home, cell.home + 0.3)
        off = 0.0
        for q, velocity in zip(way.positions, way.velocities):
            robot.command_arm(q, velocity)
            cell.step()
            off = max(off, abs(robot.q - q).max())
        assert off < 0.02


def test_the_controller_knows_the_nominal_masses_alone(cell):
    """A link that is heavier than known sags by the torque of its excess weight."""
    robot, excess = cell.robot, 1.2
    factors = [1.0] * 7
    factors[3] = excess
    model, data = robot.model, robot.data
    body, joint = model.body("panda_link4").id, model.joint("panda_joint2").id
    weight = np.array([0.0, 0.0, -(excess - 1) * model.body_mass[body] * G])
    robot.place(cell.home)
    apply(cell, robot_mass=("scale", factors))
    cell.step(240)
    lever = data.xipos[body] - data.xanchor[joint]
    torque = data.xaxis[joint] @ np.cross(lever, weight)
    assert robot.q[1] - cell.home[1] == pytest.approx(torque / 4500.0, rel=0.01)
    apply(cell)
    cell.step(240)
    np.testing.assert_allclose(robot.q, cell.home, atol=2e-5)


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_the_arm_starts_after_exactly_the_latency(cell, steps):
    robot = cell.robot
    apply(cell, latency=("set", steps * cell.dt))
    robot.place(cell.home)
    cell.step(3)
    before = robot.data.ctrl[:7].tolist()
    robot.drive_arm_to(cell.home + 0.2)
    for _ in range(steps):
        cell.step()
        assert robot.data.ctrl[:7].tolist() == before
    cell.step()
    assert robot.data.ctrl[:7].tolist() != before


def test_gripper_gain(cell):
    model = cell.robot.model
    before = model.actuator_gainprm[7, 0], model.actuator_biasprm[7].copy()
    apply(cell, gripper_gain=("scale", 1.5))
    assert model.actuator_gainprm[7, 0] == 1.5 * before[0]
    np.testing.assert_array_equal(model.actuator_biasprm[7][:3], before[1][:3] * [1, 1.5, 1])


def test_contact_stiffness_and_damping_of_the_fingertips(cell):
    """MuJoCo's contact of 5 ms, critically damped, is a stiffness of 40,000 1/s^2 and a damping of
    400 1/s."""
    model = cell.robot.model
    apply(cell, contact_stiffness=("scale", 0.5), contact_damping=("scale", 1.5))
    changed = model.pair_solref[model.pair_solref[:, 0] < 0]
    ends = model.geom_bodyid[np.column_stack([model.pair_geom1, model.pair_geom2])]
    fingers = [model.body(name).id for name in ("panda_leftfinger", "panda_rightfinger")]
    assert len(changed) == np.isin(ends, fingers).any(axis=1).sum() == 2
    np.testing.assert_allclose(changed, np.tile([-20000.0, -600.0], (len(changed), 1)))
    apply(cell, contact_stiffness=("scale", 1.0), contact_damping=("scale", 1.0))
    assert (model.pair_solref == [0.005, 1.0]).all()


def test_colours_are_seen(cell):
    scene = apply(cell)
    nominal = cell.frame().rgb
    scene.paint([(1, 0, 0, 1), (0, 0, 1, 1)])
    frame = cell.frame()
    red, blue = frame.rgb[frame.segmentation == -1], frame.rgb[frame.segmentation == 0]
    assert red[:, 1:].max() < 0.2 * red[:, 0].max() and blue[:, :2].max() < 0.2 * blue[:, 2].max()
    scene.paint(None)
    np.testing.assert_array_equal(cell.frame().rgb, nominal)
