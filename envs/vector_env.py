"""The environments of a training: copies of one Gymnasium environment, each in a worker process.

`make_env` makes one from the config's section `rl`, `training_envs` all of them. A worker that
raises, dies or hangs at a task ends the call with an error that says what is known about it: no
task of a worker waits for ever (in the main process, with rl.parallel=false or one environment, one
may). Environments never reset on their own, so that no final observation is lost.
This module knows no policy.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from tqdm import tqdm

from envs.objects import is_folder, load_objects
from utils.config import YAML_ERRORS, Config, load_yaml
from utils.config_schema import EnvConfig
from utils.errors import UserError, one_line
from utils.runs import REPOSITORY
from utils.worker_process import leave_signals, worker_environment

RANDOMIZED = "RandomizedGrasping-v0"
OWN_ENVS = "RobotGrasping-v0", RANDOMIZED  # take the whole config as an argument
ANSWERS = 10  # of a worker at least, in the time after which it counts as hung

Result = TypeVar("Result")

# Gymnasium reports a worker's error in several warnings; a WorkerError says it all once.
warnings.filterwarnings("ignore", module=AsyncVectorEnv.__module__)


class WorkerError(RuntimeError):
    """A worker process raised an error, died or did not answer; the message holds its traceback, if
    there is one."""


@contextmanager
def training_envs(config: Config, count: int) -> Iterator[TrainingEnvs]:
    """`count` environments of the config's section `rl`, closed at the end.

    Raises UserError for an environment that does not exist or does not take its arguments.
    """
    envs = TrainingEnvs(config, count)
    try:
        yield envs
    except BaseException:
        envs.kill()  # a worker in an unknown state would not answer a request to close
        raise
    envs.close()


def make_objects(config: Config) -> None:
    """Make all objects of a folder, so that a broken one is told of before the training begins, and
    not at the reset that happens to draw it. Raises UserError."""
    if config.rl.env_id in OWN_ENVS and is_folder(config.env.objects):
        objects = load_objects(config.env.objects, config)
        for index in tqdm(range(len(objects)), desc=f"objects {objects.name}"):
            objects[index]


def full_difficulty(env_id: str) -> dict[str, Any]:
    """Options of a reset for an episode of the task itself, without what makes training easier."""
    return {"start": "home"} if env_id in OWN_ENVS else {}


class TrainingEnvs:
    """`count` environments of one training; see `training_envs`.

    They implement `models.ppo_rollouts.Envs`. observation_space, action_space: of a single one.
    """

    def __init__(self, config: Config, count: int):
        self.num_envs = count
        self._id = config.rl.env_id
        self._timeout = config.rl.worker_timeout
        makers = [partial(make_env, config, index) for index in range(count)]
        self._parallel = config.rl.parallel and count > 1
        if self._parallel:
            method = start_method()
            if method == "forkserver":
                multiprocessing.set_forkserver_preload(loaded_here())
            with worker_environment(), _as_worker_errors(self._died):
                self._envs = AsyncVectorEnv(
                    makers, shared_memory=False, context=method,
                    autoreset_mode=AutoresetMode.DISABLED,
                )  # fmt: skip
        else:
            self._envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def each(self, task: Callable[[gymnasium.Env, int], Generator[None, None, Any]]) -> list[Any]:
        """What task(env, index) returns for each environment, in their order; tasks are described
        at `models.ppo_rollouts.Envs`. Raises WorkerError."""
        if not self._parallel:
            return [finished(task(env, index)) for index, env in enumerate(self._envs.envs)]
        # As bytes, because PyTorch would let tensors travel as files of shared memory.
        sent: bytes | None = pickle.dumps(task)
        between = self._timeout / ANSWERS
        answers: list[bytes | None] = [None] * self.num_envs
        with _as_worker_errors(self._died):
            while None in answers:
                self._envs.call_async("go_on", sent, between)
                new = self._envs.call_wait(self._timeout + between)
                answers = [old or answer for old, answer in zip(answers, new)]
                sent = None
        return [pickle.loads(answer) for answer in answers if answer is not None]

    def record_episodes(self, folder: Path | None, first: int = 0) -> None:
        """Let randomised environments record every episode from now on, each in a new file of its
        own in a folder: env0.jsonl and so on, counted from `first`. None: record no more."""
        if self._id != RANDOMIZED:
            return
        journals: list[Path | None] = [None] * self.num_envs
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            journals = [folder / f"env{first + number}.jsonl" for number in range(self.num_envs)]
            for journal in journals:
                journal.unlink(missing_ok=True)
        self._set("journal", journals)

    @contextmanager
    def at_full_difficulty(self) -> Iterator[None]:
        """Within this context episodes begin as the task has them, never made easier."""
        with self._reset_options(full_difficulty(self._id)):
            yield

    @contextmanager
    def pretraining(self) -> Iterator[None]:
        """Within this context episodes begin in any state that an episode may lead to."""
        with self._reset_options({"start": "pretraining"}):
            yield

    @contextmanager
    def _reset_options(self, options: dict[str, Any]) -> Iterator[None]:
        """Resets of this project's environments get these options; others do not know them."""
        self._set("reset_options", options if self._id in OWN_ENVS else {})
        yield
        # Not after an error: `training_envs` ends environments in which one was raised.
        self._set("reset_options", {})

    def _set(self, name: str, value: Any) -> None:
        with _as_worker_errors(self._died):
            self._envs.set_attr(name, value)

    @property
    def processes(self) -> list[multiprocessing.Process]:
        """The worker processes; none where rl.parallel is false."""
        return self._envs.processes if self._parallel else []

    def close(self) -> None:
        self._envs.close()

    def kill(self) -> None:
        """End the workers without asking them."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.join()
        if self._parallel:
            self._envs.closed = True
        else:
            self._envs.close()

    def _died(self) -> str:
        """A sentence about the workers that have died."""
        if not hasattr(self, "_envs"):
            return "a worker process died while it was started; its message stands above"
        wait([process.sentinel for process in self.processes], timeout=1.0)
        dead = [f"{i} (exit code {p.exitcode})" for i, p in enumerate(self.processes)
                if not p.is_alive()]  # fmt: skip
        return f"worker process {', '.join(dead) or 'of an environment'} died (out of memory?)"


def finished(task: Generator[None, None, Result]) -> Result:
    """Run a task to its end; returns its result."""
    while True:
        try:
            next(task)
        except StopIteration as end:
            return end.value


def start_method() -> str:
    """How worker processes are started: not forked from here, because threads, GPU contexts and
    OpenGL do not survive that. Windows has no fork server."""
    known = multiprocessing.get_all_start_methods()
    return "forkserver" if "forkserver" in known else "spawn"


@contextmanager
def _as_worker_errors(died: Callable[[], str]) -> Iterator[None]:
    """Turn Gymnasium's errors about a lost worker into WorkerError; `died` describes the loss."""
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError) as error:
        raise WorkerError(died()) from error
    except multiprocessing.TimeoutError as error:
        raise WorkerError(
            f"an environment hangs: {error}; rl.worker_timeout is how long it may take"
        ) from error


def loaded_here() -> list[str]:
    """Modules that every worker imports with the script: the workers' common parent imports them
    once."""
    own = {path.stem for path in REPOSITORY.iterdir() if path.suffix in ("", ".py")}
    names = [name for name in sys.modules if name.partition(".")[0] in own]
    return [*names, "torch.utils.tensorboard"]


def make_env(config: Config, index: int = 0, render_mode: str | None = None) -> gymnasium.Env:
    """One environment of the config's section `rl`, whose observations hold all entries that policy
    and critic see. Raises UserError if it cannot be made."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    settings = config.rl
    arguments = {}
    for text in settings.env_kwargs or ():
        name, _, value = text.partition("=")
        try:
            arguments[name] = load_yaml(value)
        except YAML_ERRORS as error:
            raise UserError(
                f"rl.env_kwargs: {text!r} is not valid YAML ({one_line(error)})"
            ) from error
    if render_mode is not None:  # panda-gym does not take None
        arguments["render_mode"] = render_mode
    if settings.env_id in OWN_ENVS:
        for name in arguments:
            if name in EnvConfig.model_fields:  # which alone the policy is scored by later
                raise UserError(
                    f"rl.env_kwargs: {name} is a key of section env; set env.{name} instead (a "
                    "run that was begun so cannot go on)"
                )
        arguments["config"] = config
    no_pictures = UserError(f"rl.films: {settings.env_id} draws no pictures; use rl.films=0")
    try:
        env = gymnasium.make(settings.env_id, disable_env_checker=True, **arguments)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise UserError(f"rl.env_id {settings.env_id}: {error}") from error
    except TypeError as error:
        if render_mode is not None and "render_mode" in str(error):
            raise no_pictures from error
        raise UserError(f"rl.env_kwargs {settings.env_kwargs}: {error}") from error
    except UserError:
        raise
    except (ValueError, LookupError, AssertionError) as error:  # Gymnasium's, and environments' own
        raise UserError(
            f"rl.env_id {settings.env_id}, rl.env_kwargs {settings.env_kwargs}: "
            f"{type(error).__name__}: {one_line(error)}"
        ) from error
    if env.spec is not None and env.spec.id in OWN_ENVS and settings.env_id not in OWN_ENVS:
        env.close()
        raise UserError(
            f"rl.env_id {settings.env_id}: write rl.env_id={env.spec.id}, so that the config "
            "counts for this project's environment (a run that was begun so cannot go on)"
        )
    if render_mode is not None and render_mode not in env.metadata.get("render_modes", ()):
        env.close()
        raise no_pictures
    seen = settings.policy_observations, settings.privileged_observations
    wanted = [name for names in (*seen, settings.estimated_observations) for name in names or ()]
    return CheckedEnv(with_info(env, wanted), index)


def with_info(env: gymnasium.Env, wanted: Sequence[str]) -> gymnasium.Env:
    """The environment, its observation completed by wanted entries that only its info holds."""
    space = env.observation_space
    here = space.spaces if isinstance(space, spaces.Dict) else {}
    missing = [name for name in wanted if name not in here]
    if not missing or not isinstance(space, spaces.Dict):
        return env
    _, info = env.reset(seed=0)
    missing = [name for name in missing if name in info]
    return InfoInObservation(env, missing, info) if missing else env


class InfoInObservation(gymnasium.ObservationWrapper):
    """Adds numeric entries of info to a dict observation, as float32 vectors."""

    def __init__(self, env: gymnasium.Env, names: Sequence[str], example: dict[str, Any]):
        super().__init__(env)
        self._names = names
        added = {
            name: spaces.Box(-np.inf, np.inf, self._vector(example, name).shape) for name in names
        }
        self.observation_space = spaces.Dict({**env.observation_space.spaces, **added})

    def reset(self, **arguments: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        observation, info = self.env.reset(**arguments)
        return self._complete(observation, info), info

    def step(self, action: np.ndarray) -> tuple:
        observation, *middle, info = self.env.step(action)
        return self._complete(observation, info), *middle, info

    def _complete(self, observation: dict, info: dict) -> dict[str, np.ndarray]:
        return {**observation, **{name: self._vector(info, name) for name in self._names}}

    @staticmethod
    def _vector(info: dict[str, Any], name: str) -> np.ndarray:
        try:
            return np.atleast_1d(np.asarray(info[name], np.float32))
        except (TypeError, ValueError):
            raise UserError(f"info entry {name!r} is no number or vector: {info[name]!r}") from None


class CheckedEnv(gymnasium.Wrapper):
    """Checks the observations of an environment, and turns its errors into one message.

    The message is text, because an error that cannot be pickled would never leave its process.
    reset_options: added to those of every reset.
    """

    def __init__(self, env: gymnasium.Env, index: int):
        super().__init__(env)
        self._index = index
        self.reset_options: dict[str, Any] = {}
        self._task: Iterator[None] = iter(())
        space = env.observation_space
        self._shapes = (
            {key: box.shape for key, box in space.items()}
            if isinstance(space, spaces.Dict)
            else space.shape
        )

    def go_on(self, task: bytes | None, seconds: float) -> bytes | None:
        """Begin a task of `TrainingEnvs.each`, or (None) go on with the one begun, for so many
        seconds; returns its result, or None where it has not ended. Worker processes call this."""
        leave_signals()  # not before: AsyncVectorEnv ends by SIGTERM those that it cannot start
        if task is not None:
            self._task = pickle.loads(task)(self, self._index)
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            try:
                next(self._task)
            except StopIteration as end:
                return pickle.dumps(end.value)
        return None

    def reset(self, *, options: dict[str, Any] | None = None, **arguments: Any) -> tuple:
        options = {**self.reset_options, **(options or {})} or None
        return self._checked(lambda: self.env.reset(options=options, **arguments))

    def step(self, action: np.ndarray) -> tuple:
        return self._checked(lambda: self.env.step(action))

    def _checked(self, call) -> tuple:
        try:
            result = call()
        except UserError as error:
            raise UserError(f"environment {self._index}: {error}") from None
        except (
            Exception
        ):  # a user's environment may raise anything; the message holds its traceback
            raise WorkerError(
                f"environment {self._index} raised an error:\n{traceback.format_exc()}"
            ) from None
        found = (
            {key: np.shape(value) for key, value in result[0].items()}
            if isinstance(result[0], dict)
            else np.shape(result[0])
        )
        if found != self._shapes:
            raise UserError(
                f"environment {self._index}: the observation has shapes {found}, its "
                f"space says {self._shapes}"
            )
        return result
