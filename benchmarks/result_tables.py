"""The tables of README and docs, written from docs/results/*.json; published figures stand here.

A page says where a table stands by two comments, `<!-- results:NAME -->` and `<!-- /results -->`;
NAME is a key of TABLES. Pages whose name has `zh` in it get their words in Chinese. A table names
the commit, the seed and the command that it was measured by, and the rounds of each row.

This module formats what `benchmarks.results` measured and measures nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from benchmarks.looks import looks_table
from benchmarks.table_cells import (
    Figures,
    Say,
    cleared,
    decimal,
    metrics_table,
    noise_of,
    noises_of,
    origin,
    percent,
    planner_cells,
    points,
    policy_file,
    rate,
    rounds_in_words,
    rows_of,
    success,
    table,
    weights_in_words,
    with_depths,
)
from utils.atomic_files import write_atomic
from utils.result_records import CLEAN

PAGES = (
    "README.md", "README.zh-CN.md", "docs/results.md", "docs/choices.md", "docs/planner.md",
    "docs/calibration.md", "docs/graspnet.md", "docs/six_dof.md", "docs/vgn.md", "docs/ppo.md",
    "docs/scaling.md", "docs/reliability.md", "docs/servo.md",
)  # fmt: skip
_BLOCK = re.compile(r"(<!-- results:([\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)

_SURVEY = "arXiv 2507.18847, tables I and II"
# Success per attempt and objects removed, as published; none of these systems moves a whole arm in
# simulation, and each has objects, sensors and a protocol of its own.
PUBLISHED = (
    ("VGN", "5 objects, one fixed noisy side view, floating hand", "59 %", "44 %", _SURVEY),
    (
        "EquiIGD-HR",
        "5 objects, one noisy view from any side, floating hand",
        "91 %",
        "95 %",
        _SURVEY,
    ),
    (
        "OrbitGrasp",
        "5 objects, one noisy view from any side, floating hand",
        "97 %",
        "98 %",
        "arXiv 2407.03531",
    ),
    ("AnyGrasp", "real bins of 300 unseen objects", "93 %", "-", "arXiv 2212.08333"),
)
# The best of them beside our planners in the README: success and cleared on 5 and on 15 objects.
PUBLISHED_BESIDE = (
    ("OrbitGrasp (published: floating hand, noisy side view)", ("97 %", "98 %"), ("-", "-")),
)
# The parts of the overview, and where their tables stand.
OVERVIEW = {
    "six_dof": "[from any side](six_dof.md#figures)",
    "scenes": "[from the side](six_dof.md#scenes-for-grasps-from-any-side)",
    "oblique": "[a camera at 45 degrees](six_dof.md#limits)",
    "unseen": "[new families](#families-that-no-training-sees)",
    "household": "[household things](#household-things)",
    "ycb": "[household things](#household-things)",
    "clutter": "[VGN's objects](#vgns-objects)",
    "vgn": "[VGN's protocol](vgn.md#figures)",
}
OVERVIEW_PLANNERS = "graspnet", "graspnet6d", "oracle6d"
# Success, and cleared where it has an aim of its own, by part and scenario: set before measuring,
# those of VGN's protocol over the best that is published.
AIMS: dict[tuple[str, ...], str] = {
    ("six_dof", "packed"): "97", ("six_dof", "pile"): "97", ("six_dof", "bin"): "95, 95",
    ("scenes", "tall"): "93", ("scenes", "wall"): "93", ("scenes", "shelf"): "93",
    ("scenes", "flat"): "93", ("oblique", "pile"): "98", ("unseen", "pile"): "94",
    ("ycb", "household"): "95", ("clutter", "pile"): "97", ("clutter", "packed"): "97",
    ("vgn", "packed", "gaussian"): "98.5, 99", ("vgn", "pile", "gaussian"): "97.5, 98",
    ("vgn", "packed", "gamma"): "97.5, 95", ("vgn", "pile", "gamma"): "88, 88",
}  # fmt: skip

_HEADLINE = (
    "**Result** on unseen objects{}: {} of the grasps of `graspnet` succeed in piles of 5 "
    "objects, {} in piles of 15; {} and {} of the objects reach the tray."
)
_AHEAD = (
    "On 15 objects{} the success of `graspnet` minus that of `heuristic` is {} points (95 % "
    "bootstrap, paired by scene)."
)
CHINESE = {
    "planner": "规划器",
    "5 objects: success": "5 个物体：成功率",
    "cleared": "清空率",
    "15 objects: success": "15 个物体：成功率",
    "measured at commit": "测量于提交",
    "with an earlier": "，使用较早的",
    "without": "，没有",
    "seed": "种子",
    "95 % intervals": "95 % 区间",
    "{} rounds a row": "每行 {} 轮",
    "5 objects": "5 个物体",
    "15 objects": "15 个物体",
    "not measured yet": "尚未测量",
    "depth": "深度噪声",
    " with `{}` depth": "、深度噪声为 `{}` ",
    " with `{}` depth noise": "、深度噪声为 `{}` ",
    _HEADLINE: (
        "**结果**：没见过的物体{}时，`graspnet` 的抓取在 5 个物体的堆中有 {} 成功，"
        "在 15 个物体的堆中有 {}；分别有 {} 和 {} 的物体被放进托盘。"
    ),
    _AHEAD: (
        "15 个物体{}时，`graspnet` 的成功率减去 `heuristic` 的成功率为 {} 个百分点"
        "（95 % bootstrap，按场景配对）。"
    ),
    "OrbitGrasp (published: floating hand, noisy side view)": (
        "OrbitGrasp（已发表：没有手臂的浮动手爪，带噪声的侧视图）"
    ),
    "In real bins of 300 objects AnyGrasp reaches 93 %.": (
        "AnyGrasp 在 300 个物体的真实料箱中达到 93 %。"
    ),
}


def write_tables(folder: Path, pages: Sequence[str] = PAGES) -> list[Path]:
    """Write every table of the pages anew from the figures in a folder; the pages."""
    written = []
    for page in map(Path, pages):
        write_atomic(page, with_tables(page.read_text(encoding="utf-8"), folder, "zh" in page.name))
        written.append(page)
    return written


def with_tables(text: str, folder: Path, chinese: bool = False) -> str:
    """A page's text with its tables written anew. Raises KeyError for an unknown table."""
    say: Say = (lambda word: CHINESE.get(word, word)) if chinese else (lambda word: word)

    def block(match: re.Match[str]) -> str:
        parts, draw = TABLES[match[2]]
        files = [folder / f"{part}.json" for part in parts]
        if all(file.exists() for file in files):
            body = draw(say, *(json.loads(file.read_text(encoding="utf-8")) for file in files))
        else:
            make = "soak" if parts == ("reliability",) else f"results PARTS={','.join(parts)}"
            body = f"*{say('not measured yet')}: `make {make}`*"
        return f"{match[1]}{body}\n{match[3]}"

    return _BLOCK.sub(block, text)


# --- Tables -----------------------------------------------------------------------------------


def headline(say: Say, scoreboard: Figures, clutter: Figures) -> str:
    """The README's first sentence on results: GraspNet on piles of 5 and of 15 objects, with depth
    noise where both were measured with it."""
    few, many = (
        {noise_of(row): row for row in rows if row["policy"] == "graspnet"}
        for rows in (_piles(scoreboard), rows_of(clutter))
    )
    noise = min(few.keys() & many.keys(), key=lambda noise: (noise == CLEAN, noise))
    noisy = "" if noise == CLEAN else say(" with `{}` depth noise").format(noise)
    cells = [share(rows[noise]) for share in (success, cleared) for rows in (few, many)]
    return say(_HEADLINE).format(noisy, *(cell.split(" [")[0] for cell in cells))


def planners(say: Say, scoreboard: Figures, clutter: Figures) -> str:
    """The README's: planners on piles of 5 and of 15 objects, noisy rows first, and published
    systems."""
    few, many = (
        {(noise_of(row), row["policy"]): [success(row), cleared(row)] for row in rows}
        for rows in (_piles(scoreboard), rows_of(clutter))
    )
    none = ["-", "-"]
    kinds = sorted(dict.fromkeys([*few, *many]), key=lambda kind: kind[0] == CLEAN)
    header = ["planner", "5 objects: success", "cleared", "15 objects: success", "cleared"]
    lines = [[f"`{kind[1]}`", *few.get(kind, none), *many.get(kind, none)] for kind in kinds]
    for name, five, fifteen in PUBLISHED_BESIDE:
        lines.append([say(name), *five, *fifteen])
    noises = [noise for noise, _ in kinds]
    pair = _pair(clutter, "graspnet", "heuristic")
    noisy = "" if noise_of(pair) == CLEAN else say(" with `{}` depth").format(noise_of(pair))
    ahead = say(_AHEAD).format(noisy, points(pair["success"]))
    others = say("In real bins of 300 objects AnyGrasp reaches 93 %.")
    below = f"{ahead} {others} {_short(say, scoreboard, clutter)}"
    return "\n\n".join([with_depths(list(map(say, header)), lines, noises, 1, say), below])


def published(say: Say) -> str:
    """What the best published systems reach on tasks of their own."""
    header = ["published system", "task", "success", "cleared", "source"]
    lines = [[name, say(task), *rest] for name, task, *rest in PUBLISHED]
    return table(list(map(say, header)), lines)


def overview(say: Say, *parts: Figures) -> str:
    """A line for each scene, with noisy depth: how many grasps succeed and how many objects are
    cleared, in per cent, by the planners that most parts have."""
    lines = []
    for part in parts:
        cells: dict[tuple[str, str, str], dict[str, str]] = {}
        for row in (row for command in part["commands"].values() for row in command["rows"]):
            if noise_of(row) != CLEAN:
                scene = row["scenario"], row["objects"].rpartition(":")[2], noise_of(row)
                shares = (
                    (row["successes"], row["attempts"]),
                    (row["objects_cleared"], row["objects_total"]),
                )
                both = ", ".join(percent(*share) if share[1] else "-" for share in shares)
                cells.setdefault(scene, {})[row["policy"]] = both
        page = OVERVIEW[part["part"]]
        for (scenario, objects, noise), of in cells.items():
            planners = (of.get(planner, "-") for planner in OVERVIEW_PLANNERS)
            aim = AIMS.get((part["part"], scenario, noise), AIMS.get((part["part"], scenario), "-"))
            lines.append([scenario, f"`{objects}`", f"`{noise}`", *planners, aim, page])
    names = (f"`{name}`" for name in OVERVIEW_PLANNERS)
    return table(["scenario", "objects", "depth", *names, "aim", "table"], lines)


def scoreboard(say: Say, part: Figures) -> str:
    header = ["objects", "scenario", "planner", "success", "cleared", "picks an hour"]
    rows = [row for command in part["commands"].values() for row in command["rows"]]
    lines = [[f"`{row['objects']}`", row["scenario"], *planner_cells(row)] for row in rows]
    return "\n\n".join([with_depths(header, lines, noises_of(rows), 2), origin(say, part)])


def differences(say: Say, part: Figures) -> str:
    """GraspNet against the heuristic, paired by scene."""
    pairs = [
        pair
        for command in part["commands"].values()
        for pair in command["comparisons"]
        if (pair["first"], pair["second"]) == ("graspnet", "heuristic")
    ]
    lines = [
        [f"`{pair['objects']}`", pair["scenario"], points(pair["success"]), points(pair["cleared"])]
        for pair in pairs
    ]
    header = ["objects", "scenario", "success, points", "cleared, points"]
    return "\n\n".join([with_depths(header, lines, noises_of(pairs), 2), origin(say, part)])


def variants(say: Say, part: Figures) -> str:
    """Planners beside the ones that they vary (`...6d`, `..._direct`), and the differences of each
    pair on the same scenes."""
    pairs = [
        pair
        for command in part["commands"].values()
        for pair in command["comparisons"]
        if pair["first"] in (f"{pair['second']}6d", f"{pair['second']}_direct")
    ]
    lines = [
        [f"`{pair['objects']}`", pair["scenario"], f"`{pair['first']}` - `{pair['second']}`",
         points(pair["success"]), points(pair["cleared"])]
        for pair in pairs
    ]  # fmt: skip
    header = ["objects", "scenario", "difference", "success, points", "cleared, points"]
    beside = with_depths(header, lines, noises_of(pairs), 2)
    return "\n\n".join([scoreboard(say, part), beside])


def second_look(say: Say, once: Figures, twice: Figures) -> str:
    """Planners with one image and with a second one, on the same scenes."""
    first = {(*_key(row), noise_of(row)): row for row in rows_of(once)}
    rows = rows_of(twice)
    lines = [
        [f"`{row['objects']}`", f"`{row['policy']}`", looks, *planner_cells(of)[1:]]
        for row in rows
        for looks, of in (("one", first[(*_key(row), noise_of(row))]), ("two", row))
    ]
    header = ["objects", "planner", "images", "success", "cleared", "picks an hour"]
    noises = [noise for noise in noises_of(rows) for _ in range(2)]
    return "\n\n".join([with_depths(header, lines, noises, 1), origin(say, once, twice)])


def retrieve(say: Say, part: Figures) -> str:
    rows = rows_of(part)
    lines = [
        [f"`{row['objects']}`", f"`{row['policy']}`",
         rate(row["targets_in_hand"], row["targets"]), decimal(row["picks_to_target"])]
        for row in rows
    ]  # fmt: skip
    header = ["objects", "planner", "target in hand", "picks to it"]
    return "\n\n".join([with_depths(header, lines, noises_of(rows), 1), origin(say, part)])


def calibration(say: Say, part: Figures) -> str:
    """What each planner stated, what came of it, how far both are apart in ten bins, and how far
    they would be if it stated its chances exactly: on average, and in 19 of 20 such samples."""
    lines = [
        [f"`{one['policy']}`", simulator, noise_of(one), one["grasps"], f"{one['chance']:.3f}",
         f"{one['success']:.3f}", f"{one['error']:.3f}",
         "{:.3f}, {:.3f}".format(*one["error_by_chance"])]
        for simulator, command in part["commands"].items()
        for one in command["calibration"]
    ]  # fmt: skip
    header = ["planner", "simulator", "depth", "grasps", "mean quality", "share of successes",
              "calibration error", "by chance: mean, 95 %"]  # fmt: skip
    return "\n\n".join([table(header, lines), origin(say, part)])


def calibration_by_scene(say: Say, *parts: Figures) -> str:
    """The calibration error in each scenario, with the attempts that it is of. Few attempts make an
    error of their own, which is why they stand beside it."""
    cells: dict[tuple[str, str, str], dict[str, str]] = {}
    for command in (command for part in parts for command in part["commands"].values()):
        for row in command["rows"]:
            if row.get("calibration_error") is not None:  # older files have no such key
                cell = cells.setdefault((row["objects"], row["scenario"], noise_of(row)), {})
                error = f"{row['calibration_error']:.3f} ({row['attempts']})"
                cell.setdefault(row["policy"], error)
    planners = dict.fromkeys(policy for of in cells.values() for policy in of)
    lines = [
        [f"`{objects}`", scenario, f"`{noise}`", *(of.get(policy, "-") for policy in planners)]
        for (objects, scenario, noise), of in cells.items()
    ]
    header = ["objects", "scenario", "depth", *(f"`{policy}`" for policy in planners)]
    return "\n\n".join([table(header, lines), origin(say, *parts)])


def clutter15(say: Say, part: Figures) -> str:
    header = ["planner", "success", "cleared", "picks an hour"]
    lines = [planner_cells(row) for row in rows_of(part)]
    return "\n\n".join([with_depths(header, lines, noises_of(rows_of(part)), 1), origin(say, part)])


def noise(say: Say, part: Figures, scoreboard: Figures) -> str:
    """Success with each depth noise: those of the scoreboard, and those by which the part's
    commands are named, on scenes of the same seeds. Where the two were measured at other commits,
    which stand below the table, scenes and planners may differ."""
    cells: dict[tuple[str, str, str], dict[str, str]] = {}
    for name, command in part["commands"].items():
        for row in command["rows"]:
            cells.setdefault(_key(row), {})[name] = success(row)
    for row in rows_of(scoreboard):
        cells.get(_key(row), {})[noise_of(row)] = success(row)
    noises = dict.fromkeys([*noises_of(rows_of(scoreboard)), *part["commands"]])
    lines = [
        [f"`{objects}`", scenario, f"`{policy}`", *(of.get(noise, "-") for noise in noises)]
        for (policy, scenario, objects), of in cells.items()
    ]
    header = ["objects", "scenario", "planner", *(f"`{noise}`" for noise in noises)]
    return "\n\n".join([table(header, lines), origin(say, part, scoreboard)])


def servo(say: Say, part: Figures) -> str:
    """Scenarios by controllers, both object sets together, and how long a turn of a loop takes:
    the median, over the rows, of the mean and of the 95th percentile."""
    counts: dict[str, dict[str, list[int]]] = {}
    turns: dict[str, list[tuple[float, float]]] = {}
    for row in rows_of(part):
        cell = counts.setdefault(row["scenario"], {}).setdefault(row["controller"], [0, 0])
        cell[0] += row["successes"]
        cell[1] += row["attempts"]
        if row.get("turn_ms_mean") is not None:
            of_one = row["turn_ms_mean"], row["turn_ms_p95"]
            turns.setdefault(row["controller"], []).append(of_one)
    names = list(next(iter(counts.values())))
    lines = [[f"`{name}`", *(rate(*cells[one]) for one in names)] for name, cells in counts.items()]
    typical = {name: [median(column) for column in zip(*of)] for name, of in turns.items()}
    if typical:
        spent = (", ".join(f"{ms:.1f}" for ms in typical.get(name, ())) or "-" for name in names)
        lines.append(["one iteration, ms: mean, 95 %", *spent])
    return "\n\n".join([table(["scenario", *map(str, names)], lines), origin(say, part)])


def mujoco(say: Say, part: Figures) -> str:
    ours, theirs = (
        {row["policy"]: row for row in rows_of(part, name)} for name in ("pybullet", "mujoco")
    )
    lines = [
        [f"`{policy_file(name)}`", success(row), success(theirs[name])]
        for name, row in ours.items()
    ]
    return "\n\n".join([table(["planner", "PyBullet", "MuJoCo"], lines), origin(say, part)])


def mujoco_only(say: Say, part: Figures) -> str:
    ours, theirs = (
        {(row["scenario"], row["policy"]): row for row in rows_of(part, name)}
        for name in ("pybullet", "mujoco")
    )
    lines = [
        [scenario, f"`{name}`", success(row), success(theirs[scenario, name]), cleared(row),
         cleared(theirs[scenario, name])]
        for (scenario, name), row in ours.items()
    ]  # fmt: skip
    header = ["scenario", "planner", "success in PyBullet", "success in MuJoCo",
              "cleared in PyBullet", "cleared in MuJoCo"]  # fmt: skip
    return "\n\n".join([table(header, lines), origin(say, part)])


def ppo(say: Say, part: Figures) -> str:
    lines = []
    for command in part["commands"].values():
        for row in command["rows"]:
            policy = policy_file(row["policy"])
            lines.append([f"`{row['objects']}`", f"`{policy}`", success(row), cleared(row)])
    header = ["objects", "policy", "success", "cleared"]
    return "\n\n".join([table(header, lines), origin(say, part)])


def cornell(say: Say, part: Figures) -> str:
    lines = []
    for row in rows_of(part, "simulated"):
        columns = row["columns"]
        if not columns:
            continue
        cells = [columns.get(name) for name in ("cornell", "cornell_as_taken")]
        lines.append([row["policy"], row["training"], *(
            "-" if one is None else rate(one["successes"], one["trials"], one["success_ci95"])
            for one in cells
        )])  # fmt: skip
    folds = part["commands"]["folds"]
    lines.append(["GraspNet, five folds by object", "taught by the other folds' labels", "-",
                  rate(folds["correct"], folds["images"], folds["accuracy_ci95"])])  # fmt: skip
    header = ["policy", "training", "seen from above", "as taken"]
    return "\n\n".join([table(header, lines), origin(say, part)])


def speed(say: Say, part: Figures) -> str:
    commands = part["commands"].values()
    metrics = {name: one for command in commands for name, one in command["metrics"].items()}
    return "\n\n".join([metrics_table(metrics), origin(say, part)])


def scaling(say: Say, part: Figures) -> str:
    metrics = part["commands"]["scaling"]["metrics"]
    measured = {name: one for name, one in metrics.items() if not name.startswith("model_")}
    return "\n\n".join([metrics_table(measured), origin(say, part)])


def scaling_model(say: Say, part: Figures) -> str:
    """A line for each number of workers, and what does not depend on it."""
    metrics = part["commands"]["scaling"]["metrics"]
    model = {name: one for name, one in metrics.items() if name.startswith("model_")}
    sizes = [name.split("_")[1] for name in model if name.endswith("_workers_rate")]
    columns = {"rate": "scenes/h", "scheduler_load": "scheduler, % CPU", "main_load":
               "script, % CPU", "network": "Mbit/s", "million": "a million scenes, h"}  # fmt: skip
    lines = [
        [size, *(f"{model.pop(f'model_{size}_workers_{key}')['value']:.3g}" for key in columns)]
        for size in sizes
    ]
    by_workers = table(["workers", *columns.values()], lines)
    return "\n\n".join([by_workers, metrics_table(model), origin(say, part)])


def reliability(say: Say, parts: Figures) -> str:
    """What `benchmarks.soak` has tried; each of its parts may have been run at another commit."""
    lines = [
        [row["fault"], *(f"{row[key]:,}" for key in ("tried", "survived", "lost")), row["note"]]
        for part in parts.values()
        for row in part["rows"]
        if row["tried"]  # a part that was stopped did not come to all of them
    ]
    origins = [
        f"<sub>`{part['command']}`: measured at commit `{part['commit'][:10]}`"
        f"{' with changes' if part.get('dirty') else ''} ({part['date']}), "
        f"seed {part['seed']}, {part['device']}, {part['minutes']:g} minutes</sub>"
        for part in parts.values()
    ]
    header = ["fault", "tried", "survived", "lost", "note"]
    return "\n\n".join([table(header, lines), "\\\n".join(origins)])


# Name of a table: the parts that it needs, and what writes it.
TABLES: dict[str, tuple[tuple[str, ...], Callable[..., str]]] = {
    "headline": (("scoreboard", "clutter15"), headline),
    "planners": (("scoreboard", "clutter15"), planners),
    "published": ((), published),
    "overview": (tuple(OVERVIEW), overview),
    "scoreboard": (("scoreboard",), scoreboard),
    "differences": (("scoreboard",), differences),
    "six_dof": (("six_dof",), variants),
    "direct": (("direct",), variants),
    "scenes": (("scenes",), variants),
    "oblique": (("oblique",), variants),
    "second_look": (("oblique", "second_look"), second_look),
    "unseen": (("unseen",), variants),
    "household": (("household",), variants),
    "ycb": (("ycb",), variants),
    "clutter": (("clutter",), variants),
    "retrieve": (("retrieve",), retrieve),
    "vgn": (("vgn",), variants),
    "calibration": (("calibration",), calibration),
    "calibration_by_scene": (("six_dof", "scenes", "direct"), calibration_by_scene),
    "clutter15": (("clutter15",), clutter15),
    "differences15": (("clutter15",), differences),
    "noise": (("noise", "scoreboard"), noise),
    "servo": (("servo",), servo),
    "mujoco": (("mujoco",), mujoco),
    "mujoco_only": (("mujoco_only",), mujoco_only),
    "ppo": (("ppo",), ppo),
    "ppo_mujoco": (("ppo_mujoco",), mujoco),
    "cornell": (("cornell",), cornell),
    "speed": (("speed",), speed),
    "scaling": (("scaling",), scaling),
    "scaling_model": (("scaling",), scaling_model),
    "reliability": (("reliability",), reliability),
    "looks": (("looks",), looks_table),
}


def _short(say: Say, few: Figures, many: Figures) -> str:
    origins = "; ".join(
        f"{say(objects)}: {say('measured at commit')} `{part['commit'][:10]}`"
        f"{weights_in_words(say, part)}, {say('seed')} "
        f"{part['seed']}{rounds_in_words(say, next(iter(part['commands'].values())))}"
        for objects, part in (("5 objects", few), ("15 objects", many))
    )
    return f"<sub>{origins}; {say('95 % intervals')}; [docs/results.md](docs/results.md)</sub>"


def _pair(part: Figures, first: str, second: str) -> Figures:
    command = next(iter(part["commands"].values()))
    pairs = command["comparisons"]
    return next(one for one in pairs if (one["first"], one["second"]) == (first, second))


def _piles(scoreboard: Figures) -> list[Figures]:
    return [row for row in rows_of(scoreboard) if _is(row, "pile", "random_urdfs")]


def _is(row: Figures, scenario: str, objects: str) -> bool:
    return (row["scenario"], row["objects"]) == (scenario, objects)


def _key(row: Figures) -> tuple[str, str, str]:
    return row["policy"], row["scenario"], row["objects"]
