"""Randomised physics and colours in MuJoCo: changed from nominal, and brought back exactly.

`utils.domain_randomization` draws what this module applies. Knows no distribution. What each
parameter changes, beside PyBullet's cell (`envs.pybullet_randomization`):

| parameter | in MuJoCo's model |
|---|---|
| object_mass | mass and inertia of the object, and the constants that follow from them |
| object_friction | sliding friction of the object in every contact, squared between objects |
| rolling_friction | rolling friction, m, of the object in every contact; none if it is 0 |
| spinning_friction | torque over friction force, m, in contacts of objects with the fingertips |
| table_friction, finger_friction | 1 nominally; multiplies the object's sliding friction there |
| restitution | damping of the object's contact with the table, see `restitution_of` |
| contact_stiffness, contact_damping | of contacts of objects with the fingertips, 1/s^2 and 1/s |
| robot_mass | mass and inertia of each link, but not the weight that the controller compensates |
| joint_damping | damping of each arm joint, N m s/rad |
| arm_position_gain, arm_velocity_gain | stiffness and damping of the arm's servos, 1 nominally |
| gripper_gain | stiffness of the gripper's servo, 1 nominally |
| gravity | m/s^2 along z; the controller goes on compensating the arm's weight |
| latency | s, in whole physics steps, until a motor command arrives |

MuJoCo would take the larger friction of two shapes that touch. `envs.mujoco_cell` therefore gives
each contact of an object with table, tray and robot parameters of its own (a contact pair), in
which this module multiplies as Bullet does. Contacts between two objects keep MuJoCo's rule, for
squares of the coefficients: for equal ones that is Bullet's product.

Bullet's contact stiffness is in N/m. MuJoCo's is per effective mass of the contact, so that a
factor means the same in both simulators, and a value that is added or set does not. A contact here
cannot be stiffer nor more strongly damped than MuJoCo's step resolves; the least restitution is
about 0.04, where Bullet's is 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import brentq

from envs.mujoco_bodies import OF_OTHER_BODIES, wake
from envs.mujoco_panda import ARM_JOINTS, FINGERS, MujocoPanda, load_mujoco
from envs.panda_model import FINGER_SURFACE
from utils.config_types import Change, changed_in
from utils.transforms import pose_matrix

_OF_OBJECTS = ("object_mass", "object_friction", "rolling_friction", "restitution")
_SLIDES, _TURNS, _ROLLS = 3, 4, 6  # dimensions of a contact: with torsional, with rolling friction
# The fields of MuJoCo's model that `apply` changes. MuJoCo derives others from them.
_PHYSICS = (
    "body_mass", "body_inertia", "geom_friction", "geom_condim", "pair_friction", "pair_dim",
    "pair_solref", "dof_damping", "actuator_gainprm", "actuator_biasprm",
)  # fmt: skip
_SLIDING, _TORSION, _ROLLING = slice(0, 2), 2, slice(3, 5)  # in a pair's friction
# Of a step's velocity, or of its square: with more, a contact's damper or spring overshoots.
_MOST_DAMPING, _MOST_STIFFNESS = 0.9, 0.25
_GRIPPER = len(ARM_JOINTS)  # number of its actuator


class MujocoRandomizable:
    """A `utils.domain_randomization.Randomizable` of a cell's scene as built.

    table, bodies: MuJoCo's numbers. Raises UserError without MuJoCo.
    """

    def __init__(self, robot: MujocoPanda, table: int, bodies: Sequence[int]):
        self._mujoco, self._robot, self._model = load_mujoco(), robot, robot.model
        self._bodies = list(bodies)
        self.surfaces = [table, *bodies]
        model = self._model
        self._scratch = self._mujoco.MjData(model)  # in which MuJoCo derives its constants
        self._nominal = {name: getattr(model, name).copy() for name in _PHYSICS}
        self._colours = model.geom_rgba.copy()
        self._gravity, self._latency = float(model.opt.gravity[2]), robot.latency
        self._damping_time = robot.damping_time
        joints = [model.joint(name) for name in ARM_JOINTS]
        self._joints = [joint.dofadr[0] for joint in joints]
        # Each link with what is fixed to it: the hand belongs to the last one, as in PyBullet.
        self._links = [
            np.flatnonzero(model.body_weldid == model.jnt_bodyid[joint.id]) for joint in joints
        ]
        self._gravcomp = model.body_gravcomp.copy()
        fingers = [model.body(name).id for name in FINGERS]
        ends = model.geom_bodyid[np.column_stack([model.pair_geom1, model.pair_geom2])]
        self._with_table = (ends == table).any(axis=1)
        self._with_fingers = np.isin(ends, fingers).any(axis=1)
        # Of the object's friction that a pair has, see `envs.mujoco_cell`.
        own = self._with_table | self._with_fingers
        self._shares = np.where(own, 1.0, OF_OTHER_BODIES)
        self._pair_dim = np.where(self._with_fingers, _TURNS, _SLIDES)  # without rolling friction
        self._pairs_of = [(ends == body).any(axis=1) for body in self._bodies]
        self._shapes_of = [model.geom_bodyid == body for body in self._bodies]

    def sizes(self) -> dict[str, int | None]:
        sizes: dict[str, int | None] = dict.fromkeys(_OF_OBJECTS, len(self._bodies))
        return sizes | {"robot_mass": len(self._links), "joint_damping": len(self._joints)}

    def apply(self, changes: Mapping[str, Change]) -> None:
        model = self._model
        for name, values in self._nominal.items():
            getattr(model, name)[:] = values
        self._change_masses(changes)
        self._change_friction(changes)
        self._change_contacts(changes)
        self._change_motors(changes)
        model.opt.gravity[2] = changed_in(changes, "gravity", self._gravity)
        # Inertias seen by contacts and joints; the nominal ones come back bit for bit.
        self._mujoco.mj_setConst(model, self._scratch)
        wake(model, self._robot.data, self._bodies)

    def paint(self, colours: Sequence[Sequence[float]] | None) -> None:
        self._model.geom_rgba[:] = self._colours
        if colours is not None:
            for body, colour in zip(self.surfaces, colours):
                self._model.geom_rgba[self._model.geom_bodyid == body] = colour

    def pose(self, body: int) -> np.ndarray:
        model = self._model
        if model.body_jntnum[body] == 0:  # the table
            position, (w, x, y, z) = model.body_pos[body], model.body_quat[body]
        else:
            start = model.jnt_qposadr[model.body_jntadr[body]]
            position, (w, x, y, z) = np.split(self._robot.data.qpos[start : start + 7], [3])
        return pose_matrix(position, (x, y, z, w))

    def _change_masses(self, changes: Mapping[str, Change]) -> None:
        model, nominal = self._model, self._nominal["body_mass"]
        for i, body in enumerate(self._bodies):
            self._scale_mass([body], changed_in(changes, "object_mass", nominal[body], i))
        for i, links in enumerate(self._links):
            self._scale_mass(links, changed_in(changes, "robot_mass", nominal[links].sum(), i))
            # The controller knows the nominal masses alone. A link without mass has no weight.
            known = np.divide(
                nominal[links], model.body_mass[links], where=nominal[links] > 0,
                out=np.ones(len(links)),
            )  # fmt: skip
            model.body_gravcomp[links] = self._gravcomp[links] * known

    def _scale_mass(self, bodies: Sequence[int] | np.ndarray, mass: float) -> None:
        """Make bodies together as heavy as `mass` kg, with the inertia that belongs to it."""
        factor = mass / self._nominal["body_mass"][bodies].sum()
        self._model.body_mass[bodies] *= factor
        self._model.body_inertia[bodies] *= factor

    def _change_friction(self, changes: Mapping[str, Change]) -> None:
        model = self._model
        for i, (shapes, pairs) in enumerate(zip(self._shapes_of, self._pairs_of)):
            sliding = np.sqrt(model.geom_friction[shapes, 0])  # against another object: squared
            model.geom_friction[shapes, 0] = changed_in(changes, "object_friction", sliding, i) ** 2
            share = self._shares[pairs, None]
            sliding = model.pair_friction[pairs, _SLIDING] / share
            sliding = changed_in(changes, "object_friction", sliding, i)
            model.pair_friction[pairs, _SLIDING] = share * sliding
            for friction, dimensions, plain, rows, rolling in (
                (model.geom_friction, model.geom_condim, _SLIDES, shapes, slice(2, 3)),
                (model.pair_friction, model.pair_dim, self._pair_dim[pairs], pairs, _ROLLING),
            ):
                first = np.flatnonzero(rows)[0]  # all of an object's have the same
                rolls = dimensions[first] == _ROLLS
                length = float(friction[first, rolling.start]) if rolls else 0.0
                new = changed_in(changes, "rolling_friction", length, i)
                if new != length:
                    friction[rows, rolling] = new
                    dimensions[rows] = _ROLLS if new > 0 else plain
        table, fingers, friction = self._with_table, self._with_fingers, model.pair_friction
        # As in Bullet: of the object's friction, whatever the fingers' sliding friction is.
        patch = changed_in(changes, "spinning_friction", FINGER_SURFACE.spinning)
        friction[fingers, _TORSION] = patch * friction[fingers, _SLIDING.start]
        friction[table, _SLIDING] *= changed_in(changes, "table_friction", 1.0)
        friction[fingers, _SLIDING] *= changed_in(changes, "finger_friction", 1.0)

    def _change_contacts(self, changes: Mapping[str, Change]) -> None:
        """Write stiffness and damping where they change: MuJoCo takes them negated, in place of a
        time and a damping ratio."""
        solref, step = self._model.pair_solref, self._model.opt.timestep
        most = _MOST_DAMPING / step
        if not self._bodies:
            return
        nominal = _stiffness_damping(self._nominal["pair_solref"][0])  # the same for all pairs
        critical = 2 * math.sqrt(nominal[0])
        own = restitution_of(nominal[1] / critical)
        for i, pairs in enumerate(self._pairs_of):
            bounce = changed_in(changes, "restitution", own, i)
            if bounce != own:
                ratio = _damping_ratio(bounce, most / critical)
                solref[pairs & self._with_table] = -nominal[0], -ratio * critical
        stiffness = changed_in(changes, "contact_stiffness", nominal[0])
        damping = changed_in(changes, "contact_damping", nominal[1])
        if (stiffness, damping) != nominal:
            stiffness = min(stiffness, _MOST_STIFFNESS / step**2)
            solref[self._with_fingers] = -stiffness, -min(damping, most)

    def _change_motors(self, changes: Mapping[str, Change]) -> None:
        model, robot = self._model, self._robot
        position, velocity, gripper = (
            changed_in(changes, name, 1.0)
            for name in ("arm_position_gain", "arm_velocity_gain", "gripper_gain")
        )
        model.actuator_gainprm[:_GRIPPER, 0] *= position
        model.actuator_biasprm[:_GRIPPER, 1] *= position
        model.actuator_biasprm[:_GRIPPER, 2] *= velocity
        robot.damping_time = self._damping_time * velocity / position
        model.actuator_gainprm[_GRIPPER, 0] *= gripper
        model.actuator_biasprm[_GRIPPER, 1] *= gripper
        for i, joint in enumerate(self._joints):
            damping = model.dof_damping[joint]
            model.dof_damping[joint] = changed_in(changes, "joint_damping", damping, i)
        seconds = changed_in(changes, "latency", self._latency * robot.dt)
        robot.latency = max(0, round(seconds / robot.dt))


def restitution_of(ratio: float) -> float:
    """Speed after over speed before an impact on a spring and a damper that push but never pull.

    ratio: damping over the critical one. Schwager and Poschel, "Coefficient of restitution and
    linear-dashpot model revisited" (Granular Matter 2007), for two bodies that part when the force
    between them vanishes: exp(-2 a cot a) with cos a = ratio, or cosh a above 1.
    """
    if ratio < 1:
        angle = math.acos(ratio)
        return math.exp(-2 * angle / math.tan(angle))
    angle = math.acosh(ratio)
    return math.exp(-2 * angle / math.tanh(angle)) if angle > 0 else math.exp(-2)


def _damping_ratio(restitution: float, most: float) -> float:
    """The ratio in 0..most whose `restitution_of` is nearest to a restitution."""
    if restitution >= 1:
        return 0.0
    if restitution <= restitution_of(most):
        return most
    return float(brentq(lambda ratio: restitution_of(ratio) - restitution, 0.0, most))


def _stiffness_damping(solref: np.ndarray) -> tuple[float, float]:
    """1/s^2 and 1/s of a contact that MuJoCo has as time constant, s, and damping ratio."""
    seconds, ratio = solref.tolist()
    return 1 / (seconds * ratio) ** 2, 2 / seconds
