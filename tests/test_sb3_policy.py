"""Policies of Stable-Baselines3: loaded, checked against the environment, and at work in a cell."""

import base64
import builtins
import io
import json
import pickle
import warnings
import zipfile

import cloudpickle
import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from envs.cell_scenes import make_scene
from envs.objects import load_object_set
from envs.policy_approach import check_learned, is_learned, learned_approach, placeholder
from envs.rounds import run_round
from envs.simulators import make_cell
from models import sb3_policy
from models.sb3_policy import load_sb3
from utils.config import load_config
from utils.errors import UserError

stable_baselines3 = pytest.importorskip("stable_baselines3")
DummyVecEnv = stable_baselines3.common.vec_env.DummyVecEnv
VecNormalize = stable_baselines3.common.vec_env.VecNormalize
FEW = {"PPO": {"n_steps": 8, "batch_size": 8, "n_epochs": 1}, "SAC": {"learning_starts": 4}}
SETTINGS = {"observations": ["state"], "control": "ee_planar", "max_steps": 4}
CONFIG = load_config(
    None,
    ["env.observations=state", "env.control=ee_planar", "env.max_steps=4", "sim.renderer=tiny"],
)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The files of a PPO and a SAC policy, each trained for a few steps."""
    folder = tmp_path_factory.mktemp("sb3")
    env = gymnasium.make("RobotGrasping-v0", **SETTINGS)
    for name, settings in FEW.items():
        algorithm = getattr(stable_baselines3, name)
        model = algorithm("MultiInputPolicy", env, seed=0, device="cpu", **settings)
        model.learn(8).save(folder / f"{name}.zip")
    env.close()
    return folder


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_the_algorithm_is_found_and_its_actions_are_the_model_s(files, name):
    policy = load_sb3(files / f"{name}.zip")
    assert type(policy.model).__name__ == name
    observation = {"state": np.linspace(-0.1, 0.1, 15, dtype=np.float32), "other": np.zeros(3)}
    model = getattr(stable_baselines3, name).load(files / f"{name}.zip", device="cpu")
    expected, _ = model.predict({"state": observation["state"]}, deterministic=True)
    np.testing.assert_array_equal(policy(observation), expected)


def test_a_trained_policy_is_scored(files):
    name = f"sb3:{files / 'PPO.zip'}"
    assert is_learned(name) and not is_learned("sb3")
    check_learned(name, ["isolated"], ["open_loop"], CONFIG)
    objects = load_object_set("box", cache_dir=CONFIG.cache_folder)
    with make_cell(CONFIG) as cell:
        record = run_round(
            cell, make_scene("isolated", objects, 0, CONFIG), placeholder, policy=name,
            objects="box", max_failures=1, approach_by=learned_approach(name, cell),
        )  # fmt: skip
    (attempt,) = record.attempts
    assert (record.policy, attempt.reason) == (name, "stopped"), "eight steps teach no grasp"
    assert "gripped nothing" in attempt.detail


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "env.observations=depth",
            r"observes state \(15,\) float32, but the section env gives depth",
        ),
        ("env.control=joint", r"has actions of shape \(5,\), but env.control expects \(8,\)"),
    ],
)
def test_a_policy_of_other_spaces_is_refused(files, override, message):
    config = load_config(None, ["sim.renderer=tiny", "env.control=ee_planar", override])
    with pytest.raises(UserError, match=message):
        check_learned(f"sb3:{files / 'SAC.zip'}", ["isolated"], ["open_loop"], config)


def test_a_policy_that_sees_the_truth_is_refused(tmp_path):
    """As one of train_rl.py is: no robot knows where the object is."""
    knowing = load_config(
        None,
        ["env.observations=state,object_position", "env.control=ee_planar", "sim.renderer=tiny"],
    )
    env = gymnasium.make(
        "RobotGrasping-v0", **(SETTINGS | {"observations": ["state", "object_position"]})
    )
    model = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu")
    model.save(tmp_path / "knowing.zip")
    env.close()
    with pytest.raises(UserError, match="observe object_position, which no robot knows"):
        check_learned(f"sb3:{tmp_path / 'knowing.zip'}", ["isolated"], ["open_loop"], knowing)


def normalised(algorithm, settings, **arguments):
    """A policy that was trained for some steps under VecNormalize."""
    env = DummyVecEnv([lambda: gymnasium.make("RobotGrasping-v0", **SETTINGS)])
    env = VecNormalize(env, **arguments)
    model = algorithm("MultiInputPolicy", env, seed=0, device="cpu", **settings)
    model.learn(16)
    env.close()
    return model


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_a_policy_of_normalised_observations_is_refused(tmp_path, name):
    """Its spaces are those of the environment: VecNormalize changes them for images alone."""
    model = normalised(getattr(stable_baselines3, name), FEW[name])
    model.save(tmp_path / "policy.zip")
    with pytest.raises(UserError, match="'state' .* as under VecNormalize, whose statistics"):
        check_learned(f"sb3:{tmp_path / 'policy.zip'}", ["isolated"], ["open_loop"], CONFIG)


def test_a_policy_of_normalised_rewards_is_remarked_on(files, tmp_path):
    model = normalised(stable_baselines3.PPO, FEW["PPO"], norm_obs=False)
    model.save(tmp_path / "policy.zip")
    with pytest.warns(UserWarning, match="unless it normalised rewards alone.*VecNormalize"):
        check_learned(f"sb3:{tmp_path / 'policy.zip'}", ["isolated"], ["open_loop"], CONFIG)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in FEW:
            check_learned(f"sb3:{files / name}.zip", ["isolated"], ["open_loop"], CONFIG)


def test_a_normalised_image_is_refused(files):
    policy = load_sb3(files / "PPO.zip")
    policy.observation_space = spaces.Dict({"rgb": spaces.Box(-10, 10, (64, 48, 3), np.float32)})
    policy.last = {"rgb": np.linspace(-1, 1, 64 * 48 * 3).reshape(1, 64, 48, 3)}
    ours = spaces.Dict({"rgb": spaces.Box(0, 255, (64, 48, 3), np.uint8)})
    with pytest.raises(UserError, match="'rgb' .* as under VecNormalize"):
        policy.check_spaces(ours, policy.action_space)


def test_images_may_have_their_channels_first(files):
    policy = load_sb3(files / "PPO.zip")
    policy.observation_space = spaces.Dict({"rgb": spaces.Box(0, 255, (3, 64, 48), np.uint8)})
    ours = {"rgb": spaces.Box(0, 255, (64, 48, 3), np.uint8), "state": spaces.Box(-9, 9, (15,))}
    policy.check_spaces(spaces.Dict(ours), policy.action_space)
    policy.observation_space = spaces.Box(0, 1, (15,))
    with pytest.raises(UserError, match="expected a Dict of rgb .64, 48, 3. uint8, state"):
        policy.check_spaces(spaces.Dict(ours), policy.action_space)


def test_a_file_that_is_none_is_refused(tmp_path):
    with pytest.raises(UserError, match="cannot read this file: No such file"):
        load_sb3(tmp_path / "missing.zip")
    (tmp_path / "other.zip").write_text("no zip")
    with pytest.raises(UserError, match="not a policy of Stable-Baselines3"):
        load_sb3(tmp_path / "other.zip")


def test_what_a_module_has_imported_is_none_of_its_classes():
    """`functools.partial`, which calls anything, is known to Stable-Baselines3's policies."""
    from stable_baselines3.common import policies

    assert hasattr(policies, "partial")
    for name, module in (("partial", "stable_baselines3.common.policies"), ("chain", "torch.nn")):
        code = f"c{module}\n{name}\n.".encode()
        with pytest.raises(pickle.UnpicklingError, match=f"{name}, which no policy needs"):
            sb3_policy._NetworkUnpickler(io.BytesIO(code)).load()
    code = b"cstable_baselines3.common.policies\nActorCriticPolicy\n."
    assert sb3_policy._NetworkUnpickler(io.BytesIO(code)).load() is policies.ActorCriticPolicy


def test_code_in_a_file_is_not_run(files, tmp_path):
    """A pickle that makes a file, in place of each object of a sound policy in turn."""
    made = tmp_path / "made"

    class Code:
        def __reduce__(self):
            return made.touch, ()

    code = base64.b64encode(cloudpickle.dumps(Code())).decode()
    with zipfile.ZipFile(files / "PPO.zip") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    for key in [key for key, value in data.items() if ":serialized:" in str(value)]:
        changed = data | {key: data[key] | {":serialized:": code}}
        path = tmp_path / f"{key}.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in (parts | {"data": json.dumps(changed)}).items():
                archive.writestr(name, content)
        try:
            load_sb3(path)  # what a policy needs to act is refused, anything else is left out
        except UserError as error:
            assert "which no policy needs" in str(error)
        assert not made.exists()


def test_a_policy_with_discrete_actions_is_refused(tmp_path):
    env = gymnasium.make("CartPole-v1")
    stable_baselines3.DQN("MlpPolicy", env, device="cpu", buffer_size=8).save(tmp_path / "dqn.zip")
    with pytest.raises(UserError, match="dqn.policies, which has no continuous actions; train"):
        load_sb3(tmp_path / "dqn.zip")


@pytest.mark.parametrize("module", ["sb3_contrib.tqc.policies", "mine"])
def test_a_policy_of_another_package_is_refused(tmp_path, module):
    path = tmp_path / "tqc.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps({"policy_class": {"__module__": module}}))
    package = module.partition(".")[0]
    with pytest.raises(UserError, match=f"is of {package}, which is not supported; train with PPO"):
        load_sb3(path)


def test_without_the_package_one_sentence_says_so(tmp_path, monkeypatch):
    def without(name, *rest, imported=builtins.__import__):
        if name == "stable_baselines3":
            raise ModuleNotFoundError(name)
        return imported(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserError, match="is not installed; pip install stable-baselines3"):
        load_sb3(tmp_path / "policy.zip")
