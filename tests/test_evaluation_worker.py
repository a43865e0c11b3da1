"""What a worker process hands back of a scene."""

import pytest

from envs.evaluation_worker import film_name
from utils.evaluation import Task


@pytest.mark.parametrize(
    ("policy", "objects", "name"),
    [
        ("heuristic+ibvs", "primitives", "pile-primitives-heuristic+ibvs-7.mp4"),
        ("my_module:plan", "my_module:objects", "pile-my_module_objects-my_module_plan-7.mp4"),
        ("ppo:checkpoints/a.pt", "meshes/mine", "pile-mine-ppo_checkpoints_a.pt-7.mp4"),
        (r"C:\nets\a.pt", "box", "pile-box-C__nets_a.pt-7.mp4"),
    ],
)
def test_a_film_has_a_name_that_every_system_allows(policy, objects, name):
    task = Task(objects, "pile", 7, ((policy, "open_loop"),))
    assert film_name(task, policy, "mp4") == name
