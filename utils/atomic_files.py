"""Files, folders, and lines of journals that are written whole or not at all, whatever ends the
program or fills the disk, and by one process at a time."""

from __future__ import annotations

import errno
import io
import json
import os
import secrets
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO

from utils.errors import UserError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What a full disk, a folder that may not be written and a damaged disk give.
DISK_ERRORS = (
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO
)  # fmt: skip


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a whole file or nothing, even if the power fails: into a temporary neighbour that is on
    the disk before it is renamed into place. A link stays one, and a file keeps its permissions.

    Raises UserError where that cannot be done, as on a full disk or in a read-only folder, and for
    what is no file, such as /dev/null.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        if _no_file(path):
            raise UserError(f"{path}: exists and is no file; choose another")
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        file = _neighbour(target)
        try:
            with file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                os.chmod(file.name, stat.S_IMODE(target.stat().st_mode))
            os.replace(file.name, target)
        except BaseException:
            os.unlink(file.name)
            raise
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary neighbour, to be filled within this context, that becomes the new folder `path`
    at its end; after an error nothing is left. What is written into it has to be on the disk, as
    after `write_atomic`. Raises UserError where the name is taken or nothing can be written."""
    if path.exists():
        raise UserError(f"{path}: this name is taken; give a folder that does not exist")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = _neighbour_name(path)
        folder.mkdir()
        try:
            yield folder
            os.rename(folder, path)
        except BaseException:
            shutil.rmtree(folder)
            raise
    except OSError as error:
        raise cannot_write(path, error) from error


def append_line(path: Path, line: str) -> None:
    """Add a line, which its newline ends, to a file of lines: whole and on the disk, or not at all.

    Several processes and threads may add to the same file, one after the other. A last line that a
    killed process left without its end is removed first; where the file system knows no locks it
    stays, because a line that another process is adding would look the same. Raises UserError where
    nothing can be written, as on a full disk.
    """
    data = line.encode()
    try:
        with path.open("a+b", buffering=0) as file, _alone(file) as alone:
            if alone:
                _cut_torn_line(file)
            end = file.seek(0, os.SEEK_END)
            written = file.write(data)
            if written < len(data):  # the disk is full: the next write would say so
                if os.fstat(file.fileno()).st_size == end + written:  # nobody has written since
                    file.truncate(end)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def _alone(file: FileIO) -> Iterator[bool]:
    """Wait until nobody else is in this context with the same file; gives False where the system
    knows no such locks. The lock is that of the open file, which threads do not share."""
    if sys.platform == "win32":  # its locks would keep readers out
        yield False
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)


def _cut_torn_line(file: FileIO) -> None:
    """Remove what stands after the last newline of a file of lines."""
    size = os.fstat(file.fileno()).st_size  # 0 of a device
    if size == 0:
        return
    file.seek(size - 1)
    if file.read(1) != b"\n":
        file.seek(0)
        file.truncate(file.readall().rfind(b"\n") + 1)


def _no_file(path: Path) -> bool:
    """Whether a path leads to something else than a file, such as a folder or a device."""
    return path.exists() and not path.is_file()


def _neighbour(path: Path) -> BinaryIO:
    """A new file beside another one. Unlike those of `tempfile`, it has the permissions that the
    system gives to new files."""
    return _neighbour_name(path).open("xb")


def _neighbour_name(path: Path) -> Path:
    return path.parent / f".{path.name}.{secrets.token_hex(4)}"


def check_writable(option: str, path: Path | None) -> None:
    """Raise UserError if a file that an option names could not be written at the end."""
    if path is None:
        return
    target = Path(os.path.realpath(path))
    if _no_file(path) or not target.parent.is_dir():
        raise UserError(f"{option} {path}: not a file in an existing folder; choose another")
    try:
        file = _neighbour(target)
        file.close()
        os.unlink(file.name)
    except OSError as error:
        raise UserError(
            f"{option} {path}: cannot be written ({error.strerror}); choose another folder"
        ) from error


def check_copies(files: Mapping[str, Path | None]) -> None:
    """Raise UserError if one of the files that options name could not be written at the end, or is
    that of another option, too."""
    options: dict[str, str] = {}
    for option, path in files.items():
        check_writable(option, path)
        if path is not None:
            first = options.setdefault(os.path.realpath(path), option)
            if first != option:
                raise UserError(f"{first}, {option}: both name {path}; give each its own file")


def resumption(run: Path, files: Mapping[str, Path | None]) -> str:
    """The arguments that go on with a run and write the files of the same options:
    '--resume RUN --csv FILE'."""
    named = [part for option, path in files.items() if path for part in (option, str(path))]
    return command_line(["--resume", str(run), *named])


def command_line(words: Sequence[str]) -> str:
    """Words as a line for this system's shell; on Windows for cmd.exe, without & | < > ^."""
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)


def cannot_write(path: Path, error: OSError) -> UserError:
    """The error for a file that the operating system does not let us write."""
    return UserError(
        f"{path}: cannot be written ({error.strerror or error}); make room or choose a folder that "
        "can be written, what was there before is unchanged"
    )


@contextmanager
def locked(place: Path, refusal: str) -> Iterator[None]:
    """Within this context, no other process enters it for the same lock file `place`. Raises
    UserError with the sentence `refusal` where one is in it; a file system that knows no locks lets
    all in."""
    try:
        file = place.open("ab")
    except OSError as error:
        raise cannot_write(place, error) from error
    with file:
        try:
            _lock(file)
        except (BlockingIOError, PermissionError):
            raise UserError(refusal) from None
        except OSError:
            pass
        yield


def _lock(file: IO[bytes]) -> None:
    """Take a lock that ends with this process, however that ends."""
    if sys.platform == "win32":
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def write_json_atomic(path: Path, content: Mapping) -> None:
    """Indented strict JSON; raises ValueError on NaN or infinity before touching the file."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_atomic(path, text + "\n")


def save_figure(path: Path, figure: Figure) -> None:
    """Write a matplotlib figure as a PNG file and close it."""
    write_atomic(path, figure_bytes(figure))


def figure_bytes(figure: Figure) -> bytes:
    """A matplotlib figure as the bytes of a PNG file; the figure is closed."""
    import matplotlib.pyplot as plt  # slow to import, and few callers need it

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()
