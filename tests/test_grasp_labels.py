"""Dense grasp labels on scenes whose grasps are known by construction."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tests.helpers.box_frames import CORNERS, T_WC, K, boxes_frame, yaw_pose
from utils.geometry import (
    ConvexSolid,
    GripperGeometry,
    SceneGeometry,
    SolidObject,
    Workspace,
    intersect_lines,
)
from utils.grasp_labels import (
    GraspLabels,
    LabelSettings,
    Trial,
    _support,
    bin_angles,
    dense_labels,
    draw_pairs,
    grasp_below_surface,
    grasp_depth,
    label_truth,
)
from utils.grasp_quality import _Faces, _quality
from utils.transforms import (
    Grasp,
    ImageGrasp,
    RGBDFrame,
    angle_difference,
    grasp_to_image,
    look_at,
    project,
)

BOX = (0.04, 0.10, 0.05)
OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1, 0, 0))


def labels_of(frame: RGBDFrame) -> GraspLabels:
    return dense_labels(frame, GripperGeometry(), Workspace())


def solids_frame(solids: list[ConvexSolid], T_WC: np.ndarray = T_WC) -> RGBDFrame:
    """The frame of convex solids on the table; depth by ray casting."""
    v, u = np.mgrid[0:224, 0:224]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    rays = rays @ T_WC[:3, :3].T
    depth = -T_WC[2, 3] / rays[..., 2]
    for solid in solids:
        corners, _ = project(solid.vertices, K, T_WC)
        (left, top), (right, bottom) = corners.min(axis=0).astype(int), corners.max(axis=0) + 2
        window = np.s_[top : int(bottom), left : int(right)]
        toward = rays[window].reshape(-1, 3)
        hits = intersect_lines(solid, np.broadcast_to(T_WC[:3, 3], toward.shape), toward)
        depth[window] = np.minimum(depth[window], hits.enter.reshape(depth[window].shape))
    things = [SolidObject((s,), s.vertices.mean(axis=0), 0.7) for s in solids]
    rgb = np.zeros((224, 224, 3), np.uint8)
    return RGBDFrame(rgb, depth.astype(np.float32), K, T_WC, truth=SceneGeometry(tuple(things)))


def box_solid(size, yaw: float, xy) -> ConvexSolid:
    pose = yaw_pose(*xy, size[2] / 2, yaw)
    return ConvexSolid.from_vertices(CORNERS * np.array(size) / 2).transformed(pose)


def pixel_over(frame: RGBDFrame, point) -> tuple[int, int]:
    """Row and column of the pixel that sees a point in W."""
    (u, v), _ = project(np.array(point, dtype=float), frame.K, frame.T_WC)
    return int(round(v)), int(round(u))


def image_angle(frame: RGBDFrame, point, yaw: float) -> float:
    return grasp_to_image(Grasp(np.array(point), yaw, 0.05, 1.0), frame.K, frame.T_WC).angle


@pytest.mark.parametrize("degrees", [*range(0, 180, 15), 4, 86, 94, 176, 179, 182, 270, 356])
def test_a_box_is_closed_on_across_its_short_side_only(degrees: int) -> None:
    yaw, xy = np.deg2rad(degrees), (0.52, -0.04)
    frame = boxes_frame([(BOX, yaw, xy)])
    labels, top = labels_of(frame), (*xy, BOX[2])
    v, u = pixel_over(frame, top)
    quality = labels.quality[:, v, u]
    off = angle_difference(bin_angles(), image_angle(frame, top, yaw))
    assert off[quality.argmax()] == pytest.approx(off.min(), abs=np.deg2rad(1))
    assert quality.max() > 0.8
    assert (quality[off > np.deg2rad(60)] == 0).all()  # 8 cm and more between the fingers
    settings = LabelSettings()
    if off.min() < np.deg2rad(0.1):  # faces and pads parallel
        offset = abs((frame.points()[v, u, :2] - xy) @ (np.cos(yaw), np.sin(yaw)))
        expected = 0.04 + 2 * (offset + settings.room)
        assert labels.width[quality.argmax(), v, u] == pytest.approx(expected, abs=0.002)


@pytest.mark.parametrize("side", [0.02, 0.03, 0.04, 0.055])
def test_width_is_the_opening_that_clears_both_sides_from_the_pixel(side: float) -> None:
    """Off the middle, the farther side decides: 2 (side / 2 + offset + room), at most 8 cm."""
    frame = boxes_frame([((side, 0.08, 0.05), 0.0, (0.5, 0.0))])
    labels, points, settings = labels_of(frame), frame.points(), LabelSettings()
    bin_ = round(image_angle(frame, (0.5, 0, 0.05), 0.0) / (np.pi / 18)) % 18
    on_top = np.abs(points[..., 2] - 0.05) < 1e-4
    near_middle = on_top & (np.abs(points[..., 1]) < 0.01) & (np.abs(points[..., 0] - 0.5) < 0.008)
    expected = 2 * (side / 2 + np.abs(points[near_middle][:, 0] - 0.5) + settings.room)
    assert len(expected) > 20
    assert labels.width[bin_][near_middle] == pytest.approx(np.minimum(expected, 0.08), abs=0.002)
    assert labels.width.max() <= GripperGeometry().max_opening + 1e-6


def quality_of(changes: dict, friction: float = 1.0) -> float:
    """Of one grasp: a face of 4 cm that both pads cover whole, 2 cm deep, gripped at its centre of
    mass with room to spare, but for `changes` of the face or of the arms to the centre of mass."""
    face = {
        "touched": True, "label": 0, "left": -0.02, "right": 0.02, "engagement": 0.02,
        "wedge": 0.0, "turn": 0.0, "tilt": 0.0, "cover": 1.0,
    }  # fmt: skip
    hand = GripperGeometry()
    arms = {"along": 0.0, "across": 0.0, "up": hand.pad_height / 2, "half": 0.03}
    face |= {name: changes.pop(name) for name in list(changes) if name in face}
    assert changes.keys() <= arms.keys()
    arms |= changes
    one = _Faces(**{name: np.array([value]) for name, value in face.items()})
    along, across, up, half = (np.array([value]) for value in arms.values())
    settings = LabelSettings()
    return _quality(one, along, across, up, np.array([friction]), half, hand, settings).item()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 1.0),
        ({"wedge": 0.1}, np.exp(-((0.1 / 0.35) ** 2))),
        ({"turn": -0.2}, np.exp(-((0.2 / 0.30) ** 2))),
        ({"tilt": 0.3}, np.exp(-((0.3 / 0.50) ** 2))),
        ({"across": -0.02}, np.exp(-((0.02 / 0.03) ** 2))),
        ({"along": 0.04}, np.exp(-((0.04 / 0.08) ** 2))),
        ({"up": GripperGeometry().pad_height / 2 + 0.04}, np.exp(-((0.04 / 0.08) ** 2))),
        # 1 cm off the middle, and off the centre of mass, which stays under the pixel
        ({"left": -0.01, "right": 0.03, "half": 0.04},
         np.exp(-((0.01 / 0.025) ** 2) - (0.01 / 0.08) ** 2)),
        ({"cover": 0.5}, 0.6 + 0.4 * 0.5),
        ({"engagement": 0.01}, 0.01 / 0.02),
        ({"engagement": 0.006}, 0.4),  # at the least
        ({"engagement": 0.005}, 0.0),  # too little
        ({"half": 0.0235}, 0.9),  # 3.5 mm of room, halfway from 2 to 5 mm
        ({"half": 0.022}, 0.8),
        ({"touched": False}, 0.0),
    ],
)  # fmt: skip
def test_quality_is_the_product_of_its_factors(changes, expected) -> None:
    assert quality_of(dict(changes)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("angle", ["wedge", "tilt"])
def test_faces_beyond_the_friction_cone_slip(angle) -> None:
    """At 0.4 rad a coefficient of 0.3, a cone of atan 0.3 = 0.29 rad, does not hold, one of 0.5 or
    0.7 does; 30 degrees are the most."""
    held = [quality_of({angle: 0.4}, friction) > 0 for friction in (0.3, 0.5, 0.7)]
    assert held == [False, True, True]
    assert quality_of({angle: np.deg2rad(31)}, 0.7) == 0 < quality_of({angle: np.deg2rad(29)}, 0.7)


def test_support_counts_the_feasible_ones_around() -> None:
    """27 of 27 inside a block of five bins, 2 x 9 in its last bin, 3 x 6 at its edge, 3 x 4 at its
    corner; bins 17 and 0 are neighbours."""
    feasible = np.zeros((18, 20, 20), bool)
    feasible[4:9, 5:12, 5:12] = True
    feasible[[16, 17, 0], 15:18, 15:18] = True
    share = _support(feasible)
    places = ((6, 8, 8), (8, 8, 8), (6, 5, 8), (6, 5, 5), (17, 16, 16), (0, 16, 16), (12, 8, 8))
    counts = [27, 18, 18, 12, 27, 18, 0]
    assert [share[place] * 27 for place in places] == pytest.approx(counts, abs=1e-4)


def test_a_ball_is_grasped_alike_from_all_sides() -> None:
    ball = trimesh.creation.icosphere(3, 0.025).vertices + (0.5, 0.0, 0.025)
    frame = solids_frame([ConvexSolid.from_vertices(ball)])
    labels = labels_of(frame)
    v, u = pixel_over(frame, (0.5, 0.0, 0.05))
    quality, width = labels.quality[:, v, u], labels.width[:, v, u]
    assert quality.min() > 0.7
    assert np.ptp(quality) < 0.06
    assert np.ptp(width) <= 0.0041


def test_nothing_closes_across_a_gap_between_two_objects() -> None:
    frame = boxes_frame(
        [((0.03, 0.06, 0.05), 0.0, (0.48, 0.0)), ((0.03, 0.06, 0.05), 0.0, (0.52, 0.0))]
    )
    labels = labels_of(frame)
    across = image_angle(frame, (0.5, 0.0, 0.05), 0.0)
    off = np.rad2deg(angle_difference(bin_angles(), across))
    assert (labels.quality[off < 15] == 0).all()
    assert labels.quality[off < 25].max() < LabelSettings().positive  # round a corner, both outside
    assert labels.quality[off > 85].max() > LabelSettings().positive  # along the gap


def test_the_palm_is_kept_off_a_tall_neighbour() -> None:
    """9 cm beside the grasp, under the hand but not under a finger."""
    low, tall = ((0.03, 0.03, 0.03), 0.0, (0.5, 0.0)), ((0.02, 0.02, 0.09), 0.0, (0.5, 0.085))
    v, u = pixel_over(boxes_frame([low]), (0.5, 0.0, 0.03))
    alone, beside = (labels_of(boxes_frame(b)).quality[:, v, u] for b in ([low], [low, tall]))
    frame = boxes_frame([low])
    along_y, along_x = (
        int(round(image_angle(frame, (0.5, 0, 0.03), yaw) / (np.pi / 18))) % 18
        for yaw in (np.pi / 2, 0.0)
    )
    assert alone[along_y] > 0.5 and alone[along_x] > 0.5
    assert beside[along_y] == 0 and beside[along_x] == alone[along_x]


def test_pads_close_on_nothing_under_an_overhang() -> None:
    """A plate 4 mm thick, 7.6 cm up: 2 cm below its top only the pads' rims would touch it."""
    plate = ConvexSolid.from_vertices(CORNERS * (0.02, 0.02, 0.002))
    raised = plate.transformed(yaw_pose(0.5, 0.0, 0.078, 0.0))
    assert not labels_of(solids_frame([raised])).quality.any()
    block = box_solid((0.04, 0.04, 0.080), 0.0, (0.5, 0.0))  # the same from above
    assert labels_of(solids_frame([block])).quality.max() > 0.5


def test_an_empty_table_has_no_grasp() -> None:
    labels = labels_of(boxes_frame([]))
    assert labels.valid.all()
    assert not labels.quality.any() and not labels.width.any()


def test_unknown_depth_and_the_robot_are_not_valid() -> None:
    frame = boxes_frame([(BOX, 0.0, (0.5, 0.0))])
    depth, segmentation = frame.depth.copy(), np.full(frame.depth.shape, -1, np.int32)
    depth[100:105], segmentation[120:125] = 0, -2
    labels = labels_of(replace(frame, depth=depth, segmentation=segmentation))
    assert not labels.valid[100:105].any() and not labels.valid[120:125].any()
    assert not labels.quality[:, ~labels.valid].any()


def test_labels_without_truth_say_what_is_missing() -> None:
    with pytest.raises(ValueError, match=r"frame\.truth"):
        labels_of(boxes_frame([]).without_truth())


def test_labels_turn_with_the_scene() -> None:
    """A quarter turn about the optical axis is np.rot90, nine bins on."""
    solids = [box_solid(BOX, 0.3, (0.45, -0.03)), box_solid((0.03, 0.03, 0.04), 1.0, (0.56, 0.05))]
    # The image's sense: np.rot90 turns the image anticlockwise; the camera's up is W's x.
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    turn[:2, 3] = np.array((0.5, 0)) - turn[:2, :2] @ (0.5, 0)
    one = labels_of(solids_frame(solids))
    two = labels_of(solids_frame([solid.transformed(turn) for solid in solids]))
    expected = np.roll(np.rot90(one.quality, axes=(1, 2)), 9, axis=0)
    assert (expected > 0).sum() > 3000
    assert np.abs(expected - two.quality).max() < 1e-3
    turned_width = np.roll(np.rot90(one.width, axes=(1, 2)), 9, axis=0)
    assert np.abs(turned_width - two.width).max() < 1e-6


def test_an_oblique_camera_gets_the_grasps_of_the_overhead_one() -> None:
    """Decoded into W, the best grasp of either view closes across the box."""
    oblique = look_at((0.25, 0.3, 0.7), (0.5, 0.0, 0.0))
    for T in (T_WC, oblique):
        frame = solids_frame([box_solid(BOX, 0.7, (0.5, 0.02))], T)
        labels = labels_of(frame)
        k, v, u = np.unravel_index(labels.quality.argmax(), labels.quality.shape)
        at_surface = ImageGrasp(
            np.array([u, v]), bin_angles()[k], frame.depth[v, u], labels.width[k, v, u], 1.0
        )
        grasp = grasp_below_surface(at_surface, K, T, 0.0, GripperGeometry())
        assert angle_difference(grasp.angle, 0.7) < np.deg2rad(10)
        assert np.linalg.norm(grasp.position[:2] - (0.5, 0.02)) < 0.02
        assert grasp.position[2] == pytest.approx(0.05 - 0.020 + 0.0072, abs=1e-4)


def test_depth_rule_by_hand() -> None:
    """2 cm below the surface, 4 mm over the table."""
    assert grasp_depth(np.array([0.05, 0.024, 0.010]), 0.0) == pytest.approx([0.02, 0.02, 0.006])
    assert grasp_depth(0.110, 0.1) == pytest.approx(0.006)


def test_labels_are_the_same_every_time() -> None:
    frame = boxes_frame([(BOX, 0.4, (0.5, 0.0)), ((0.03, 0.05, 0.06), 1.2, (0.58, 0.04))])
    one, two = labels_of(frame), labels_of(frame)
    assert one.quality.dtype == one.width.dtype == np.float32
    assert one.quality.shape == (18, 224, 224)
    for name in ("quality", "width", "valid"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert ((one.width > 0) == (one.quality > 0)).all()


# --- Labels against physics ----------------------------------------------------------------


def test_label_truth_of_seven_trials():
    trials = [
        Trial(1.0, 2.0, True), Trial(0.7, 4.0, False), Trial(0.6, 1.0, True),
        Trial(0.59, 10.0, True), Trial(0.2, 3.0, True), Trial(0.0, 5.0, True),
        Trial(0.0, 5.0, False),
    ]  # fmt: skip
    truth = label_truth([trials])
    assert (truth.executed, truth.positives) == (7, 3)
    assert truth.precision == pytest.approx(2 / 3)
    # Wilson's interval of 2 in 3 with z = 1.96, by hand.
    assert truth.precision_ci95 == pytest.approx((0.2077, 0.9385), abs=1e-4)
    assert truth.precision_weighted == pytest.approx(3 / 7)  # (2 + 1) of 2 + 4 + 1
    assert truth.recall_weighted == pytest.approx(3 / 21)  # of 2 + 1 + 10 + 3 + 5
    edges = [(low, high) for low, high, _, _ in truth.by_stratum]
    assert edges == [
        (0, 1e-6), (1e-6, 0.3), (0.3, 0.5), (0.5, 0.6), (0.6, 0.7), (0.7, 0.8), (0.8, 1)
    ]  # fmt: skip
    assert [count for _, _, count, _ in truth.by_stratum] == [2, 1, 0, 1, 1, 1, 1]
    rates = [rate for _, _, _, rate in truth.by_stratum]
    np.testing.assert_equal(rates, [0.5, 1, np.nan, 1, 1, 0, 1])


def test_label_truth_in_words_says_what_its_shares_are_of():
    trials = [Trial(0.9, 1.0, True)] * 5 + [Trial(0.2, 20.0, True)]
    assert label_truth([trials]).describe() == (
        "labels against physics: 6 executed, 100.0 % [56.6, 100.0] of the 5 positive ones succeed; "
        "20 % of all grasps that would succeed are positive (labels are strict)"
    )


def test_trials_of_one_scene_are_not_independent():
    """Of ten scenes whose four trials end alike, the precision is as certain as of ten trials and
    a tenth of them more (Bessel's correction)."""
    ends = [True, True, False, True, True, True, False, True, True, True]
    truth = label_truth([[Trial(0.9, 1.0, end)] * 4 for end in ends])
    z, n = 1.959964, 40 / (4 * 10 / 9)
    spread = z * np.sqrt(0.8 * 0.2 / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    low, high = truth.precision_ci95
    assert (high - low) / 2 == pytest.approx(spread, abs=1e-5)


def test_label_truth_of_nothing_is_not_a_number():
    truth = label_truth([])
    assert truth.executed == truth.positives == 0
    assert np.isnan([truth.precision, truth.precision_weighted, truth.recall_weighted]).all()


@pytest.mark.parametrize("table", [0.0, 0.1])
def test_pairs_are_drawn_from_every_stratum_with_weights_that_count_them_all(table):
    """A surface 5 cm above the table in the left half of the image; 1 mm of the same object in the
    right half."""
    T_WC = OVERHEAD.copy()
    T_WC[2, 3] += table
    height, width = 20, 30
    depth = np.full((height, width), 0.8, np.float32)
    segmentation = np.full((height, width), -1, np.int32)
    depth[:, :15], segmentation[:, :15] = 0.75, 0
    depth[:5, 15:], segmentation[:5, 15:] = 0.799, 0
    K = np.array([[60.0, 0, 14.5], [0, 60.0, 9.5], [0, 0, 1]])
    frame = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), depth, K, T_WC, segmentation,
        SceneGeometry((), table),
    )  # fmt: skip
    quality = np.zeros((18, height, width), np.float32)
    quality[3, 0, :2] = 0.4  # fewer than are asked for
    quality[7, 1, :10] = 0.65
    quality[9, :, 20:] = 0.9  # on the table: not drawn
    opening = np.where(quality > 0, 0.03, 0).astype(np.float32)
    valid = np.ones((height, width), bool)
    valid[19, :15] = False  # not labelled: not drawn
    labels, rng = GraspLabels(quality, opening, valid), np.random.default_rng(0)
    pairs = list(draw_pairs(frame, labels, GripperGeometry(), rng))

    zeros = 18 * 19 * 15 - 12
    found = sorted((q, weight) for _, q, weight in pairs)
    expected = [(0, zeros / 6)] * 6 + [(0.4, 1.0)] * 2 + [(0.65, 10 / 3)] * 3
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    for grasp, q, _ in pairs:
        assert grasp.width == pytest.approx(0.03 if q else GripperGeometry().max_opening)
        tips = grasp.position[2] - GripperGeometry().tip_below_centre
        assert tips == pytest.approx(table + 0.05 - LabelSettings().depth, abs=1e-6)
    angles = {round(np.degrees(g.angle)) for g, q, _ in pairs if q > 0.6}
    # Bin 7 is 70 degrees on the image; +u is -y and +v is -x of this camera: -90 - 70, modulo 180.
    assert angles == {20}
