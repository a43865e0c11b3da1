"""Hostile actions of the arm, and episodes without end: parts `actions` and `memory` of the soak.

Actions are random or extreme, in every mode of the environment. After every physics step the
joints' positions and speeds and the place of the fingertips are compared with the limits of the
robot and of the config. Joint accelerations are reported only: the torques of the motors are all
that limits them in the environment. Memory is the resident set of this process.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from itertools import islice
from threading import Event

import numpy as np
import psutil

from benchmarks.soak_tally import Tally
from envs.cell import Cell
from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import (
    JOINT_ACCELERATION,
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    tip_position,
)
from envs.robot_safety import reaching_down
from utils.config import Config, load_config

ACTIONS, RESETS, STEPS = 100_000, 10_000, 1_000_000  # in each simulator
EPISODE, SUBSTEPS = 100, 4  # actions, and physics steps of each, in part `memory`
# A joint is stopped in the physics step after the one that took it over its limit, and the motors
# follow a command that is at the edge of the box with an error.
POSITION_TOLERANCE, BOX_TOLERANCE = 5e-3, 0.02  # rad, m
PRESSED = 10.0  # N
ROUNDING = 1e-6  # of a speed or an acceleration
SAMPLED = 50  # episodes from one look at the memory to the next
GROWTH = 4.0  # kB an episode by which the second half of a run may grow: 40 MB in 10,000 resets

MODES: list[dict[str, str]] = [
    {"control": "joint", "gripper": "opening"},
    {"control": "joint", "gripper": "change"},
    *(
        {"control": control, "frame": frame, "gripper": gripper}
        for control in ("ee", "ee_planar")
        for frame in ("world", "hand")
        for gripper in ("opening", "change")
    ),
]


def hostile_actions(size: int, random: np.random.Generator) -> Iterator[np.ndarray]:
    """Without end: uniform ones, corners held for a while, corners back and forth, one entry alone,
    and numbers far beyond the bounds, which the environment clips."""

    def corner() -> np.ndarray:
        return random.choice([-1.0, 1.0], size)

    while True:
        kind, length, held = random.integers(5), int(random.integers(1, 30)), corner()
        for number in range(length):
            if kind == 0:
                yield random.uniform(-1, 1, size)
            elif kind == 1:
                yield held
            elif kind == 2:
                yield held if number % 2 else -held
            elif kind == 3:
                yield np.where(np.arange(size) == length % size, held, 0.0)
            else:
                yield corner() * 10.0 ** random.uniform(0, 300)


class LimitWatch:
    """Compares arms with the limits of a config after each physics step.

    position, speed, box: the farthest that an arm was beyond a limit in rad, rad/s and m, negative
    within. acceleration: the largest, as a multiple of the joint's limit. steps: physics steps.
    forces: newtons with which the arm pressed on something whenever it was beyond a limit.
    """

    def __init__(self, config: Config):
        safety = reaching_down(config.safety, config.closed_loop.floor)
        self._lower, self._upper = np.array(safety.box_lower), np.array(safety.box_upper)
        self._fastest = JOINT_VELOCITY * config.robot.velocity_scale
        self._dt = 1 / config.sim.frequency
        self._states: list[list[float]] = []
        self.position = self.speed = self.box = -np.inf
        self.acceleration, self.steps = 0.0, 0
        self.forces: list[float] = []

    def follow(self, cell: Cell) -> None:
        """Watch a cell's arm from now on."""
        self._states.clear()
        cell.on_step = lambda cell: self._states.append(cell.robot.state())

    def held(self) -> bool:
        """Whether every limit held in the physics steps since the last call."""
        states = np.array(self._states).reshape(-1, 15)
        self._states.clear()
        q, velocities = states[:, :7], states[:, 7:14]
        tips = np.array([tip_position(one) for one in q.tolist()]).reshape(-1, 3)
        position = np.maximum(JOINT_LOWER - q, q - JOINT_UPPER).max(initial=-np.inf)
        speed = (abs(velocities) - self._fastest).max(initial=-np.inf)
        box = np.maximum(self._lower - tips, tips - self._upper).max(initial=-np.inf)
        change = abs(np.diff(velocities, axis=0)) / (JOINT_ACCELERATION * self._dt)
        self.position, self.speed = max(self.position, position), max(self.speed, speed)
        self.box, self.steps = max(self.box, box), self.steps + len(states)
        self.acceleration = max(self.acceleration, change.max(initial=0.0))
        # A number that is not finite fails each comparison.
        return bool(
            position <= POSITION_TOLERANCE
            and box <= BOX_TOLERANCE
            and speed <= ROUNDING
            and np.isfinite(states).all()
        )

    def in_words(self) -> str:
        return (
            f"{self.steps:,} physics steps; at most {1e3 * max(self.position, 0):.1f} mrad beyond "
            f"a joint's limit, {1e3 * max(self.box, 0):.1f} mm beyond the box, "
            f"{max(self.speed, 0):.2g} rad/s beyond a joint's speed limit; joint accelerations up "
            f"to {self.acceleration:.0f} times the limit of planned motions"
            f"; beyond one of these in {len(self.forces)} actions, in {self._pressed()} of which "
            f"it pressed on something with more than {PRESSED:g} N"
        )

    def _pressed(self) -> int:
        return sum(force > PRESSED for force in self.forces)


def soak_actions(simulator: str, scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """Actions of the environment in all its modes."""
    tally = Tally(f"{simulator}: random and extreme actions in {len(MODES)} modes")
    yield tally
    config = load_config(None, [f"simulator={simulator}", "sim.renderer=tiny"])
    watch, random = LimitWatch(config), np.random.default_rng(seed)
    for mode in MODES:
        count = round(scale * ACTIONS / len(MODES))
        hostile_episodes(config, mode, count, random, watch, tally, stop)
    tally.note = watch.in_words()


def hostile_episodes(
    config: Config,
    mode: dict[str, str],
    count: int,
    random: np.random.Generator,
    watch: LimitWatch,
    tally: Tally,
    stop: Event,
) -> None:
    """Play `count` hostile actions in one mode of the environment; counts them."""
    env = RobotGraspingEnv(config=config, observations=["state"], **mode)
    ended = True
    for action in islice(hostile_actions(env.action_space.shape[0], random), count):
        if stop.is_set():
            break
        if ended:
            env.cell.on_step = None
            env.reset(seed=int(random.integers(2**31)))
            watch.follow(env.cell)
        _, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
        held = watch.held()
        if not held:
            watch.forces.append(env.cell.robot.contact_force())
        tally.add(held and info["reason"] != "physics")
    env.close()


def soak_memory(simulator: str, scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """Episodes of the environment without images: resets, steps, and this process's memory."""
    tally = Tally(f"{simulator}: steps of the environment in one process")
    yield tally
    config = load_config(None, [f"simulator={simulator}", "sim.renderer=tiny"])
    env = RobotGraspingEnv(
        config=config, observations=["state"], substeps=SUBSTEPS, near_share=1.0, max_steps=EPISODE
    )
    random, process = np.random.default_rng(seed), psutil.Process()
    env.reset(seed=seed)
    resets, resident = 1, list[int]()
    while (tally.tried < STEPS * scale or resets < RESETS * scale) and not stop.is_set():
        action = random.uniform(-1, 1, env.action_space.shape)
        *_, terminated, truncated, info = env.step(action)
        tally.add(info["reason"] != "physics")
        if terminated or truncated:
            env.reset()
            resets += 1
            if resets % SAMPLED == 0:
                gc.collect()
                resident.append(process.memory_info().rss)
    env.close()
    tally.note = f"{resets:,} resets, actions of {SUBSTEPS} physics steps, no images"
    judge_memory(tally, resident)


def judge_memory(tally: Tally, resident: Sequence[int]) -> None:
    """Say in a row how memory grew, and that nothing survived if it grew too much.

    resident: bytes after each `SAMPLED` episodes; only their second half counts.
    """
    half = resident[len(resident) // 2 :]
    if len(half) < 2:
        tally.note += "; too few episodes to judge the memory"
        return
    growth = (half[-1] - half[0]) / (len(half) - 1) / SAMPLED / 1e3
    tally.note += (
        f"; {half[-1] / 1e6:.0f} MB at the end, {growth:+.1f} kB an episode in the second half"
    )
    if growth > GROWTH:
        tally.survived = 0
