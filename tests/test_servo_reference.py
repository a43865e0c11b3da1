"""The reference table, and what a linear filter leaves of noise."""

from __future__ import annotations

import numpy as np
import pytest

from utils.servo_features import interaction_matrix
from utils.servo_reference import FOCAL, SQUARE, KnownResult, known_results, main


@pytest.fixture(scope="module")
def table() -> dict[str, KnownResult]:
    return {row.name: row for row in known_results()}


@pytest.mark.slow
def test_every_row_of_the_reference_table_holds(table):
    assert len(table) == 23
    assert [row for row in table.values() if not row.holds] == []


def test_a_row_can_fail():
    assert not KnownResult("", 1.2, 1.0, 0.1).holds


@pytest.mark.slow
def test_noise_is_what_a_linear_filter_leaves(table):
    # Each step keeps 0.98 of the pose error and adds 0.02 L^+ noise, so the variance settles at
    # 0.02^2 / (1 - 0.98^2) of that of L^+ noise.
    xy = SQUARE[:, :2] / 0.75
    L = interaction_matrix(xy, np.full(4, 0.75))
    covariance = (0.5 / FOCAL) ** 2 * np.linalg.inv(L.T @ L) * 0.02**2 / (1 - 0.98**2)
    for unit, factor, part in ("mm", 1e3, slice(0, 3)), ("deg", np.degrees(1), slice(3, 6)):
        expected = factor * np.sqrt(np.trace(covariance[part, part]))
        found = table[f"steady RMS ({unit}), noise 0.5 px"].value
        assert found == pytest.approx(expected, rel=0.06)


@pytest.mark.slow
def test_demo_prints_the_table_and_draws(tmp_path, capsys, monkeypatch):
    some = [KnownResult("right", 1.0, 1.0, 0.01), KnownResult("wrong", 2.0, 1.0, 0.01)]
    monkeypatch.setattr("utils.servo_reference.known_results", lambda: some)
    main(["--folder", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["right", "1", "1", "yes"]
    assert lines[2].split() == ["wrong", "2", "1", "NO"]
    assert len(list(tmp_path.glob("*.png"))) == 6
