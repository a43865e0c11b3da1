"""The config: defaults, merging, and one clear sentence for every mistake."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from utils.config import (
    DEFAULTS,
    ConfigError,
    alternatives,
    changed_keys,
    dump_config,
    known_keys,
    load_config,
    load_foreign,
    schema_at,
    with_settings,
)
from utils.errors import unknown_choice
from utils.plugins import code_named_in
from utils.runs import REPOSITORY


def write(folder: Path, text: str, name: str = "mine.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def message(*overrides: str, path: Path | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_without_a_file_or_overrides_the_values_are_those_of_the_defaults():
    config = load_config(None)
    assert config.seed == 0
    assert config.camera.position == (0.5, 0.0, 0.8)
    assert config.evaluate.policies == ("random", "heuristic", "graspnet", "oracle")
    assert config.env.control == "ee"
    assert config.evaluate.workers is None


def test_every_default_has_a_comment():
    for line in DEFAULTS.read_text(encoding="utf-8").splitlines():
        if ":" in line and not line.startswith("#") and not line.rstrip().endswith(":"):
            assert " # " in line, f"no unit or meaning: {line}"


def test_defaults_and_schema_have_the_same_keys():
    def keys(values, prefix=""):
        for key, value in values.items():
            yield prefix + key
            if isinstance(value, dict):
                yield from keys(value, f"{prefix}{key}.")

    assert set(keys(yaml.safe_load(DEFAULTS.read_text(encoding="utf-8")))) == set(known_keys())


def test_a_loaded_config_cannot_be_changed():
    with pytest.raises(ValidationError):
        load_config(None).seed = 1


def test_file_then_overrides(tmp_path):
    path = write(tmp_path, "seed: 7\nevaluate:\n  rounds: 50\n  videos: 3\n")
    config = load_config(path, ["evaluate.rounds=60", "camera.position=[0, 0, 1]"])
    assert (config.seed, config.evaluate.rounds, config.evaluate.videos) == (7, 60, 3)
    assert config.evaluate.gallery == load_config(None).evaluate.gallery
    assert config.camera.position == (0, 0, 1)


def test_empty_file_is_the_defaults(tmp_path):
    assert load_config(write(tmp_path, "# nothing\n")) == load_config(None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("evaluate.policies=[heuristic,oracle]", ("heuristic", "oracle")),
        ("evaluate.policies=heuristic,oracle", ("heuristic", "oracle")),
        ("evaluate.policies=oracle", ("oracle",)),
        ("evaluate.scenarios=pile", ("pile",)),
        ("camera.up=0, 1, 0", (0, 1, 0)),
        ("evaluate.name=007", "007"),
        ("evaluate.name=null", None),
        ("closed_loop.controller=a=b", "a=b"),
        ("evaluate.workers=2", 2),
        ("objects.scale=3e-1", 0.3),
        ("objects.density=1E3", 1000.0),
        ("camera={near: 0.2, far: 3}", None),
    ],
)
def test_override_values(text, expected):
    config = load_config(None, [text])
    if text.startswith("camera={"):
        assert (config.camera.near, config.camera.far, config.camera.width) == (0.2, 3, 224)
    else:
        section, key = text.split("=")[0].split(".")
        assert getattr(getattr(config, section), key) == expected


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("evaluate.roundz=5", ["evaluate.roundz", "unknown", "did you mean evaluate.rounds?"]),
        ("evalute.rounds=5", ["did you mean evaluate.rounds?"]),
        ("rounds=5", ["did you mean evaluate.rounds?"]),
        ("lift_height=1", ["execution.lift_height or env.lift_height"]),
        ("round=5", ["did you mean evaluate.rounds?"]),
        ("zzz=5", ["zzz", "allowed here: seed, cache_dir, simulator, compute, sim"]),
        ("sim.zzz=5", ["sim.zzz", "frequency, solver_iterations, renderer"]),
        ("seed.x=5", ["seed.x", "unknown"]),
        ("evaluate.rounds=0", ["evaluate.rounds", "got 0", "command line", "whole number >= 1"]),
        ("compute.timeout=1e10", ["compute.timeout", "a number > 0 and <= 604800"]),
        ("rl.worker_timeout=604801", ["rl.worker_timeout", "a number > 0 and <= 604800"]),
        ("execution.hold_seconds=1e308", ["hold_seconds", "a number >= 0 and <= 60"]),
        ("env.hold_seconds=61", ["hold_seconds", "a number >= 0 and <= 60"]),
        ("scene.settle_seconds=300", ["settle_seconds", "a number > 0 and <= 60"]),
        ("closed_loop.seconds=1e308", ["closed_loop.seconds", "a number > 0 and <= 60"]),
        ("closed_loop.lost_seconds=61", ["lost_seconds", "a number > 0 and <= 60"]),
        ("closed_loop.final_seconds=61", ["final_seconds", "a number > 0 and <= 60"]),
        ("closed_loop.compute_seconds=61", ["compute_seconds", "a number >= 0 and <= 60"]),
        ("evaluate.rounds=ten", ["got 'ten'", "whole number"]),
        ("evaluate.rounds=1.5", ["got 1.5", "whole number"]),
        ("evaluate.rounds=true", ["got true", "whole number"]),
        ("evaluate.rounds=null", ["got null", "whole number"]),
        ("robot.velocity_scale=1.5", ["got 1.5", "a number >= 0.01 and <= 1"]),
        ("execution.approach_speed=0.0001", ["got 0.0001", "a number >= 0.005 and <= 1.7"]),
        ("robot.grip_force=yes", ["got true", "a number > 0"]),
        ("robot.grip_force=.nan", ["got nan", "a number > 0"]),
        ("robot.home=[1,2]", ["robot.home", "a list of 7 numbers"]),
        ("camera.position=[0,a,1]", ["camera.position[1]", "got 'a'", "a list of 3 numbers"]),
        ("camera.mount=overhed", ["one of overhead, wrist", "did you mean overhead?"]),
        ("camera.near=5", ["camera: near (5.0) must be smaller than far (2.0)", "command line"]),
        ("camera={view: side, mount: wrist}", ["camera: view=side places the overhead camera"]),
        (
            "workspace={center: [0.45, -0.33], size: 0.25}",
            [
                "workspace must not overlap the tray, which takes x from 0.285 to 0.555 m and y "
                "from -0.615 to -0.345 m: move workspace.center"
            ],
        ),
        ("data.fold=0", ["data: fold is one of photographs, and kind is simulated"]),
        ("gripper={max_opening: 0.02, least_held: 0.02}", ["least_held (0.02) must be smaller"]),
        ("camera=3", ["camera: got 3", "a section with the keys mount, width"]),
        ("evaluate.scenarios=[]", ["evaluate.scenarios", "got []"]),
        ("evaluate.scenarios=pile,pile", ["repeated"]),
        ("randomization.parts=physic", ["parts[0]", "one of physics, vision", "mean physics?"]),
        ("objects.scale=-1", ["got -1", "a number > 0, or null"]),
        ("evaluate.rounds", ["KEY=VALUE without spaces"]),
        ("=5", ["KEY=VALUE"]),
        ("camera.position=[0,", ["camera.position", "YAML", "a list of 3 numbers"]),
        ("camera.position=0,]", ["camera.position", "YAML"]),
        ("env.reward={success:1}", ["env.reward", "lacks a space after a colon"]),
    ],
)
def test_bad_override(override, parts):
    text = message(override)
    for part in parts:
        assert part in text


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("evaluate: [1\n", ["not valid YAML: while", "in line 2"]),
        ("- 1\n- 2\n", ["got a list", "'key: value'"]),
        ("just text\n", ["got a str"]),
        ("sede: 1\n", ["sede: unknown key", "did you mean seed?"]),
        ("camera:\n  wdith: 3\n", ["camera.wdith", "did you mean camera.width?"]),
        ("camera:\n", ["camera: got null", "a section with the keys"]),
        ("evaluate.rounds: 2\n", ["evaluate.rounds: dots are for the command line", "rounds: 2"]),
        ("seed: 1\nseed: 2\n", ["stands twice", "line 2"]),
        ("1: 2\n", ["text"]),
        ("seed: -1\n", ["seed: got -1", ">= 0"]),
        ("seed: '1'\n", ["seed: got '1'"]),
        ("seed: -1\nscene:\n  count: 0\n", ["1 more problem"]),
    ],
)
def test_bad_file(tmp_path, content, parts):
    path = write(tmp_path, content)
    text = message(path=path)
    for part in [str(path), *parts]:
        assert part in text


def test_missing_file_names_a_near_one(tmp_path):
    write(tmp_path, "", "wrist.yaml")
    assert "did you mean wrist.yaml?" in message(path=tmp_path / "wirst.yaml")
    assert "check the path" in message(path=tmp_path / "no" / "such.yaml")


def test_unreadable_files(tmp_path):
    assert "cannot read" in message(path=tmp_path)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\xfa")
    assert "cannot read" in message(path=binary)


def test_every_leaf_explains_a_wrong_type():
    for key in known_keys():
        if "properties" not in schema_at(key):
            types = {part.get("type") for part in alternatives(schema_at(key))}
            wrong = "[2]" if "object" in types else "{a: 1}"
            text = message(f"{key}={wrong}")
            assert text.startswith(key) and "expected" in text


def test_dump_round_trip(tmp_path):
    config = load_config(None, ["evaluate.name=夹", f"cache_dir={tmp_path}", "objects.fit=0.06"])
    assert load_config(write(tmp_path, dump_config(config))) == config


def test_changed_keys_repeat_a_run():
    given = ["evaluate.name=007", "scene.count=2", "camera.up=0,1,0", "evaluate.policies=oracle"]
    config = load_config(None, [*given, "objects.scale=1e-7"])
    changes = changed_keys(config)
    assert len(changes) == 5 and "scene.count=2" in changes
    assert load_config(None, changes) == config
    assert changed_keys(load_config()) == []


def test_with_settings_changes_one_section():
    config = load_config()
    changed = with_settings(config, "env", {"max_steps": 7})
    assert changed.env.max_steps == 7 and config.env.max_steps != 7
    assert changed_keys(changed) == ["env.max_steps=7"]


def test_with_settings_refuses_an_unknown_key():
    with pytest.raises(ConfigError) as caught:
        with_settings(load_config(), "env", {"max_step": 7})
    text = str(caught.value)
    assert text.startswith("env.max_step: unknown key (keyword arguments)")
    assert "did you mean env.max_steps?" in text


def test_the_cache_is_in_the_key_s_folder_the_variable_s_or_the_home_s(monkeypatch, tmp_path):
    monkeypatch.delenv("ROBOT_GRASPING_CACHE", raising=False)
    assert load_config(None).cache_folder == Path.home() / ".cache" / "robot_grasping"
    monkeypatch.setenv("ROBOT_GRASPING_CACHE", str(tmp_path / "env"))
    assert load_config(None).cache_folder == tmp_path / "env"
    assert load_config(None, ["cache_dir=~/x"]).cache_folder == Path.home() / "x"


def test_unknown_choice():
    error = unknown_choice("evaluate.policies", "heuristc", ["random", "heuristic"])
    assert str(error) == (
        "evaluate.policies: got 'heuristc', expected one of heuristic, random; "
        "did you mean heuristic?"
    )


# --- Hostile files --------------------------------------------------------------------------------

LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{two}: &{two} [*{one}, *{one}]\n" for one, two in zip("abcdefgh", "bcdefghi")
)


@pytest.mark.parametrize(
    "text",
    [
        LAUGHS,
        "seed: &a 1\nsim: {<<: *a}\n",
        "seed: " + 5000 * "[",
        "{[1, 2]: 3}\n",
        "1: 2\n",
        "seed: 2020-99-99\n",
        "seed: " + 5000 * "9" + "\n",
        "seed: .nan\n",
        "robot: {grip_force: .inf}\n",
        "camera: {width: 1000000000}\n",
        "evaluate: {name: !!python/object/apply:os.system [id]}\n",
        "seed: 1\n--- \nseed: 2\n",
        "seed: 1\n" + 1_000_000 * "#",
        "\x00",
    ],
)
def test_a_hostile_file_is_one_sentence(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert len(str(caught.value)) < 1000 and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "stored",
    [
        {"rl": {"env_id": "antigravity:Grasping-v0"}},
        {"env": {"objects": "antigravity:objects"}},
        {"env": {"reward": "antigravity:reward"}},
        {"env": {"reward": {"success": 1.0, "antigravity:term": 0.1}}},
        {"camera": {"depth_noise": "antigravity:Noise"}},
        {"evaluate": {"policies": ["heuristic", "antigravity:plan"]}},
        {"evaluate": {"object_sets": ["antigravity:objects"]}},
        {"evaluate": {"policies": ["sb3:antigravity.zip"]}},
        {"evaluate": {"object_sets": {"antigravity:objects"}}},
        {"transfer": {"policies": [["x", "no", "antigravity:plan", None, None]]}},
        {"transfer": {"policies": [["x", "no", "y.pt", ["pile", "antigravity:objects"], None]]}},
    ],
)
def test_a_file_of_data_names_no_code(stored):
    """The command line may: then it is the user who names it."""
    with pytest.raises(
        ConfigError, match="FILE: names code to run, .*antigravity.*name it yourself"
    ):
        load_foreign(stored, "FILE")
    key, name = next(code_named_in(stored), ("", ""))
    if key in ("rl.env_id", "env.objects", "camera.depth_noise"):
        assert load_foreign(stored, "FILE", [f"{key}={name}"])
    assert "antigravity" not in sys.modules


def test_ppo_is_a_checkpoint_among_the_policies_and_a_module_elsewhere():
    def row(planner, objects):
        return [["x", "no", planner, ["pile", objects], None]]

    load_foreign({"evaluate": {"policies": ["ppo:mine.pt"]}}, "FILE")
    load_foreign({"transfer": {"policies": row("ppo:mine.pt", "primitives")}}, "FILE")
    for stored in (
        {"camera": {"depth_noise": "ppo:Noise"}},
        {"env": {"objects": "ppo:objects"}},
        {"evaluate": {"object_sets": ["ppo:objects"]}},
        {"transfer": {"policies": row("heuristic", "ppo:objects")}},
    ):
        with pytest.raises(ConfigError, match="FILE: names code to run, .*'ppo:"):
            load_foreign(stored, "FILE")


def test_a_file_of_data_does_not_say_where_to_compute_and_to_write():
    stored = {"cache_dir": "/etc", "compute": {"scheduler": "tcp://10.0.0.1:8786"}, "seed": 7}
    config = load_foreign(stored, "FILE", ["evaluate.rounds=3"])
    assert (config.seed, config.evaluate.rounds) == (7, 3)
    assert (config.cache_dir, config.compute.scheduler) == (None, None)


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_quick_chain_scores_the_network_that_it_has_trained():
    done = subprocess.run(
        ["make", "-n", "quick"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    (trained,) = re.findall(
        r"train_graspnet\.py --config configs/quick\.yaml --weights (\S+)", done.stdout
    )
    assert "evaluate.py --config configs/quick.yaml\n" in done.stdout
    assert trained in load_config(REPOSITORY / "configs" / "quick.yaml").evaluate.policies
