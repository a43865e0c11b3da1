"""Names in a config: each registry is complete, documented, and answers an unknown name."""

import re

import pytest

from envs.registries import OBJECT_SET_KEYS, REGISTRIES, check_names
from utils.config import DEFAULTS, load_config
from utils.errors import UserError


def test_the_shipped_configs_name_entries_of_the_registries():
    for path in DEFAULTS.parent.glob("*.yaml"):
        check_names(load_config(path, ["data.root=."]))


@pytest.mark.parametrize("key", [*REGISTRIES, *OBJECT_SET_KEYS])
def test_any_entry_can_be_named(key):
    sets = ("box", "primitives", "random_urdfs", "thin", "tall", "flat", "household", "rounded")
    known = REGISTRIES.get(key, sets)
    for name in known:
        check_names(load_config(None, [f"{key}={name}", "env.goal=object"]))


@pytest.mark.parametrize("key", REGISTRIES)
def test_the_defaults_comment_lists_every_entry(key):
    section, _, name = key.rpartition(".")
    text = DEFAULTS.read_text(encoding="utf-8")
    if section:
        text = text[re.search(rf"^{section}:", text, re.MULTILINE).end() :]
    (line,) = re.findall(rf"^ *{name}: .*", text, re.MULTILINE)[:1]
    comment = line.partition("#")[2]
    for entry in REGISTRIES[key]:
        assert re.search(rf"\b{entry}\b", comment), f"{key}: {entry} is not in {comment!r}"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("evaluate.scenarios=pil", "evaluate.scenarios: got 'pil', .* did you mean pile?"),
        ("evaluate.controllers=ibsv", "evaluate.controllers: got 'ibsv', .* did you mean ibvs?"),
        (
            "env.scenario=moved",
            "env.scenario: got 'moved', expected one of bin, dense, flat, household, isolated",
        ),
        ("simulator=pybulet", "simulator: got 'pybulet', .* did you mean pybullet?"),
        ("data.kind=cornel", "data.kind: got 'cornel', .* did you mean cornell?"),
        ("train.backbone=vgg", "train.backbone: got 'vgg', expected one of .*grconvnet"),
        ("env.reward=dens", "env.reward: got 'dens', .* did you mean dense?"),
        ("evaluate.object_sets=random_urdf", "an existing folder or .* did you mean random_urdfs?"),
        ("evaluate.object_sets=primitive", "expected one of auto, box, primitives, "),
        ("env.objects=primitive", "expected one of box, primitives, "),
        ("env.reward={succes: 1}", "env.reward, a term: got 'succes', .* did you mean success?"),
        ("env.control=eee", "env.control: got 'eee', expected one of ee, ee_planar, joint"),
        ("rl.activation=gelu", "rl.activation: got 'gelu', .*elu"),
        ("camera.depth_noise=kinec", "camera.depth_noise: got 'kinec', .* did you mean kinect?"),
        ("train.depth_noises=[kinec]", "train.depth_noises: got 'kinec', .* did you mean kinect?"),
        ("env.objects=bx", "env.objects: got 'bx', expected one of box, .* did you mean box?"),
        ("data.object_sets=no_module:sets", "data.object_sets: .* there is no module 'no_module'"),
        ("transfer.columns=mujcoo", "transfer.columns: got 'mujcoo', .* did you mean mujoco?"),
        ("transfer.policies=[[a, b, random, [pil, box], null]]", "transfer.policies: got 'pil'"),
        ("transfer.policies=[[a, b, random, [pile, bx], null]]", "transfer.policies: got 'bx'"),
    ],
)
def test_an_unknown_name_is_answered_by_the_known_ones(override, message):
    with pytest.raises(UserError, match=message) as error:
        check_names(load_config(None, [override]))
    assert "\n" not in str(error.value)


def test_an_object_set_may_be_a_folder_or_an_import_path(tmp_path, monkeypatch):
    (tmp_path / "sets_to_check.py").write_text(f"folder = {str(tmp_path)!r}\nmissing = 'none'\n")
    monkeypatch.syspath_prepend(tmp_path)
    named = [tmp_path, "envs.objects:BoxSet", "sets_to_check:folder"]
    for name in named:
        check_names(load_config(None, [f"evaluate.object_sets=[box, {name}]"]))
    for name in ("math:pi", "sets_to_check:missing"):
        with pytest.raises(
            UserError, match="^env.objects: '.*' gives .*, expected an envs.objects"
        ):
            check_names(load_config(None, [f"env.objects={name}"]))


def test_a_config_that_names_a_missing_plug_in_can_be_loaded():
    for override in ("camera.depth_noise=no_module:noise", "env.reward=no_module:reward"):
        config = load_config(None, [override])
        with pytest.raises(UserError, match="there is no module 'no_module'"):
            check_names(config)
