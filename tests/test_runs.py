"""Command lines, exit statuses, run folders, resumed runs, files written whole or not at all."""

import hashlib
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import warnings
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from tqdm import tqdm

from tests.helpers.processes import another_process_within
from tests.helpers.records import CONFIG
from tests.helpers.systems import needs_proc
from utils import runs
from utils.atomic_files import write_atomic, write_json_atomic
from utils.config import ConfigError, load_config
from utils.distributed import Team, run_folder
from utils.errors import UserError
from utils.runs import (
    REPOSITORY,
    GitState,
    begun_with,
    check_resume,
    code_of,
    environment,
    git_state,
    named_files,
    new_run_folder,
    note_code,
    open_run,
    parse_args,
    plain_remarks,
    resume_command,
    run_of_job,
    run_script,
    save_results,
    this_python,
    usable_cpus,
)


def test_remarks_are_plain_lines_and_faults_keep_their_place(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    plain_remarks()
    remark = warnings.formatwarning(UserWarning("2 of 26\nobjects"), UserWarning, "a.py", 3)
    assert remark == "note: 2 of 26 objects\n"
    fault = warnings.formatwarning(RuntimeWarning("nan"), RuntimeWarning, "a.py", 3)
    assert fault.startswith("a.py:3: RuntimeWarning: nan")


@pytest.mark.parametrize("in_a_worker", [False, True])
def test_in_a_file_a_remark_has_a_line_of_its_own_below_a_progress_bar(monkeypatch, in_a_worker):
    for name in ("formatwarning", "showwarning"):
        monkeypatch.setattr(warnings, name, getattr(warnings, name))
    output = io.StringIO()
    monkeypatch.setattr(sys, "stderr", output)
    with warnings.catch_warnings():
        plain_remarks(in_a_worker)
        warnings.simplefilter("always")
        with nullcontext() if in_a_worker else tqdm(total=2, file=output):
            warnings.warn("one file is left out", stacklevel=1)
        if not in_a_worker:
            warnings.warn("after the bar", stacklevel=1)
    assert "note: one file is left out" in output.getvalue().split("\n")
    assert in_a_worker or output.getvalue().endswith("\nnote: after the bar\n")
    assert "\n\n" not in output.getvalue()


def test_the_command_that_goes_on_can_be_copied(monkeypatch):
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    files = {"--csv": Path("a b.csv"), "--latex": None}
    words = [sys.executable, "evaluate.py", "--resume", "run", "--csv", "a b.csv"]
    monkeypatch.chdir("/")
    assert shlex.split(resume_command("evaluate.py", Path("run"), files))[1:] == words[1:]
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    launch = "-m torch.distributed.run --nproc_per_node=2 train_rl.py --resume run"
    assert resume_command("train_rl.py", Path("run")) == f"{this_python()} {launch}"


def test_a_job_of_torchrun_finds_the_run_that_it_has_begun(tmp_path, monkeypatch):
    other = load_config(None, ["seed=1"])
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    new_run_folder("train_rl", None, CONFIG, tmp_path)
    assert run_of_job("train_rl", CONFIG, tmp_path) is None, "jobs without a name are not the same"
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "first")
    assert run_of_job("train_rl", CONFIG, tmp_path) is None
    run = new_run_folder("train_rl", None, CONFIG, tmp_path)
    new_run_folder("train_rl", None, other, tmp_path)
    assert run_of_job("train_rl", CONFIG, tmp_path) == run
    assert run_of_job("train_graspnet", CONFIG, tmp_path) is None
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "second")
    assert run_of_job("train_rl", CONFIG, tmp_path) is None
    monkeypatch.delenv("TORCHELASTIC_RUN_ID")
    assert run_of_job("train_rl", CONFIG, tmp_path) is None


def test_run_folder(tmp_path):
    first = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    second = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    assert first != second and first.parent == second.parent == tmp_path / "evaluate"
    assert re.fullmatch(r"\d{8}-\d{6}-pile(-2)?", second.name)
    assert load_config(first / "config.yaml") == CONFIG
    assert yaml.safe_load((first / "config.yaml").read_text())["evaluate"]["rounds"] == 2
    facts = json.loads((first / "environment.json").read_text())
    assert facts["packages"]["numpy"] == np.__version__ and facts["cpu_count"] >= 1
    assert re.fullmatch(r"\d{8}-\d{6}", new_run_folder("evaluate", None, CONFIG, tmp_path).name)


def test_run_folder_errors(tmp_path):
    for name in ("../x", "a/b", ".x", "a b", "-x"):
        for section in ("evaluate", "train", "rl"):
            with pytest.raises(ConfigError, match=f"{section}.name: got .*run's name"):
                load_config(None, [f"{section}.name={name}"])
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot make a run folder"):
        new_run_folder("evaluate", None, CONFIG, tmp_path / "file")


def test_commands_that_are_printed_name_the_interpreter_from_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(Path.cwd() / ".venv" / "bin" / "python"))
    assert this_python() == str(Path(".venv", "bin", "python"))
    monkeypatch.setattr(sys, "executable", str(Path.cwd().parent / "a b" / "python"))
    assert shlex.split(this_python()) == [sys.executable]
    monkeypatch.setattr(sys, "executable", r"C:\a b\python.exe")
    monkeypatch.setattr(sys, "platform", "win32")
    assert this_python() == r'"C:\a b\python.exe"'


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_git_state_is_that_of_git(tmp_path, monkeypatch):
    """At the top of a repository; what lies in a folder of one is not the repository's code."""
    for name in ("GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM"):  # which may sign or run hooks
        monkeypatch.setenv(name, os.devnull)

    def git(*arguments: str) -> str:
        names = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", "-C", str(tmp_path), *names, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init")
    file = tmp_path / "code.py"
    file.write_text("1\n")
    git("add", "code.py")
    git("commit", "-m", "first")
    (tmp_path / "notes.txt").write_text("git does not track this file\n")
    assert git_state(tmp_path) == (git("rev-parse", "HEAD"), False)
    file.write_text("2\n")
    assert git_state(tmp_path) == (git("rev-parse", "HEAD"), True)
    (tmp_path / "unpacked").mkdir()
    assert git_state(tmp_path / "unpacked") == (None, None)


def test_git_state_outside_a_repository(tmp_path):
    assert git_state(tmp_path) == (None, None)
    assert set(environment()) >= {"commit", "dirty", "platform", "packages", "cpu_count"}


@pytest.mark.parametrize(
    ("content", "count"), [("250000 100000", 3), ("10000 100000", 1), ("max 100000", 16), ("?", 16)]
)
def test_a_container_gets_no_more_processes_than_its_share_of_time(
    tmp_path, monkeypatch, content, count
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)), raising=False)
    monkeypatch.setattr("utils.runs.CPU_QUOTA", tmp_path / "cpu.max")
    assert usable_cpus() == 16
    (tmp_path / "cpu.max").write_text(f"{content}\n")
    assert usable_cpus() == count


def test_cpus_are_those_of_this_job_shared_by_the_processes_of_this_machine(monkeypatch, tmp_path):
    monkeypatch.setattr("utils.runs.CPU_QUOTA", tmp_path / "none")
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)), raising=False)
    monkeypatch.setenv("WORLD_SIZE", "64")
    assert usable_cpus() == 16
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "8")
    assert usable_cpus() == 2
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "32")
    assert usable_cpus() == 1
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "8")
    monkeypatch.delattr(os, "sched_getaffinity")
    assert usable_cpus() == 16


def test_results_tell_where_they_come_from(tmp_path):
    save_results(tmp_path / "results.json", {"best": 0.5}, None)
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["best"] == 0.5 and content["commit"] == git_state().commit
    assert content["versions"]["numpy"] == np.__version__ and "written_at" not in content


def test_results_of_a_run_that_went_on_at_another_commit_name_both(tmp_path, monkeypatch):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    facts = json.loads((run / "environment.json").read_text())
    begun = facts | {"commit": 40 * "a", "dirty": False, "packages": {"numpy": "0.1"}}
    write_json_atomic(run / "environment.json", begun)
    monkeypatch.setattr("utils.runs.git_state", lambda: GitState(40 * "b", False))
    save_results(tmp_path / "copy.json", {}, run)
    content = json.loads((tmp_path / "copy.json").read_text())
    assert (content["commit"], content["written_at"]) == (40 * "a", 40 * "b")
    assert content["versions"]["numpy"] == "0.1"


def test_only_what_may_change_is_changed_when_a_run_is_resumed(tmp_path):
    run, free = new_run_folder("evaluate", None, CONFIG, tmp_path), ["evaluate.workers", "rl.lr"]
    check_resume(CONFIG, None, free)
    check_resume(CONFIG, run, free)
    changes = ["evaluate.workers=7", "rl.lr=1.0"]
    config = load_config(run / "config.yaml", changes)
    check_resume(config, run, free)
    with pytest.raises(UserError, match="only evaluate.workers may differ"):
        check_resume(config, run, free[:1])
    with pytest.raises(UserError, match="no last.pt or fold./last.pt in there"):
        check_resume(CONFIG, run, free, ["last.pt", "fold*/last.pt"])
    (run / "fold0").mkdir()
    (run / "fold0" / "last.pt").touch()
    check_resume(CONFIG, run, free, ["last.pt", "fold*/last.pt"])


def test_a_run_that_another_commit_began_goes_on_with_a_remark(tmp_path):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    facts = json.loads((run / "environment.json").read_text())
    write_json_atomic(run / "environment.json", facts | {"commit": 40 * "a"})
    with pytest.warns(UserWarning, match="begun at commit aaaaaaaaaa and goes on at"):
        check_resume(CONFIG, run, [])


def test_a_run_that_other_uncommitted_changes_began_goes_on_with_a_remark(tmp_path):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    facts = json.loads((run / "environment.json").read_text())
    write_json_atomic(run / "environment.json", facts | {"changes": 64 * "a"})
    remark = "it was begun with other changes to the code since the last commit; where the two"
    with pytest.warns(UserWarning, match=remark):
        check_resume(CONFIG, run, [])


def test_a_run_goes_on_with_a_remark_where_what_it_names_has_changed(tmp_path, monkeypatch):
    """The weights of a policy, and the module of a plug-in; a package."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("weights.pt").write_bytes(b"first")
    Path("my_own_planner.py").write_text("def plan(frame): ...\n")
    policies = "evaluate.policies=ppo:weights.pt,my_own_planner:plan"
    config = load_config(None, [policies])
    digest = "a7937b64b8caa58f03721bb6bacf5c78cb235febe0e70b1b84cd99541461a08e"  # of sha256sum
    assert named_files(config)["ppo:weights.pt"] == digest
    Path("package").mkdir()
    Path("package", "__init__.py").write_text("raise RuntimeError('not to be run')\n")
    Path("package", "inner.py").write_text("first")
    inner = load_config(None, ["evaluate.policies=package.inner:plan,package.none:plan"])
    assert named_files(inner) == {"package.inner:plan": digest}
    run = new_run_folder("evaluate", None, config, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_resume(config, run, [])
    Path("my_own_planner.py").write_text("def plan(frame): return []\n")
    with pytest.warns(UserWarning, match="begun with another content of my_own_planner:plan; wh"):
        check_resume(config, run, [])
    facts = json.loads((run / "environment.json").read_text())
    packages = facts["packages"] | {"numpy": "0.1"}
    write_json_atomic(run / "environment.json", facts | {"packages": packages})
    with pytest.warns(UserWarning, match="with numpy 0.1 and goes on with "):
        check_resume(config, run, [])


def test_an_unknown_option_is_told_how_a_setting_is_written(capsys):
    with pytest.raises(SystemExit, match="2"):
        parse_args(["--rounds", "3"], "a script")
    assert "--rounds; a setting is written KEY=VALUE, such as evaluate.rounds=50" in (
        capsys.readouterr().err
    )


def test_overrides_win_over_the_file_and_options_of_a_script_are_given_back(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("seed: 3\n")
    config, options = parse_args(
        ["scene.count=2", "--config", str(path), "evaluate.rounds=4", "--results", "r.json"],
        "a script",
        lambda parser: parser.add_argument("--results", type=Path),
    )
    assert (config.seed, config.scene.count, config.evaluate.rounds) == (3, 2, 4)
    assert options.results == Path("r.json") and options.resume is None


def test_what_changes_when_a_run_is_resumed_stays_changed(tmp_path):
    with open_run(None, "evaluate", None, load_config(), root=tmp_path) as run:
        pass
    config, _ = parse_args(["--resume", str(run), "evaluate.rounds=70"], "a script")
    with open_run(run, "evaluate", None, config, root=tmp_path) as resumed:
        assert resumed == run
    again, _ = parse_args(["--resume", str(run)], "a script")
    assert again.evaluate.rounds == 70 and again == config


def test_a_run_notes_with_which_code_it_was_continued(tmp_path, monkeypatch):
    """Each change of the code once, and nothing where it is the same."""
    config = load_config()
    code = {"commit": "a" * 40, "changes": None}
    monkeypatch.setattr(runs, "environment", lambda: dict(code))
    with open_run(None, "evaluate", None, config, root=tmp_path) as run:
        assert code_of(run) == ["commit aaaaaaaaaa"]
    note_code(run / "a_column" / "of_it")
    assert code_of(run) == ["commit aaaaaaaaaa"]
    for commit, changes in (("a", None), ("b", "c" * 64), ("b", "c" * 64), ("a", None)):
        code.update(commit=commit * 40, changes=changes)
        with open_run(run, "evaluate", None, config):
            note_code(run / "a_column" / "of_it")
    code.update(commit=None)  # where git does not answer
    note_code(run)
    expected = ["aaaaaaaaaa", "bbbbbbbbbb with changes cccccccc", "aaaaaaaaaa"]
    assert code_of(run) == [f"commit {one}" for one in expected]
    assert begun_with(run)["commit"] == "a" * 40 and begun_with(run)["script"] == "evaluate"
    # As earlier versions noted that pages alone had been changed.
    facts = begun_with(run) | {"changes": hashlib.sha256(b"").hexdigest()}
    write_json_atomic(run / "environment.json", facts)
    assert code_of(run)[0] == "commit aaaaaaaaaa"
    (run / "environment.json").unlink()
    assert code_of(run) == []


def test_a_run_of_another_script_is_left_as_it_is(tmp_path):
    with open_run(None, "train_rl", None, load_config(), root=tmp_path) as run:
        before = (run / "config.yaml").read_text()
    opened = open_run(run, "evaluate", None, load_config(None, ["seed=9"]))
    with pytest.raises(UserError, match=r"a run of train_rl\.py; go on with train_rl\.py"), opened:
        pass
    assert (run / "config.yaml").read_text() == before


def test_a_run_in_which_another_process_works_is_left_as_it_is(tmp_path):
    with another_process_within(
        "from utils.config import load_config\nfrom utils.runs import open_run",
        "open_run(None, 'train_rl', None, load_config(), argument)",
        tmp_path,
    ) as folder:
        run = Path(folder)
        before, config = (run / "config.yaml").read_text(), load_config(None, ["seed=9"])
        alone = Team(0, 1, torch.device("cpu"))
        for opened in (
            open_run(run, "train_rl", None, config),
            run_folder("train_rl", None, config, run, alone),
        ):
            with pytest.raises(UserError, match="another process works in this run"), opened:
                pass
        assert (run / "config.yaml").read_text() == before
    with run_folder("train_rl", None, config, run, alone):
        assert (run / "config.yaml").read_text() != before


def test_resume_takes_the_run_s_config(tmp_path):
    (tmp_path / "config.yaml").write_text("seed: 9\n")
    with pytest.raises(ConfigError, match=r"no environment\.json"):  # a config is not yet a run
        parse_args(["--resume", str(tmp_path)], "a script")
    (tmp_path / "environment.json").write_text("{}")
    config, options = parse_args(["--resume", str(tmp_path), "evaluate.rounds=4"], "a script")
    assert (config.seed, config.evaluate.rounds, options.resume) == (9, 4, tmp_path)
    with pytest.raises(ConfigError, match=r"no such folder"):
        parse_args(["--resume", str(tmp_path / "none")], "a script")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        parse_args(["--resume", str(tmp_path / "empty")], "a script")


def test_errors_of_users_end_a_script_by_one_line_and_bugs_by_their_traceback(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "evaluate.roundz=3"])

    def status(main) -> int:
        with pytest.raises(SystemExit) as caught:
            run_script(main)
        return caught.value.code

    assert status(lambda argv: parse_args(argv, "x") and None) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: evaluate.roundz") and error.count("\n") == 1

    def other(argv):
        raise UserError("two\nlines")

    assert status(other) == 2
    assert capsys.readouterr().err == "error: two lines\n"
    assert status(lambda argv: None) == 0
    assert status(lambda argv: 3) == 3

    def interrupted(argv):
        raise KeyboardInterrupt

    assert status(interrupted) == 130
    with pytest.raises(ZeroDivisionError):  # a bug keeps its traceback
        run_script(lambda argv: 1 / 0)


# --- Faults of the machine ------------------------------------------------------------------------

SCRIPT = """
import signal, sys, time
from utils.distributed import stop_on_interrupt
from utils.runs import run_script

def loop(argv):  # as a training that saves what it has
    with stop_on_interrupt() as stop:
        print("ready", flush=True)
        while not stop.is_set():
            time.sleep(0.01)
    print("saved", flush=True)
    return 130

def wait(argv):  # as a script that is between two such loops
    print("ready", flush=True)
    while True:  # no long sleep: a signal that comes just before it does not end it
        time.sleep(0.01)

# Whatever the tests themselves have inherited: a shell's background jobs ignore Ctrl-C.
ignored = sys.argv[1] == "background"
signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
run_script(loop if sys.argv[1] == "loop" else wait)
"""


@pytest.mark.parametrize(
    ("what", "number", "status"),
    [
        ("loop", signal.SIGINT, 130), ("loop", signal.SIGTERM, 143),
        ("wait", signal.SIGINT, 130), ("wait", signal.SIGTERM, 143),
        ("background", signal.SIGTERM, 143),
    ],
)  # fmt: skip
def test_a_script_that_is_stopped_saves_and_says_so(what, number, status):
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, what], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, cwd=REPOSITORY,
    ) as process:  # fmt: skip
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        output, error = process.communicate(timeout=30)
    assert process.returncode == status
    assert (output == "saved\n") is (what == "loop")
    assert error in ("", "interrupted\n", "terminated\n")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_script_whose_output_nobody_reads_any_more_ends_without_a_word(unbuffered):
    code = (
        "from utils.runs import run_script\n"
        "def main(argv):\n"
        "    print('first', flush=True)\n"
        "    input()\n"
        "    print('second')\n"
        "run_script(main)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, cwd=REPOSITORY,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
    ) as process:  # fmt: skip
        assert process.stdout.readline() == "first\n"
        process.stdout.close()
        process.stdin.write("\n")
        process.stdin.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_a_broken_pipe_to_anything_but_a_reader_is_a_bug():
    def main(argv):
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        run_script(main)


def limited(limit: str, size: int, code: str) -> subprocess.CompletedProcess:
    """Run Python code as a script, under a limit of the operating system in bytes."""
    pytest.importorskip("resource", reason="Windows has no such limits")
    text = (
        f"import resource; resource.setrlimit(resource.{limit}, ({size}, {size}))\n"
        "from pathlib import Path\nimport numpy as np\nfrom utils.atomic_files import *\n"
        "from utils.runs import *\n"
        f"def main(argv):\n    {code}\nrun_script(main)"
    )
    # Each thread of an algebra library takes its share of the address space.
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, cwd=REPOSITORY, timeout=60,
        env=os.environ | threads,
    )  # fmt: skip


def test_a_disk_without_room_is_one_sentence_and_keeps_what_was_there(tmp_path):
    """A limit of the size of files is a full disk that needs no rights to make."""
    path = tmp_path / "last.pt"
    path.write_bytes(b"before")
    done = limited("RLIMIT_FSIZE", 10_000, f"write_atomic(Path({str(path)!r}), bytes(20_000))")
    assert done.returncode == 2
    said = r"error: .*last.pt: cannot be written \(File too large\); .*\n"
    assert re.fullmatch(said, done.stderr)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
    done = limited("RLIMIT_FSIZE", 10_000, f"Path({str(path)!r}).write_bytes(bytes(20_000))")
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the address space")
def test_too_little_memory_is_one_sentence():
    done = limited("RLIMIT_AS", 2 * 1024**3, "np.ones(10**10)")
    assert done.returncode == 2
    assert done.stderr.startswith("error: out of memory (") and done.stderr.count("\n") == 1


def test_a_folder_that_may_not_be_written_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="x.json: cannot be written .File exists"):
        write_atomic(tmp_path / "file" / "x.json", "{}")


@needs_proc
def test_a_folder_that_takes_no_files_is_one_sentence():
    with pytest.raises(UserError, match="/proc/x.json: cannot be written"):
        write_atomic(Path("/proc/x.json"), "{}")
