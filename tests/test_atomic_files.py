"""Files, and lines, that are written whole or not at all."""

import errno
import math
import os
import shlex
import stat
import time
from concurrent.futures import ThreadPoolExecutor
from io import FileIO
from pathlib import Path

import pytest

from tests.helpers.systems import needs_dev_full, needs_proc
from utils import atomic_files
from utils.atomic_files import (
    append_line,
    check_writable,
    new_folder,
    resumption,
    write_atomic,
    write_json_atomic,
)
from utils.errors import UserError


def test_a_file_is_on_the_disk_before_it_takes_the_place_of_another(tmp_path, monkeypatch):
    """Otherwise an empty file may be left where the power fails after the renaming."""
    path, on_disk = tmp_path / "last.pt", []
    path.write_bytes(b"before")

    def fsync(number):
        on_disk.append((os.fstat(number).st_ino, os.fstat(number).st_size, path.read_bytes()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_atomic(path, b"afterwards")
    assert on_disk == [(path.stat().st_ino, 10, b"before")]


def test_a_file_keeps_its_permissions_and_a_new_one_has_those_of_the_system(tmp_path):
    shared, new = tmp_path / "shared.json", tmp_path / "new.json"
    shared.write_text("before")
    shared.chmod(0o664)
    before = os.umask(0o027)
    try:
        write_atomic(shared, "afterwards")
        write_atomic(new, "{}")
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (shared, new)]
    assert modes == [0o664, 0o640] and shared.read_text() == "afterwards"


def test_a_link_still_leads_to_the_file_that_is_replaced(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    for link, target in (("old", "elsewhere/old.csv"), ("new", "elsewhere/new.csv")):
        (tmp_path / link).symlink_to(target)
    (tmp_path / "elsewhere" / "old.csv").write_text("before")
    for link in ("old", "new"):
        check_writable("--csv", tmp_path / link)
        write_atomic(tmp_path / link, "afterwards")
        assert (tmp_path / link).is_symlink()
        assert (tmp_path / "elsewhere" / f"{link}.csv").read_text() == "afterwards"


def test_what_is_no_file_is_refused_and_stays(tmp_path):
    """A pipe, as /dev/stdout may be one, stands for all devices."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name in ("folder", "pipe", "link"):
        with pytest.raises(UserError, match=f"--csv .*{name}: not a file in an existing folder"):
            check_writable("--csv", tmp_path / name)
        with pytest.raises(UserError, match=f"{name}: exists and is no file; choose another"):
            write_atomic(tmp_path / name, "a,b")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "pipe", "link"}


def test_a_file_that_could_not_be_written_at_the_end_is_refused_at_once(tmp_path):
    check_writable("--csv", None)
    check_writable("--csv", tmp_path / "x.csv")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="none/x.csv: not a file in an existing folder"):
        check_writable("--csv", tmp_path / "none" / "x.csv")


@needs_proc
def test_nothing_is_begun_in_a_folder_that_takes_no_files():
    with pytest.raises(UserError, match="--csv /proc/x.csv: cannot be written"):
        check_writable("--csv", Path("/proc/x.csv"))
    with pytest.raises(UserError, match="cannot be written"), new_folder(Path("/proc/new")):
        pass


def test_a_folder_is_there_when_it_is_whole(tmp_path):
    folder = tmp_path / "in" / "new"
    with pytest.raises(KeyboardInterrupt), new_folder(folder) as filled:
        write_atomic(filled / "half", "1")
        raise KeyboardInterrupt
    assert list(folder.parent.iterdir()) == []
    with new_folder(folder) as filled:
        write_atomic(filled / "one", "1")
        assert not folder.exists() and filled.parent == folder.parent
        write_atomic(filled / "two", "2")
    assert list(folder.parent.iterdir()) == [folder]
    assert sorted(file.name for file in folder.iterdir()) == ["one", "two"]
    with pytest.raises(UserError, match="new: this name is taken"), new_folder(folder):
        pass


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError):
        write_json_atomic(tmp_path / "x.json", {"a": math.inf})
    assert list(tmp_path.iterdir()) == []


def test_a_line_is_on_the_disk_and_takes_the_place_of_one_that_was_cut_short(tmp_path, monkeypatch):
    path, on_disk = tmp_path / "lines", []
    path.write_text("first\nsecond\ntor")
    monkeypatch.setattr(os, "fsync", lambda number: on_disk.append(path.read_text()))
    append_line(path, "third\n")
    assert on_disk == ["first\nsecond\nthird\n"] == [path.read_text()]
    path.write_text("torn alone")
    append_line(path, "whole\n")
    assert path.read_text() == "whole\n"


@needs_dev_full
def test_a_full_disk_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match="/dev/full: cannot be written .No space left on device"):
        append_line(Path("/dev/full"), "line\n")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="folder: cannot be written"):
        append_line(tmp_path / "folder", "line\n")


def test_a_line_for_which_there_is_no_room_leaves_nothing(tmp_path, monkeypatch):
    class Small(FileIO):
        def write(self, data):
            return super().write(data[:3])

    path = tmp_path / "lines"
    append_line(path, "before\n")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", lambda path, mode, buffering: Small(path, "a+"))
        with pytest.raises(UserError, match=os.strerror(errno.ENOSPC)):
            append_line(path, "afterwards\n")
    assert path.read_text() == "before\n"


def test_many_add_whole_lines_to_one_file(tmp_path, monkeypatch):
    """Each write comes in two parts, as a busy disk may take it."""

    class Slow(FileIO):
        def write(self, data):
            first = super().write(data[:50])
            time.sleep(0.002)
            return first + super().write(data[50:])

    path = tmp_path / "lines"
    lines = [f"{number}" * 100 + "\n" for number in range(40)]
    with monkeypatch.context() as patched, ThreadPoolExecutor(4) as threads:
        patched.setattr(Path, "open", lambda path, mode, buffering: Slow(path, "a+"))
        list(threads.map(append_line, [path] * 40, lines))
    assert sorted(path.read_text().splitlines(keepends=True)) == sorted(lines)


def test_a_file_system_without_locks_keeps_what_may_be_anothers_line(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(atomic_files.fcntl, "flock", no_locks)
    (tmp_path / "lines").write_text("half")
    append_line(tmp_path / "lines", "whole\n")
    assert (tmp_path / "lines").read_text() == "halfwhole\n"


def test_a_run_goes_on_with_the_files_of_its_options():
    assert resumption(Path("run"), {"--weights": None}) == "--resume run"
    files = {"--csv": Path("my table.csv"), "--latex": None, "--results": Path("r.json")}
    words = ["--resume", "run", "--csv", "my table.csv", "--results", "r.json"]
    assert shlex.split(resumption(Path("run"), files)) == words
