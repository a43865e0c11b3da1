"""The soak's command line, and its table."""

import json

import pytest

from benchmarks import soak
from benchmarks.result_tables import reliability
from benchmarks.soak import Part, main
from benchmarks.soak_tally import Tally
from utils.errors import UserError


@pytest.fixture
def parts(monkeypatch):
    """Two parts that take no time."""

    def run(scale, seed, stop):
        tally = Tally("a fault", note=f"seed {seed}")
        yield tally
        for number in range(round(10 * scale)):
            tally.add(number % 2 == 0, lost=number == 3)

    made = {"one": Part("the first", 10, run), "two": Part("the second", 1, run)}
    monkeypatch.setattr(soak, "PARTS", made)


def test_parts_are_kept_beside_each_other_and_drawn(parts, tmp_path, capsys):
    file = tmp_path / "reliability.json"
    assert main(["--parts", "one", "--json", str(file)]) == 1, "something was lost"
    assert main(["--parts", "two", "--scale", "0.2", "--json", str(file)]) == 0
    assert "a fault: 10 tried, 5 survived, 1 lost (seed 2027)" in capsys.readouterr().out
    kept = json.loads(file.read_text())
    lines = reliability(str, kept).splitlines()
    assert lines[0] == "| fault | tried | survived | lost | note |"
    assert lines[2:4] == [
        "| a fault | 10 | 5 | 1 | seed 2027 |",
        "| a fault | 2 | 1 | 0 | seed 2027 |",
    ]
    assert "`python -m benchmarks.soak --parts two --scale 0.2`" in lines[-1]


def test_a_file_that_holds_something_else_is_refused_before_anything_is_tried(parts, tmp_path):
    for content in ("not JSON", "[1]"):
        (tmp_path / "notes.txt").write_text(content)
        with pytest.raises(UserError, match=r"--json .*notes\.txt: holds no .*choose another file"):
            main(["--parts", "one", "--json", str(tmp_path / "notes.txt")])
        assert (tmp_path / "notes.txt").read_text() == content


@pytest.mark.parametrize("scale", ["nan", "inf", "-1", "0"])
def test_a_scale_that_is_no_share_of_tries_is_refused(parts, scale):
    with pytest.raises(UserError, match="--scale: got .*, expected a positive number"):
        main(["--parts", "one", "--scale", scale])


def test_parts_are_listed_and_unknown_ones_refused(parts, capsys):
    assert main(["--list", "--scale", "0.5"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "one: the first; about 5 minutes"
    with pytest.raises(UserError, match="--parts: 'three' is no part; choose among one, two"):
        main(["--parts", "one,three"])
