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

import gymnasium
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.metrics import Metric, benchmark_parser, median_ratio, report
from envs.cell import Intrinsics
from envs.cell_layout import Scene
from envs.cell_scenes import make_scene
from envs.grasping_env import RobotGraspingEnv
from envs.objects import load_object_set
from utils.config import Config, load_config, with_settings
from utils.runs import run_script

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
    against nothing but the physics steps in it."""
    ours = RobotGraspingEnv(config=config, observations=["state"], substeps=20)
    peer = gymnasium.make("PandaPickAndPlace-v3").unwrapped
    physics_seconds: list[float] = []
    advance = ours.cell.step

    def timed_advance(count: int) -> None:
        start = perf_counter()
        advance(count)
        physics_seconds.append(perf_counter() - start)

    def share() -> float:
        physics_seconds.clear()
        return seconds_per_step(ours) * STEPS / sum(physics_seconds)

    for env in (ours, peer):
        env.action_space.seed(0)
    faster = median_ratio(lambda: seconds_per_step(peer), lambda: seconds_per_step(ours), repeats)
    rate = 1 / seconds_per_step(ours)
    ours.cell.step = timed_advance
    overhead = float(np.median([share() for _ in range(repeats)]))
    ours.close()
    peer.close()
    return [
        Metric("step_vs_panda_gym", faster, "x", at_least=1.5),
        Metric("step_vs_bare_physics", overhead, "x", at_most=1.25),
        Metric("steps_per_second", rate, "1/s"),
    ]


def seconds_per_step(env: gymnasium.Env) -> float:
    """Mean over a new episode of random actions; the reset is not counted."""
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(STEPS)]
    start = perf_counter()
    for action in actions:
        env.step(action)
    return (perf_counter() - start) / STEPS


# --- Physics clients ----------------------------------------------------------------------------


@contextmanager
def our_client(scene: Scene, config: Config, robot: bool) -> Iterator[int]:
    """A physics client with our table, (robot and bin,) and the scene's objects."""
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
