"""Scores of a network by dense labels, and the curves of a training."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from torch import nn

from models.graspnet_decoding import Peaks
from models.graspnet_scores import (
    LabelScores,
    centre_error,
    check_graspable,
    curve_tag,
    describe_scores,
    draw_curves,
    draw_predictions,
    row_in_words,
    score_labels,
    score_peak,
)
from tests.helpers.trainings import BINS, labelled
from utils.errors import UserError


def peak(u: float, v: float, degrees: float, width: float) -> Peaks:
    return Peaks(
        np.array([[u, v]]), np.radians([degrees]), np.array([width], np.float32), np.array([0.9])
    )


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        # Nearest bin 0 has no label; 170 and 2 degrees are 12 apart, over the seam.
        (peak(6.0, 4.0, 2.0, 0.05), (0.0, 12.0, 0.02, 0.0)),
        (peak(6.0, 4.0, 172.0, 0.03), (0.9, 2.0, 0.0, 0.0)),
        # Between 176 and 180 the nearest bin is 0 again.
        (peak(6.0, 4.0, 177.0, 0.03), (0.0, 7.0, 0.0, 0.0)),
        # One pixel beside: no label there, but the labels of the neighbour count.
        (peak(7.0, 4.0, 170.0, 0.03), (0.0, 0.0, 0.0, 1.0)),
        # 3 right and 4 down: the nearest label, not the one of the nearest angle farther away.
        (peak(9.0, 8.0, 90.0, 0.03), (0.0, 80.0, 0.0, 5.0)),
        # A subpixel place belongs to the rounded pixel.
        (peak(6.3, 4.4, 170.0, 0.04), (0.9, 0.0, 0.01, 0.5)),
    ],
)
def test_a_peak_against_labels(found, expected):
    image = labelled((17, 4, 6, 0.9, 0.03), (9, 15, 15, 0.8, 0.06), (0, 5, 6, 0.5, 0.01))
    label, angle, width, distance = score_peak(found, image)
    assert (label, np.degrees(angle), width, distance) == pytest.approx(expected, abs=1e-5)


def test_of_several_good_angles_the_nearest_counts():
    image = labelled((3, 4, 6, 0.7, 0.02), (6, 4, 6, 0.9, 0.05))
    label, angle, width, distance = score_peak(peak(6, 4, 58, 0.05), image)
    assert (label, np.degrees(angle), width, distance) == pytest.approx((0.9, 2, 0, 0), abs=1e-5)
    label, angle, width, _ = score_peak(peak(6, 4, 36, 0.05), image)
    assert (label, np.degrees(angle), width) == pytest.approx((0.0, 6, 0.03), abs=1e-5)


class Always(nn.Module):
    """A network that sees a bump of quality at row 10, column 12, bin 4 and width 0.04 m."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, x: torch.Tensor, centres: bool = False):
        rows, columns = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
        quality = torch.exp(-((rows - 10) ** 2 + (columns - 12) ** 2) / 8.0)[None, None]
        circle = 2 * np.pi * (torch.arange(BINS) - 4) / BINS
        angle = (4 * torch.cos(circle))[None, :, None, None].expand(1, BINS, 20, 20)
        return quality, angle, torch.full_like(quality, 0.04)


def test_scores_are_means_over_images_with_something_to_grasp():
    scores = score_labels(
        Always(),
        [
            labelled((4, 10, 12, 0.9, 0.05)),
            labelled((4, 10, 12, 0.3, 0.05), (5, 10, 16, 0.8, 0.01)),
            labelled((4, 10, 12, 0.5, 0.05)),  # nothing that counts as a grasp
            labelled(),
        ],
    )
    assert scores.images == 2
    assert scores.label_quality == pytest.approx(0.6)
    assert scores.precision == pytest.approx(0.5)
    assert np.degrees(scores.angle_error) == pytest.approx(5.0, abs=1e-3)  # 0 and 10 degrees
    assert scores.width_error == pytest.approx(0.02)  # 1 and 3 cm
    assert scores.distance == pytest.approx(2.0, abs=1e-4)  # 0 and 4 pixels
    nothing = score_labels(Always(), [labelled()])
    assert (nothing.images, nothing.label_quality, nothing.precision) == (0, 0.0, 0.0)


def test_the_error_of_centres_is_a_median_over_objects_and_a_mean_over_images():
    """On 13 of an object's 25 pixels the network points (3, 4) pixels beside, on 12 far away: 5.
    In the second image the centre lies there: 0. A third one shows no object."""
    centre = torch.full((2, 20, 20), torch.nan)
    centre[:, 5:10, 5:10] = torch.tensor([7.0, 7.0])[:, None, None]

    class Pointing(Always):
        def forward(self, x, centres=False):
            rows, columns = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
            offset = torch.stack([7.0 - columns, 7.0 - rows])
            beside = torch.tensor([3.0, 4.0])[:, None, None].expand(2, 20, 20).clone()
            beside.view(2, -1)[:, (5 * 20 + 5) + torch.arange(5)] = 300.0
            beside.view(2, -1)[:, (6 * 20 + 5) + torch.arange(5)] = 300.0
            beside.view(2, -1)[:, (7 * 20 + 5) + torch.arange(2)] = 300.0
            return *super().forward(x), (offset + beside)[None]

    first = replace(labelled(), centre=centre)
    nothing = replace(labelled(), centre=torch.full((2, 20, 20), torch.nan))
    exact = replace(labelled(), centre=centre + torch.tensor([3.0, 4.0])[:, None, None])
    assert centre_error(Pointing(), [first, nothing]) == pytest.approx(5.0)
    assert centre_error(Pointing(), [first, exact, nothing]) == pytest.approx(2.5)


def test_a_network_that_sees_nothing_is_scored_too():
    """After an epoch that diverged every quality may be 0 in single precision."""

    class Blind(Always):
        def forward(self, x: torch.Tensor, centres: bool = False):
            quality, angle, width = super().forward(x, centres)
            return 0 * quality, angle, width

    scores = score_labels(Blind(), [labelled((4, 10, 12, 0.9, 0.05))])
    assert (scores.images, scores.label_quality, scores.precision) == (1, 0.0, 0.0)


def test_one_image_with_something_to_grasp_is_enough():
    poor = labelled((4, 10, 12, 0.5, 0.05))
    check_graspable([poor, labelled((4, 10, 12, 0.9, 0.05))])
    with pytest.raises(UserError, match="none of the 2 validation images.*validation_frames"):
        check_graspable([poor, labelled()])


def test_curves_name_their_origin_and_unit():
    assert curve_tag("width_error") == "validation/width_error_m"
    assert curve_tag("width_loss") == "training/width_loss_m"
    assert curve_tag("label_quality") == "validation/label_quality"


def test_scores_are_described_in_degrees_and_millimetres():
    scores = LabelScores(0.75, 0.83, np.radians(6.0), 0.0062, 1.23, 254)._asdict()
    assert describe_scores(scores) == (
        "the network alone, by the best grasp on each of 254 validation images: mean label 0.75 of "
        "1, 83 % positive; the nearest label is 6.0 degrees, 6.2 mm of width and 1.2 px away"
    )


def test_a_row_of_the_history_is_printed_with_units():
    row = {"epoch": 3, "step": 12345, "angle_loss": 2.0, "width_loss": 0.0066,
           "label_quality": 0.75, "angle_error": np.radians(48.9), "width_error": 0.02013,
           "distance": 73.05, "images": 254}  # fmt: skip
    assert row_in_words(row) == (
        "epoch 3, step 12,345, angle loss 2 nats, width loss 6.6 mm, label quality 0.75, "
        "angle error 48.9 degrees, width error 20.1 mm, distance 73 px, images 254"
    )


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn instead of being written."""
    figures = []
    monkeypatch.setattr("models.graspnet_scores.save_figure", lambda _, one: figures.append(one))
    yield figures
    for figure in figures:
        plt.close(figure)


class Corners(Always):
    """Peaks at two corners, two beside each other and one alone, of an image of 80 x 80 pixels."""

    def forward(self, x: torch.Tensor, centres: bool = False):
        rows, columns = torch.meshgrid(torch.arange(80), torch.arange(80), indexing="ij")
        bumps = [
            torch.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 6.0)
            for row, column in ((0, 79), (79, 0), (40, 40), (41, 45), (58, 40))
        ]
        quality = torch.stack(bumps).amax(dim=0)[None, None]
        _, angle, _ = super().forward(x)
        return quality, angle[..., :1, :1].expand(1, BINS, 80, 80), torch.full_like(quality, 0.04)


def test_grasps_at_the_border_do_not_move_the_columns_of_the_picture(drawn):
    image = labelled((4, 10, 12, 0.9, 0.05), side=80)
    draw_predictions(Path("unwritten.png"), Corners(), [image] * 2)
    axes, places = drawn[0].axes, []
    for axis in axes:
        assert (axis.get_xlim(), axis.get_ylim()) == ((-0.5, 79.5), (79.5, -0.5))
        places.append(axis.get_window_extent())
    assert len(axes) == 8 and len(axes[0].lines) == 10, "five grasps, each with a rim"
    assert [box.width for box in places] == pytest.approx(8 * [places[0].width])
    assert [box.y0 for box in places[:4]] == pytest.approx(4 * [places[0].y0])
    numbers = [text.get_window_extent() for text in axes[0].texts]
    assert len(numbers) == 4, "of the two beside each other one has its number"
    assert not any(one.overlaps(other) for one, other in combinations(numbers, 2))
    for number in numbers:
        assert places[0].x0 <= number.x0 and number.x1 <= places[0].x1
        assert places[0].y0 <= number.y0 and number.y1 <= places[0].y1


def test_curves_have_whole_epochs_and_a_mark_at_the_chosen_one(drawn):
    rows = [{"epoch": n, "step": 4 * n, "loss": 1 / n, "angle_error": 0.1} for n in (1, 2, 3)]
    draw_curves(Path("unwritten.png"), rows, chosen=2)
    draw_curves(Path("unwritten.png"), rows)
    for axis in drawn[0].axes:
        ticks = axis.get_xticks()
        assert np.array_equal(ticks, ticks.round()) and set(ticks) >= {1, 2, 3}
        assert list(axis.lines[1].get_xdata()) == [2, 2]
    assert "epoch 2" in drawn[0].get_suptitle()
    assert [len(axis.lines) for axis in drawn[1].axes] == [1, 1]
