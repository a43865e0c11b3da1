"""predict.py: one scene at several resolutions gives the same metric grasps, frames agree, and bad
input is one sentence.

The network is made by hand: its quality is the blurred height, its angle an oriented line filter.
It sees what a trained one sees, and what it should say is known.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import nn

import predict
from envs.camera import Intrinsics
from envs.cell_scenes import Placement, Scene
from envs.pybullet_cell import PybulletCell
from envs.studio import write_rgbd
from models import graspnet_backbones, graspnet_inference
from models.graspnet import GraspNet
from models.graspnet_io import OUTPUTS, SavedGraspNet, export_onnx, metres_per_pixel, save_graspnet
from utils.errors import UserError
from utils.image_overlay import is_prediction_panel
from utils.images import PixelScaling, intrinsics_matrix, read_depth, read_pose
from utils.table_plane import dominant_plane
from utils.transforms import (
    RGBDFrame,
    angle_difference,
    deproject,
    grasp_to_image,
    inverse_pose,
    look_at,
    project,
    transform_points,
)

FOCAL = 112 / np.tan(np.radians(14))  # of the training's images: 224 pixels, 28 degrees
PIXEL = 0.8 / FOCAL
BINS = 18
OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
CUBES = {(0.45, -0.06): 0.3, (0.55, 0.06): 1.1}  # x, y: yaw of 6 cm cubes


class HandMade(nn.Module):
    """Features: 18 line filters on the depth, one for each closing direction, and its blur."""

    stride = 8
    out_channels = BINS + 1

    def __init__(self, input_channels: int):
        super().__init__()
        radius = 24
        self.filters = nn.Conv2d(
            1, BINS + 1, 2 * radius + 1, padding=radius, padding_mode="replicate", bias=False
        )
        v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        kernels = []
        for angle in np.arange(BINS) * np.pi / BINS:
            along = u * np.cos(angle) + v * np.sin(angle)
            across = -u * np.sin(angle) + v * np.cos(angle)
            plates = np.exp(-((np.abs(along) - 20) ** 2) / 8 - across**2 / 50)
            kernels.append(plates / plates.sum())  # far: high where the fingers go is free
        blur = np.exp(-(u**2 + v**2) / 2 / 8**2)
        kernels.append(blur / blur.sum())
        with torch.no_grad():
            self.filters.weight.copy_(torch.tensor(np.array(kernels))[:, None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.filters(x[:, 3:])


@pytest.fixture(autouse=True)
def hand_made_backbone(monkeypatch):
    monkeypatch.setitem(graspnet_backbones.BACKBONES, "hand_made", HandMade)


def hand_made() -> GraspNet:
    """Depth falls by 0.6 units over a cube; half of that, blurred, is quality 0.5."""
    model = GraspNet(max_width=0.08, backbone="hand_made").eval()
    with torch.no_grad():
        for head in (model.quality_head, model.angle_head, model.width_head):
            head.weight.zero_()
            head.bias.zero_()
        model.quality_head.weight[0, BINS] = -12.0
        model.quality_head.bias[0] = -3.0
        model.angle_head.weight[range(BINS), range(BINS)] = 20.0
        model.width_head.weight[0, BINS] = -4.0
    return model


@pytest.fixture(scope="module")
def cell(config, box_set):
    placements = tuple(
        Placement(box_set[0], np.array([*xy, 0.03]), np.array([0, 0, np.sin(a / 2), np.cos(a / 2)]))
        for xy, a in CUBES.items()
    )
    with PybulletCell(config) as cell:
        cell.load(Scene("isolated", 0, placements))
        yield cell


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "graspnet.pt"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(graspnet_backbones.BACKBONES, "hand_made", HandMade)
        save_graspnet(path, hand_made(), PIXEL)
    return path


@pytest.fixture
def files(tmp_path, cell, checkpoint):
    """A user's files, and the command line that goes with them."""
    return UserFiles(tmp_path, cell.look(Intrinsics(320, 240, 28), OVERHEAD), checkpoint)


class UserFiles:
    def __init__(self, folder: Path, frame: RGBDFrame, checkpoint: Path):
        self.folder, self.frame = folder, frame
        Image.fromarray(frame.rgb).save(folder / "rgb.png")
        Image.fromarray(np.rint(frame.depth * 1000).astype(np.uint16)).save(folder / "depth.png")
        np.savetxt(folder / "pose.txt", frame.T_WC)
        self.options = {
            "--rgb": folder / "rgb.png",
            "--depth": folder / "depth.png",
            "--intrinsics": [*frame.K[[0, 1], [0, 1]], *frame.K[:2, 2]],
            "--camera-pose": folder / "pose.txt",
            "--checkpoint": checkpoint,
            "--out": folder / "out",
        }

    def command(self, **changes) -> list[str]:
        """The arguments; `camera_pose=None` leaves an option out."""
        options = self.options | {f"--{k.replace('_', '-')}": v for k, v in changes.items()}
        argv = []
        for name, value in options.items():
            if value is not None:
                argv += [name, *map(str, value if isinstance(value, list) else [value])]
        return argv

    def run(self, capsys, **changes) -> dict:
        assert predict.main(self.command(**changes)) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed == json.loads((self.folder / "out" / "grasps.json").read_text())
        assert is_prediction_panel(self.folder / "out" / "grasps.png")
        return printed


def sorted_by_place(grasps):
    return sorted(grasps, key=lambda grasp: grasp.in_world.position[0])


def by_row(grasps: list[dict]) -> list[dict]:
    """The two cubes are alike, so rounding decides which one is the best."""
    return sorted(grasps, key=lambda grasp: grasp["pixel"][1])


def check_on_cubes(grasps, tolerance: float) -> None:
    assert len(grasps) == len(CUBES)
    for grasp, (xy, yaw) in zip(sorted_by_place(grasps), CUBES.items()):
        position = grasp.in_world.position
        np.testing.assert_allclose(position[:2], xy, atol=tolerance)
        # 2 cm below the top of 6 cm, and E above the lowest point of the fingertips.
        assert position[2] == pytest.approx(0.04 + 0.0072, abs=0.002)
        wrong = min(angle_difference(grasp.in_world.angle, yaw + k * np.pi / 2) for k in (0, 1))
        assert np.rad2deg(wrong) < 3


# --- Resolutions ----------------------------------------------------------------------------


def test_resolutions_and_aspect_ratios_give_the_same_metric_grasps(cell):
    model, found = hand_made(), []
    for width, height in ((224, 224), (640, 480), (320, 240)):
        frame = cell.look(Intrinsics(width, height, 28), OVERHEAD)
        result = graspnet_inference.predict(model, PIXEL, frame, 0.0)
        check_on_cubes(result.grasps, 0.0015)
        assert result.quality.shape == result.angle.shape == result.width.shape == (height, width)
        for grasp in result.grasps:  # the maps lie where the grasps do
            u, v = np.rint(grasp.on_image.pixel).astype(int)
            assert result.quality[v, u] == pytest.approx(grasp.on_image.quality, abs=0.03)
            assert result.width[v, u] == pytest.approx(grasp.on_image.width, abs=0.001)
            assert angle_difference(result.angle[v, u], grasp.on_image.angle) < np.radians(8)
        found.append(sorted_by_place(result.grasps))
    for other in found[1:]:
        for ours, theirs in zip(found[0], other):
            np.testing.assert_allclose(ours.in_world.position, theirs.in_world.position, atol=0.001)
            assert angle_difference(ours.in_world.angle, theirs.in_world.angle) < np.radians(1.5)
            assert ours.in_world.width == pytest.approx(theirs.in_world.width, abs=0.0005)


def test_another_distance_and_focal_length_give_the_same_metric_grasps(cell):
    farther = look_at((0.5, 0.0, 1.3), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
    frame = cell.look(Intrinsics(400, 300, 20), farther)
    check_on_cubes(graspnet_inference.predict(hand_made(), PIXEL, frame, 0.0).grasps, 0.002)


@pytest.mark.parametrize("unknown", [0.0, -1.0, np.inf, np.nan])
def test_unknown_depth_has_no_part_in_the_scale(unknown):
    depth = np.full((64, 64), 0.8, np.float32)
    depth[:, :30] = 0.6
    depth[:60, 34:] = unknown  # infinite ones would make most of the image's depths
    frame = RGBDFrame(
        np.zeros((64, 64, 3), np.uint8), depth, np.diag([400.0, 400.0, 1.0]), OVERHEAD
    )
    scaling = graspnet_inference.training_scale(frame, 0.0015)
    assert (scaling.u, scaling.v) == pytest.approx((1.0, 1.0))  # 0.6 / 400 = 1.5 mm


def test_pixels_that_are_not_square(cell):
    square = cell.look(Intrinsics(320, 240, 28), OVERHEAD)
    wider = PixelScaling(1.25, 1.0)
    frame = RGBDFrame(
        wider.image(square.rgb), wider.image(square.depth), wider.intrinsics(square.K), OVERHEAD
    )
    assert frame.depth.shape == (240, 400)
    result = graspnet_inference.predict(hand_made(), PIXEL, frame, 0.0)
    check_on_cubes(result.grasps, 0.0015)
    for grasp in result.grasps:  # the angle is that of the picture as it is
        shown = grasp_to_image(grasp.in_world, frame.K, OVERHEAD)
        assert angle_difference(shown.angle, grasp.on_image.angle) < np.radians(1)


@pytest.mark.parametrize("factors", [(0.5, 0.5), (0.37, 0.37), (1.7, 1.7), (0.8, 1.3), (1.0, 1.0)])
def test_scaled_ramps_are_where_the_formula_says(factors):
    """A linear image stays linear, so its values tell where each pixel came from."""
    scaling = PixelScaling(*factors)
    v, u = np.mgrid[0:90, 0:120].astype(np.float32)
    rows, columns = scaling.size(u.shape)
    assert (rows, columns) == (int(90 * factors[1]), int(120 * factors[0]))
    at = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    original = scaling.original_pixels(at)
    np.testing.assert_allclose(scaling.pixels(original), at, atol=1e-9)
    inner = (slice(3, -3), slice(3, -3))
    for axis, ramp in enumerate((u, v)):
        scaled = scaling.image(ramp)
        # The mean over a part of a pixel is that pixel's, 1/8 pixel off at most, either way.
        wrong = scaled[inner] - original[inner][..., axis]
        assert abs(wrong).max() < 0.13 and abs(wrong.mean()) < 0.01
        back = scaling.original_map(scaled, u.shape)
        assert abs(back - ramp)[8:-8, 8:-8].max() < 0.13


def test_scaled_intrinsics_see_the_same_points():
    K = intrinsics_matrix([600, 560, 301, 251], 640, 480)
    scaling = PixelScaling.to_focal_length(K, 300)
    assert scaling.intrinsics(K)[0, 0] == pytest.approx(scaling.intrinsics(K)[1, 1])
    pixel = np.array([123.4, 56.7])
    point = deproject(pixel, 0.9, K, OVERHEAD)
    seen, _ = project(point, scaling.intrinsics(K), OVERHEAD)
    np.testing.assert_allclose(seen, scaling.pixels(pixel))


def test_angles_of_stretched_lines():
    # A line at 45 degrees in an image that was squeezed to half its width was flatter before.
    scaling = PixelScaling(0.5, 1.0)
    assert scaling.original_angles(np.pi / 4) == pytest.approx(np.arctan(0.5))
    assert scaling.original_angles(np.pi / 2) == pytest.approx(np.pi / 2)


def test_metres_per_pixel():
    assert metres_per_pixel(np.diag([FOCAL, FOCAL, 1]), 0.8) == pytest.approx(PIXEL)


# --- The table ------------------------------------------------------------------------------


def cloud(T_WC: np.ndarray, noise: float, share_of_boxes: float) -> np.ndarray:
    """Points of a table z = 0 with boxes on it, in the camera's frame."""
    random = np.random.default_rng(0)
    points = random.uniform((-0.3, -0.3, 0), (0.3, 0.3, 0), (5000, 3))
    boxes = random.random(5000) < share_of_boxes
    points[boxes, 2] = random.uniform(0.01, 0.12, boxes.sum())
    points[random.random(5000) < 0.05] = np.nan
    seen = transform_points(inverse_pose(T_WC), points)
    return seen * (1 + random.normal(0, noise, (5000, 1)))  # along the line of sight


@pytest.mark.parametrize("eye", [(0.0, 0.01, 0.8), (0.5, -0.3, 0.6), (-0.9, 0.2, 0.5)])
def test_the_table_is_found_under_clutter_and_noise(eye):
    T_WC = look_at(eye, (0, 0, 0))
    plane = dominant_plane(cloud(T_WC, 0.002, 0.4))
    normal = T_WC[:3, :3].T @ (0, 0, 1)
    assert np.rad2deg(np.arccos(plane.normal @ normal)) < 0.5
    assert plane.distance == pytest.approx(eye[2], abs=0.003)
    pose = plane.camera_pose()
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], (0, 0, plane.distance), atol=1e-12)
    assert pose[1, 0] == pytest.approx(0, abs=1e-12) and pose[0, 0] > 0  # x is the image's right


def test_a_portrait_camera_that_looks_along_the_table_has_a_frame_too():
    plane = dominant_plane(np.random.default_rng(0).uniform((0.3, -1, 1), (0.3, 1, 2), (500, 3)))
    pose = plane.camera_pose()  # the normal is the image's left
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], (0, 0, 0.3), atol=1e-9)


def test_no_plane_is_said():
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 3), (3000, 3))
    with pytest.raises(UserError, match="no table found"):
        dominant_plane(points)
    with pytest.raises(UserError, match="too few"):
        dominant_plane(np.full((10, 3), np.nan))
    line = np.linspace(0, 1, 50)[:, None] * (0, 0, 1.0) + (0, 0, 1)
    with pytest.raises(UserError, match="one line"):
        dominant_plane(line)


# --- The command ----------------------------------------------------------------------------


def test_frames_of_the_output_agree(files, capsys):
    found = files.run(capsys)
    assert found["format"] == predict.FORMAT and len(found["grasps"]) == len(CUBES)
    assert found["table"]["estimated"] and abs(found["table"]["height_world"]) < 0.002
    qualities = [grasp["quality"] for grasp in found["grasps"]]
    assert qualities == sorted(qualities, reverse=True)
    for grasp in found["grasps"]:
        in_camera, in_world = grasp["camera"], grasp["world"]
        np.testing.assert_allclose(
            transform_points(OVERHEAD, np.array(in_camera["position"])), in_world["position"]
        )
        np.testing.assert_allclose(
            OVERHEAD[:3, :3] @ in_camera["rotation"], in_world["rotation"], atol=1e-9
        )
        np.testing.assert_allclose(
            Rotation.from_quat(in_camera["quaternion"]).as_matrix(), in_camera["rotation"]
        )
        np.testing.assert_allclose(np.array(in_world["rotation"])[:, 2], (0, 0, -1), atol=1e-9)
        nearest = min(np.hypot(*np.subtract(in_world["position"][:2], xy)) for xy in CUBES)
        assert nearest < 0.002


def test_without_a_pose_the_gripper_descends_along_the_tables_normal(files, capsys):
    posed = files.run(capsys)
    bare = files.run(capsys, camera_pose=None)
    assert bare["T_WC"] is None and bare["table"]["height_world"] is None
    for one, other in zip(by_row(posed["grasps"]), by_row(bare["grasps"])):
        assert "world" not in other
        np.testing.assert_allclose(
            one["camera"]["position"], other["camera"]["position"], atol=0.002
        )
        turned = np.array(one["camera"]["rotation"]) * other["camera"]["rotation"]
        # The same axes; the fingers may be swapped, for angles are told modulo half a turn.
        np.testing.assert_allclose(np.abs(turned.sum(axis=0)), 1, atol=0.001)
        approach = np.array(other["camera"]["rotation"])[:, 2]
        np.testing.assert_allclose(approach, -np.array(bare["table"]["normal_camera"]), atol=1e-9)


def test_an_oblique_camera_finds_the_tables_normal(tmp_path, cell, checkpoint, capsys):
    T_WC = look_at((0.5, 0.5, 0.6), (0.5, 0.0, 0.0))
    files = UserFiles(tmp_path, cell.look(Intrinsics(320, 240, 35), T_WC), checkpoint)
    found = files.run(capsys, camera_pose=None)
    up = T_WC[:3, :3].T @ (0, 0, 1)
    assert np.rad2deg(np.arccos(up @ found["table"]["normal_camera"])) < 0.3
    assert found["table"]["camera_height"] == pytest.approx(0.6, abs=0.003)


def test_depth_files_of_every_kind_say_the_same(files, capsys):
    metres = files.frame.depth
    expected = files.run(capsys)["grasps"]
    Image.fromarray(metres).save(files.folder / "depth.tiff")
    Image.fromarray(np.rint(metres * 1000).astype(np.uint16)).save(files.folder / "mm.tif")
    Image.fromarray(np.rint(metres * 10000).astype(np.uint16)).save(files.folder / "tenths.png")
    np.save(files.folder / "depth.npy", metres.astype(np.float64)[..., None])
    np.save(files.folder / "mm.npy", np.rint(metres * 1000).astype(np.int32))
    for name, scale in (
        ("depth.tiff", None), ("mm.tif", None), ("tenths.png", 1e-4), ("depth.npy", None),
        ("mm.npy", None), ("depth.tiff", 1.0),
    ):  # fmt: skip
        depth = read_depth(files.folder / name, scale)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, metres, atol=0.0006)
    fine = files.run(capsys, depth=files.folder / "depth.npy")["grasps"]
    for ours, theirs in zip(by_row(expected), by_row(fine)):
        np.testing.assert_allclose(
            ours["world"]["position"], theirs["world"]["position"], atol=0.001
        )


def test_a_jpeg_and_holes_in_the_depth_do_not_matter(files, capsys):
    Image.fromarray(files.frame.rgb).save(files.folder / "rgb.jpg", quality=95)
    depth = np.rint(files.frame.depth * 1000).astype(np.uint16)
    holes = np.random.default_rng(0).random(depth.shape) < 0.1
    Image.fromarray(np.where(holes, 0, depth)).save(files.folder / "depth.png")
    found = files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"]
    assert len(found) == len(CUBES)
    Image.fromarray(np.where(holes, np.uint16(65535), depth)).save(files.folder / "depth.png")
    assert files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"] == found


def test_count_and_table_height(files, capsys):
    assert len(files.run(capsys, count=1)["grasps"]) == 1
    told = files.run(capsys, table_height=0.045)  # fingertips stay 4 mm above it
    assert not told["table"]["estimated"]
    for grasp in told["grasps"]:
        assert grasp["world"]["position"][2] == pytest.approx(0.049 + 0.0072, abs=1e-6)


def test_an_empty_table_gives_an_empty_list(files, capsys):
    Image.fromarray(np.full((240, 320), 800, np.uint16)).save(files.folder / "depth.png")
    assert files.run(capsys)["grasps"] == []


def test_a_network_that_sees_grasps_on_the_bare_table_is_not_believed(tmp_path, files, capsys):
    model = hand_made()
    with torch.no_grad():
        model.quality_head.bias[0] = 3.0  # quality 0.95 on the table
    save_graspnet(tmp_path / "eager.pt", model, PIXEL)
    found = files.run(capsys, checkpoint=tmp_path / "eager.pt")["grasps"]
    assert 0 < len(found) <= 20
    assert all(grasp["world"]["position"][2] > 0.01 for grasp in found)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", "\n".join(" ".join(map(repr, row)) for row in OVERHEAD.tolist())),
        ("b.txt", "\n".join(", ".join(map(repr, row)) for row in OVERHEAD.tolist()) + "\n\n"),
        ("c.json", json.dumps(OVERHEAD.tolist())),
        ("d.json", json.dumps({"T_WC": OVERHEAD.ravel().tolist()})),
        ("e.yaml", "T_WC:\n" + "\n".join(f"- {row}" for row in OVERHEAD.tolist())),
    ],
)
def test_poses_of_every_kind(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_pose(tmp_path / name), OVERHEAD, atol=1e-12)
    np.save(tmp_path / "pose.npy", OVERHEAD)
    np.testing.assert_allclose(read_pose(tmp_path / "pose.npy"), OVERHEAD, atol=1e-12)


# --- Bad input ------------------------------------------------------------------------------


def small_rgb(files):
    Image.fromarray(files.frame.rgb[:100]).save(files.folder / "rgb.png")


def metres_wanted(files):  # millimetres as floats
    np.save(files.folder / "mm.npy", files.frame.depth * 1000)
    return {"depth": files.folder / "mm.npy"}


def zero_depth(files):
    Image.fromarray(np.zeros((240, 320), np.uint16)).save(files.folder / "depth.png")


def nan_depth(files):
    np.save(files.folder / "nan.npy", np.full((240, 320), np.nan))
    return {"depth": files.folder / "nan.npy"}


def grey_rgb(files):
    Image.fromarray(files.frame.rgb[..., 0]).save(files.folder / "rgb.png")


def colour_depth(files):
    return {"depth": files.folder / "rgb.png"}


def picture_of_depth(files):
    Image.fromarray(np.full((240, 320), 80, np.uint8)).save(files.folder / "depth.png")


def no_rgb(files):
    return {"rgb": files.folder / "nothing.png"}


def no_depth(files):
    return {"depth": files.folder / "nothing.npy"}


def cut_depth(files):
    path = files.folder / "depth.png"
    path.write_bytes(path.read_bytes()[:-3000])


def text_depth(files):
    (files.folder / "depth.npy").write_text("not an array")
    return {"depth": files.folder / "depth.npy"}


def pose(files, T):
    np.savetxt(files.folder / "pose.txt", T)


def mirrored_pose(files):
    pose(files, OVERHEAD @ np.diag([1, 1, -1, 1]))


def scaled_pose(files):
    pose(files, OVERHEAD @ np.diag([2, 2, 2, 1]))


def transposed_pose(files):
    pose(files, OVERHEAD.T)


def small_pose(files):
    pose(files, OVERHEAD[:3])


def nan_pose(files):
    pose(files, np.where(np.eye(4) > 0, np.nan, OVERHEAD))


def words_pose(files):
    (files.folder / "pose.txt").write_text("identity")


def ragged_pose(files):
    (files.folder / "pose.json").write_text("[[1, 2], [3]]")
    return {"camera_pose": files.folder / "pose.json"}


def unnamed_pose(files):
    (files.folder / "pose.yaml").write_text("T_CW: 3")
    return {"camera_pose": files.folder / "pose.yaml"}


def opengl_pose(files):
    """The camera as OpenGL has it, turned half about its x axis, looks at a ceiling."""
    pose(files, OVERHEAD @ np.diag([1, -1, -1, 1]))


def cut_checkpoint(files):
    path = files.folder / "cut.pt"
    path.write_bytes(files.options["--checkpoint"].read_bytes()[:5000])
    return {"checkpoint": path}


def other_checkpoint(files):
    content = torch.load(files.options["--checkpoint"], weights_only=True)
    content["model_args"]["num_angle_bins"] = 12
    torch.save(content, files.folder / "other.pt")
    return {"checkpoint": files.folder / "other.pt"}


def newer_checkpoint(files):
    content = torch.load(files.options["--checkpoint"], weights_only=True)
    content["format_version"] += 1
    torch.save(content, files.folder / "newer.pt")
    return {"checkpoint": files.folder / "newer.pt"}


def three_channels(files):
    save_graspnet(files.folder / "rgb.pt", GraspNet(3, backbone="ggcnn"), PIXEL)
    return {"checkpoint": files.folder / "rgb.pt"}


def other_json(files):
    (files.folder / "out").mkdir()
    (files.folder / "out" / "grasps.json").write_text('{"mine": 1}')


def other_picture(files):
    (files.folder / "out").mkdir()
    Image.fromarray(files.frame.rgb).save(files.folder / "out" / "grasps.png")


def out_is_a_file(files):
    (files.folder / "out").write_text("mine")


def options(**changes):
    return lambda files: changes


def only_a_count_beside_export(files):
    everything = {name.strip("-").replace("-", "_"): None for name in files.options}
    return everything | {"export": "x.onnx", "count": 5}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (small_rgb, "differ in size: 320x100 and 320x240"),
        (metres_wanted, "millimetres"),
        (options(depth_scale=1.0), "millimetres"),
        (options(depth_scale=-1), "--depth-scale"),
        (options(depth_scale="nan"), "--depth-scale"),
        (options(depth_scale=0.01), "check the unit of the depth"),
        (zero_depth, "no pixel is known"),
        (nan_depth, "no pixel is known"),
        (grey_rgb, "expected colour"),
        (colour_depth, "one channel"),
        (picture_of_depth, "8 bits"),
        (no_rgb, "nothing.png: no such file"),
        (no_depth, "nothing.npy: no such file"),
        (cut_depth, "cut short"),
        (text_depth, "not a readable array"),
        (options(depth=None), "--depth"),
        (options(intrinsics=[600, 600, 160]), "got 3 numbers, expected 4"),
        (options(intrinsics=[481, 0, 160, 120]), "positive"),
        (options(intrinsics=[481, -481, 160, 120]), "positive"),
        (options(intrinsics=[481, "nan", 160, 120]), "finite"),
        (options(intrinsics=[481, 160, 481, 120]), "order is fx fy cx cy"),
        (options(intrinsics=[481, 481, 960, 120]), "far outside"),
        (options(intrinsics=[48100, 48100, 160, 120]), "too little"),
        (mirrored_pose, "not rigid"),
        (scaled_pose, "not rigid"),
        (transposed_pose, "transposed"),
        (small_pose, "4x4"),
        (nan_pose, "finite"),
        (words_pose, "cannot be read"),
        (ragged_pose, "cannot be read"),
        (unnamed_pose, "T_WC"),
        (opengl_pose, "tilted by 180 degrees"),
        (options(camera_pose="nowhere.txt"), "no such file"),
        (options(camera_pose=None, table_height=0.1), "needs --camera-pose"),
        (options(table_height=0.5), "below the table"),
        (options(table_height="inf"), "--table-height"),
        (options(count=0), "--count"),
        (options(checkpoint="nowhere.pt"), "nowhere.pt"),
        (cut_checkpoint, "truncated"),
        (other_checkpoint, "another architecture"),
        (newer_checkpoint, "version"),
        (three_channels, "3 channels"),
        (other_json, "was not written by predict.py"),
        (other_picture, "was not written by predict.py"),
        (out_is_a_file, "no folder"),
        (options(export="x.onnx"), "takes only --checkpoint"),
        (only_a_count_beside_export, "takes only --checkpoint"),
    ],
)
def test_bad_input_is_one_sentence_and_writes_nothing(files, capsys, spoil, message):
    command = files.command(**(spoil(files) or {}))
    before = {path: path.read_bytes() for path in files.folder.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match=message) as caught:
        predict.main(command)
    assert len(str(caught.value)) < 300
    assert capsys.readouterr().out == ""
    after = {path: path.read_bytes() for path in files.folder.rglob("*") if path.is_file()}
    assert after == before


def test_images_of_one_name_do_not_overwrite_each_other(files, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = files.command(out=None)
    assert predict.main(command) == 0
    told = tmp_path / "runs" / "predict" / "rgb" / "grasps.json"
    before = told.read_bytes()
    assert predict.main(command) == 0, "the same image again is no other one"
    (files.folder / "second").mkdir()
    other = files.folder / "second" / "rgb.png"
    other.write_bytes((files.folder / "rgb.png").read_bytes())
    with pytest.raises(UserError, match="holds the grasps of .*rgb.png; give --out"):
        predict.main(files.command(out=None, rgb=other))
    assert told.read_bytes() == before


def test_what_the_studio_leaves_is_what_predict_takes(files, tmp_path, capsys):
    write_rgbd(files.frame, tmp_path / "studio")
    color, depth, pose = (tmp_path / "studio" / n for n in ("color.png", "depth.png", "T_WC.txt"))
    theirs = files.run(capsys, rgb=color, depth=depth, camera_pose=pose)
    assert theirs["grasps"] == files.run(capsys)["grasps"]


def test_a_bad_input_ends_with_status_2():
    program = Path(predict.__file__)
    done = subprocess.run(
        [sys.executable, str(program), "--rgb", "x.png"], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


# --- Export ---------------------------------------------------------------------------------


@pytest.mark.parametrize("backbone", ["ggcnn", "tutorial_skip"])
def test_onnx_says_what_pytorch_says(tmp_path, backbone):
    torch.manual_seed(0)
    model = GraspNet(max_width=0.08, backbone=backbone, centre_head=True).eval()
    for layer in model.modules():  # statistics that are not those of a fresh layer
        if isinstance(layer, nn.BatchNorm2d):
            layer.running_mean.uniform_(-0.2, 0.2)
            layer.running_var.uniform_(0.2, 1.0)
    path = tmp_path / "net.onnx"
    export_onnx(SavedGraspNet(model, PIXEL, {}, {}), path)
    session = onnxruntime.InferenceSession(str(path))
    described = session.get_modelmeta().custom_metadata_map
    stride = model.backbone.stride
    assert json.loads(described["stride"]) == stride
    assert "centre_head" not in described, "it is left out of the graph"
    assert json.loads(described["metres_per_pixel"]) == PIXEL
    assert [output.name for output in session.get_outputs()] == list(OUTPUTS)
    for batch, rows, columns in ((1, 5, 3), (3, 2, 7)):
        x = 3 * torch.randn(batch, 4, rows * stride, columns * stride)
        with torch.no_grad():
            expected = model(x)
        for ours, theirs in zip(session.run(None, {"image": x.numpy()}), expected):
            assert theirs.std() > 1e-6
            np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-4)


def test_export_replaces_its_own_file_and_no_other(tmp_path, capsys):
    save_graspnet(tmp_path / "net.pt", GraspNet(backbone="ggcnn"), PIXEL)
    path = tmp_path / "net.onnx"
    command = ["--checkpoint", str(tmp_path / "net.pt"), "--export", str(path)]
    assert predict.main(command) == 0
    first = path.read_bytes()
    assert predict.main(command) == 0 and len(path.read_bytes()) == len(first)
    path.write_text("mine")
    with pytest.raises(UserError, match="no export"):
        predict.main(command)
    assert path.read_text() == "mine"
