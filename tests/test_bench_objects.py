"""What counts as an object that the votes cut, or join with another one."""

import json

import numpy as np
import pytest

from benchmarks import bench_objects
from benchmarks.bench_objects import faults
from models import graspnet_objects


def halves(left: int, right: int, columns: int = 20) -> np.ndarray:
    """(20, 40) labels of two halves, the left one `columns` wide."""
    label = np.full((20, 40), right)
    label[:, :columns] = left
    return label


@pytest.mark.parametrize(
    "label, expected",
    [
        (halves(7, 5), [[False, False], [False, False]]),
        (halves(7, 7), [[False, True], [False, True]]),  # half of the part is theirs
        (halves(7, 5, 25), [[False, False], [False, False]]),  # 0.8 and 1, 1 and 0.75
        (halves(7, 5, 28), [[False, False], [True, False]]),  # 20 of 28 are 0.71; 12 of 20 are 0.6
        (halves(7, 5, 30), [[False, True], [True, False]]),  # 20 of 30; of two equal parts, part 5
    ],
)
def test_two_objects(label, expected):
    assert faults(label, halves(0, 1)).tolist() == expected


def test_what_is_hardly_seen_does_not_count():
    truth = halves(0, 1, 4)  # 80 cells
    assert faults(truth, truth).tolist() == [[False, False]]
    hidden = truth.copy()
    hidden[:, 6:] = -1
    assert faults(hidden, truth).shape == (0, 2)


@pytest.mark.parametrize("more", [[], ["--one-colour"]])
def test_a_benchmark_counts_the_objects_of_its_scenes(tmp_path, monkeypatch, more):
    pytest.importorskip("pybullet")
    monkeypatch.setattr(bench_objects, "SCENES", {"pair": ("flat", "flat", "scene.count=2")})
    colours_at, file = graspnet_objects.colours_at, tmp_path / "objects.json"
    bench_objects.main(["--quick", "--json", str(file), *more])
    found = {name: one["value"] for name, one in json.loads(file.read_text()).items()}
    assert list(found) == ["pair_objects", "pair_cut", "pair_joined"]
    assert 1 <= found["pair_objects"] <= 3 and 0 <= found["pair_cut"] <= 100
    assert graspnet_objects.colours_at is colours_at
