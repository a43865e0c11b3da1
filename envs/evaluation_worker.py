"""What a worker process of evaluate.py does: every policy works on the scene of a task.

`utils.evaluation` hands out the tasks. Each process has one cell, and one planner of each name,
which is reset for every round.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

from envs.cell import Cell
from envs.cell_scenes import make_scene
from envs.execution import GraspOutcome, check_bin
from envs.objects import OBJECT_SETS, ObjectSet, load_object_set, prepare
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
from models.planners import Planner, make_planner, needs_truth
from utils.config import Config
from utils.evaluation import Task, TaskResult, policies_of, worker_count
from utils.geometry import Workspace
from utils.report import picture
from utils.result_records import policy_name
from utils.transforms import Grasp, RGBDFrame

# --- In the main process, before any work is done --------------------------------------------


def check_everything(config: Config, key: str = "evaluate.policies") -> None:
    """Raise UserError for a policy, a cell or an object set that cannot be used.

    key: of the config, where the policies' names stand; for errors.
    The user's own meshes are read and cut into convex parts here, so that the error names a broken
    one before any work is done.
    """
    for name in config.evaluate.policies:
        if is_learned(name):
            controllers = [controller for _, controller in policies_of(config)]
            check_learned(name, config.evaluate.scenarios, controllers, config)
        else:
            new_planner(name, config, key)
    make_cell(config).close()
    check_bin(config)
    for name in config.evaluate.object_sets:
        objects = load_objects(name, config)
        if name not in OBJECT_SETS:
            prepare(objects, min(worker_count(config), len(objects)))


def privileged_policies(config: Config) -> set[str]:
    """The policies of the evaluation whose planners see the true scene."""
    planned = [name for name in config.evaluate.policies if not is_learned(name)]
    return {name for name in planned if needs_truth(new_planner(name, config))}


@functools.cache
def load_objects(name: str, config: Config) -> ObjectSet:
    return load_object_set(
        name, max_opening=config.gripper.max_opening, cache_dir=config.cache_folder,
        **config.objects.model_dump(),
    )  # fmt: skip


def new_planner(name: str, config: Config, key: str = "evaluate.policies") -> Planner:
    workspace = Workspace(tuple(config.workspace.center), config.workspace.size)
    return make_planner(name, config.gripper.geometry, workspace, config.seed, key)


# --- In a worker process ----------------------------------------------------------------------

_config: Config
_cell: Cell
_planners: dict[str, Planner]  # each is made once and reset for every round
_approaches: dict[str, PolicyApproach]  # of learned policies, each made once for the cell


def set_up(config: Config) -> None:
    global _config, _cell, _planners, _approaches
    _config, _cell, _planners, _approaches = config, make_cell(config), {}, {}


def work(task: Task) -> TaskResult:
    """Let each policy of a task work on its scene."""
    objects, layout = load_objects(task.objects, _config), SCENARIOS[task.scenario].layout
    scene = make_scene(layout, objects, task.seed, _config)
    result = TaskResult()
    for name, controller in task.policies:
        policy, approach, planner = policy_name(name, controller), None, placeholder
        if is_learned(name):
            if name not in _approaches:
                _approaches[name] = learned_approach(name, _cell)
            approach = _approaches[name]
        else:
            if name not in _planners:
                _planners[name] = new_planner(name, _config)
            planner = _planners[name]

        def keep(frame: RGBDFrame, grasp: Grasp, outcome: GraspOutcome, policy=policy) -> None:
            if task.keep_pictures or not outcome.success:
                shown = picture(frame, grasp, policy, task.scenario, outcome.reason)
                result.gallery.append(shown)

        film = Film(_cell) if task.film_folder is not None else None
        result.rounds.append(
            run_round(
                _cell, scene, planner, policy=name, objects=task.objects,
                max_failures=_config.evaluate.max_failures, scenario=task.scenario,
                controller=controller, on_attempt=keep, approach_by=approach,
            )
        )  # fmt: skip
        if film is not None:
            path = task.film_folder / _film_name(task, policy)
            film.write(path)
            result.films.append((path, f"{policy} on {task.scenario}"))
    return result


def _film_name(task: Task, policy: str) -> str:
    who = policy.replace(os.sep, "_")  # a checkpoint's path
    name = f"{task.scenario}-{Path(task.objects).name}-{who}-{task.seed}"
    return f"{name}.{_config.evaluate.film_format}"
