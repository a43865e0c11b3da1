"""The tables of README and docs, written from docs/results/*.json: nothing is typed by hand.

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
from typing import Any

from utils.result_records import CLEAN
from utils.runs import write_atomic
from utils.statistics import wilson_interval

PAGES = (
    "README.md", "README.zh-CN.md", "docs/results.md", "docs/planner.md", "docs/graspnet.md",
    "docs/six_dof.md", "docs/vgn.md",
    "docs/scaling.md", "docs/reliability.md",
)  # fmt: skip
_BLOCK = re.compile(r"(<!-- results:([\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)

Figures = dict[str, Any]  # of one part, as docs/results/<part>.json holds them
Say = Callable[[str], str]  # a word in the page's language

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
        _SURVEY,
    ),
    ("AnyGrasp", "real bins of 300 unseen objects", "93 %", "-", "arXiv 2212.08333"),
)
# The best of them beside our planners in the README: success and cleared on 5 and on 15 objects.
PUBLISHED_BESIDE = (
    ("OrbitGrasp (published: floating hand, noisy side view)", ("97 %", "98 %"), ("-", "-")),
)

_AHEAD = (
    "On 15 objects{} GraspNet's success minus the heuristic's is {} points (95 % bootstrap, paired "
    "by scene)."
)
CHINESE = {
    "planner": "规划器",
    "5 objects: success": "5 个物体:成功率",
    "cleared": "清空率",
    "15 objects: success": "15 个物体:成功率",
    "measured at commit": "测量于提交",
    "seed": "种子",
    "{} rounds a row": "每行 {} 轮",
    "5 objects": "5 个物体",
    "15 objects": "15 个物体",
    "not measured yet": "尚未测量",
    "depth": "深度噪声",
    " with `{}` depth": "、深度噪声为 `{}` ",
    _AHEAD: (
        "15 个物体{}时,GraspNet 的成功率减去启发式规划器的成功率为 {} 个百分点"
        "(95 % bootstrap,按场景配对)。"
    ),
    "OrbitGrasp (published: floating hand, noisy side view)": (
        "OrbitGrasp(已发表:没有手臂的浮动手爪,带噪声的侧视图)"
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
            body = draw(say, *(json.loads(file.read_text()) for file in files))
        else:
            make = "soak" if parts == ("reliability",) else f"results PARTS={','.join(parts)}"
            body = f"*{say('not measured yet')}: `make {make}`*"
        return f"{match[1]}{body}\n{match[3]}"

    return _BLOCK.sub(block, text)


# --- Cells ------------------------------------------------------------------------------------


def rate(successes: int, trials: int) -> str:
    """'97 % [95, 98] (488/502)', with the 95 % Wilson interval; '-' of nothing."""
    if trials == 0:
        return "-"
    low, high = (100 * bound for bound in wilson_interval(successes, trials))
    return f"{100 * successes / trials:.0f} % [{low:.0f}, {high:.0f}] ({successes}/{trials})"


def success(row: Figures) -> str:
    return rate(row["successes"], row["attempts"])


def cleared(row: Figures) -> str:
    return rate(row["objects_cleared"], row["objects_total"])


def points(difference: Figures | None) -> str:
    """'+1.5 [+0.7, +2.2]' percentage points."""
    if difference is None:
        return "-"
    value, low, high = (100 * difference[key] for key in ("value", "low", "high"))
    if value == low == high == 0:
        return "0 (alike in every round)"
    return f"{value:+.1f} [{low:+.1f}, {high:+.1f}]"


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def with_depths(
    header: Sequence[str],
    lines: Sequence[Sequence[str]],
    noises: Sequence[str],
    place: int,
    say: Say = str,
) -> str:
    """A Markdown table whose first rows have these depth noises, in column number `place`; the
    column is left out where there is no noise."""
    if set(noises) <= {CLEAN}:
        return table(header, lines)
    column = [say("depth"), *(f"`{noise}`" for noise in noises), *["-"] * len(lines)]
    wider = [[*line[:place], cell, *line[place:]] for line, cell in zip([header, *lines], column)]
    return table(wider[0], wider[1:])


def metrics_table(metrics: Figures) -> str:
    """What a benchmark reports, as a Markdown table."""
    lines = [
        [f"`{name}`", f"{one['value']:.3g} {one['unit']}", one["target"] or "-",
         {True: "yes", False: "no", None: "-"}[one["holds"]]]
        for name, one in metrics.items()
    ]  # fmt: skip
    return table(["what", "measured", "aim", "reached"], lines)


def origin(say: Say, *parts: Figures) -> str:
    """The line under a table: commit, date, seed, and each command with the rounds of its rows."""
    said = []
    for part in parts:
        commands = "; ".join(
            f"`{one['command']}`{_rounds(say, one)}" for one in part["commands"].values()
        )
        said.append(
            f"<sub>{say('measured at commit')} `{part['commit'][:10]}` ({part['date']}), "
            f"{_seed(say, part)}{commands}</sub>"
        )
    return "\n".join(said)


def _seed(say: Say, part: Figures) -> str:
    """'seed 2027: ', or nothing for benchmarks, whose scenes have seeds of their own."""
    seeded = any("seed=" in one["command"] for one in part["commands"].values())
    return f"{say('seed')} {part['seed']}: " if seeded else ""


def _rounds(say: Say, command: Figures) -> str:
    """' (30 rounds a row)', or nothing for what has no rounds."""
    counts = sorted({row["rounds"] for row in command.get("rows", ()) if "rounds" in row})
    return f" ({say('{} rounds a row').format(' / '.join(map(str, counts)))})" if counts else ""


def rows_of(part: Figures, command: str | None = None) -> list[Figures]:
    """The rows of a part's command, the first one by default."""
    commands = part["commands"]
    return commands[command or next(iter(commands))]["rows"]


# --- Tables -----------------------------------------------------------------------------------


def planners(say: Say, scoreboard: Figures, clutter: Figures) -> str:
    """The README's: four planners on piles of 5 and of 15 objects, noisy rows first, and published
    systems."""
    few, many = (
        {(_noise(row), row["policy"]): [success(row), cleared(row)] for row in rows}
        for rows in (
            [row for row in rows_of(scoreboard) if _is(row, "pile", "random_urdfs")],
            rows_of(clutter),
        )
    )
    none = ["-", "-"]
    kinds = sorted(dict.fromkeys([*few, *many]), key=lambda kind: kind[0] == CLEAN)
    header = ["planner", "5 objects: success", "cleared", "15 objects: success", "cleared"]
    lines = [[f"`{kind[1]}`", *few.get(kind, none), *many.get(kind, none)] for kind in kinds]
    for name, five, fifteen in PUBLISHED_BESIDE:
        lines.append([say(name), *five, *fifteen])
    noises = [noise for noise, _ in kinds]
    pair = _pair(clutter, "graspnet", "heuristic")
    noisy = "" if _noise(pair) == CLEAN else say(" with `{}` depth").format(_noise(pair))
    ahead = say(_AHEAD).format(noisy, points(pair["success"]))
    others = say("In real bins of 300 objects AnyGrasp reaches 93 %.")
    below = f"{ahead} {others} {_short(say, scoreboard, clutter)}"
    return "\n\n".join([with_depths(list(map(say, header)), lines, noises, 1, say), below])


def published(say: Say) -> str:
    """What the best published systems reach on tasks of their own."""
    header = ["published system", "task", "success", "cleared", "source"]
    lines = [[name, say(task), *rest] for name, task, *rest in PUBLISHED]
    return table(list(map(say, header)), lines)


def scoreboard(say: Say, part: Figures) -> str:
    header = ["objects", "scenario", "planner", "success", "cleared", "picks an hour"]
    rows = [row for command in part["commands"].values() for row in command["rows"]]
    lines = [[f"`{row['objects']}`", row["scenario"], *_planner_cells(row)] for row in rows]
    return "\n\n".join([with_depths(header, lines, _noises(rows), 2), origin(say, part)])


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
    return "\n\n".join([with_depths(header, lines, _noises(pairs), 2), origin(say, part)])


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
    beside = with_depths(header, lines, _noises(pairs), 2)
    return "\n\n".join([scoreboard(say, part), beside])


def retrieve(say: Say, part: Figures) -> str:
    rows = rows_of(part)
    lines = [
        [f"`{row['objects']}`", f"`{row['policy']}`",
         rate(row["targets_in_hand"], row["targets"]), _decimal(row["picks_to_target"])]
        for row in rows
    ]  # fmt: skip
    header = ["objects", "planner", "target in hand", "picks to it"]
    return "\n\n".join([with_depths(header, lines, _noises(rows), 1), origin(say, part)])


def calibration(say: Say, part: Figures) -> str:
    """What each planner stated, what came of it, and how far both are apart in ten bins."""
    lines = [
        [f"`{one['policy']}`", simulator, _noise(one), one["grasps"], f"{one['chance']:.3f}",
         f"{one['success']:.3f}", f"{one['error']:.3f}"]
        for simulator, command in part["commands"].items()
        for one in command["calibration"]
    ]  # fmt: skip
    header = ["planner", "simulator", "depth", "grasps", "mean quality", "share of successes",
              "calibration error"]  # fmt: skip
    return "\n\n".join([table(header, lines), origin(say, part)])


def clutter15(say: Say, part: Figures) -> str:
    header = ["planner", "success", "cleared", "picks an hour"]
    lines = [_planner_cells(row) for row in rows_of(part)]
    return "\n\n".join([with_depths(header, lines, _noises(rows_of(part)), 1), origin(say, part)])


def noise(say: Say, part: Figures, scoreboard: Figures) -> str:
    """Success with each depth noise: those of the scoreboard, and those by which the part's
    commands are named, on the same scenes."""
    cells: dict[tuple[str, str, str], dict[str, str]] = {}
    for name, command in part["commands"].items():
        for row in command["rows"]:
            cells.setdefault(_key(row), {})[name] = success(row)
    for row in rows_of(scoreboard):
        cells.get(_key(row), {})[_noise(row)] = success(row)
    noises = dict.fromkeys([*_noises(rows_of(scoreboard)), *part["commands"]])
    lines = [
        [f"`{objects}`", scenario, f"`{policy}`", *(of.get(noise, "-") for noise in noises)]
        for (policy, scenario, objects), of in cells.items()
    ]
    header = ["objects", "scenario", "planner", *(f"`{noise}`" for noise in noises)]
    return "\n\n".join([table(header, lines), origin(say, part, scoreboard)])


def servo(say: Say, part: Figures) -> str:
    """Scenarios by controllers, both object sets together."""
    counts: dict[str, dict[str, list[int]]] = {}
    for row in rows_of(part):
        cell = counts.setdefault(row["scenario"], {}).setdefault(row["controller"], [0, 0])
        cell[0] += row["successes"]
        cell[1] += row["attempts"]
    names = list(next(iter(counts.values())))
    lines = [[f"`{name}`", *(rate(*cells[one]) for one in names)] for name, cells in counts.items()]
    return "\n\n".join([table(["scenario", *map(str, names)], lines), origin(say, part)])


def mujoco(say: Say, part: Figures) -> str:
    ours, theirs = (
        {row["policy"]: row for row in rows_of(part, name)} for name in ("pybullet", "mujoco")
    )
    lines = [[f"`{name}`", success(row), success(theirs[name])] for name, row in ours.items()]
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
            policy = row["policy"].removeprefix("ppo:checkpoints/")
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
            "-" if one is None else rate(one["successes"], one["trials"]) for one in cells
        )])  # fmt: skip
    folds = part["commands"]["folds"]
    lines.append(["GraspNet, five folds by object", "taught by the other folds' labels", "-",
                  rate(folds["correct"], folds["images"])])  # fmt: skip
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
        f"<sub>`{part['command']}`: measured at commit `{part['commit'][:10]}` ({part['date']}), "
        f"seed {part['seed']}, {part['device']}, {part['minutes']:g} minutes</sub>"
        for part in parts.values()
    ]
    header = ["fault", "tried", "survived", "lost", "note"]
    return "\n\n".join([table(header, lines), "\\\n".join(origins)])


# Name of a table: the parts that it needs, and what writes it.
TABLES: dict[str, tuple[tuple[str, ...], Callable[..., str]]] = {
    "planners": (("scoreboard", "clutter15"), planners),
    "published": ((), published),
    "scoreboard": (("scoreboard",), scoreboard),
    "differences": (("scoreboard",), differences),
    "six_dof": (("six_dof",), variants),
    "direct": (("direct",), variants),
    "scenes": (("scenes",), variants),
    "retrieve": (("retrieve",), retrieve),
    "vgn": (("vgn",), variants),
    "calibration": (("calibration",), calibration),
    "clutter15": (("clutter15",), clutter15),
    "differences15": (("clutter15",), differences),
    "noise": (("noise", "scoreboard"), noise),
    "servo": (("servo",), servo),
    "mujoco": (("mujoco",), mujoco),
    "mujoco_only": (("mujoco_only",), mujoco_only),
    "ppo": (("ppo",), ppo),
    "cornell": (("cornell",), cornell),
    "speed": (("speed",), speed),
    "scaling": (("scaling",), scaling),
    "scaling_model": (("scaling",), scaling_model),
    "reliability": (("reliability",), reliability),
}


def _decimal(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _planner_cells(row: Figures) -> list[str]:
    an_hour = row["picks_per_hour"]
    picks = "-" if an_hour is None else f"{an_hour:.0f}"
    return [f"`{row['policy']}`", success(row), cleared(row), picks]


def _short(say: Say, few: Figures, many: Figures) -> str:
    origins = "; ".join(
        f"{say(objects)}: {say('measured at commit')} `{part['commit'][:10]}`, {say('seed')} "
        f"{part['seed']}{_rounds(say, next(iter(part['commands'].values())))}"
        for objects, part in (("5 objects", few), ("15 objects", many))
    )
    return f"<sub>{origins}; 95 % Wilson; [docs/results.md](docs/results.md)</sub>"


def _pair(part: Figures, first: str, second: str) -> Figures:
    command = next(iter(part["commands"].values()))
    pairs = command["comparisons"]
    return next(one for one in pairs if (one["first"], one["second"]) == (first, second))


def _is(row: Figures, scenario: str, objects: str) -> bool:
    return (row["scenario"], row["objects"]) == (scenario, objects)


def _noise(row: Figures) -> str:
    """The depth noise of a row or a pair; older figures do not name it."""
    return row.get("depth_noise", CLEAN)


def _noises(rows: Sequence[Figures]) -> list[str]:
    return [_noise(row) for row in rows]


def _key(row: Figures) -> tuple[str, str, str]:
    return row["policy"], row["scenario"], row["objects"]
