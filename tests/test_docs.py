"""README and docs say what is there: both languages alike, every file and link, generated tables.

The tables of README and docs/results.md are those that `docs/results/*.json` give; what they are
drawn with is tested by `test_result_tables`.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from benchmarks.result_parts import PARTS
from benchmarks.result_tables import PAGES, with_tables
from benchmarks.results import FIGURES
from utils.config import load_config
from utils.runs import REPOSITORY

READMES, TUTORIAL_NAMES = (
    (REPOSITORY / f"{page}.md", REPOSITORY / f"{page}.zh-CN.md")
    for page in ("README", "docs/tutorial_names")
)
DOCUMENTS = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md")])
# Files that a reader brings or a run leaves.
READERS_OWN = re.compile(
    r"^(runs/|data/|top_object|path/to/|my|color\.png|depth\.png|scene\.png|results\.|report\.html|~|\$|"
    r".*(NAME|FILE|[<*{]))"
)


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def code_blocks(text: str) -> list[str]:
    return re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)


def commands(text: str) -> list[list[str]]:
    """The shell commands of a page's blocks, without comments, as words."""
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.strip()]


def code(text: str) -> list[str]:
    """Code blocks without comments."""
    return [re.sub(r" *#.*", "", block) for block in code_blocks(text)]


def anchor(heading: str) -> str:
    """A heading's anchor, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")).replace(" ", "-")


@pytest.mark.parametrize("page", [REPOSITORY / page for page in PAGES], ids=lambda page: page.name)
def test_every_table_is_measured(page):
    """`with_tables` writes the command of `make results` in place of a table without figures, in
    italics; a sentence begins with a word in bold type."""
    for body in re.findall(
        r"<!-- results:[\w-]+ -->\n(.*?)<!-- /results -->", text_of(page), re.DOTALL
    ):
        assert body.startswith(("|", "**")), body


def test_readme_is_short():
    assert len(text_of(READMES[0]).splitlines()) <= 150
    assert len(text_of(READMES[1]).splitlines()) <= 150


@pytest.mark.parametrize("pages", [READMES, TUTORIAL_NAMES], ids=lambda pages: pages[0].name)
def test_both_languages_have_the_same_commands_links_names_and_figures(pages):
    english, chinese = map(text_of, pages)
    assert code(english) == code(chinese)
    links = [re.findall(r"\]\(([^)]+)\)", text)[1:] for text in (english, chinese)]
    # But the first, which leads to the other language; the others to the own one, where it exists.
    assert links[0] == [link.replace(".zh-CN.md", ".md") for link in links[1]]
    for pattern in (r"(?<!`)`([^`\n]+)`(?!`)", r"\d[\d,.]*\d|\d"):
        prose = [
            sorted(set(re.findall(pattern, re.sub(r"```.*?```", "", text, flags=re.DOTALL))))
            for text in (english, chinese)
        ]
        assert prose[0] == prose[1]


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if target.startswith("http"):
            continue
        file, _, place = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{page.name} links {target}"
        if place:
            headings = re.findall(r"^#+ +(.*)$", text_of(path), re.MULTILINE)
            assert place in map(anchor, headings), f"{page.name} links {target}"


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_named_files_exist(page):
    """Every `folder/file.py`, `configs/x.yaml` and module of `python -m` on a page."""
    text = text_of(page)
    named = set(re.findall(r"(?<![\w/.-])((?:[\w.-]+/)+[\w.-]+\.(?:py|yaml|md|pt|j2|toml))", text))
    bare = set(re.findall(r"(?<![\w/.-])(\w+\.py)\b", " ".join(code_blocks(text))))
    for name in sorted((named | bare) - {"models/policy.py"}):  # of the tutorial alone
        if READERS_OWN.match(name):
            continue
        places = [REPOSITORY / name, page.parent / name]
        assert any(place.exists() for place in places), f"{page.name} names {name}"
    for module in set(re.findall(r"python -m ([\w.]+)", text)) - {"pytest", "venv", "pip"}:
        assert (REPOSITORY / (module.replace(".", "/") + ".py")).exists(), (
            f"{page.name} names {module}"
        )


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_overrides_of_commands_are_keys_of_the_config(page):
    overrides = [
        word
        for words in commands(text_of(page))
        if any(word.endswith(".py") for word in words)
        for word in words
        if re.match(r"[a-z_]+(\.[a-z_]+)*=", word)
        and not re.search(r"<|\.\.\.|path/to|my_module|=runs/", word)
    ]
    load_config(None, overrides)


@pytest.mark.parametrize("page", PAGES)
def test_tables_are_those_of_the_measured_figures(page):
    text = text_of(REPOSITORY / page)
    assert text == with_tables(text, REPOSITORY / FIGURES, "zh" in page), (
        "write the tables again: .venv/bin/python -m benchmarks.results --write"
    )


def test_architecture_lists_every_module_once():
    text = text_of(REPOSITORY / "docs/architecture.md")
    for folder in ("envs", "models", "utils"):
        room = text.split(f"### `{folder}/`")[1].split("\n### ")[0]
        listed = re.findall(r"^\| `(\w+\.py)`", room, re.MULTILINE)
        there = {path.name for path in (REPOSITORY / folder).glob("*.py")} - {"__init__.py"}
        assert sorted(listed) == sorted(there)


@pytest.mark.parametrize(
    ("page", "title"),
    [("CONTRIBUTING.md", "## Recipes"), ("docs/architecture.md", "## Where to change what")],
)
def test_recipes_name_files_and_registries_that_exist(page, title):
    """Each recipe: its files, its registry as a name in one of them, and its test."""
    table = text_of(REPOSITORY / page).split(title)[1].split("\n## ")[0]
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(rows) >= 10
    for _, file, registry, *test in rows:
        files = re.findall(r"`((?:envs|models|utils|configs)/\w+\.[\w.]+)`", file + registry)
        files = [text_of(REPOSITORY / name) for name in files if "NAME" not in name]
        for name in re.findall(r"`([A-Z_]{3,})`", file + registry):
            assert any(re.search(rf"^{name}\b", one, re.MULTILINE) for one in files), name
        for path in re.findall(r"`(tests/\w+\.py)`", "".join(test)):
            assert (REPOSITORY / path).exists(), path


def test_the_policies_that_are_measured_are_those_that_ship() -> None:
    arguments = " ".join(command.arguments for part in PARTS for command in part.commands)
    measured = set(re.findall(r"checkpoints/(ppo_\w+\.pt)", arguments))
    assert measured == {path.name for path in (REPOSITORY / "checkpoints").glob("ppo_*.pt")}
