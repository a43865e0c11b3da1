"""predict.py: frames agree, files are read, and bad input is one sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import predict
from envs.cell import Intrinsics
from envs.studio import write_rgbd
from models.graspnet import GraspNet
from models.graspnet_io import save_graspnet
from tests.helpers.hand_made import (
    CUBES,
    OVERHEAD,
    PIXEL,
    cell_of_cubes,
    hand_made,
    hand_made_backbone,
)
from utils.errors import UserError
from utils.image_overlay import grasp_picture, is_grasp_picture
from utils.transforms import RGBDFrame, look_at, transform_points

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


def by_row(grasps: list[dict]) -> list[dict]:
    """The two cubes are alike, so rounding decides which one is the best."""
    return sorted(grasps, key=lambda grasp: grasp["pixel"][1])


# --- The command ----------------------------------------------------------------------------


def test_frames_of_the_output_agree(files, capsys, monkeypatch, panel):
    monkeypatch.setattr(predict, "grasp_picture", PICTURE)
    found = files.run(capsys)
    assert (files.folder / "out" / "grasps.png").read_bytes() != panel
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
        # The same axes; the fingers may be swapped, for angles are modulo half a turn.
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


def test_a_jpeg_and_holes_in_the_depth_do_not_matter(files, capsys):
    Image.fromarray(files.frame.rgb).save(files.folder / "rgb.jpg", quality=95)
    depth = np.rint(files.frame.depth * 1000).astype(np.uint16)
    holes = np.random.default_rng(0).random(depth.shape) < 0.1
    Image.fromarray(np.where(holes, 0, depth)).save(files.folder / "depth.png")
    found = files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"]
    assert len(found) == len(CUBES)
    Image.fromarray(np.where(holes, np.uint16(65535), depth)).save(files.folder / "depth.png")
    assert files.run(capsys, rgb=files.folder / "rgb.jpg")["grasps"] == found


@pytest.mark.parametrize(
    ("trained", "opening"), [({"gripper": {"max_opening": 0.10}}, 0.10), ({}, 0.08)]
)
def test_widths_are_limited_to_the_hand_of_the_checkpoint(
    trained, opening, files, tmp_path, capsys
):
    model = hand_made(max_width=0.2)
    with torch.no_grad():
        model.width_head.bias.fill_(20.0)  # as wide as it can, everywhere
    save_graspnet(tmp_path / "wide.pt", model, PIXEL, trained)
    found = files.run(capsys, checkpoint=tmp_path / "wide.pt")["grasps"]
    assert [grasp["width"] for grasp in found] == [opening] * len(CUBES)


def test_count_and_table_height(files, capsys):
    assert len(files.run(capsys, count=1)["grasps"]) == 1
    given = files.run(capsys, table_height=0.045)  # fingertips stay 4 mm above it
    assert not given["table"]["estimated"]
    for grasp in given["grasps"]:
        assert grasp["world"]["position"][2] == pytest.approx(0.049 + 0.0072, abs=1e-6)


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
        (options(intrinsics=["K.txt", 481, 160, 120]), "4 numbers fx fy cx cy or a FILE.json"),
        (options(intrinsics="nowhere.json"), "nowhere.json: no such file"),
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


def test_images_of_one_name_get_folders_of_their_own(files, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = files.command(out=None)
    first = tmp_path / "runs" / "predict" / "rgb" / "grasps.json"
    assert predict.main(command) == 0
    before = first.read_bytes()
    assert predict.main(command) == 0, "the same image again writes the same folder"
    (files.folder / "second").mkdir()
    other = files.folder / "second" / "rgb.png"
    other.write_bytes((files.folder / "rgb.png").read_bytes())
    for _ in range(2):
        assert predict.main(files.command(out=None, rgb=other)) == 0
    assert first.read_bytes() == before
    names = sorted(path.name for path in first.parent.parent.iterdir())
    assert names == ["rgb", "rgb-2"]
    second = json.loads((first.parent.parent / "rgb-2" / "grasps.json").read_text())
    assert second["rgb"] == str(other)


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
