"""What a worker process of evaluate.py does: every policy works on the scene of a task.

`utils.evaluation` hands out the tasks. Each process has a cell for each depth noise (every further
one takes 30 MB in PyBullet and 50 MB in MuJoCo), and one planner of each name, which is reset for
every round.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from envs.cell import camera_intrinsics, require_arm
from envs.cell_arrangements import viewpoint_of
from envs.cell_scenes import TARGET_LAYOUT, check_suited, make_scene
from envs.closed_loop import check_watchdog
from envs.execution import GraspOutcome, check_tray
from envs.objects import OBJECT_SETS, load_objects, prepare
from envs.policy_approach import (
    PolicyApproach,
    check_learned,
    is_learned,
    learned_approach,
    placeholder,
)
from envs.rounds import run_round
from envs.scenarios import SCENARIOS
from envs.simulators import make_cell
from envs.studio import Film
from models.planner_target import check_takes_targets
from models.planners import (
    Planner,
    calibration_of,
    calibrations,
    make_planner,
    needs_truth,
    tilts,
)
from utils.config import Config
from utils.config_schema import CameraConfig, WorkspaceConfig
from utils.errors import UserError
from utils.evaluation import FilmFile, Task, TaskResult, policies_of, with_depth_noise
from utils.executor import open_executor
from utils.report import picture, set_in_words
from utils.result_formats import depth_in_words
from utils.result_records import CLEAN, OPEN_LOOP, policy_name
from utils.runs import portable_name
from utils.transforms import Grasp, RGBDFrame, look_at, project
from utils.worker_process import kept

# --- In the main process, before any work is done --------------------------------------------


def check_everything(config: Config, key: str = "evaluate.policies") -> None:
    """Raise UserError for a policy, a cell, an object set or a cluster that cannot be used.

    key: of the config, where the policies' names stand; for errors.
    The user's own meshes are read and cut into convex parts here, so that the error names a broken
    one before any work is done.
    """
    for name in config.evaluate.policies:
        controllers = {controller for _, controller in policies_of(config)}
        planner = None if is_learned(name) else new_planner(name, config, key)
        if controllers != {OPEN_LOOP}:
            require_arm(config, "a closed loop")
        if planner is None:
            require_arm(config, f"{key}: {name}")
            check_learned(name, config.evaluate.scenarios, sorted(controllers), config)
        elif tilts(planner) and controllers != {OPEN_LOOP}:
            raise UserError(
                f"{key}: {name} plans grasps from any side, and closed loops follow those from "
                f"straight above alone; score it with {OPEN_LOOP} alone"
            )
        for scenario in config.evaluate.scenarios:
            if SCENARIOS[scenario].layout == TARGET_LAYOUT and planner is not None:
                check_takes_targets(planner, f"{key}: {name}", f"play {scenario!r}")
        states_chances = planner is not None and calibration_of(planner) is not None
        if config.evaluate.abstain and not states_chances:
            raise UserError(
                f"evaluate.abstain: {name} states no chances of success (it has no `calibration`); "
                f"allowed with it are {', '.join(calibrations())}, a planner of your own that has "
                "one (docs/calibration.md), or evaluate.abstain=null"
            )
    if config.evaluate.second_look > 0:
        require_arm(config, "evaluate.second_look, whose camera is in the arm's hand,")
    layouts = {SCENARIOS[scenario].layout for scenario in config.evaluate.scenarios}
    if any(viewpoint_of(layout, config) is None for layout in layouts):
        check_sees_workspace(config.camera, camera_intrinsics(config.camera).K, config.workspace)
    with make_cell(config) as cell:
        if any(controller != OPEN_LOOP for _, controller in policies_of(config)):
            for scenario in config.evaluate.scenarios:
                check_watchdog(cell, scenario)
    if config.robot.arm != "none":
        check_tray(config)
    sets = {name: objects_of(name, config) for name in config.evaluate.object_sets}
    with open_executor(config.compute, config.evaluate.workers) as workers:
        for name, objects in sets.items():
            if name not in OBJECT_SETS:
                prepare(objects, workers, config.gripper.geometry)
            for scenario in config.evaluate.scenarios:
                check_suited(SCENARIOS[scenario].layout, objects, config)


def check_sees_workspace(camera: CameraConfig, K: np.ndarray, workspace: WorkspaceConfig) -> None:
    """Raise UserError where a fixed camera with intrinsics K shows no place of the workspace.

    No planner would find a grasp, and every policy would be scored with 0 %. Cameras of other
    mounts and views follow the hand or the workspace.
    """
    if camera.mount != "overhead" or camera.view != "fixed":
        return
    steps = np.linspace(-0.5, 0.5, 21) * workspace.size
    x, y = np.meshgrid(workspace.center[0] + steps, workspace.center[1] + steps)
    places = np.stack([x, y, np.zeros_like(x)], axis=-1)
    T_WC = look_at(camera.position, camera.target, camera.up)
    pixels, depth = project(places, K, T_WC)
    last = np.array([camera.width, camera.height]) - 0.5
    inside = ((pixels > -0.5) & (pixels < last)).all(axis=-1)
    if not (inside & (depth > camera.near) & (depth < camera.far)).any():
        raise UserError(
            "camera: sees nothing of the workspace, the square of the table with the side "
            f"{workspace.size:g} m around ({workspace.center[0]:g}, {workspace.center[1]:g}); "
            "point camera.target there, or change camera.position, camera.fov_deg, camera.near or "
            "camera.far"
        )


def privileged_policies(config: Config) -> set[str]:
    """The policies of the evaluation whose planners see the true scene."""
    planned = [name for name in config.evaluate.policies if not is_learned(name)]
    return {name for name in planned if needs_truth(new_planner(name, config))}


def new_planner(name: str, config: Config, key: str = "evaluate.policies") -> Planner:
    workspace = config.workspace.geometry
    return make_planner(name, config.gripper.geometry, workspace, config.seed, key)


# --- In a worker process ----------------------------------------------------------------------

cell_of = kept(make_cell)
objects_of = kept(load_objects)
planner_of = kept(new_planner)  # is reset for every round


@kept
def approach_of(name: str, config: Config) -> PolicyApproach:
    """A learned policy in the process's cell."""
    return learned_approach(name, cell_of(config))


def work(config: Config, task: Task) -> TaskResult:
    """Let each policy of a task work on its scene."""
    objects = objects_of(task.objects, config)
    objects.told = True  # by the main process, which prepares the sets
    scene = make_scene(SCENARIOS[task.scenario].layout, objects, task.seed, config)
    result = TaskResult()
    sets = config.evaluate.object_sets
    named = f", {set_in_words(task.objects, sets)}" if len(sets) > 1 else ""
    for name, controller, noise in task.policies:
        noisy = with_depth_noise(config, noise)
        cell = cell_of(noisy)
        policy, approach, planner = policy_name(name, controller), None, placeholder
        if is_learned(name):
            approach = approach_of(name, noisy)
        else:
            planner = planner_of(name, config)
        caption = f"{policy}, {task.scenario}{named}{depth_in_words(noise)}"
        kind = task.scenario, task.objects, noise

        def keep(
            frame: RGBDFrame, grasp: Grasp, outcome: GraspOutcome,
            policy=policy, caption=caption, kind=kind,
        ) -> None:  # fmt: skip
            if task.keep_pictures or not outcome.success:
                shown = picture(frame, grasp, policy, caption, outcome.reason, kind)
                result.gallery.append(shown)

        with Film(cell) if noise == task.filmed else nullcontext() as film:
            result.rounds.append(
                run_round(
                    cell, scene, planner, policy=name, objects=task.objects,
                    max_failures=config.evaluate.max_failures, abstain=config.evaluate.abstain,
                    second_look=config.evaluate.second_look, scenario=task.scenario,
                    controller=controller, on_attempt=keep, approach_by=approach,
                )
            )  # fmt: skip
            if film is not None:
                ending = config.evaluate.film_format
                file = film_name(task, policy, noise, ending)
                # Not written here: the run's folder may be on another machine.
                result.films.append(FilmFile(file, film.encoded(ending), caption))
    return result


def film_name(task: Task, policy: str, noise: str, suffix: str) -> str:
    """A film's name; policies, noises and object sets may be paths or MODULE:NAME."""
    kind = [task.scenario, task.objects, *([] if noise == CLEAN else [noise])]
    stem = "-".join([*kind, policy, str(task.seed)])
    return f"{portable_name(stem)}.{suffix}"
