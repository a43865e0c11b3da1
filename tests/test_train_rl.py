"""The training script of PPO: files, exact resume, troubles of environments, several processes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.tensorboard import SummaryWriter

import train_rl
from envs.policy_approach import KNOWN_TO_A_ROBOT, check_learned
from envs.studio import film_episode
from envs.vector_env import WorkerError, make_env, training_envs
from models.grasp_policy import GraspPPO, load_policy, make_ppo
from models.ppo import KIND
from models.ppo_observations import ObservationLayout
from models.ppo_progress import (
    not_finite,
    reached,
    scoring_command,
    warn_of_short_episodes,
)
from models.ppo_rollouts import (
    EVALUATION,
    Diverged,
    NotFinite,
    derived_seeds,
    evaluate_policy,
)
from tests.helpers.compare import same
from tests.helpers.interruption import interrupt_after
from tests.helpers.ppo_parts import batch_of, ppo_of
from tests.helpers.ppo_step import SIZE, take_step
from tests.helpers.quick_envs import POINT, PointEnv
from tests.helpers.torchrun import in_two_processes
from utils.checkpoint import load_checkpoint
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError
from utils.runs import REPOSITORY, Stopwatch, this_python


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run of six updates with four evaluations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("training"))
        assert train_rl.main(POINT) == 0
        (run,) = Path("runs/train_rl").resolve().iterdir()
    return run


# --- What a run leaves -------------------------------------------------------------------------


def test_a_training_leaves_all_its_files(finished):
    results = json.loads((finished / "results.json").read_text())
    history = results["history"]
    assert [(row["update"], row["step"]) for row in history] == [
        (0, 0),
        (2, 64),
        (4, 128),
        (6, 192),
    ]
    assert results["best"] == max(history, key=lambda row: (row["success"], row["return"]))
    last, best = (load_checkpoint(finished / f"{name}.pt", KIND) for name in ("last", "best"))
    assert last["step"] == 6 and last["extra"]["history"] == history
    assert best["step"] == results["best"]["update"]
    assert last["config"]["rl"]["hidden_dim"] == 8


def test_curves_name_their_units_and_whether_episodes_were_training(finished):
    events = EventAccumulator(str(finished / "tensorboard")).Reload()
    assert set(events.Tags()["scalars"]) == {
        "evaluation/return", "evaluation/length_steps", "evaluation/success_share",
        "training/return", "training/length_steps", "training/success_share",
        "update/loss", "update/policy_loss", "update/value_loss", "update/entropy_nats",
        "update/approx_kl_nats", "update/clip_fraction", "update/gradient_norm",
        "update/explained_variance", "update/std", "update/learning_rate", "update/optimizer_steps",
        "time/steps_per_second",
    }  # fmt: skip
    assert [event.step for event in events.Scalars("evaluation/return")] == [0, 64, 128, 192]
    assert [event.step for event in events.Scalars("update/loss")] == [32, 64, 96, 128, 160, 192]


def test_the_evaluation_of_the_best_policy_can_be_repeated(finished):
    """By itself, one environment after the other."""
    results = json.loads((finished / "results.json").read_text())
    policy = load_policy(finished / "best.pt")
    env = make_env(load_config(None, POINT))
    totals = []
    for seed in derived_seeds(3, 0, EVALUATION):
        observation, _ = env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            total, done = total + reward, terminated or truncated
        totals.append(total)
    assert np.mean(totals) == pytest.approx(results["best"]["return"], rel=1e-5)


def test_the_best_policy_alone_acts_as_in_its_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train_rl.main([*POINT, "rl.total_steps=64", "--weights", "alone.pt"]) == 0
    (run,) = Path("runs/train_rl").iterdir()
    alone, best = load_policy("alone.pt"), load_policy(run / "best.pt")
    seen, _ = make_env(load_config(None, POINT)).reset(seed=0)
    for value in best.network.parameters():
        value.data = value.data.half().float() if value.dim() > 1 else value.data
    assert alone(seen).tolist() == best(seen).tolist()  # but for half precision
    assert alone.config == best.config
    held, whole = (torch.load(file, weights_only=True) for file in ("alone.pt", run / "best.pt"))
    assert not held["optimizer"] and not held["rng"] and whole["optimizer"]
    assert {value.dtype for value in held["model"].values() if value.dim() > 1} == {torch.float16}
    with pytest.raises(UserError, match="existing folder"):
        train_rl.main([*POINT, "--weights", "nowhere/alone.pt"])


ESTIMATED = [
    "rl.env_kwargs=images=true", "rl.policy_observations=[rgb,depth,state]",
    "rl.estimated_observations=goal", "rl.normalise_observations=false",
    "rl.conv_channels=[8,16]", "rl.image_feature_dim=32",
]  # fmt: skip


@pytest.mark.parametrize("memory, images", [(0, 0), (48, 0), (48, 128)])
def test_a_run_that_estimates_goes_on_bit_for_bit(tmp_path, monkeypatch, memory, images):
    monkeypatch.chdir(tmp_path)
    whole = [*POINT, *ESTIMATED, "rl.total_steps=128", f"rl.estimate_memory={memory}",
             f"rl.pretraining_images={images}"]  # fmt: skip
    assert train_rl.main([*whole, "rl.name=whole"]) == 0
    (run,) = Path("runs/train_rl").glob("*-whole")
    expected = load_checkpoint(run / "last.pt", KIND)["model"]

    stopped_at = train_rl.reached
    monkeypatch.setattr(train_rl, "reached", lambda settings, row: row["step"] == 64)
    assert train_rl.main([*whole, "rl.name=halves"]) == 0
    monkeypatch.setattr(train_rl, "reached", stopped_at)
    (half,) = Path("runs/train_rl").glob("*-halves")
    assert train_rl.main(["--resume", str(half)]) == 0
    found = load_checkpoint(half / "last.pt", KIND)["model"]
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


@pytest.mark.slow
def test_the_estimator_learns_where_the_goal_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    longer = [*POINT, *ESTIMATED, "rl.total_steps=4096", "rl.rollout_steps=128", "rl.lr=1e-4",
              "rl.batch_size=64", "rl.estimate_epochs=8", "rl.anneal_lr=false"]  # fmt: skip
    assert train_rl.main(longer) == 0
    (run,) = Path("runs/train_rl").iterdir()
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    losses = [event.value for event in events.Scalars("update/estimate_loss")]
    assert losses[-1] < losses[0] / 3


@pytest.mark.slow
def test_pretraining_teaches_the_estimator_before_anything_is_done(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = [*POINT, *ESTIMATED, "rl.total_steps=128", "rl.rollout_steps=64",
                "rl.hidden_dim=32", "rl.pretraining_images=4000", "rl.estimate_memory=500",
                "rl.estimate_epochs=8"]  # fmt: skip
    assert train_rl.main(settings) == 0
    (run,) = Path("runs/train_rl").iterdir()
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    losses = events.Scalars("pretraining/estimate_loss")
    assert [event.step for event in losses] == list(range(-3968, 1, 64)), "whole turns of 2 x 32"
    assert losses[-1].value < losses[0].value / 2, "of images not learned from yet"
    first = events.Scalars("update/estimate_loss")[0].value
    assert first < losses[0].value / 2, "what was learned is not lost"


def test_pretraining_without_anything_to_estimate_is_refused():
    with pytest.raises(UserError, match="pretraining_images .* estimated_observations"):
        load_config(None, ["rl.pretraining_images=64"])


def test_what_is_estimated_has_no_other_role():
    for other in ("policy", "privileged"):
        with pytest.raises(UserError, match="goal"):
            load_config(None, ["rl.estimated_observations=goal", f"rl.{other}_observations=goal"])


def test_evaluation_does_not_depend_on_how_many_environments_there_are():
    ppo, episodes = None, []
    for count in (1, 3, 8):
        config = load_config(None, [*POINT, f"rl.envs={count}", "rl.batch_size=8"])
        with training_envs(config, count) as envs:
            ppo = ppo or make_ppo(envs.observation_space, envs.action_space, config)
            episodes.append(evaluate_policy(ppo.network, envs, ppo.layout, range(7), Stopwatch()))
    for other in episodes[1:]:
        assert [e.length for e in other] == [e.length for e in episodes[0]]
        np.testing.assert_allclose(
            [e.total for e in other], [e.total for e in episodes[0]], rtol=1e-5
        )


def test_a_target_that_no_episode_has_reported_is_warned_of():
    changes = ["rl.env_id=Pendulum-v1", "rl.target_success=0.9", "rl.target_return=-200"]
    settings = load_config(None, changes).rl
    with pytest.warns(UserWarning, match="no episode .* Pendulum-v1 reported .*rl.target_return"):
        assert not reached(settings, {"return": -300.0})
    assert reached(settings, {"return": -300.0, "success": 0.9})


def test_where_the_time_went_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train_rl.main([*POINT, "rl.target_return=-100"]) == 0  # reached before any update
    out = capsys.readouterr().out
    assert "% simulation and rendering" in out and "% network" in out and "% overhead" in out
    (run,) = Path("runs/train_rl").iterdir()
    assert load_checkpoint(run / "last.pt", KIND)["step"] == 0


# --- Going on ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stop", "saved", "words", "changes"),
    [
        (3, 2, "stopped after 96 steps, but the last checkpoint is of 64: {go_on} goes", []),
        # The evaluation that is due is broken off, and no step is lost.
        (4, 4, "128 steps, at a checkpoint; go on with {go_on}\n", ["rl.parallel=true"]),
    ],
)
def test_ctrl_c_and_resume_end_as_if_nothing_had_happened(
    finished, tmp_path, monkeypatch, capfd, stop, saved, words, changes
):
    """A real Ctrl-C; then it goes on, in worker processes too."""
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        interrupt_after(patch, GraspPPO, "update", lambda ppo: ppo.updates == stop)
        assert train_rl.main(POINT) == 130
    (run,) = Path("runs/train_rl").iterdir()
    go_on = f"{this_python()} train_rl.py --resume {run}"
    assert words.format(go_on=go_on) in capfd.readouterr().out
    assert load_checkpoint(run / "last.pt", KIND)["step"] == saved

    assert train_rl.main(["--resume", str(run), *changes]) == 0
    for name in ("last.pt", "best.pt"):
        ours, theirs = (load_checkpoint(folder / name, KIND) for folder in (run, finished))
        for part in ("step", "model", "optimizer", "extra"):
            assert same(ours[part], theirs[part]), (name, part)


def test_ctrl_c_breaks_off_the_first_evaluation(finished, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("models.ppo_rollouts.SLICE_SECONDS", 0.0)
        interrupt_after(patch, PointEnv, "step", lambda env: env._steps == 3)
        assert train_rl.main([*POINT, "--weights", "alone.pt"]) == 130
    (run,) = Path("runs/train_rl").iterdir()
    out, err = capfd.readouterr()
    assert err.count("interrupted: stopping") == 1 and "evaluating: 0 of 3 episodes" in err
    command = f"{this_python()} train_rl.py --resume {run} --weights alone.pt"
    assert f"stopped after 0 steps, at a checkpoint; go on with {command}\n" in out
    assert "best evaluation" not in out and not Path("alone.pt").exists()
    assert train_rl.main(["--resume", str(run)]) == 0
    for name in ("last.pt", "best.pt"):
        ours, theirs = (load_checkpoint(folder / name, KIND) for folder in (run, finished))
        for part in ("step", "model", "optimizer", "extra"):
            assert same(ours[part], theirs[part]), (name, part)


def test_pretraining_is_not_repeated_where_the_first_evaluation_was_broken_off(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("models.ppo_rollouts.SLICE_SECONDS", 0.0)
        interrupt_after(patch, PointEnv, "step", lambda env: True)
        pretrained = [*POINT, *ESTIMATED, "rl.pretraining_images=64", "rl.total_steps=32"]
        assert train_rl.main(pretrained) == 130
    (run,) = Path("runs/train_rl").iterdir()
    monkeypatch.setattr(train_rl, "pretrain_estimator", None)
    assert train_rl.main(["--resume", str(run)]) == 0


def test_episodes_that_checkpoints_cut_short_are_told_of():
    with pytest.warns(UserWarning, match="every 32 steps, so that none .* env.max_steps=100; eval"):
        warn_of_short_episodes(load_config(None, ["rl.rollout_steps=32", "rl.evaluate_every=1"]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for file in ("ppo", "ppo_primitives", "ppo_random_urdfs", "ppo_state", "ppo_varied_looks"):
            warn_of_short_episodes(load_config(REPOSITORY / f"configs/{file}.yaml", []))


def test_an_environment_s_bad_number_is_not_taken_for_a_diverged_network(tmp_path):
    bad, diverged = NotFinite("the reward"), Diverged("a gradient")
    looking = "; look at the environment's rewards and observations"
    assert str(not_finite(bad, tmp_path, ALONE)).endswith(looking)
    assert str(not_finite(diverged, tmp_path, ALONE)).endswith("rewards, or lower rl.lr")
    (tmp_path / "last.pt").touch()
    assert str(not_finite(bad, tmp_path, ALONE)).endswith(f"last.pt are sound{looking}")
    assert "continue from them with rl.initial" in str(not_finite(diverged, tmp_path, ALONE))
    second = ALONE._replace(rank=1, ranks=2)
    assert str(not_finite(bad, tmp_path, second)).startswith("process 1 of 2: the reward; ")


def test_the_end_says_where_policy_and_curves_are(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train_rl.main([*POINT, "rl.target_return=-100"]) == 0
    (run,) = Path("runs/train_rl").iterdir()
    out = capsys.readouterr().out
    assert f"its policy: {run / 'best.pt'}\n" in out
    curves = f"{this_python()} -m tensorboard.main --logdir {run / 'tensorboard'}"
    assert f"curves: {curves}\n" in out
    assert "evaluate.py" not in out, "which knows the project's own environments"


def test_a_policy_that_sees_what_no_robot_knows_is_not_scored_beside_planners():
    config, box = load_config(None, ["env.objects=primitives"]), spaces.Box(-1, 1, (3,))
    seen = ObservationLayout.of(spaces.Dict({"gripper": box}))
    assert scoring_command(config, Path("run"), seen, KNOWN_TO_A_ROBOT) == (
        f"{this_python()} evaluate.py evaluate.policies=ppo:run/best.pt "
        "evaluate.scenarios=isolated evaluate.object_sets=primitives"
    )
    # With what makes another cell, and nothing of the training.
    cell = ["simulator=mujoco", "objects.scale=1.5", "objects.split=train", "seed=3", "rl.lr=1e-4",
            "randomization.parts=[vision]", "camera.depth_noise=gamma"]  # fmt: skip
    other = load_config(None, ["env.objects=primitives", "env.control=ee", *cell])
    command = scoring_command(other, Path("run"), seen, KNOWN_TO_A_ROBOT)
    assert command.partition(" evaluate.object_sets=primitives ")[2] == (
        "'simulator=\"mujoco\"' objects.scale=1.5 evaluate.depth_noises=gamma"
    )
    more = ObservationLayout.of(spaces.Dict({"gripper": box, "object_offset": box}))
    command = scoring_command(config, Path("run"), more, KNOWN_TO_A_ROBOT)
    assert command == f"{this_python()} -m benchmarks.bench_policy run/best.pt"


def test_resuming_a_finished_run_changes_nothing(finished, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    monkeypatch.chdir(tmp_path)
    assert train_rl.main(["--resume", str(copy)]) == 0
    assert (copy / "last.pt").read_bytes() == (finished / "last.pt").read_bytes()


def test_resuming_keeps_the_curves_up_to_its_checkpoint(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    with SummaryWriter(run / "tensorboard") as writer:  # as of updates after the last checkpoint
        writer.add_scalar("update/loss", 7.0, 224)
    assert train_rl.main([*POINT, "--resume", str(run)]) == 0
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("evaluation/return")] == [0, 64, 128, 192]
    assert events.Scalars("update/loss")[-1].step == 192


def test_an_environment_without_pictures_is_told_of_before_the_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="rl.films: .*QuickPoint-v0 draws no pictures"):
        train_rl.main([*POINT, "rl.films=1"])
    assert not Path("runs").exists()


def test_an_error_before_the_first_checkpoint_names_none(tmp_path, monkeypatch):
    """Six evaluation episodes: the third of a process has a reward that is no number."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="not finite.*nothing was saved before"):
        train_rl.main([*POINT, "rl.env_kwargs=trouble=reward", "rl.evaluation_episodes=20"])
    (run,) = Path("runs/train_rl").iterdir()
    assert not (run / "last.pt").exists()


def test_what_cannot_be_resumed(finished, tmp_path):
    for changes in (["rl.lr=0.1"], ["seed=9"], ["env.max_steps=5"]):
        with pytest.raises(UserError, match="only .*rl.name.* may differ"):
            train_rl.main(["--resume", str(finished), *changes])
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(finished / "config.yaml", empty)
    with pytest.raises(UserError, match=r"no environment\.json"):
        train_rl.main(["--resume", str(empty)])
    shutil.copy(finished / "environment.json", empty)
    with pytest.raises(UserError, match="no last.pt"):
        train_rl.main(["--resume", str(empty)])
    (empty / "last.pt").write_bytes((finished / "last.pt").read_bytes()[:-300])
    with pytest.raises(UserError, match="last.pt: the checkpoint is truncated"):
        train_rl.main(["--resume", str(empty)])


def test_a_training_can_start_from_weights(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    initial = f"rl.initial={finished / 'best.pt'}"
    assert train_rl.main([*POINT, initial, "rl.target_return=-100"]) == 0
    (run,) = Path("runs/train_rl").iterdir()
    ours, theirs = (load_checkpoint(file, KIND)["model"] for file in
                    (run / "last.pt", finished / "best.pt"))  # fmt: skip
    assert same(dict(ours), dict(theirs))


def test_a_run_goes_on_without_the_file_of_its_first_weights(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    initial = Path(shutil.copy(finished / "best.pt", "initial.pt"))
    started = [*POINT, f"rl.initial={initial}", "rl.total_steps=128"]
    assert train_rl.main([*started, "rl.name=whole"]) == 0
    with monkeypatch.context() as patch:
        interrupt_after(patch, GraspPPO, "update", lambda ppo: ppo.updates == 3)
        assert train_rl.main([*started, "rl.name=halves"]) == 130
    initial.unlink()
    (whole,), (halves,) = (list(Path("runs/train_rl").glob(f"*-{n}")) for n in ("whole", "halves"))
    assert train_rl.main(["--resume", str(halves)]) == 0
    ours, theirs = (load_checkpoint(folder / "last.pt", KIND) for folder in (halves, whole))
    for part in ("step", "model", "optimizer", "extra"):
        assert same(ours[part], theirs[part]), part
    assert load_config(halves / "config.yaml").rl.initial == initial


# --- Mistakes and troubles ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["rl.env_id=Pendulums-v1"], "rl.env_id Pendulums-v1: .*Pendulum"),
        (["rl.env_id=no_such_module:Pendulum-v1"], "rl.env_id .*no_such_module"),
        (["rl.env_kwargs=gravity=3"], "rl.env_kwargs .*gravity"),
        (["rl.env_id=:Foo-v0"], "rl.env_id :Foo-v0, .*Empty module name"),
        (["rl.env_kwargs=max_episode_steps=0"], "rl.env_kwargs .*max_episode_steps=0.* positive"),
        (["rl.env_kwargs=gravity"], "rl.env_kwargs.*NAME=VALUE"),
        (["rl.env_id=tests.helpers.quick_envs:QuickDiscrete-v0"], "Discrete"),
        (["rl.env_id=CartPole-v1"], "Discrete"),
        (["rl.policy_observations=stat"], "'stat', expected one of state; did you mean state"),
        (["rl.policy_observations=name"], "info entry 'name' is no number"),
        (["rl.device=tpu"], "rl.device: got 'tpu'"),
        (
            ["rl.batch_size=12"],
            r"batch_size \(12\) must divide envs x rollout_steps \(32\); use rl.batch_size=8 or 16",
        ),
        (["rl.batch_size=64"], r"envs x rollout_steps \(32\); use rl.batch_size=32"),
        (["rl.initial=nowhere.pt"], "nowhere.pt"),
    ],
)
def test_mistakes_end_a_run_before_its_folder_is_made(tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        train_rl.main([*POINT, *changes])
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("trouble", "message"),
    [
        ("reward", r"the reward of environment \d is not finite at step \d+"),
        ("observation", r"observation 'state' of environment \d is not finite at step \d+"),
        ("keys", r"environment \d: the observation has shapes {'velocity': \(4,\)}"),
        ("shape", r"environment \d: the observation has shapes {'state': \(1,\)}"),
    ],
)
def test_bad_numbers_end_a_run_with_a_sound_checkpoint(tmp_path, monkeypatch, trouble, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        train_rl.main([*POINT, f"rl.env_kwargs=trouble={trouble}", "rl.evaluation_episodes=2"])
    (run,) = Path("runs/train_rl").iterdir()
    if trouble in ("reward", "observation"):
        assert str(run / "last.pt") in str(caught.value)
    weights = load_checkpoint(run / "last.pt", KIND)["model"]
    assert all(torch.isfinite(value).all() for value in weights.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trouble", "message"),
    [
        ("raise", "(?s)raised an error.*quick_envs.py.*OddError.*the table is gone"),
        ("die", r"worker process .*[01] \(exit code 7\) died"),
        ("hang", "hangs"),
    ],
)
def test_lost_workers_end_a_run(tmp_path, monkeypatch, capsys, trouble, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WorkerError, match=message):
        train_rl.main([*POINT, "rl.parallel=true", "rl.worker_timeout=10",
                       f"rl.env_kwargs=trouble={trouble}"])  # fmt: skip
    (run,) = Path("runs/train_rl").iterdir()
    assert f"go on with {this_python()} train_rl.py --resume {run}" in capsys.readouterr().err
    assert (run / "last.pt").exists()


@pytest.mark.slow
def test_a_killed_worker_ends_the_script_with_its_traceback(tmp_path):
    changes = ["rl.parallel=true", "rl.env_kwargs=trouble=raise"]
    done = subprocess.run(
        [sys.executable, REPOSITORY / "train_rl.py", *POINT, *changes], cwd=tmp_path, timeout=200,
        capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 1 and "OddError" in done.stderr and "the table is gone" in done.stderr
    bad = subprocess.run(
        [sys.executable, REPOSITORY / "train_rl.py", "rl.env_id=CartPole-v1"], cwd=tmp_path,
        timeout=200, capture_output=True, text=True, env=os.environ,
    )  # fmt: skip
    assert bad.returncode == 2 and bad.stderr.splitlines()[-1].startswith(
        "error: rl.env_id CartPole"
    )


# --- Several processes -------------------------------------------------------------------------


@pytest.mark.slow
def test_two_processes_take_the_step_of_the_joint_minibatch(tmp_path):
    in_two_processes(REPOSITORY, "-m", "tests.helpers.ppo_step", tmp_path)
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert same(dict(first), dict(second)), "the processes stay together"
    joint = take_step(ALONE)
    for name, value in joint.items():
        torch.testing.assert_close(first[name], value, rtol=1e-4, atol=1e-6, msg=name)
    half = ppo_of()
    half.gradient(half.losses(batch_of(SIZE).rows(slice(0, None, 2))).loss)
    assert not torch.allclose(half.weights.grad, joint["gradient"], rtol=0.01)


@pytest.mark.slow
def test_torchrun_replaces_a_lost_process_and_the_training_goes_on(tmp_path):
    """From the last checkpoint, in the run's one folder, with no command of the user's."""
    printed = in_two_processes(
        tmp_path, "--max-restarts=1", REPOSITORY / "train_rl.py", *POINT, "rl.envs=4",
        "rl.env_kwargs=trouble=lost",
    )  # fmt: skip
    assert (tmp_path / "lost").exists() and printed.count("PPO on") == 2
    assert "2 process(es)" in printed and printed.count("best evaluation") == 1
    (run,) = (tmp_path / "runs" / "train_rl").iterdir()
    rows = json.loads((run / "results.json").read_text())["history"]
    assert [row["step"] for row in rows] == [0, 128, 192]


# --- Learning ----------------------------------------------------------------------------------


LITTLE = 0.3  # the success of a policy that has not learned


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "changes"),
    [
        (0.95, ["rl.squash=false"]),
        (0.85, ["rl.squash=true", "rl.env_kwargs=images=true", "rl.conv_channels=8,8",
                "rl.privileged_observations=goal", "rl.total_steps=60000"]),
    ],
)  # fmt: skip
def test_the_point_learns_to_go_to_its_goal(tmp_path, monkeypatch, target, changes):
    """From its coordinates, and from an image with what is privileged for the critic."""
    monkeypatch.chdir(tmp_path)
    settings = ["rl.total_steps=30000", "rl.rollout_steps=64", "rl.envs=8", "rl.batch_size=128",
                "rl.hidden_dim=32", "rl.lr=2e-3", "rl.gamma=0.9", "rl.evaluation_episodes=50",
                f"rl.target_success={(LITTLE + target) / 2}", "rl.evaluate_every=10", "rl.epochs=5",
                "rl.image_feature_dim=64", "rl.target_kl=null",
                "rl.initial_log_std=-1"]  # fmt: skip
    assert train_rl.main([*POINT, *settings, *changes]) == 0
    (run,) = Path("runs/train_rl").iterdir()
    history = json.loads((run / "results.json").read_text())["history"]
    # Half of what was there to win: how much of it a seed gets differs from processor to processor.
    # The training stops as soon as it is certain.
    assert history[0]["success"] < LITTLE
    assert max(row["success"] for row in history) >= (history[0]["success"] + target) / 2


@pytest.mark.slow
def test_the_pendulum_is_learned(tmp_path, monkeypatch):
    """To a return that takes swinging up and balancing from most places: hanging still costs about
    1,200 an episode, the best known policies 150."""
    monkeypatch.chdir(tmp_path)
    settings = ["rl.env_id=Pendulum-v1", "rl.envs=4", "rl.rollout_steps=256", "rl.batch_size=64",
                "rl.epochs=10", "rl.gamma=0.9", "rl.lr=1e-3", "rl.hidden_dim=64",
                "rl.total_steps=100000", "rl.parallel=false", "rl.target_kl=null",
                "rl.evaluation_episodes=20", "rl.initial_log_std=0",
                "rl.evaluate_every=10", "rl.target_return=-600", "rl.device=cpu"]  # fmt: skip
    assert train_rl.main(settings) == 0
    (run,) = Path("runs/train_rl").iterdir()
    history = json.loads((run / "results.json").read_text())["history"]
    assert history[0]["return"] < -900 and max(row["return"] for row in history) >= -600


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo_state", "ppo"])
def test_the_cell_is_trained_by_the_shipped_configs(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    small = ["rl.envs=2", "rl.rollout_steps=8", "rl.batch_size=8", "rl.total_steps=32",
             "rl.evaluate_every=1", "rl.evaluation_episodes=2", "env.max_steps=6",
             "sim.renderer=tiny", "rl.device=cpu", "rl.epochs=1"]  # fmt: skip
    arguments = ["--config", str(REPOSITORY / "configs" / f"{name}.yaml"), *small]
    assert train_rl.main(arguments) == 0
    (run,) = Path("runs/train_rl").iterdir()
    policy = load_policy(run / "last.pt")
    keys = {part.key for part in (*policy.layout.images, *policy.layout.state)}
    assert ("object_offset" in keys) == (name == "ppo_state")
    printed = capsys.readouterr().out
    if name == "ppo":  # the command that is printed can be carried out
        assert f"evaluate.policies=ppo:{run / 'best.pt'} evaluate.scenarios=isolated" in printed
        box = load_config(None, ["evaluate.object_sets=box"])
        check_learned(f"ppo:{run / 'best.pt'}", ["isolated"], ["open_loop"], box)
    else:
        assert f"benchmarks.bench_policy {run / 'best.pt'}" in printed
    first = load_checkpoint(run / "last.pt", KIND)
    shutil.rmtree("runs")
    assert train_rl.main(arguments) == 0  # the same seeds, in new processes
    (run,) = Path("runs/train_rl").iterdir()
    assert same(dict(first["model"]), dict(load_checkpoint(run / "last.pt", KIND)["model"]))


@pytest.mark.parametrize(
    "name", ["ppo", "ppo_state", "ppo_primitives", "ppo_random_urdfs", "ppo_varied_looks"]
)
def test_shipped_configs_are_valid(name):
    config = load_config(REPOSITORY / "configs" / f"{name}.yaml")
    hidden = {*(config.rl.privileged_observations or ()), *(config.rl.estimated_observations or ())}
    truth = {"object_position", "object_offset", "object_outline", "grasp_goal", "grasped"}
    if not name.endswith("_state"):
        assert hidden and hidden < truth, "only the critic sees them"
        assert not truth & set(config.rl.policy_observations)
    if config.rl.initial:
        layout = load_policy(REPOSITORY / config.rl.initial).layout
        assert {part.key for part in layout.parts()} - hidden == {*config.rl.policy_observations}


def test_episodes_are_filmed(tmp_path):
    """One picture at the start, one after each of three steps, and the last one for a while."""
    changes = ["env.observations=state", "env.max_steps=3", "env.hold_seconds=0"]
    config = load_config(None, [*changes, "sim.renderer=tiny"])
    env = make_env(config, render_mode="rgb_array")
    path = tmp_path / "films" / "0.mp4"
    assert film_episode(env, lambda observation: np.zeros(7), 0, path) == "max_steps"
    env.close()
    pictures = iio.imread(path)
    assert pictures.shape == (1 + 3 + 6, 480, 640, 3) and pictures.std() > 20


def test_the_environment_of_films_is_closed_where_one_fails(tmp_path, monkeypatch):
    closed = []

    def broken(*_):
        raise UserError("no room for a film")

    monkeypatch.setattr(train_rl, "film_episode", broken)
    monkeypatch.setattr(
        train_rl, "make_env", lambda *_, **__: SimpleNamespace(close=lambda: closed.append(True))
    )
    asked = []
    monkeypatch.setattr(train_rl, "load_policy", asked.append)
    with pytest.raises(UserError, match="no room for a film"):
        train_rl.film(load_config(None, ["rl.films=1"]), tmp_path)
    assert closed == [True] and asked == [tmp_path / "best.pt"]
