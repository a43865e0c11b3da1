"""Actions of `RobotGraspingEnv`, and the initial states of its episodes.

An action changes the commanded pose of the hand a little. `ActionDecoder` decides how much of the
change the arm may carry out, within joint limits, speeds, workspace and safety, and sends the
commands. `checked_options` reads the options of `reset`. `near_pose` and `pretraining_state` draw
where the hand is when an episode does not begin at home; their poses are not yet checked for the
arm's reach.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.env_rewards import LOWEST_TIP, GraspGoal
from envs.robot import Robot
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    ServoStep,
    moved,
    moved_within,
    pose_error,
    rotation_matrix,
    stepped_towards,
    wrist_room,
)
from utils.config import Config
from utils.errors import UserError, unknown_choice

# What each entry of an action means, by `env.control`.
ACTION_ENTRIES = {
    "ee": ("dx", "dy", "dz", "rotation x", "rotation y", "rotation z", "gripper"),
    "ee_planar": ("dx", "dy", "dz", "dyaw", "gripper"),
    "joint": (*(f"joint {number}" for number in range(1, 8)), "gripper"),
}

STARTS = ("home", "near", "pretraining")  # of an episode

_HIGHEST_TIP = 0.50  # m
_MARGIN = 0.08  # m that E may leave the workspace sideways
# How far the solution of inverse kinematics may miss a command before the command is refused.
_FOLLOW_POSITION, _FOLLOW_ROTATION = 0.01, 0.06  # m, rad
# All joints share the lowest speed limit, because Bullet holds a body's joints to one limit only.
_FASTEST = float(JOINT_VELOCITY.min())  # rad/s
# Share of that speed that is commanded: inertia and contacts carry a joint a little over what its
# motor asks for (3 % in free motion).
_SPEED_HEADROOM = 0.95
_LONGEST_LEAD = 0.5  # rad that a command may be ahead of the arm; in free motion up to 0.25
_GRIPPER_LEAD = 0.02  # m that a changed command may differ from the opening: grips at full force
_FOLLOW_TRIES = 4  # steps of inverse kinematics for one action; nearly always the first is enough


def action_entries(control: str) -> tuple[str, ...]:
    """What each entry of an action means. Raises UserError for an unknown `env.control`."""
    if control not in ACTION_ENTRIES:
        raise unknown_choice("env.control", control, ACTION_ENTRIES)
    return ACTION_ENTRIES[control]


class ActionDecoder:
    """Turns the actions of an episode into commands; `RobotGraspingEnv` documents the actions.

    config: its section `env` says what the entries of an action mean. lowest, highest: (3,) m in W,
    the corners of the box that E stays in. opening: m, as commanded. reachable: whether the arm
    could follow the last action.
    """

    def __init__(self, config: Config):
        self._settings, self._max_opening = config.env, config.gripper.max_opening
        reach = config.workspace.size / 2 + _MARGIN
        x, y = config.workspace.center
        self.lowest = np.array([x - reach, y - reach, LOWEST_TIP])
        self.highest = np.array([x + reach, y + reach, _HIGHEST_TIP])
        self._speed = _FASTEST * _SPEED_HEADROOM * config.robot.velocity_scale
        self._max_joint_change = self._speed * config.env.substeps / config.sim.frequency

    def begin(self, robot: Robot, q: np.ndarray, opening: float | None = None) -> None:
        """Begin with a robot whose arm is at joint positions q (7,) and whose gripper is commanded
        to open by `opening` metres, or as wide as it gets."""
        self._robot = robot
        robot.limit_speed(_FASTEST)
        self._servo = ServoStep(q)  # at the commanded joint positions
        self._T_command = self._servo.reached
        self.opening = self._max_opening if opening is None else opening
        self.reachable = True

    def command(self, action: np.ndarray, state: np.ndarray) -> None:
        """Move the commanded pose by an action (A,) and send the motors there. state: (15,) of the
        robot now, as in the observation of `RobotGraspingEnv`."""
        self._state = state
        if self._settings.control == "joint":
            goal = self._servo.q + self._settings.joint_step * action[:7]
            goal = np.minimum(np.maximum(goal, JOINT_LOWER), JOINT_UPPER)
            servo = ServoStep(self._within_speed(goal)[0])
            self.reachable = self._allowed(servo)
            if self.reachable:
                self._servo = servo
        else:
            self._follow(self._moved_pose(action))
        self._robot.drive_arm_to(self._servo.q, self._speed)
        self.opening = self._new_opening(float(action[-1]))
        self._robot.command_gripper(self.opening)

    def _new_opening(self, action: float) -> float:
        """The commanded opening in metres after an action of the gripper in [-1, 1]."""
        if self._settings.gripper == "opening":
            return self._max_opening * (action + 1) / 2
        opening = self.opening + self._settings.gripper_step * action
        now = float(self._state[14])
        opening = min(max(opening, now - _GRIPPER_LEAD), now + _GRIPPER_LEAD)
        return min(max(opening, 0.0), self._max_opening)

    def _moved_pose(self, action: np.ndarray) -> np.ndarray:
        """(4, 4) the commanded pose of E moved by an action, within the workspace and what the
        wrist can turn: a hand at its limit can still move."""
        settings = self._settings
        turn = action[3:6] if settings.control == "ee" else np.array([0.0, 0.0, action[3]])
        return moved_within(
            self._T_command, settings.position_step * action[:3], settings.rotation_step * turn,
            settings.frame == "hand", self.lowest, self.highest, wrist_room(self._servo.q),
        )  # fmt: skip

    def _follow(self, target: np.ndarray) -> None:
        """Move the command towards a pose (4, 4) as far as the joint speeds allow, or not at all
        where the arm cannot get there: a compromise would tilt the hand and jam the elbow."""
        goal, share = self._within_speed(self._servo.towards(target))
        for _ in range(_FOLLOW_TRIES):
            wanted = target
            if share < 1.0:
                wanted = moved(self._T_command, share * pose_error(self._T_command, target))
            servo = ServoStep(goal)
            error = [abs(part) for part in pose_error(servo.reached, wanted).tolist()]
            if max(error[:3]) < _FOLLOW_POSITION and max(error[3:]) < _FOLLOW_ROTATION:
                self.reachable = self._allowed(servo)
                if self.reachable:
                    self._servo, self._T_command = servo, wanted
                return
            goal, slower = self._within_speed(servo.towards(wanted))
            share *= slower
        self.reachable = False

    def _allowed(self, goal: ServoStep) -> bool:
        """Whether a goal may be commanded: nothing blocks the arm, and its gate lets the goal
        pass."""
        tip = goal.reached[:3, 3]
        return not self._blocked(goal.q) and self._robot.gate.refusal(goal.q, tip) is None

    def _blocked(self, goal: np.ndarray) -> bool:
        """Whether something holds the arm up and a goal (7,) is still farther ahead of it."""
        now = self._state[:7]
        lead = abs(goal - now).max()
        return bool(lead > _LONGEST_LEAD and lead > abs(self._servo.q - now).max())

    def _within_speed(self, goal: np.ndarray) -> tuple[np.ndarray, float]:
        """Joint positions (7,) towards a goal that one action can reach, and the share of the way
        that they are."""
        return stepped_towards(self._servo.q, goal, self._max_joint_change)


# --- Initial states -----------------------------------------------------------------------------

_NEAR_SIDE, _NEAR_HEIGHT, _NEAR_TURN = 0.04, (0.01, 0.10), math.pi / 4
# Pretraining: heights are even in the logarithm, as what is near moves most in the image.
_PRETRAINING_HEIGHT = 0.01, 0.42
_PRETRAINING_SIDE = 0.01, 0.4  # m, and metres for a metre of height: deviations sideways
_OPEN_SHARE = 0.6  # of the states: with open fingers, as nearly all of an episode is seen
_GRASP_SHARE = 0.4  # of the states: on the way down to a grasp
_MOVING_SHARE, _LARGEST_OPENING_ERROR = 0.5, 0.02  # of the states: while the fingers close; m
_GRASP_SIDE, _GRASP_TURN, _GRASP_HEIGHT = 0.008, math.radians(8), 0.06
_HALF_TURN, _ANY_TURN = math.pi, math.pi / 2
_START_SLACK = 0.01  # rad or m


def checked_options(
    options: dict[str, Any] | None, max_opening: float
) -> tuple[int | None, str | dict[str, Any] | None]:
    """The scene's seed that reset's options ask for, and where to start; None for what they leave
    open. max_opening: m, of the gripper. Raises UserError."""
    options = dict(options or {})
    seed, start = options.pop("scene_seed", None), options.pop("start", None)
    if options:
        raise UserError(
            f"reset: unknown option {next(iter(options))!r}; allowed are 'scene_seed' and 'start', "
            "and for RandomizedGrasping-v0 'randomization'"
        )
    known = set(start) == {"q", "opening", "command"} if isinstance(start, dict) else False
    if not known and start is not None and start not in STARTS:
        raise UserError(
            f"reset: start must be {', '.join(map(repr, STARTS))} or an episode's own (q, opening "
            f"and command), got {start!r}"
        )
    if isinstance(start, dict):
        _check_start(start, max_opening)
    if seed is None:
        return None, start
    if not isinstance(seed, (int, np.integer)) or isinstance(seed, bool) or seed < 0:
        raise UserError(f"reset: scene_seed must be a whole number of at least 0, got {seed!r}")
    return int(seed), start


def _check_start(start: Mapping[str, Any], max_opening: float) -> None:
    """Raise UserError for a start in which no arm can be. A recorded one may be beyond a limit by
    a little."""
    try:
        q = np.array(start["q"], dtype=float)
        openings = np.array([start["opening"], start["command"]], dtype=float)
    except (TypeError, ValueError):
        q, openings = np.empty(0), np.empty(0)
    possible = q.shape == JOINT_LOWER.shape and openings.shape == (2,)
    if possible:
        beyond = np.concatenate([
            q - np.clip(q, JOINT_LOWER, JOINT_UPPER), openings - np.clip(openings, 0, max_opening)
        ])  # fmt: skip
        possible = bool((np.abs(beyond) <= _START_SLACK).all())
    if not possible:
        raise UserError(
            f"reset: start must have seven joint positions q in {JOINT_LOWER.tolist()} to "
            f"{JOINT_UPPER.tolist()} rad, and opening and command in 0 to {max_opening:g} m; got "
            f"{dict(start)!r}"
        )


def near_pose(
    T_home: np.ndarray, object_place: np.ndarray, top: float, random: np.random.Generator
) -> np.ndarray:
    """(4, 4) T_WE a little over an object, turned a little from how the hand is at home.

    T_home: (4, 4) T_WE at home. object_place: (2,) x, y of the object; top: height of the highest
    point of it and of what stands beside it; both m in W.
    """
    side = random.uniform(-_NEAR_SIDE, _NEAR_SIDE, 2)
    height = top + random.uniform(*_NEAR_HEIGHT)
    return _hand(T_home, object_place + side, height, random.uniform(-_NEAR_TURN, _NEAR_TURN))


def pretraining_state(
    T_home: np.ndarray,
    object_place: np.ndarray,
    top: float,
    goal: GraspGoal | None,
    max_opening: float,
    random: np.random.Generator,
) -> tuple[np.ndarray, float, float]:
    """A state that an episode may lead to, from high above an object, and above what
    stands beside it, to right around a grasp: (4, 4) T_WE, the opening and the commanded opening in
    metres.

    Arguments as of `near_pose`; goal: a grasp of the object, None for no states on the way down.
    max_opening: m, of the hand.
    """
    if goal is not None and random.random() < _GRASP_SHARE:
        place = goal.position[:2] + random.normal(0, _GRASP_SIDE, 2)
        height = random.uniform(goal.position[2], top + _GRASP_HEIGHT)
        turn = goal.angle - math.atan2(T_home[1, 1], T_home[0, 1])
        turn -= _HALF_TURN * round(turn / _HALF_TURN)
        turn += random.normal(0, _GRASP_TURN)
        opening = random.uniform(goal.narrow, goal.wide)
    else:
        rise = math.exp(random.uniform(*np.log(_PRETRAINING_HEIGHT)))
        deviation = _PRETRAINING_SIDE[0] + _PRETRAINING_SIDE[1] * rise
        place = object_place + random.normal(0, deviation, 2)
        height, turn = top + rise, random.uniform(-_ANY_TURN, _ANY_TURN)
        opened = random.random() < _OPEN_SHARE
        opening = max_opening if opened else random.uniform(0, max_opening)
    closing = random.random() < _MOVING_SHARE
    opening_error = random.uniform(0, _LARGEST_OPENING_ERROR) if closing else 0.0
    return _hand(T_home, place, height, turn), opening, max(opening - opening_error, 0.0)


def _hand(T_home: np.ndarray, place: np.ndarray, height: float, turn: float) -> np.ndarray:
    T = T_home.copy()
    T[:3, 3] = *place, height
    T[:3, :3] = rotation_matrix(np.array([0.0, 0.0, turn])) @ T[:3, :3]
    return T
