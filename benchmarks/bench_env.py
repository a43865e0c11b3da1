"""Speed of the robot cell and its environment: python -m benchmarks.bench_env [--json FILE]

Everything is a ratio of two things timed in turn in this one run. Peers: panda-gym's
PandaPickAndPlace-v3, and PyBullet's stock Panda and objects with PyBullet's default settings.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.metrics import Metric, benchmark_parser, median_ratio, report
from envs.cell import Intrinsics
from envs.cell_layout import Scene
from envs.cell_scenes import make_scene
from envs.grasping_env import RobotGraspingEnv
from envs.objects import load_object_set
from envs.robot_kinematics import inverse_kinematics
from utils.config import Config, load_config, with_settings
from utils.runs import run_script
from utils.transforms import Grasp

try:
    import panda_gym  # noqa: F401 - registers its environments
    import pybullet
    import pybullet_data

    from envs.pybullet_bodies import add_table, set_up_physics, spawn
    from envs.pybullet_camera import PybulletCamera, projection_matrix
    from envs.pybullet_cell import PybulletCell
except ModuleNotFoundError as error:
    raise SystemExit(
        f"error: {error.name} is not installed; the peers, panda-gym and PyBullet's own objects, "
        "have wheels for Python 3.10 and 3.11 on Linux x86-64"
    ) from None

STEPS = 40  # of an environment, between two readings of the clock
CLOSE = -1.0  # the hand's entry in an action, of both environments
PHYSICS_STEPS = 120
DATA = Path(pybullet_data.getDataPath())


def main(argv: Sequence[str] | None = None) -> None:
    options = benchmark_parser(__doc__.splitlines()[0]).parse_args(argv)
    repeats, scene_count = (3, 1) if options.quick else (25, 4)
    config = load_config(None, ["sim.renderer=tiny"])
    objects = load_object_set("random_urdfs", cache_dir=config.cache_folder)
    scenes = [make_scene("pile", objects, seed, config) for seed in range(scene_count)]
    single = make_scene("isolated", objects, 0, config)
    metrics = [
        *bench_step(config, repeats),
        *bench_frames(config, [single, *scenes], max(repeats // 5, 1)),
        *bench_physics(config, scenes, max(repeats // 5, 1)),
        bench_processes(max(repeats // 4, 1)),
    ]
    report(metrics, options.json)


# --- Environment steps ------------------------------------------------------------------------


def bench_step(config: Config, repeats: int) -> list[Metric]:
    """A state-only action of 20 physics steps against panda-gym's, both under random actions, and
    against nothing but the physics steps in it; with a free hand and with one that holds the box.
    """
    # With 10 s to hold the box no episode ends in success before the actions do.
    ours = RobotGraspingEnv(
        config=config, observations=["state"], substeps=20, hold_seconds=10, max_steps=200
    )
    peer = gymnasium.make("PandaPickAndPlace-v3").unwrapped
    physics_seconds: list[float] = []
    advance = ours.cell.step

    def timed_advance(count: int) -> None:
        start = perf_counter()
        advance(count)
        physics_seconds.append(perf_counter() - start)

    def physics_share(begin: Callable[[Any], None], held: bool) -> float:
        seconds = seconds_per_step(ours, begin, held, physics_seconds.clear)
        return seconds * STEPS / sum(physics_seconds)

    metrics = []
    for name, held, our_begin, peer_begin in (
        ("step", False, begin_at_home, begin_at_home),
        ("held_step", True, begin_with_box_held, peer_with_box_held),
    ):
        for env in (ours, peer):
            env.action_space.seed(0)
        ratio = median_ratio(
            partial(seconds_per_step, peer, peer_begin, held),
            partial(seconds_per_step, ours, our_begin, held),
            repeats,
        )
        seconds = [seconds_per_step(ours, our_begin, held) for _ in range(repeats)]
        ours.cell.step = timed_advance
        overhead = float(np.median([physics_share(our_begin, held) for _ in range(repeats)]))
        ours.cell.step = advance
        metrics += [
            Metric(f"{name}_vs_panda_gym", ratio, "x", at_least=1.6),
            Metric(f"{name}_vs_bare_physics", overhead, "x", at_most=1.2),
            Metric(f"{name}s_per_second", 1 / float(np.median(seconds)), "1/s"),
        ]
    ours.close()
    peer.close()
    return metrics


def seconds_per_step(
    env: Any, begin: Callable[[Any], None], held: bool, started: Callable[[], None] = lambda: None
) -> float:
    """Mean over a new episode of random actions, which all close the hand where the box is held,
    so that it is held to the last; how the episode begins is not counted. started: called before
    the first action that is. Raises RuntimeError where the box is lost in 20 episodes in turn."""
    for _ in range(20):
        begin(env)
        actions = [env.action_space.sample() for _ in range(STEPS)]
        for action in actions:
            action[-1] = CLOSE if held else action[-1]
        started()
        start = perf_counter()
        for action in actions:
            env.step(action)
        seconds = (perf_counter() - start) / STEPS
        if not held or holds_box(env):
            return seconds
    raise RuntimeError(f"{type(env).__name__}: the hand does not keep hold of the box")


def begin_at_home(env: gymnasium.Env) -> None:
    env.reset(seed=0)


def begin_with_box_held(env: RobotGraspingEnv) -> None:
    """An episode of ours in which the hand has closed around the box where it lies."""
    env.reset(seed=0)
    T_WO, opening = env.cell.object_pose(0), env.config.gripper.max_opening
    yaw = np.arctan2(T_WO[1, 0], T_WO[0, 0])
    q = inverse_kinematics(Grasp(T_WO[:3, 3], yaw, opening, 1.0).pose, env.cell.home, env.cell.home)
    env.reset(seed=0, options={"start": {"q": q, "opening": opening, "command": opening}})
    close_and_lift(env)


def peer_with_box_held(env: Any) -> None:
    """An episode of panda-gym's in which the box is put between the fingers and held."""
    env.reset(seed=0)
    env.sim.set_base_pose("object", env.robot.get_ee_position(), np.array([0.0, 0.0, 0.0, 1.0]))
    close_and_lift(env)


def close_and_lift(env: gymnasium.Env) -> None:
    """Off the table, against which random actions would push the box out of the hand."""
    action = np.zeros(env.action_space.shape, np.float32)
    action[-1] = CLOSE
    for up in [0.0] * 8 + [1.0] * 4:
        action[2] = up
        env.step(action)


def holds_box(env: Any) -> bool:
    """Whether the physics has contacts of the robot with the box."""
    if isinstance(env, RobotGraspingEnv):
        return env.cell.robot.holds(env.cell.bodies[0])
    robot, box = (env.sim._bodies_idx[name] for name in ("panda", "object"))
    return len(env.sim.physics_client.getContactPoints(bodyA=robot, bodyB=box)) > 0


# --- Physics clients ----------------------------------------------------------------------------


@contextmanager
def our_client(scene: Scene, config: Config, robot: bool) -> Iterator[int]:
    """A physics client with our table, (robot and tray,) and the scene's objects."""
    if robot:
        with PybulletCell(config) as cell:
            cell.build(scene)
            yield cell.client
        return
    client = pybullet.connect(pybullet.DIRECT)
    set_up_physics(client, config.sim)
    add_table(client)
    for placed in scene.placements:
        spawn(client, placed.model, placed.position, placed.quaternion)
    yield client
    pybullet.disconnect(physicsClientId=client)


@contextmanager
def stock_client(scene: Scene, config: Config, robot: bool) -> Iterator[int]:
    """The same from the URDF files that PyBullet ships, on its plane."""
    client = pybullet.connect(pybullet.DIRECT)
    set_up_physics(client, config.sim)
    pybullet.loadURDF(str(DATA / "plane.urdf"), physicsClientId=client)
    if robot:
        panda = str(DATA / "franka_panda" / "panda.urdf")
        body = pybullet.loadURDF(panda, useFixedBase=True, physicsClientId=client)
        for joint, angle in enumerate(config.robot.home):
            pybullet.resetJointState(body, joint, angle, physicsClientId=client)
    for placed in scene.placements:
        name, origin = placed.model.name, placed.model.fine_visual.position
        pybullet.loadURDF(
            str(DATA / "random_urdfs" / name / f"{name}.urdf"),
            placed.position + Rotation.from_quat(placed.quaternion).apply(origin),
            placed.quaternion,
            globalScaling=placed.model.fine_visual.scale[0],
            physicsClientId=client,
        )
    yield client
    pybullet.disconnect(physicsClientId=client)


def mean_over_scenes(
    config: Config, scenes: Sequence[Scene], robot: bool, compare: Callable[[int, int], float]
) -> float:
    """Mean over scenes of compare(client with the stock files, client with ours)."""
    values = []
    for scene in scenes:
        with ExitStack() as stack:
            stock = stack.enter_context(stock_client(scene, config, robot))
            ours = stack.enter_context(our_client(scene, config, robot))
            values.append(compare(stock, ours))
    return float(np.mean(values))


# --- Frames -----------------------------------------------------------------------------------


def bench_frames(config: Config, scenes: Sequence[Scene], repeats: int) -> list[Metric]:
    """An RGB-D frame of the overhead camera against the stock meshes with PyBullet's defaults."""
    with PybulletCell(config) as cell:
        T_WC = cell.camera_pose("overhead")

    def compare(stock: int, ours: int, side: int) -> float:
        view = config.camera
        camera = Intrinsics(side, side, view.fov_deg, view.near, view.far)
        matrices = {
            "viewMatrix": np.linalg.inv(T_WC @ np.diag([1.0, -1.0, -1.0, 1.0])).T.ravel(),
            "projectionMatrix": projection_matrix(camera, pybullet.ER_TINY_RENDERER),
        }

        def stock_frame() -> None:
            pybullet.getCameraImage(
                side, side, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=stock, **matrices
            )

        def our_frame() -> None:
            PybulletCamera(ours, pybullet.ER_TINY_RENDERER).render(camera, T_WC)

        return median_ratio(lambda: seconds(stock_frame, 3), lambda: seconds(our_frame, 3), repeats)

    return [
        Metric(
            f"frame_{side}_vs_stock",
            mean_over_scenes(config, scenes, True, partial(compare, side=side)),
            "x",
            at_least=target,
        )
        for side, target in ((64, 8.0), (224, 2.2))
    ]


def seconds(work: Callable[[], None], times: int) -> float:
    start = perf_counter()
    for _ in range(times):
        work()
    return perf_counter() - start


# --- Physics ----------------------------------------------------------------------------------


def bench_physics(config: Config, scenes: Sequence[Scene], repeats: int) -> list[Metric]:
    """Physics steps a second with five resting `random_urdfs`: ours are concave, made of a few
    small hulls; the stock URDFs are single dense hulls."""

    def compare(stock: int, ours: int) -> float:
        for client in (stock, ours):
            advance(client, 2 * config.sim.frequency)  # come to rest
        return median_ratio(
            lambda: advance(stock, PHYSICS_STEPS), lambda: advance(ours, PHYSICS_STEPS), repeats
        )

    return [
        Metric("physics_5_objects_vs_stock", mean_over_scenes(config, scenes, False, compare), "x",
               at_least=2.0),
        Metric("physics_5_objects_and_robot_vs_stock",
               mean_over_scenes(config, scenes, True, compare), "x"),
    ]  # fmt: skip


def advance(client: int, steps: int) -> float:
    """Seconds that some physics steps take."""
    start = perf_counter()
    for _ in range(steps):
        pybullet.stepSimulation(physicsClientId=client)
    return perf_counter() - start


# --- Processes --------------------------------------------------------------------------------


def bench_processes(repeats: int) -> Metric:
    """Environment steps a second of two worker processes together against one alone."""
    context = multiprocessing.get_context("spawn")
    pipes, workers = [], []
    for _ in range(2):
        ours, theirs = context.Pipe()
        pipes.append(ours)
        workers.append(context.Process(target=step_on_request, args=(theirs,), daemon=True))
        workers[-1].start()

    def rate(pipes: list) -> float:
        for pipe in pipes:
            pipe.send(0.5)
        return sum(pipe.recv() for pipe in pipes)

    ratio = median_ratio(lambda: rate(pipes), lambda: rate(pipes[:1]), repeats)
    for pipe, worker in zip(pipes, workers):
        pipe.send(None)
        worker.join()
    return Metric("two_processes_vs_one", ratio, "x", at_least=1.8)


def step_on_request(pipe) -> None:
    """Worker: for each number of seconds received, step that long and send back steps a second."""
    config = with_settings(load_config(), "env", {"observations": ["state"]})
    env = RobotGraspingEnv(config=config)
    env.reset(seed=0)
    while (duration := pipe.recv()) is not None:
        start, count = perf_counter(), 0
        while perf_counter() - start < duration:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            count += 1
            if terminated or truncated:
                env.reset()
        pipe.send(count / (perf_counter() - start))
    env.close()


if __name__ == "__main__":
    run_script(main)
