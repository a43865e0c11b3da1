"""What a worker process hands back of a scene."""

import contextlib

import pytest

from envs.cell import camera_intrinsics
from envs.evaluation_worker import (
    check_everything,
    check_sees_workspace,
    film_name,
    privileged_policies,
    work,
)
from tests.helpers.records import ROUNDS
from utils.config import Config, load_config, with_settings
from utils.errors import UserError
from utils.evaluation import Task


@pytest.mark.parametrize(
    ("policy", "objects", "noise", "name"),
    [
        ("heuristic+ibvs", "primitives", "none", "pile-primitives-heuristic+ibvs-7.mp4"),
        ("m:plan", "m:objects", "m:noise", "pile-m_objects-m_noise-m_plan-7.mp4"),
        ("ppo:nets/a.pt", "meshes/mine", "gamma", "pile-meshes_mine-gamma-ppo_nets_a.pt-7.mp4"),
        (r"C:\nets\a.pt", "box", "none", "pile-box-C__nets_a.pt-7.mp4"),
    ],
)
def test_a_film_has_a_name_that_every_system_allows(policy, objects, noise, name):
    task = Task(objects, "pile", 7, ((policy, "open_loop", noise),))
    assert film_name(task, policy, noise, "mp4") == name


def test_a_film_of_long_paths_has_a_name_of_its_own():
    """Systems allow 255 bytes, and a file that is being written has an ending more."""
    names = set()
    for policy in (
        "/home/me/" + 200 * "a" + ".pt",
        "/home/me/" + 200 * "a" + "b.pt",
        90 * "\u7269",
    ):
        task = Task(150 * "m", "pile", 7, ((policy, "open_loop", "none"),))
        names.add(film_name(task, policy, "none", "mp4"))
    assert len(names) == 3 and max(len(name.encode()) for name in names) < 200
    assert all(name.startswith("pile-mmm") and name.endswith(".mp4") for name in names)


def test_oracles_alone_see_the_true_scene():
    names = "random,heuristic,graspnet,oracle,oracle6d"
    config = load_config(None, [f"evaluate.policies={names}"])
    assert privileged_policies(config) == {"oracle", "oracle6d"}


def test_a_planner_that_cannot_tell_objects_apart_does_not_retrieve(config):
    def asked(policy: str) -> Config:
        changes = {"policies": (policy,), "scenarios": ("retrieve",), "object_sets": ("box",)}
        return with_settings(config, "evaluate", changes)

    with pytest.raises(UserError, match="random does not tell objects apart.*play 'retrieve'"):
        check_everything(asked("random"))
    check_everything(asked("heuristic"))


@pytest.mark.parametrize(
    ("words", "oldest"),
    [
        ("evaluate.scenarios=latency", "0.129"),  # 0.1 s, and 7 of the 8 steps of 1/240 s at 30 Hz
        ("evaluate.scenarios=latency safety.watchdog=0.13", None),
        ("evaluate.scenarios=latency evaluate.controllers=open_loop", None),
        ("evaluate.scenarios=static servo.rate=9", "0.108"),  # 26 of 27 steps
        ("evaluate.scenarios=static servo.rate=10", None),
        ("evaluate.scenarios=static closed_loop.compute_seconds=0.07", "0.129"),  # a third image
    ],
)
def test_closed_loops_that_the_watchdog_always_stops_are_refused(words, oldest):
    given = "evaluate.policies=random evaluate.controllers=ibvs evaluate.object_sets=box " + words
    config = load_config(None, ["sim.renderer=tiny", *given.split()])
    refused = pytest.raises(UserError, match=f"safety.watchdog: 0.1 s .* {oldest} s .* servo.rate")
    with refused if oldest else contextlib.nullcontext():
        check_everything(config)


@pytest.mark.parametrize(("layout", "what"), [("flat", "0.016 m thick"), ("tall", "0.12 m long")])
def test_a_set_of_which_no_object_suits_a_layout_is_refused_before_any_round(config, layout, what):
    """A cube of 6 cm is neither flat nor tall."""
    changes = {"policies": ("random",), "scenarios": ("pile", layout), "object_sets": ("box",)}
    with pytest.raises(UserError, match=f"no object of 'box' is .*{what}.* use the set {layout}"):
        check_everything(with_settings(config, "evaluate", changes))


@pytest.mark.parametrize(
    ("changes", "sees"),
    [
        ({}, True),
        ({"target": (-0.5, 0.0, 0.0)}, False),  # away from the table
        ({"far": 0.3}, False),  # the table is farther away
        ({"target": (0.5, 0.1, 0.0)}, True),  # the workspace's part
        ({"target": (-0.5, 0.0, 0.0), "view": "side"}, True),  # looks at the middle in any case
        ({"target": (-0.5, 0.0, 0.0), "mount": "wrist"}, True),
    ],
)
def test_a_camera_that_sees_nothing_of_the_workspace_is_refused(config, changes, sees):
    camera = with_settings(config, "camera", changes).camera
    K = camera_intrinsics(camera).K
    if sees:
        check_sees_workspace(camera, K, config.workspace)
        return
    with pytest.raises(UserError, match="camera: sees nothing of the workspace.*camera.target"):
        check_sees_workspace(camera, K, config.workspace)


@pytest.mark.usefixtures("kept_here")
def test_a_picture_knows_its_scene_and_names_the_object_set_where_there_are_several(config):
    def caption(sets: tuple[str, ...]) -> str:
        changes = {"policies": ("random",), "object_sets": sets, "max_failures": 1}
        task = Task("box", "isolated", 3, (("random", "open_loop", "none"),), keep_pictures=True)
        first, *_ = work(with_settings(config, "evaluate", changes), task).gallery
        assert first.kind == ("isolated", "box", "none")
        return first.caption.removesuffix(f": {first.reason}")

    assert caption(("box",)) == "random, isolated, clean depth"
    assert caption(("box", "primitives")) == "random, isolated, box, clean depth"


@pytest.mark.usefixtures("kept_here")
def test_a_round_is_played_by_the_rules_of_the_config(config, monkeypatch):
    rules = {"max_failures": 3, "second_look": 20.0, "abstain": 0.4}
    received = []

    def play(*arguments, **settings):
        received.append({name: settings[name] for name in rules})
        return ROUNDS[0]

    monkeypatch.setattr("envs.evaluation_worker.run_round", play)
    asked = with_settings(config, "evaluate", rules)
    work(asked, Task("box", "isolated", 0, (("random", "open_loop", "none"),)))
    assert received == [rules]
