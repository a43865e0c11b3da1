"""Checkpoints: one file that alone rebuilds its model, and never runs code when loaded.

The file is `torch.save` of a dict of tensors, numbers, strings and containers, with this project's
mark, a kind ("graspnet", ...) and a format version. It is loaded with `weights_only=True`, because
a pickled object could run code. This module knows no network.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import nn

from utils.atomic_files import check_writable, write_atomic
from utils.errors import UserError, one_line

MAGIC = "robot-grasping checkpoint"
FORMAT_VERSION = 1  # raise when the meaning of an entry changes
LARGEST_SIZE = 100_000  # of a layer, far beyond any network of this project
PLAIN = (bool, int, float, str, bytes, type(None), torch.Tensor)  # what `weights_only` loads

Model = TypeVar("Model", bound=nn.Module)
Generators = Mapping[str, np.random.Generator | torch.Generator]


def save_checkpoint(
    path: Path | str,
    *,
    kind: str,
    model_args: dict[str, Any],
    model: nn.Module,
    optimizer: torch.optim.Optimizer | None = None,
    scheduler: torch.optim.lr_scheduler.LRScheduler | None = None,
    step: int = 0,
    rng: dict[str, Any] | None = None,
    config: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
    format_version: int = FORMAT_VERSION,
    half_precision: bool = False,
) -> None:
    """Write a checkpoint whole or not at all.

    kind: the kind of model, checked when loading. model_args: arguments that rebuild the
    architecture. model: the bare module, not its DistributedDataParallel. step: optimiser steps
    taken. rng: from `rng_states`. config: the resolved config as plain data. extra: other plain
    data, such as normalisers or metrics. half_precision: the kernels and matrices among the weights
    are stored as float16, in half the space; whoever loads them gets float32, rounded to 11 bits.
    Raises TypeError for values that cannot be loaded again.
    """
    content = {
        "magic": MAGIC,
        "format_version": format_version,
        "kind": kind,
        "model_args": dict(model_args),
        "model": _halved(model.state_dict()) if half_precision else model.state_dict(),
        "optimizer": None if optimizer is None else optimizer.state_dict(),
        "scheduler": None if scheduler is None else scheduler.state_dict(),
        "step": step,
        "rng": rng or {},
        "config": config or {},
        "extra": extra or {},
    }
    _check_plain(content, "checkpoint")
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomic(Path(path), buffer.getvalue())


def _halved(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Vectors, such as the variances of batch normalisations, stay as they are, and so does what
    float16 does not reach."""
    most = torch.finfo(torch.float16).max
    return {
        name: value.half() if value.dim() > 1 and bool((value.abs() < most).all()) else value
        for name, value in weights.items()
    }


def check_weights_file(option: str, path: Path | None, kind: str) -> None:
    """Raise UserError if a checkpoint of this kind could not be written at the end to the file that
    an option names, or would replace a file that is none of this kind."""
    check_writable(option, path)
    if path is None or not path.exists():
        return
    try:
        load_checkpoint(path, kind)
    except UserError as error:
        raise UserError(
            f"{option} {path}: would replace a file that holds no {kind} of this program; give "
            "another name"
        ) from error


def load_checkpoint(
    path: Path | str,
    kind: str,
    *,
    model_args: dict[str, Any] | None = None,
    format_version: int = FORMAT_VERSION,
    map_location: str | torch.device = "cpu",
) -> dict[str, Any]:
    """Return the dict that `save_checkpoint` wrote, with entries named like its arguments.

    model_args: if given, the architecture that the checkpoint must hold. Raises UserError, naming
    the file, if it is missing, damaged, no checkpoint of this project, or of another kind, version
    or architecture.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the checkpoint: {error.strerror}") from None
    content = _unpack(data, path, map_location)
    if not isinstance(content, dict) or content.get("magic") != MAGIC:
        raise UserError(f"{path}: not a checkpoint of this project")
    _check_entries(content, path, len(data))
    if content["format_version"] != format_version:
        raise UserError(
            f"{path}: checkpoint format version {content['format_version']}, "
            f"this program reads version {format_version}"
        )
    if content["kind"] != kind:
        raise UserError(f"{path}: a checkpoint of kind {content['kind']!r}, expected {kind!r}")
    if model_args is not None and content["model_args"] != model_args:
        raise UserError(
            f"{path}: a checkpoint of another architecture: "
            + _differences(content["model_args"], model_args)
        )
    return content


def build_model(
    make: Callable[..., Model],
    checkpoint: dict[str, Any],
    path: Path | str,
    bounds: Collection[str] = (),
) -> Model:
    """Build the model of a checkpoint's arguments, with its weights, in evaluation mode.

    bounds: names of what may be infinite.

    Nothing is allocated before the shapes have been compared: a few numbers in a file may ask for
    any amount of memory. Raises UserError, naming `path`, where they do not fit, and for weights
    that are not finite.
    """
    arguments, stored = checkpoint["model_args"], checkpoint["model"]
    try:
        if any(isinstance(value, int) and value > LARGEST_SIZE for value in _parts(arguments)):
            raise ValueError(f"a size is larger than {LARGEST_SIZE}")
        with torch.device("meta"):
            planned = make(**arguments)
    except (TypeError, ValueError, RuntimeError, KeyError, IndexError) as error:
        raise UserError(
            f"{path}: a checkpoint of another architecture: {one_line(error)}"
        ) from None
    _check_fit(planned, stored, path)
    model = make(**arguments)
    load_weights(model, checkpoint, path)
    weights = model.state_dict()
    finite = [torch.isfinite(v) | (torch.isinf(v) & (k in bounds)) for k, v in weights.items()]
    if not all(bool(each.all()) for each in finite):
        raise UserError(f"{path}: holds weights that are not finite; its training has diverged")
    return model.eval()


def load_weights(model: nn.Module, checkpoint: dict[str, Any], path: Path | str) -> None:
    """Load a checkpoint's weights into a model; UserError names `path` if they do not fit."""
    _check_fit(model, checkpoint["model"], path)
    model.load_state_dict(checkpoint["model"])


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Within this context, entries of a checkpoint that are missing or unlike what was saved raise
    UserError, which names `path`."""
    try:
        yield
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError, AttributeError) as error:
        raise UserError(
            f"{path}: the checkpoint's entries do not fit ({type(error).__name__}: "
            f"{one_line(error)}); start anew or from another checkpoint"
        ) from error


def _check_fit(model: nn.Module, stored: dict[str, torch.Tensor], path: Path | str) -> None:
    own = model.state_dict()
    wrong = sorted(own.keys() ^ stored.keys())
    wrong += sorted(k for k in own.keys() & stored.keys() if own[k].shape != stored[k].shape)
    if wrong:
        raise UserError(
            f"{path}: a checkpoint of another architecture: {len(wrong)} tensors do not fit, "
            f"the first is {wrong[0]}"
        )


def rng_states(generators: Generators) -> dict[str, Any]:
    """Return the states of torch's generators (CPU, all GPUs) and of the named ones, plain."""
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "named": {
            name: generator.bit_generator.state
            if isinstance(generator, np.random.Generator)
            else generator.get_state()
            for name, generator in generators.items()
        },
    }


def restore_rng(states: dict[str, Any], generators: Generators) -> None:
    """Restore the states that `rng_states` returned; the named generators continue from there."""
    torch.set_rng_state(states["torch"].cpu())
    if torch.cuda.is_available() and len(states["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([state.cpu() for state in states["cuda"]])
    for name, generator in generators.items():
        state = states["named"][name]
        if isinstance(generator, np.random.Generator):
            generator.bit_generator.state = state
        else:
            generator.set_state(state.cpu())


def _unpack(data: bytes, path: Path, map_location: str | torch.device) -> Any:
    """Verify the archive's checksums and return the object that torch.save packed."""
    if not data.startswith(b"PK"):
        raise UserError(f"{path}: not a checkpoint of this project")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # torch.save compresses nothing; what is compressed may have any size in memory.
            packed = any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist())
            damaged = "it is compressed" if packed else archive.testzip()
    except Exception as error:  # zipfile raises errors of many kinds for damaged archives
        damaged = one_line(error) or type(error).__name__
    if damaged is not None:
        raise UserError(f"{path}: the checkpoint is truncated or damaged ({damaged})")
    try:
        return torch.load(io.BytesIO(data), map_location=map_location, weights_only=True)
    except Exception as error:  # torch raises several types for archives that it did not write
        raise UserError(
            f"{path}: not a checkpoint of this project ({type(error).__name__})"
        ) from None


_ENTRIES: dict[str, type | tuple[type, ...]] = {
    "format_version": int,
    "kind": str,
    "model_args": dict,
    "model": dict,
    "optimizer": (dict, type(None)),
    "scheduler": (dict, type(None)),
    "step": int,
    "rng": dict,
    "config": dict,
    "extra": dict,
}


def _check_entries(content: dict[str, Any], path: Path, size: int) -> None:
    """Raise UserError for entries that `save_checkpoint` would not have written, and for a tensor
    that is larger than the whole file of `size` bytes: it repeats the same numbers."""
    for name, kind in _ENTRIES.items():
        if not isinstance(content.get(name), kind):
            raise UserError(f"{path}: not a checkpoint of this project, its {name} is missing")
    weights = content["model"].items()
    sound = all(isinstance(k, str) and isinstance(v, torch.Tensor) for k, v in weights)
    try:
        for count, part in enumerate(_parts(content)):
            if isinstance(part, torch.Tensor) and part.numel() * part.element_size() > size:
                sound = False
            if not sound or count > size:  # no part takes less than a byte, unless it is repeated
                raise UserError(f"{path}: not a checkpoint of this project, its parts do not fit")
    except RecursionError:
        raise UserError(f"{path}: not a checkpoint of this project, it has no end") from None


def _parts(value: Any) -> Iterator[Any]:
    """A value and all that is nested in it, the keys of mappings included."""
    yield value
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _parts(key)
            yield from _parts(entry)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for entry in value:
            yield from _parts(entry)


def _differences(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Return 'max_width is 0.15, expected 0.08' for every entry that differs."""
    return ", ".join(
        f"{key} is {found.get(key)!r}, expected {expected.get(key)!r}"
        for key in sorted(found.keys() | expected.keys())
        if found.get(key) != expected.get(key)
    )


def _check_plain(value: Any, where: str) -> None:
    """Raise TypeError, with the place, for a value that `weights_only` would refuse to load."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            _check_plain(key, f"{where} key")
            _check_plain(entry, f"{where}.{key}")
    elif isinstance(value, (list, tuple)):
        for number, entry in enumerate(value):
            _check_plain(entry, f"{where}[{number}]")
    elif isinstance(value, np.generic) or not isinstance(value, PLAIN):
        raise TypeError(f"{where}: a {type(value).__name__} cannot be kept in a checkpoint")
