"""predict.py: frames agree, files are read, and bad input is one sentence."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import predict
from envs.cell import Intrinsics
from envs.studio import write_rgbd
from models.graspnet import GraspNet
from models.graspnet_io import save_graspnet
from models.planners import HeuristicPlanner, make_planner
from tests.helpers.box_frames import FLAT, TALL, boxes_frame
from tests.helpers.hand_made import (
    CUBES,
    OVERHEAD,
    PIXEL,
    cell_of_cubes,
    hand_made,
    hand_made_backbone,
)
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.image_overlay import grasp_picture, is_grasp_picture
from utils.table_plane import distances
from utils.transforms import Grasp, RGBDFrame, look_at, project, transform_points

PICTURE = predict.grasp_picture


@pytest.fixture(scope="module")
def panel() -> bytes:
    black = np.zeros((32, 32, 3), np.uint8)
    return grasp_picture(RGBDFrame(black, np.ones((32, 32)), np.eye(3), np.eye(4)), [], [])


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch, panel):
    """One picture for all: drawing takes longer than predicting."""
    monkeypatch.setattr(predict, "grasp_picture", lambda *_: panel)


@pytest.fixture(autouse=True, scope="module")
def backbone():
    with hand_made_backbone():
        yield


@pytest.fixture(scope="module")
def cell(config, box_set):
    with cell_of_cubes(config, box_set) as cell:
        yield cell


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "graspnet.pt"
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
        assert is_grasp_picture(self.folder / "out" / "grasps.png")
        return printed


def test_a_terminal_gets_a_table(files, capsys, monkeypatch):
    plain = files.run(capsys)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert predict.main(files.command()) == 0
    header, rule, *rows = capsys.readouterr().out.splitlines()
    columns = "list  rank  quality  pixel u v  width  image angle"
    assert " ".join(header.split()).startswith(" ".join(columns.split()))
    assert set(rule) == {"-", " "}
    assert len(rows) == len(plain["grasps"])
    for rank, (row, grasp) in enumerate(zip(rows, plain["grasps"]), start=1):
        name, place, quality, u, v, width, mm, *_ = row.split()
        assert (name, int(place), mm) == ("grasps", rank, "mm")
        assert abs(float(quality) - grasp["quality"]) <= 0.005 + 1e-9
        assert np.abs(np.array([u, v], float) - grasp["pixel"]).max() <= 0.5
        assert abs(float(width) / 1000 - grasp["width"]) <= 0.0005 + 1e-9


def best_of_each(grasps: list[dict]) -> list[dict]:
    """The best grasp of each cube, in the order of CUBES."""
    places = [in_world(grasp) for grasp in grasps]
    nearest = [min(CUBES, key=lambda xy: np.hypot(*(place[:2] - xy))) for place in places]
    assert set(nearest) == set(CUBES)
    return [grasps[nearest.index(xy)] for xy in CUBES]


def in_world(grasp: dict) -> np.ndarray:
    return transform_points(OVERHEAD, np.array(grasp["camera"]["position"]))


def test_the_planner_sees_the_image_as_it_was_taken(files, capsys):
    """It corrects a rough image once, as in `evaluate.py`."""
    rng, shape = np.random.default_rng(0), files.frame.depth.shape
    waves = gaussian_filter(rng.standard_normal(shape), 4)
    rough = files.frame.depth + np.float32(0.012 / waves.std()) * waves.astype(np.float32)
    rgb = rng.integers(0, 256, files.frame.rgb.shape, dtype=np.uint8)  # smooths no colour alike
    colours, path = files.folder / "speckled.png", files.folder / "rough.npy"
    Image.fromarray(rgb).save(colours)
    np.save(path, rough)
    found = files.run(
        capsys, rgb=colours, depth=path, planner="heuristic", checkpoint=None, table_height=0
    )
    place = found["workspace"]
    workspace = Workspace(tuple(place["centre_world"][:2]), place["size"], 0.0)
    plan = make_planner("heuristic", GripperGeometry(), workspace, 0)
    grasps = plan(replace(files.frame, rgb=rgb, depth=rough))
    assert grasps and len(grasps) == len(found["grasps"])
    for grasp, printed in zip(grasps, found["grasps"]):
        np.testing.assert_allclose(printed["world"]["position"], grasp.position, atol=1e-6)


def test_a_lens_that_distorts_is_a_remark_of_the_result(files, capsys):
    fx, fy, cx, cy = files.options["--intrinsics"]
    path = files.folder / "bent.json"
    path.write_text(json.dumps({"fx": fx, "fy": fy, "cx": cx, "cy": cy, "D": [0.1, -0.2]}))
    assert any(
        "lens distorts" in remark for remark in files.run(capsys, intrinsics=path)["remarks"]
    )


def marked(files: UserFiles, xy: tuple[float, float]) -> np.ndarray:
    """(H, W) bool, the pixels of the cube at xy."""
    points = files.frame.points()
    near = np.hypot(points[..., 0] - xy[0], points[..., 1] - xy[1]) < 0.05
    return near & (points[..., 2] > 0.005)


# --- The command ----------------------------------------------------------------------------


def test_frames_of_the_output_agree(files, capsys, monkeypatch, panel):
    monkeypatch.setattr(predict, "grasp_picture", PICTURE)
    found = files.run(capsys)
    assert (files.folder / "out" / "grasps.png").read_bytes() != panel
    assert (found["format"], found["version"]) == ("robot-grasping grasps", 2)
    assert len(best_of_each(found["grasps"])) == len(CUBES)
    assert found["table"]["estimated"] and abs(found["table"]["height_world"]) < 0.002
    qualities = [grasp["quality"] for grasp in found["grasps"]]
    assert qualities == sorted(qualities, reverse=True)
    for grasp in found["grasps"]:
        in_camera, in_world = grasp["camera"], grasp["world"]
        assert grasp["tilt"] == 0.0
        np.testing.assert_allclose(
            project(np.array(in_world["position"]), files.frame.K, OVERHEAD)[0], grasp["pixel"]
        )
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
        assert nearest < 0.02  # a cube may also be held off its middle
    for xy, grasp in zip(CUBES, best_of_each(found["grasps"])):
        assert np.hypot(*np.subtract(grasp["world"]["position"][:2], xy)) < 0.004


def test_the_grasps_are_those_of_the_planner(files, capsys):
    """With the shipped network, in a workspace that the user gives: every number is the planner's,
    and qualities are chances."""
    found = files.run(capsys, checkpoint=None, table_height=0, workspace=[0.5, 0.0, 0.3])
    T_WC = np.array(found["T_WC"])
    depth = np.rint(files.frame.depth * 1000).astype(np.float64) * 0.001
    frame = RGBDFrame(files.frame.rgb, depth.astype(np.float32), np.array(found["K"]), T_WC)
    plan = make_planner("graspnet", GripperGeometry(), Workspace(), 0)
    expected = plan(frame)
    assert found["calibrated"] and found["planner"] == "graspnet" and len(expected) > 2
    assert len(found["grasps"]) == len(expected)
    for grasp, other in zip(found["grasps"], expected):
        np.testing.assert_allclose(grasp["world"]["position"], other.position, atol=1e-9)
        np.testing.assert_allclose(
            [grasp["quality"], grasp["width"], grasp["world"]["angle"]],
            [other.quality, other.width, other.angle],
        )


@pytest.mark.parametrize("name", ["heuristic", "heuristic6d"])
def test_planners_without_a_network(name, files, capsys):
    found = files.run(capsys, checkpoint=None, planner=name)
    assert found["checkpoint"] is None and found["calibrated"]
    best_of_each(found["grasps"])
    tilts = [grasp["tilt"] for grasp in found["grasps"]]
    assert (max(tilts) > 0.5) == (name == "heuristic6d")


@pytest.mark.parametrize(("how", "number"), [("point", 0), ("box", 1), ("mask", 0)])
def test_grasp_that_one(how, number, files, capsys):
    xy = list(CUBES)[number]
    pixels = marked(files, xy)
    v, u = np.nonzero(pixels)
    Image.fromarray((255 * pixels).astype(np.uint8)).save(files.folder / "mask.png")
    value = {
        "point": [int(u.mean()), int(v.mean())],
        "box": [u.min() - 3, v.min() - 3, u.max() + 3, v.max() + 3],
        "mask": files.folder / "mask.png",
    }[how]
    found = files.run(capsys, **{how: value})
    assert found["target"]["pixels"] == pytest.approx(pixels.sum(), rel=0.1)
    box = [u.min(), v.min(), u.max(), v.max()]
    np.testing.assert_allclose(found["target"]["box"], box, atol=3)
    assert found["grasps"] and found["clearing"] == []  # the other cube is 17 cm away
    for grasp in found["grasps"]:
        assert np.hypot(*(in_world(grasp)[:2] - xy)) < 0.03


def test_what_is_in_the_way_of_a_marked_object_can_be_cleared(tmp_path, checkpoint, capsys):
    """A flat box between two higher ones, beside which no finger fits."""
    files = UserFiles(tmp_path, boxes_frame([FLAT, *TALL]), checkpoint)
    found = files.run(capsys, checkpoint=None, planner="heuristic", point=[111.5, 111.5])
    assert found["clearing"]
    for grasp in found["clearing"]:
        x, y, _ = grasp["world"]["position"]
        assert abs(abs(x - 0.5) - 0.035) < 0.01 and abs(y) < 0.05


def test_grasps_that_rather_fail_are_remarked_on(files, capsys, monkeypatch):
    cube = Grasp(np.array([*list(CUBES)[0], 0.03]), 0.3, 0.08, 1.0)
    two = [replace(cube, quality=chance) for chance in (0.9, 0.4)]
    monkeypatch.setattr(HeuristicPlanner, "__call__", lambda self, frame: two)
    found = files.run(capsys, checkpoint=None, planner="heuristic")
    (remark,) = found["remarks"]
    assert remark.startswith("1 of the 2 grasps has a chance under 0.5")


def test_a_planner_returns_as_many_grasps_as_are_asked_for(files):
    command = files.command(checkpoint=None, planner="heuristic", count=33)
    planner = predict.new_planner(predict.parse_options(command), None, Workspace())
    assert planner.settings.returned == 33


def test_a_planner_without_a_network_reads_none(files, capsys, monkeypatch):
    monkeypatch.delattr(predict, "load_graspnet")
    found = files.run(capsys, planner="heuristic", checkpoint=None)
    assert found["grasps"] and found["checkpoint"] is None


def test_a_mask_that_may_be_inverted_is_asked_about(files, capsys):
    pixels = marked(files, list(CUBES)[0])
    np.save(files.folder / "mask.npy", ~pixels)
    found = files.run(capsys, mask=files.folder / "mask.npy")
    assert any("is it inverted?" in remark for remark in found["remarks"])
    np.save(files.folder / "mask.npy", pixels)
    assert files.run(capsys, mask=files.folder / "mask.npy")["remarks"] == []


def test_without_a_pose_the_gripper_descends_along_the_tables_normal(files, capsys):
    posed = files.run(capsys)
    bare = files.run(capsys, camera_pose=None)
    assert bare["T_WC"] is None and bare["table"]["height_world"] is None
    assert all("world" not in grasp for grasp in bare["grasps"])
    for one, other in zip(best_of_each(posed["grasps"]), best_of_each(bare["grasps"])):
        # The grids of the two worlds differ by parts of a cell; fingertips by one level of 6 mm.
        apart = np.subtract(one["camera"]["position"], other["camera"]["position"])
        assert np.abs(apart[:2]).max() < 0.004 and abs(apart[2]) < 0.007
        turned = np.array(one["camera"]["rotation"]).T @ other["camera"]["rotation"]
        assert np.abs(turned[:2, :2]).max() > np.cos(0.1)  # along a side of the cube, either one
        approach = np.array(other["camera"]["rotation"])[:, 2]
        np.testing.assert_allclose(approach, -np.array(bare["table"]["normal_camera"]), atol=1e-9)


def test_an_oblique_camera_finds_the_tables_normal(tmp_path, cell, checkpoint, capsys):
    T_WC = look_at((0.5, 0.5, 0.6), (0.5, 0.0, 0.0))
    files = UserFiles(tmp_path, cell.look(Intrinsics(320, 240, 35), T_WC), checkpoint)
    found = files.run(capsys, camera_pose=None)
    up = T_WC[:3, :3].T @ (0, 0, 1)
    assert np.rad2deg(np.arccos(up @ found["table"]["normal_camera"])) < 0.3
    assert found["table"]["camera_height"] == pytest.approx(0.6, abs=0.003)


def test_a_jpeg_and_holes_in_the_depth_do_not_matter(files, capsys):
    Image.fromarray(files.frame.rgb).save(files.folder / "rgb.jpg", quality=95)
    depth = np.rint(files.frame.depth * 1000).astype(np.uint16)
    holes = np.random.default_rng(0).random(depth.shape) < 0.1
    Image.fromarray(np.where(holes, 0, depth)).save(files.folder / "depth.png")
    found = files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"]
    best_of_each(found)
    Image.fromarray(np.where(holes, np.uint16(65535), depth)).save(files.folder / "depth.png")
    assert files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"] == found


@pytest.mark.parametrize("opening", [0.10, 0.08, 0.05])
def test_widths_are_limited_to_the_hand_of_the_checkpoint(opening, files, tmp_path, capsys):
    """Cubes of 6 cm: a hand that opens 5 cm takes none."""
    trained = {} if opening == 0.08 else {"gripper": {"max_opening": opening}}
    save_graspnet(tmp_path / "other.pt", hand_made(), PIXEL, trained)
    found = files.run(capsys, checkpoint=tmp_path / "other.pt")
    widths = [grasp["width"] for grasp in found["grasps"]]
    assert not found["calibrated"]
    assert all(0.06 < width <= opening for width in widths) and bool(widths) == (opening > 0.06)


def test_count_and_table_height(files, capsys):
    assert len(files.run(capsys, count=1)["grasps"]) == 1
    given = files.run(capsys, table_height=0.045)
    assert not given["table"]["estimated"]
    # The image shows the table at 0, 0.8 m away. So all depths shrink, cubes of 6 cm by as much.
    (remark,) = given["remarks"]
    assert f"multiplied by {1 - 0.045 / 0.8:.3f}" in remark and "height of 0.045 m" in remark
    lowest, top = 0.045 + 0.004 + 0.0072, 0.045 + 0.06 * (1 - 0.045 / 0.8)
    for grasp in best_of_each(given["grasps"]):
        assert lowest - 1e-6 < grasp["world"]["position"][2] < top


def test_a_camera_that_measures_too_near_is_corrected_before_the_workspace_is_chosen(files, capsys):
    """By 3.5 %: the whole table, 0.8 m away, seems to stand 2.8 cm high."""
    good = files.run(capsys, table_height=0.0)
    depth = np.rint(965 * files.frame.depth).astype(np.uint16)
    Image.fromarray(depth).save(files.folder / "depth.png")
    found = files.run(capsys, table_height=0.0)
    assert found["workspace"]["size"] == pytest.approx(good["workspace"]["size"], abs=0.011)
    assert good["remarks"] == [] and "multiplied by 1.036" in found["remarks"][0]
    assert len(best_of_each(found["grasps"])) == len(CUBES)
    with pytest.raises(UserError, match="shows only the table"):
        files.run(capsys, table_height=0.0, **mask_of_the_table(files))


def test_an_empty_table_gives_an_empty_list(files, capsys):
    Image.fromarray(np.full((240, 320), 800, np.uint16)).save(files.folder / "depth.png")
    assert files.run(capsys)["grasps"] == []


def test_grasps_on_the_bare_table_are_dropped(tmp_path, files, capsys):
    model = hand_made()
    with torch.no_grad():
        model.quality_head.bias[0] = 3.0  # quality 0.95 on the table
    save_graspnet(tmp_path / "eager.pt", model, PIXEL)
    found = files.run(capsys, checkpoint=tmp_path / "eager.pt")["grasps"]
    assert 0 < len(found) <= 20
    assert all(grasp["world"]["position"][2] > 0.01 for grasp in found)


# --- Bad input ------------------------------------------------------------------------------


def small_rgb(files):
    Image.fromarray(files.frame.rgb[:100]).save(files.folder / "rgb.png")


def metres_wanted(files):  # millimetres as floats
    np.save(files.folder / "mm.npy", files.frame.depth * 1000)
    return {"depth": files.folder / "mm.npy"}


def zero_depth(files):
    Image.fromarray(np.zeros((240, 320), np.uint16)).save(files.folder / "depth.png")


def distances_from_a_base(files):
    np.save(files.folder / "base.npy", distances(files.frame.depth, files.frame.K))
    return {"depth": files.folder / "base.npy"}


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


def closed_hand(files):
    shut = files.folder / "shut.pt"
    save_graspnet(shut, GraspNet(backbone="ggcnn"), PIXEL, config={"gripper": {"max_opening": -1}})
    return {"checkpoint": shut}


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


def small_mask(files):
    Image.fromarray(np.ones((100, 100), np.uint8)).save(files.folder / "mask.png")
    return {"mask": files.folder / "mask.png"}


def empty_mask(files):
    np.save(files.folder / "mask.npy", np.zeros((240, 320)))
    return {"mask": files.folder / "mask.npy"}


def mask_of_everything(files):
    Image.fromarray(files.frame.rgb).save(files.folder / "mask.png")  # the picture by mistake
    return {"mask": files.folder / "mask.png"}


def mask_of_the_table(files):
    mask = np.zeros((240, 320), bool)
    mask[:30, :30] = True
    np.save(files.folder / "mask.npy", mask)
    return {"mask": files.folder / "mask.npy"}


def target_that_is_too_wide(files):
    """What the table shows in this image is raised by 8 cm over 20 cm."""
    depth = np.full((240, 320), 800, np.uint16)
    depth[60:180, 100:220] = 720
    Image.fromarray(depth).save(files.folder / "depth.png")
    return {"point": [160, 120]}


def target_wider_than_the_hand_opens(files):
    """The same, raised by 10 cm, and all of it marked: no side of it is less than 8 cm."""
    target_that_is_too_wide(files)
    depth = np.asarray(Image.open(files.folder / "depth.png")).copy()
    depth[depth == 720] = 700
    Image.fromarray(depth).save(files.folder / "depth.png")
    Image.fromarray(np.uint8(255 * (depth == 700))).save(files.folder / "mask.png")
    return {"point": None, "mask": str(files.folder / "mask.png")}


def oblique_pose(files):
    depth = np.full((240, 320), 800, np.uint16)
    Image.fromarray(depth).save(files.folder / "depth.png")
    pose(files, look_at((0.0, 0.0, 0.2), (0.8, 0.0, 0.0)))
    return {"table_height": 0.0}


def unseen(files):
    depth = np.rint(files.frame.depth * 1000).astype(np.uint16)
    depth[:, ::2] = 0
    depth[::4] = 0
    Image.fromarray(depth).save(files.folder / "depth.png")


def only_a_count_beside_export(files):
    everything = {name.strip("-").replace("-", "_"): None for name in files.options}
    return everything | {"export": "x.onnx", "count": 5}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (small_rgb, "differ in size: 320x100 and 320x240"),
        (metres_wanted, "median is [5-9].. m.*check its unit"),
        (distances_from_a_base, "seems to hold distances from a robot's base.*give --from-base"),
        (options(depth_scale=1.0), "median is [5-9].. m.*check its unit"),
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
        (options(depth=None), "missing: --depth; an image takes"),
        (options(intrinsics=None, rgb=None), "missing: --rgb, --intrinsics; an image takes"),
        (options(intrinsics=[600, 600, 160]), "got 3 numbers, expected 4"),
        (options(intrinsics=[481, 0, 160, 120]), "positive"),
        (options(intrinsics=[481, -481, 160, 120]), "positive"),
        (options(intrinsics=[481, "nan", 160, 120]), "finite"),
        (options(intrinsics=["K.txt", 481, 160, 120]), "4 numbers fx fy cx cy, or a FILE.json"),
        (options(intrinsics="nowhere.json"), "nowhere.json: no such file"),
        (options(intrinsics=[481, 160, 481, 120]), "order is fx fy cx cy"),
        (options(intrinsics=[481, 481, 960, 120]), "far outside"),
        (options(intrinsics=[481, 481, 400, 120]), r"point \(400, 120\) lies outside .* 320x240"),
        (options(intrinsics=[48100, 48100, 160, 120]), "too little"),
        (closed_hand, "its hand opens -1"),
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
        (
            options(planner="oracle"),
            "--planner: got 'oracle', expected one of graspnet, graspnet6d",
        ),
        (options(planner="heuristic"), "heuristic has no network"),
        (options(planner="graspnet6d"), "graspnet6d ranks by a critic"),
        (
            options(point=[3, 3]),
            "point 3 3: not on an object, but on the table or outside the workspace; the nearest",
        ),
        (options(point=[320, 3]), "outside the image"),
        (options(point=["nan", 3]), "--point nan 3.0: expected pixels"),
        (options(box=[0, 0, "inf", 20]), "--box 0.0 0.0 inf 20.0: expected pixels"),
        (options(box=[0, 0, 20, 20]), "no object in it"),
        (options(mask="nowhere.png"), "no such file"),
        (small_mask, "a mask of 100x100 pixels, the image has 320x240"),
        (empty_mask, "the mask is empty"),
        (mask_of_everything, "the mask marks every pixel"),
        (mask_of_the_table, "shows only the table"),
        (target_that_is_too_wide, "no grasp reaches the target"),
        (
            target_wider_than_the_hand_opens,
            r"is at least 0\.\d+ m wide, and the hand opens 0\.08 m",
        ),
        (oblique_pose, "the view is too oblique: the camera looks 76 degrees off"),
        (unseen, "too much is unseen: 6[23] % of the place|too much is unseen: 6[23]%"),
        (options(camera_pose=None, workspace=[0, 0, 0.3]), "needs --camera-pose"),
        (options(workspace=[0.5, 0, 3]), "a side of 0.15 to 1 m"),
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


def test_every_run_has_a_folder_of_its_own(files, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runs = tmp_path / "runs" / "predict"
    assert predict.main(files.command(out=None)) == 0
    (first,) = runs.iterdir()
    before = (first / "grasps.json").read_bytes()
    assert predict.main(files.command(out=None, count=1)) == 0
    folders = sorted(runs.iterdir())
    assert len(folders) == 2 and first in folders
    assert (first / "grasps.json").read_bytes() == before
    assert all(re.fullmatch(r"\d{8}-\d{6}-rgb(-2)?", folder.name) for folder in folders)


def test_a_folder_that_is_named_keeps_the_last_result_and_says_so(files, capsys):
    for verb in ("wrote", "replaced"):
        assert predict.main(files.command()) == 0
        assert f"{verb} {files.folder / 'out' / 'grasps.json'}" in capsys.readouterr().err


def test_intrinsics_may_come_from_a_file(files, capsys):
    expected = files.run(capsys)["grasps"]
    fx, fy, cx, cy = files.options["--intrinsics"]
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": 320, "height": 240}
    path = files.folder / "intrinsics.json"
    path.write_text(json.dumps(values))
    assert files.run(capsys, intrinsics=path)["grasps"] == expected


def test_predict_reads_what_the_studio_writes(files, tmp_path, capsys):
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


def test_an_export_that_cannot_be_written_is_refused_before_the_network_is_read(tmp_path):
    path = tmp_path / "none" / "dir" / "x.onnx"
    with pytest.raises(UserError, match=f"--export {path}: not a file in an existing folder"):
        predict.main(["--checkpoint", str(tmp_path / "missing.pt"), "--export", str(path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
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
