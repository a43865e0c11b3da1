"""Checkpoints: one file that alone rebuilds its model, and never runs code when loaded.

The file is `torch.save` of a dict of tensors, numbers, strings and containers, with this project's
mark, a kind ("graspnet", ...) and a format version. It is loaded with `weights_only=True`, because
a pickled object could run code. This module knows no network.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from utils.errors import UserError
from utils.runs import write_atomic

MAGIC = "robot-grasping checkpoint"
FORMAT_VERSION = 1  # raise when the meaning of an entry changes
PLAIN = (bool, int, float, str, bytes, type(None), torch.Tensor)  # what `weights_only` loads

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
) -> None:
    """Write a checkpoint whole or not at all.

    kind: the kind of model, checked when loading. model_args: arguments that rebuild the
    architecture. model: the bare module, not its DistributedDataParallel. step: optimiser steps
    taken. rng: from `rng_states`. config: the resolved config as plain data. extra: other plain
    data, such as normalisers or metrics. Raises TypeError for values that cannot be loaded again.
    """
    content = {
        "magic": MAGIC,
        "format_version": format_version,
        "kind": kind,
        "model_args": dict(model_args),
        "model": model.state_dict(),
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


def load_weights(model: nn.Module, checkpoint: dict[str, Any], path: Path | str) -> None:
    """Load a checkpoint's weights into a model; UserError names `path` if they do not fit."""
    own, stored = model.state_dict(), checkpoint["model"]
    wrong = sorted(own.keys() ^ stored.keys())
    wrong += sorted(k for k in own.keys() & stored.keys() if own[k].shape != stored[k].shape)
    if wrong:
        raise UserError(
            f"{path}: a checkpoint of another architecture: {len(wrong)} tensors do not fit, "
            f"the first is {wrong[0]}"
        )
    model.load_state_dict(stored)


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
            damaged = archive.testzip()
    except (zipfile.BadZipFile, EOFError, ValueError) as error:
        damaged = str(error)
    if damaged is not None:
        raise UserError(f"{path}: the checkpoint is truncated or damaged ({damaged})")
    try:
        return torch.load(io.BytesIO(data), map_location=map_location, weights_only=True)
    except Exception as error:  # torch raises several types for archives that it did not write
        raise UserError(
            f"{path}: not a checkpoint of this project ({type(error).__name__})"
        ) from None


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
