"""What a training checks before it begins or goes on: its folder's place, and its data.

A run keeps in its environment.json, in words, what it learns from: `keep_data` notes it, and
`check_data` refuses to go on with something else. This module does not know what the data are.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from utils.atomic_files import cannot_write, write_json_atomic
from utils.errors import UserError
from utils.runs import begun_with


def check_place(folder: Path) -> None:
    """Raise UserError if nothing can be written in a folder, or where it would be made."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".", dir=there))
    except OSError as error:
        raise cannot_write(folder, error) from error


def counted(names: Sequence[str]) -> str:
    """How many images there are, and a digest of their names: '30 images (5a2f1c3d)'."""
    digest = hashlib.sha256("\n".join(names).encode(errors="surrogateescape")).hexdigest()
    return f"{len(names)} images ({digest[:8]})"


def check_data(run: Path | None, data: Mapping[str, str]) -> None:
    """Raise UserError where a run was begun with other data than these; what it did not note counts
    as the same.

    run: None where a new run is started. data: in words, by name, what a training learns from.
    """
    noted = {} if run is None else begun_with(run).get("data", {})
    for name, now in data.items():
        if noted.get(name, now) != now:
            raise UserError(
                f"--resume {run}: it was begun with other data, {name}: {noted[name]}, and would "
                f"go on with {now}; bring back what was there (of objects of your own their files, "
                "too), or start a new run"
            )


def keep_data(run: Path, data: Mapping[str, str]) -> None:
    """Note in the environment.json of a run what it learns from, for `check_data`, which comes
    first."""
    begun = begun_with(run)
    write_json_atomic(run / "environment.json", begun | {"data": dict(data)})
