"""Tables of figures made up here, so that every cell is known; the parts of make results."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from datetime import date, datetime
from pathlib import Path

import pytest

from benchmarks import results
from benchmarks.looks import add_look, begin_look
from benchmarks.result_parts import PARTS, SEALED, SEED, SPLIT, Part
from benchmarks.result_tables import OVERVIEW, PAGES, TABLES, with_tables, write_tables
from benchmarks.results import chosen_parts, main
from benchmarks.table_cells import (
    FITS,
    WEIGHTS,
    cleared,
    points,
    rate,
    shipped_weights,
    success,
)
from tests.helpers.records import CONFIG, ROUNDS
from utils.config import dump_config, load_config
from utils.errors import UserError
from utils.result_records import append_round, read_sample
from utils.runs import REPOSITORY
from utils.statistics import wilson_interval

# Tests that look at names and numbers of the sealed objects, and play nothing.
SPLIT_NAMED_IN = [
    "tests/test_objects.py",
    "tests/test_planner_fan.py",
    "tests/test_result_tables.py",
]


def row(
    policy: str, successes: int, attempts: int, objects: str = "random_urdfs", rounds: int = 100
) -> dict:
    return {
        "policy": policy, "scenario": "pile", "objects": objects, "controller": "open_loop",
        "successes": successes, "attempts": attempts, "objects_cleared": successes,
        "objects_total": 500, "plan_ms_median": 24.4, "picks_per_hour": 536.2, "rounds": rounds,
        "success_ci95": wilson_interval(successes, attempts),
        "cleared_ci95": wilson_interval(successes, 500),
    }  # fmt: skip


def figures(folder, name: str, rows: list[dict]) -> None:
    pair = {
        "first": "graspnet", "second": "heuristic", "scenario": "pile", "objects": "random_urdfs",
        "success": {"value": 0.015, "low": -0.002, "high": 0.0311, "rounds": 100}, "cleared": None,
    }  # fmt: skip
    command = {"command": "python evaluate.py seed=2027", "rows": rows, "comparisons": [pair]}
    part = {"part": name, "commit": 40 * "a", "seed": 2027, "date": "2026-11-22"}
    (folder / f"{name}.json").write_text(json.dumps(part | {"commands": {name: command}}))


def test_a_table_of_other_weights_says_so(tmp_path):
    now = shipped_weights()
    for name in WEIGHTS:
        command = ["git", "hash-object", str(REPOSITORY / "checkpoints" / name)]
        hashed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        assert now[name] == hashed
    fits = now[FITS]
    other, none = {FITS: fits | {"heuristic": None}}, dict.fromkeys(now)
    for policy, weights, words in (
        ("graspnet6d", now, ""),
        ("graspnet6d", now | {"critic.pt": 40 * "0"}, " with an earlier `critic.pt`"),
        ("oracle6d", now | {"critic.pt": 40 * "0"}, ""),
        ("oracle", none, " without `critic.pt`, `calibration.json`"),
        ("graspnet", now | other, ""),
        ("heuristic+pbvs", now | other, " with an earlier `calibration.json`"),
        ("random", none, ""),
    ):
        figures(tmp_path, "direct", [row(policy, 450, 500)])
        content = json.loads((tmp_path / "direct.json").read_text())
        (tmp_path / "direct.json").write_text(json.dumps(content | {"weights": weights}))
        written = with_tables("<!-- results:direct -->\n<!-- /results -->", tmp_path)
        assert f"`aaaaaaaaaa` (2026-11-22){words}, seed" in written


def test_rate_has_wilsons_interval():
    """Newcombe, Stat. Med. 17 (1998), table I, method 3: 81 of 263 is 0.2553 to 0.3662."""
    assert rate(81, 263) == "31 % [26, 37] (81/263)"
    assert rate(0, 0) == "-"


def test_a_share_above_0_is_never_0_percent_and_no_difference_is_negative_zero():
    assert rate(2, 450).startswith("0.4 % [") and rate(1, 100_000).startswith("0.1 % [")
    assert rate(0, 450).startswith("0 % [") and rate(5, 450).startswith("1 % [")
    assert points({"value": -0.0004, "low": -0.012, "high": 0.0, "rounds": 50}) == (
        "+0.0 [-1.2, +0.0]"
    )


def test_a_share_below_1_is_never_100_percent():
    assert rate(250, 250).startswith("100 % [")
    assert rate(249, 250).startswith("99.6 % [") and rate(99_999, 100_000).startswith("99.9 % [")
    assert rate(248, 250).startswith("99 % [")


def test_cells_have_the_intervals_of_their_row():
    """Which know that the attempts of a round hang together."""
    wide = row("graspnet", 50, 100) | {"success_ci95": [0.3, 0.7], "cleared_ci95": [0.02, 0.25]}
    assert success(wide) == "50 % [30, 70] (50/100)"
    assert cleared(wide) == "10 % [2, 25] (50/500)"


def test_each_scene_has_the_calibration_error_of_each_planner(tmp_path):
    sure, unsure = (
        row(policy, 9, 10) | {"calibration_error": error}
        for policy, error in (("graspnet", 0.0254), ("oracle", 0.1))
    )
    figures(tmp_path, "six_dof", [sure, row("random", 1, 10) | {"calibration_error": None}])
    figures(tmp_path, "scenes", [unsure, unsure | {"scenario": "tall"}])
    figures(tmp_path, "direct", [sure | {"calibration_error": 0.5}])  # six_dof's row is the first
    page = with_tables("<!-- results:calibration_by_scene -->\n<!-- /results -->\n", tmp_path)
    header, _, *lines = page.splitlines()[1:5]
    assert header == "| objects | scenario | depth | `graspnet` | `oracle` |"
    assert lines == [
        "| `random_urdfs` | pile | `none` | 0.025 (10) | 0.100 (10) |",
        "| `random_urdfs` | tall | `none` | - | 0.100 (10) |",
    ]


def test_the_overview_has_a_line_for_each_noisy_scene(tmp_path):
    noisy, bowls = {"depth_noise": "realsense"}, "benchmarks.bowls:bowls"
    for part in OVERVIEW:
        figures(tmp_path, part, [row("graspnet", 1, 2)])  # clean: not in it
    figures(
        tmp_path,
        "six_dof",
        [
            row("graspnet", 81, 263) | noisy,
            row("oracle6d", 250, 250) | noisy,
            row("graspnet", 0, 0, bowls) | noisy,  # no attempt: nothing cleared, no success
            row("graspnet6d", 450, 500, bowls) | noisy,
        ],
    )
    page = with_tables("<!-- results:overview -->\n<!-- /results -->\n", tmp_path)
    where = "[from any side](six_dof.md#figures)"
    assert page.splitlines()[3:-1] == [
        f"| pile | `random_urdfs` | `realsense` | 31, 16 | - | 100, 50 | 97 | {where} |",
        f"| pile | `bowls` | `realsense` | -, 0 | 90, 90 | - | 97 | {where} |",
    ]


def test_a_second_image_stands_below_the_first_one(tmp_path):
    for part, successes in (("oblique", 80), ("second_look", 90)):
        rows = [row(name, successes, 100) for name in ("graspnet", "heuristic")]
        figures(tmp_path, part, rows[: 2 if part == "oblique" else 1])
    page = with_tables("<!-- results:second_look -->\n<!-- /results -->\n", tmp_path)
    assert page.splitlines()[3:5] == [
        f"| `random_urdfs` | `graspnet` | {name} | {rate(n, 100)} | {rate(n, 500)} | 536 |"
        for name, n in (("one", 80), ("two", 90))
    ]
    assert page.splitlines()[5] == ""


def test_loops_have_successes_of_all_objects_and_the_median_time_of_a_turn(tmp_path):
    def rows(controller: str, mean: float | None, most: float | None) -> list[dict]:
        times = {"turn_ms_mean": mean, "turn_ms_p95": most, "controller": controller}
        return [row("heuristic", 3, 4, objects) | times for objects in ("a", "b")]

    loops = [*rows("open_loop", None, None), *rows("ibvs", 4.0, 6.0)]
    loops[-1]["turn_ms_mean"] = 5.0
    figures(tmp_path, "servo", loops)
    page = with_tables("<!-- results:servo -->\n<!-- /results -->\n", tmp_path)
    assert page.splitlines()[1:5] == [
        "| scenario | open_loop | ibvs |",
        "| --- | --- | --- |",
        f"| `pile` | {rate(6, 8)} | {rate(6, 8)} |",
        "| one iteration, ms: mean, 95 % | - | 4.5, 6.0 |",
    ]


def test_a_table_is_written_between_its_marks_with_commit_seed_and_command(tmp_path):
    figures(tmp_path, "clutter15", [row("heuristic", 81, 263)])
    page = "before\n<!-- results:clutter15 -->\nold\n<!-- /results -->\nafter\n"
    written = with_tables(page, tmp_path)
    assert written.startswith("before\n<!-- results:clutter15 -->\n| planner |")
    assert written.endswith("<!-- /results -->\nafter\n") and "old" not in written
    cells = "| `heuristic` | 31 % [26, 37] (81/263) | 16 % [13, 20] (81/500) | 536 |"
    assert cells in written.splitlines()
    command = "`python evaluate.py seed=2027` (100 rounds a row)"
    assert f"commit `aaaaaaaaaa` (2026-11-22), seed 2027: {command}" in written
    assert with_tables(written, tmp_path) == written


def test_both_languages_have_the_same_figures(tmp_path):
    for part, rounds in (("scoreboard", 100), ("clutter15", 30)):
        rows = [
            row(name, 400 + k, 500, rounds=rounds)
            for k, name in ((0, "heuristic"), (50, "graspnet"))
        ]
        figures(tmp_path, part, rows)
    page = "<!-- results:planners -->\n<!-- /results -->\n"
    english, chinese = with_tables(page, tmp_path), with_tables(page, tmp_path, chinese=True)
    few = "5 objects: measured at commit `aaaaaaaaaa`, seed 2027 (100 rounds a row)"
    many = "15 objects: measured at commit `aaaaaaaaaa`, seed 2027 (30 rounds a row)"
    assert f"<sub>{few}; {many};" in english and "每行 30 轮" in chinese
    assert "is +1.5 [-0.2, +3.1] points" in english and "规划器" in chinese
    assert "| `graspnet` | 90 % [87, 92] (450/500) |" in english
    assert [line for line in english.splitlines() if "`" in line and "|" in line] == [
        line for line in chinese.splitlines() if "`" in line and "|" in line
    ]


def noisy(row: dict, noise: str = "realsense") -> dict:
    return row | {"depth_noise": noise}


def test_noisy_rows_come_first_with_a_column_that_names_the_noise(tmp_path):
    """Also beside a part that was measured without noise; its other cells are empty."""
    rows = [row("heuristic", 400, 500), row("graspnet", 450, 500)]
    figures(tmp_path, "scoreboard", rows)
    figures(tmp_path, "clutter15", [*map(noisy, rows), *rows])
    page = "".join(
        f"<!-- results:{name} -->\n<!-- /results -->\n" for name in ("planners", "clutter15")
    )
    written = with_tables(page, tmp_path).splitlines()
    header = "| planner | depth | 5 objects: success | cleared | 15 objects: success | cleared |"
    assert written[1] == header
    assert [line.split(" | ")[:3] for line in written[3:7]] == [
        ["| `heuristic`", "`realsense`", "-"], ["| `graspnet`", "`realsense`", "-"],
        ["| `heuristic`", "`none`", "80 % [76, 83] (400/500)"],
        ["| `graspnet`", "`none`", "90 % [87, 92] (450/500)"],
    ]  # fmt: skip
    assert written[7].startswith("| OrbitGrasp") and " | - | 97 % | 98 % |" in written[7]
    assert "| planner | depth | success | cleared | picks an hour |" in written
    chinese = with_tables(page, tmp_path, chinese=True)
    assert "| 规划器 | 深度噪声 | 5 个物体：成功率 |" in chinese


def test_differences_name_the_noise_of_the_first_pair(tmp_path):
    for part in ("scoreboard", "clutter15"):
        figures(tmp_path, part, [noisy(row("graspnet", 450, 500)), row("graspnet", 460, 500)])
        content = json.loads((tmp_path / f"{part}.json").read_text())
        (pair,) = content["commands"][part]["comparisons"]
        content["commands"][part]["comparisons"] = [noisy(pair), pair]
        (tmp_path / f"{part}.json").write_text(json.dumps(content))
    page = "".join(
        f"<!-- results:{name} -->\n<!-- /results -->\n" for name in ("planners", "differences")
    )
    written = with_tables(page, tmp_path)
    assert "On 15 objects with `realsense` depth the success of `graspnet` minus" in written
    assert "| `random_urdfs` | pile | `realsense` | +1.5 [-0.2, +3.1] | - |" in written
    chinese = with_tables(page, tmp_path, chinese=True)
    assert "15 个物体、深度噪声为 `realsense` 时，`graspnet`" in chinese


def test_the_first_sentence_has_the_shares_of_the_noisy_rows(tmp_path):
    """450 of 500 and 300 of 400 grasps; of 500 objects as many reach the tray."""
    for part, others in (("scoreboard", (450, 500)), ("clutter15", (300, 400))):
        rows = [row("graspnet", 490, 500), row("heuristic", 1, 500), row("graspnet", *others)]
        figures(tmp_path, part, [*rows[:2], noisy(rows[2])])
    page = "<!-- results:headline -->\n<!-- /results -->"
    written = with_tables(page, tmp_path).splitlines()[1]
    assert written == (
        "**Result** on unseen objects with `realsense` depth noise: 90 % of the grasps of "
        "`graspnet` succeed in piles of 5 objects, 75 % in piles of 15; 90 % and 60 % of the "
        "objects reach the tray."
    )
    chinese = with_tables(page, tmp_path, chinese=True)
    assert re.findall(r"\d+ %", chinese) == ["90 %", "75 %", "90 %", "60 %"]
    figures(tmp_path, "clutter15", [row("graspnet", 400, 500)])  # no noise in common
    assert "on unseen objects: 98 % of" in with_tables(page, tmp_path)


def test_every_depth_noise_is_a_column(tmp_path):
    """The scoreboard's, noisy first, then those of the part's commands."""
    figures(tmp_path, "scoreboard", [noisy(row("graspnet", 95, 100)), row("graspnet", 98, 100)])
    figures(tmp_path, "noise", [row("graspnet", 90, 100)])
    content = json.loads((tmp_path / "noise.json").read_text())
    command = content["commands"]["noise"]
    other = command | {"rows": [noisy(row("graspnet", 80, 100), "gamma")]}
    content["commands"] = {"kinect": command, "gamma": other}
    (tmp_path / "noise.json").write_text(json.dumps(content))
    written = with_tables("<!-- results:noise -->\n<!-- /results -->", tmp_path).splitlines()
    header = "| objects | scenario | planner | `realsense` | `none` | `kinect` | `gamma` |"
    assert written[1] == header
    assert [cell.split(" [")[0] for cell in written[3].split(" | ")[3:]] == [
        "95 %", "98 %", "90 %", "80 %",
    ]  # fmt: skip


def test_a_table_that_is_not_measured_says_how_to(tmp_path):
    written = with_tables("<!-- results:servo -->\n<!-- /results -->", tmp_path)
    assert "*not measured yet: `make results PARTS=servo`*" in written


def test_every_table_stands_on_a_page_and_needs_known_parts():
    marked = "".join((REPOSITORY / page).read_text(encoding="utf-8") for page in PAGES)
    assert all(f"<!-- results:{name} -->" in marked for name in TABLES)
    # The soak measures the one, every part adds to the other.
    parts = {part.name for part in PARTS} | {"reliability", "looks"}
    assert {need for needs, _ in TABLES.values() for need in needs} == parts


def test_parts_are_chosen_by_name():
    assert [part.name for part in chosen_parts("servo, ppo")] == ["servo", "ppo"]
    with pytest.raises(UserError, match="'serv' is no part; choose among scoreboard"):
        chosen_parts("serv")


def test_commands_are_valid_and_take_fresh_seeds(capsys):
    """Seeds used while developing stand in docs/choices.md; the tables' is none of them."""
    sealed = load_config(SEALED)
    for part in PARTS:
        for command in part.commands:
            words = shlex.split(command.line(command.scaled(0.001)))
            if words[1].endswith(".py"):
                overrides = [w for w in words[2:] if "=" in w and "path/to" not in w]
                config = load_config(None, overrides)
                assert (config.seed, config.objects.split) == (sealed.seed, command.split)
    assert main(["--list"]) == 0
    assert f"seed={sealed.seed} objects.split=sealed" in capsys.readouterr().out


def test_a_trial_plays_no_sealed_scene(capsys):
    """A look at them is one, whatever the share of the rounds."""
    assert main(["--list", "--scale", "0.99"]) == 0
    lines = capsys.readouterr().out
    assert "seed=900 objects.split=test" in lines and "objects.split=unseen_families" in lines
    commands = [line for line in lines.splitlines() if " seed=" in line]
    sealed = load_config(SEALED)
    assert len(commands) > 20
    assert not [line for line in commands if f"seed={sealed.seed}" in line or "sealed" in line]
    assert main(["--list", "--scale", "0.99", "--write-docs"]) == 0
    assert f"seed={sealed.seed} objects.split=sealed" in capsys.readouterr().out


@pytest.mark.parametrize("scale", ["nan", "inf", "-1", "0"])
def test_a_scale_that_is_no_share_of_rounds_is_refused(scale):
    with pytest.raises(UserError, match="--scale: got .*, expected a positive number"):
        main(["--list", "--scale", scale])


def test_what_a_part_lacks_is_said_in_its_own_order(two_parts, monkeypatch, capsys):
    folders = ["scans", "urdfs", "photographs", "meshes", "weights", "films", "logs", "masks"]
    part = Part("all_of_them", "needs eight folders", 1, (), needs=tuple(folders))
    monkeypatch.setattr(results, "SOURCES", dict.fromkeys(folders, "something"))
    monkeypatch.setattr(results, "chosen_parts", lambda names: [part])
    assert main(["--scale", "0.1"]) == 0
    assert re.findall(r"no --(\w+) names something", capsys.readouterr().out) == folders


def test_parts_that_need_what_is_not_shipped_say_so_and_take_its_place(two_parts, capsys):
    assert main(["--parts", "ycb,cornell"]) == 0
    said = capsys.readouterr().out
    assert "ycb: skipped, because no --ycb names YCB's objects" in said
    assert "cornell: skipped, because no --cornell names Cornell's photographs" in said
    assert not results.FIGURES.exists()
    with pytest.raises(UserError, match="--ycb: there is no folder some/ycb; give the right"):
        main(["--parts", "ycb", "--ycb", "some/ycb"])
    assert not results.FIGURES.exists(), "no look was noted"
    Path("some/ycb").mkdir(parents=True)
    assert main(["--parts", "ycb", "--ycb", "some/ycb"]) == 0
    (part,) = chosen_parts("clutter")
    line = part.commands[0].line(3, {"clutter": Path("some/vgn")})
    assert "evaluate.object_sets=some/vgn/pile objects.scale=0.9" in line
    assert "path/to/clutter/pile" in part.commands[0].line(3)
    content = json.loads((results.FIGURES / "ycb.json").read_text())
    assert "path/to/ycb" in content["commands"]["ycb"]["command"]
    names = str(Path("../some/vgn/pile").resolve()), "ycb", "a/ycb + b"
    rows = [row("oracle", 3, 4, name) for name in names]
    here = {"clutter": Path("../some/vgn/"), "ycb": Path("a/ycb")}
    told = results.without_places({"rows": rows, "run": "runs/ycb"}, here)
    assert [one["objects"] for one in told["rows"]] == [
        "path/to/clutter/pile", "ycb", "path/to/ycb + b",
    ]  # fmt: skip
    assert told["run"] == "runs/ycb"
    report = {"policy": "heuristic", "scenes": "pile of random_urdfs"}  # a transfer report's row
    assert results.without_places({"rows": [dict(report)]}, here)["rows"] == [report]
    (cornell,) = chosen_parts("cornell")
    line = cornell.commands[0].line(None, {"cornell": Path("YCB/cornell")})
    assert line.endswith("transfer.columns=cornell,cornell_as_taken transfer.cornell=YCB/cornell")


def names_sealed_scenes(root: Path) -> list[str]:
    """Files below `root`, in a repository those that git tracks, that name the sealed seed or the
    sealed objects, but for those that make and keep them."""
    seed, split = str(load_config(SEALED).seed), SPLIT
    named = re.compile(rf"\b{seed}\b|split\W{{1,4}}{split}\b|{split}\W{{1,4}}split")
    folders = {"envs", "models", "utils", "benchmarks", "configs", "tests", "checkpoints"}
    if (root / ".git").exists():
        command = ["git", "-C", str(root), "ls-files", "-z"]
        listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        files = [Path(name) for name in listed.split("\0")[:-1]]
    else:
        inside = (file for folder in folders for file in (root / folder).rglob("*"))
        files = [file.relative_to(root) for file in (*root.glob("*"), *inside)]
    return sorted(
        str(file)
        for file in files
        if (len(file.parts) == 1 or file.parts[0] in folders)
        and file.suffix in {".py", ".yaml", ".toml", ".sh", ".j2"}
        and (root / file).is_file()
        and named.search((root / file).read_text(encoding="utf-8"))
    )


def test_sealed_scenes_are_named_by_the_tables_alone(tmp_path):
    """In code, configs and tests, neither the seed nor the objects' split is chosen elsewhere. The
    Makefile and the workflow name neither."""
    assert names_sealed_scenes(REPOSITORY) == ["configs/sealed.yaml", *SPLIT_NAMED_IN]
    for name in ("Makefile", ".ci/run"):
        file = REPOSITORY / name
        assert not file.exists() or "sealed" not in file.read_text()
    for place, text in (("tests/helpers", f"SEED = {SEED}"), ("configs", "split: sealed")):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "planted.yaml").write_text(text)
    assert names_sealed_scenes(tmp_path) == ["configs/planted.yaml", "tests/helpers/planted.yaml"]


def test_finished_commands_are_not_run_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = []

    def run_command(part, command, scale, commit, folders):
        lines.append(command.line(command.scaled(scale)))
        if command.name == "primitives" and len(lines) == 3:
            raise KeyboardInterrupt
        return {"command": lines[-1], "rows": [row(command.name, 3, 4)]}

    monkeypatch.setattr(results, "run_command", run_command)
    monkeypatch.setattr(results, "code_commit", lambda: "c0ffee")
    monkeypatch.setattr(results, "weights_at", lambda commit: None)
    (tmp_path / "docs").mkdir()
    (part,) = chosen_parts("ppo")
    with pytest.raises(KeyboardInterrupt):
        results.measure(part, "c0ffee", 0.1)
    results.measure(part, "c0ffee", 0.1)
    assert len(lines) == 4 and lines[2] == lines[3]
    assert not results.FIGURES.exists(), "measuring alone writes no docs"
    results.publish(part, "c0ffee", 0.1)
    content = json.loads((results.FIGURES / "ppo.json").read_text())
    assert (content["commit"], content["seed"]) == ("c0ffee", SEED)
    assert list(content["commands"]) == ["box", "random_urdfs", "primitives"]
    assert results.is_finished(part, "c0ffee", 0.1) and not results.is_finished(part, "dead", 0.1)


def test_a_run_of_another_folder_is_not_gone_on_with(tmp_path, monkeypatch):
    """Neither where its figures are finished, nor where it was stopped."""
    monkeypatch.chdir(tmp_path)
    (part,) = chosen_parts("ycb")
    (command,) = part.commands
    name = results.run_name(part, command, command.scaled(0.1), "c0ffee")
    run = tmp_path / "runs" / "evaluate" / f"20260102-030405-{name}"
    run.mkdir(parents=True)
    config = load_config(None, ["evaluate.object_sets=old/ycb"])
    (run / "config.yaml").write_text(dump_config(config))
    played = []
    monkeypatch.setattr(results, "run_command", lambda *job: played.append(job) or {"rows": []})
    monkeypatch.setattr(results, "code_commit", lambda: "c0ffee")
    refused = r"results: .*ycb.* has evaluate\.object_sets=old/ycb and does not go on with new/ycb"
    for _ in range(2):
        with pytest.raises(UserError, match=refused):
            results.measure(part, "c0ffee", 0.1, {"ycb": Path("new/ycb")})
        assert len(played) < 2
        results.measure(part, "c0ffee", 0.1, {"ycb": tmp_path / "old" / "ycb"})
    assert len(played) == 1


def edited():
    raise UserError("commit these first")


@pytest.mark.parametrize(
    ("code_commit", "message"),
    [
        (lambda: "dead", "from commit c0ffee to dead while retrieve was measured"),
        (edited, r"code was changed \(commit these first\) while retrieve was measured"),
    ],
)
def test_figures_of_code_that_changed_meanwhile_are_dropped(
    tmp_path, monkeypatch, code_commit, message
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(results, "run_command", lambda *job: {"rows": []})
    monkeypatch.setattr(results, "code_commit", code_commit)
    (part,) = chosen_parts("retrieve")
    (command,) = part.commands
    name = results.run_name(part, command, command.scaled(1.0), "c0ffee")
    run = tmp_path / "runs" / "evaluate" / f"20260102-030405-{name}"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(dump_config(load_config()))
    with pytest.raises(UserError, match=message):
        results.measure(part, "c0ffee", 1.0)
    assert not results.is_finished(part, "c0ffee", 1.0)
    assert results.latest_run("evaluate", name) is None, "nor does the next call go on with it"
    assert len(list(run.parent.iterdir())) == 1, "but it is kept"


def test_figures_of_another_folder_are_not_taken_for_this_one_s(tmp_path, monkeypatch):
    """Where the run's folder is gone, too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(results, "run_command", lambda *job: {"rows": [], "date": "2026-01-02"})
    monkeypatch.setattr(results, "code_commit", lambda: "c0ffee")
    (part,) = chosen_parts("ycb")
    results.measure(part, "c0ffee", 0.1, {"ycb": Path("my ycb")})
    results.measure(part, "c0ffee", 0.1, {"ycb": tmp_path / "my ycb"})
    with pytest.raises(UserError, match=r"with .*my ycb, not with .*other; give the folder"):
        results.measure(part, "c0ffee", 0.1, {"ycb": Path("other")})
    (command,) = part.commands
    words = shlex.split(command.line(3, {"ycb": Path("my ycb")}))
    assert "evaluate.object_sets=my ycb" in words


@pytest.fixture
def two_parts(tmp_path, monkeypatch):
    """`main` in an empty folder: commands play nothing, a page stands for the docs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").mkdir()
    blocks = [f"<!-- results:{name} -->\n<!-- /results -->\n" for name in ("clutter15", "mujoco")]
    (tmp_path / "docs" / "results.md").write_text("".join(blocks))

    def run_command(part, command, scale, commit, folders):
        rounds = command.scaled(scale)
        figures = {"command": command.line(rounds), "rounds": rounds, "date": "2026-01-02"}
        return figures | {"rows": [row("heuristic", 3, 4, rounds=rounds)]}

    monkeypatch.setattr(results, "run_command", run_command)
    monkeypatch.setattr(results, "code_commit", lambda: 40 * "c")
    monkeypatch.setattr(results, "_git", lambda *arguments: 40 * "c")
    monkeypatch.setattr(results, "weights_at", lambda commit: None)
    page = tmp_path / "docs" / "results.md"
    monkeypatch.setattr(
        results, "write_tables", lambda folder: write_tables(folder, ["docs/results.md"])
    )
    return page


def test_a_trial_leaves_the_docs_alone(two_parts, capsys):
    before = two_parts.read_text()
    assert main(["--parts", "mujoco", "--scale", "0.1"]) == 0
    assert "they are of scenes with seed 900" in capsys.readouterr().out
    assert two_parts.read_text() == before and not results.FIGURES.exists()
    assert main(["--parts", "mujoco", "--scale", "0.1", "--write-docs"]) == 0
    assert "(5 rounds a row)" in two_parts.read_text()


def test_a_look_is_noted_before_it_begins(two_parts, monkeypatch):
    """A run that is stopped leaves it; one that goes on makes it none."""
    play = results.run_command

    class SecondOfJanuary(date):
        @classmethod
        def today(cls):
            return cls(2026, 1, 2)

    monkeypatch.setattr(results, "date", SecondOfJanuary)

    def stop(*_):
        raise KeyboardInterrupt

    def looks() -> dict:
        file = results.FIGURES / "looks.json"
        return json.loads(file.read_text()) if file.exists() else {}

    for part, is_look in (("clutter15", True), ("speed", False)):
        monkeypatch.setattr(results, "run_command", stop)
        with pytest.raises(KeyboardInterrupt):
            main(["--parts", part])
        assert looks().get(part, []) == is_look * [
            {"commit": 40 * "c", "scale": 1.0, "date": "2026-01-02", "noises": {}}
        ]
        with pytest.raises(KeyboardInterrupt):
            main(["--parts", part])
        assert len(looks().get(part, [])) == is_look
    monkeypatch.setattr(results, "run_command", play)
    assert main(["--parts", "clutter15"]) == 0 and "clutter15" not in looks()  # no planner's


def test_each_part_has_its_own_scale_and_the_date_of_its_measuring(two_parts):
    assert main(["--parts", "mujoco"]) == 0
    assert main(["--parts", "clutter15", "--scale", "0.5", "--write-docs"]) == 0
    page = two_parts.read_text()
    assert "(50 rounds a row)" in page and "(15 rounds a row)" in page
    assert "`cccccccccc` (2026-01-02)" in page
    content = json.loads((results.FIGURES / "clutter15.json").read_text())
    assert (content["scale"], content["date"]) == (0.5, "2026-01-02")


def test_every_look_at_sealed_scenes_is_kept(tmp_path):
    """97 of 100 and 45 of 50 grasps of two noisy rows are 95 %, 142 of 1,000 objects 14 %; clean
    rows stand beside them where there are no others. The same figures, published again, are no
    look; others are one, though the commit may be the same."""
    noisy = [
        row("graspnet", 97, 100) | {"depth_noise": "realsense"},
        row("graspnet", 45, 50, objects="primitives") | {"depth_noise": "realsense"},
    ]
    clean = [row("graspnet6d", 3, 4), row("heuristic", 1, 4)]
    target = [row("graspnet", 8, 10) | {"targets": 5, "targets_in_hand": 4}]
    for name, commit, rows in [
        ("scoreboard", "a", noisy), ("scoreboard", "a", noisy), ("mujoco", "b", clean),
        ("scoreboard", "a", clean), ("retrieve", "b", target), ("servo", "b", clean[1:]),
    ]:  # fmt: skip
        part = {"part": name, "commit": 40 * commit, "date": "2026-01-02", "scale": 1.0}
        first, second = {"rows": rows[:1]}, {"rows": rows[1:]}
        add_look(tmp_path, part | {"commands": {"one": first, "two": second, "three": {}}})
    for name in ("mujoco", "servo", "servo"):  # the first one is broken off
        about = {"part": name, "commit": 40 * "c", "scale": 0.5, "date": "2026-01-03"}
        begin_look(tmp_path, about)
        if name == "servo":
            add_look(tmp_path, about | {"commands": {"one": {"rows": clean[1:]}}})
    written = with_tables("<!-- results:looks -->\n<!-- /results -->", tmp_path).splitlines()
    assert [line.split(" | ")[:2] + line.split(" | ")[4:] for line in written[3:-1]] == [
        ["| `scoreboard`", "1", "`realsense`", "1000", "95 %, 14 %", "-", "- |"],
        ["| `scoreboard`", "2", "`none`", "500", "-", "-", "75 %, 1 % |"],
        ["| `mujoco`", "1", "`none`", "500", "-", "-", "75 %, 1 % |"],
        ["| `mujoco`", "2", "not finished", "0", "-", "-", "- |"],
        ["| `retrieve`", "1", "`none`", "5", "80 %, 80 %", "-", "- |"],
    ]


def test_what_was_measured_by_an_older_version_is_written(two_parts, tmp_path, capsys):
    """Its file has no date, its run folder lies below runs/evaluate."""
    run = tmp_path / "runs" / "evaluate" / "20260102-030405-old"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(dump_config(CONFIG))
    facts = {"commit": 40 * "d", "python": "3.11", "packages": {"numpy": "2.0"}}
    (run / "environment.json").write_text(json.dumps(facts))
    for record in ROUNDS:
        append_round(run / "rounds.jsonl", record)
    (part,) = chosen_parts("clutter15")
    file = results.finished_file(part, part.commands[0], 40 * "c", 0.5)
    file.parent.mkdir(parents=True)
    old = {"command": "python evaluate.py", "rounds": 30, "rows": [row("heuristic", 3, 4)]}
    file.write_text(json.dumps(old | {"run": str(run.relative_to(tmp_path))}))
    os.utime(file, (datetime(2026, 1, 3, 12).timestamp(),) * 2)  # at noon, wherever this is
    assert main(["--parts", "clutter15", "--scale", "0.5", "--commit", "cccccc"]) == 0
    content = json.loads((results.FIGURES / "clutter15.json").read_text())
    assert content["date"] == content["commands"]["clutter15"]["date"] == "2026-01-03"
    sample = read_sample(results.FIGURES / "clutter15-clutter15.jsonl")
    assert len(sample.rounds) == len(ROUNDS)
    assert sample.commit == content["commit"], "whatever commit stood on top of it"
    assert main(["--parts", "clutter15", "--scale", "0.25", "--commit", "cccccc"]) == 0
    assert "clutter15: skipped, because" in capsys.readouterr().out
