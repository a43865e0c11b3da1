"""The Python blocks of README and docs run as they are printed, page by page."""

from __future__ import annotations

import importlib
import json
import math
import re
import sys

import pytest
import torch

from tests.helpers.box_frames import boxes_frame
from utils.geometry import GripperGeometry, Workspace
from utils.runs import REPOSITORY

ELSEWHERE = {
    "README.zh-CN.md": "tests/test_docs.py: it has the code of README.md",
    "servo.md": "tests/test_visual_servo.py, with what it prints",
}
# Blocks that cannot run here, by a word of theirs, and what they need.
LEFT_OUT = {
    "dask_jobqueue": "a SLURM scheduler",
    "dask_kubernetes": "a Kubernetes cluster",
    "stable_baselines3": "a training of 100,000 steps",
}
# Where a page defines what it does not call: what it gives on the two boxes of `names`.
CALLED = {
    # 2 cm below the top of the higher box
    "README.md": ("round(plan(frame)[0].position[2], 3)", 0.03),
    # by `names`' fit the odds are the score over 0.9, here 1
    "calibration.md": (
        "MyPlanner(hand, workspace, 0)(frame) or "
        "round(float(MyPlanner(hand, workspace, 0).calibration(0.9, 0.001)), 9)",
        0.5,
    ),
}


def blocks(text: str) -> list[tuple[int, str]]:
    """The Python blocks of a page: the number of the first line, and the code."""
    return [
        (text.count("\n", 0, found.start(1)) + 1, found[1])
        for found in re.finditer(r"```python\n(.*?)```", text, re.DOTALL)
    ]


PAGES = {
    page: found
    for page in sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md")])
    if (found := blocks(page.read_text(encoding="utf-8"))) and page.name not in ELSEWHERE
}


@pytest.fixture
def names(tmp_path, monkeypatch):
    """What the pages take as given: a frame of two boxes, one at the pixel (97, 88), its parts,
    and files of the reader's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    fit = {"planners": {"my_module:MyPlanner": {"slope": 1.0, "offset": -math.log(0.9)}}}
    (tmp_path / "my_fit.json").write_text(json.dumps(fit))
    modules = set(sys.modules)
    importlib.invalidate_caches()
    frame = boxes_frame([((0.04, 0.06, 0.05), 0.3, (0.547, 0.029)),
                         ((0.05, 0.05, 0.04), 0.0, (0.45, -0.05))])  # fmt: skip
    given = {
        "__name__": "a_page", "frame": frame, "rgb": frame.rgb, "depth": frame.depth,
        "K": frame.K, "T_WC": frame.T_WC, "hand": GripperGeometry(), "workspace": Workspace(),
    }  # fmt: skip
    yield given
    for name in {"env", "cell"} & given.keys():
        given[name].close()
    for name in {"my_module", "top_object"} & (set(sys.modules) - modules):
        del sys.modules[name]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_code_of_a_page_runs(page, names, tmp_path):
    """The blocks of a page build on each other; one that begins with the name of its file is also
    that module."""
    for line, code in PAGES[page]:
        if any(word in code for word in LEFT_OUT):
            continue
        if not torch.cuda.is_available():
            code = code.replace('"cuda"', '"cpu"')
        if file := re.match(r'(?:# |""")(\w+\.py): ', code):
            (tmp_path / file[1]).write_text(code, encoding="utf-8")
        exec(compile((line - 1) * "\n" + code, str(page), "exec"), names)
    if page.name in CALLED:
        call, expected = CALLED[page.name]
        assert eval(call, names) == expected


def test_no_more_is_left_out_than_has_to_be():
    """Each word stands for one block, and each page has some."""
    assert {page.name for page in PAGES} >= CALLED.keys()
    everything = [code for found in PAGES.values() for _, code in found]
    for word in LEFT_OUT:
        assert sum(word in code for code in everything) == 1
    assert len(everything) > 12
