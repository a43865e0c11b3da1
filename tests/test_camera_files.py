"""A camera's intrinsics and pose, as users, drivers and calibrations write them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from utils.camera_files import read_intrinsics, read_pose
from utils.errors import UserError
from utils.transforms import look_at

OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))


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


def test_intrinsics_from_numbers_and_from_a_file_are_the_same(tmp_path):
    expected = np.array([[615.0, 0, 320], [0, 614, 240], [0, 0, 1]])
    np.testing.assert_array_equal(read_intrinsics(["615", "614", "320", "240"], 640, 480), expected)
    values = {"fx": 615, "fy": 614.0, "cx": 320, "cy": 240}
    for more in ({}, {"width": 640, "height": 480}):
        (tmp_path / "intrinsics.json").write_text(json.dumps(values | more))
        found = read_intrinsics([str(tmp_path / "intrinsics.json")], 640, 480)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ros1.json", '{"height": 480, "width": 640, "D": [0, 0, 0, 0, 0], '
         '"K": [615.0, 0, 320, 0, 614.0, 240, 0, 0, 1], "P": [9, 0, 9, 0]}'),
        ("ros2.yaml", "height: 480\nwidth: 640\nd: [0.0, 0.0]\n"
         "k: [615.0, 0.0, 320.0, 0.0, 614.0, 240.0, 0.0, 0.0, 1.0]\n"),
        ("calibration.yml", "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n"
         "  cols: 3\n  data: [615, 0, 320, 0, 614, 240, 0, 0, 1]\ndistortion_model: plumb_bob\n"
         "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.0, 0.0, 0, 0, 0]\n"),
        ("echo.yaml", "header:\n  frame_id: camera\nheight: 480\nwidth: 640\nD: [0.0]\n"
         "K: [615.0, 0.0, 320.0, 0.0, 614.0, 240.0, 0.0, 0.0, 1.0]\nbinning_x: 0\n---\n"),
        ("camera.json", '{"extrinsic": [1], "intrinsic": {"width": 640, "height": 480, '
         '"intrinsic_matrix": [615, 0, 0, 0, 614, 0, 320, 240, 1]}}'),
        ("both.json", '{"fx": 615, "K": [615, 0, 320, 0, 614, 240, 0, 0, 1]}'),
        ("open3d.json", '{"width": 640, "height": 480, '
         '"intrinsic_matrix": [615, 0, 0, 0, 614, 0, 320, 240, 1]}'),
        ("nested.json", '{"K": [[615, 0, 320], [0, 614, 240], [0, 0, 1]]}'),
        ("plain.yaml", "{fx: 615, fy: 614, cx: 320, cy: 240}"),
    ],
)  # fmt: skip
def test_intrinsics_as_ros_and_open3d_write_them(tmp_path, recwarn, name, text):
    """Their messages: CameraInfo's K and k row by row, Open3D's intrinsic_matrix by columns."""
    (tmp_path / name).write_text(text)
    found = read_intrinsics([str(tmp_path / name)], 640, 480)
    np.testing.assert_array_equal(found, [[615.0, 0, 320], [0, 614, 240], [0, 0, 1]])
    assert not recwarn.list
    if "640" in text:
        with pytest.raises(UserError, match="of an image of 640x480 pixels"):
            read_intrinsics([str(tmp_path / name)], 320, 240)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"fx": 600, "fy": 600, "cx": 160}', "has no cy"),
        ('{"K": [600, 0, 160, 0, 600, 120]}', "K: holds 6 numbers, expected the 9"),
        ('{"K": [600, 2, 160, 0, 600, 120, 0, 0, 1]}', "K: 600 2 160 .* without skew"),
        ('{"K": [600, 0, 160, 0, 600, 120, 0, 0, NaN]}', "K: holds nan, expected"),
        ("[600, 600, 160, 120]", "has no fx, fy, cx, cy"),
        ('{"fx": "a", "fy": 600, "cx": 160, "cy": 120}', "fx is 'a', expected a number"),
        ('{"fx": 600, "fy": 600, "cx": 160, "cy": 120, "width": 640, "height": 480}',
         "of an image of 640x480 pixels, the image has 320x240"),
        ('{"fx": 600, "fy": 600, "cx": 320, "cy": 120}',
         r"point \(320, 120\) lies outside the image of 320x240 pixels.*scale them"),
        ('{"fx": 600, "fy": 600, "cx": 160, "cy": -1}', "lies outside the image"),
        ("no json", "cannot be read as JSON"),
        (None, "no such file"),
    ],
)  # fmt: skip
def test_an_intrinsics_file_that_does_not_fit_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "k.json").write_text(text)
    with pytest.raises(UserError, match=message):
        read_intrinsics([str(tmp_path / "k.json")], 320, 240)


@pytest.mark.parametrize(
    "lens",
    ['"coeffs": [0.1, 0]', '"D": {"data": [[-0.2]]}', '"distortion": {"k1": 0.1}', '"k2": 1'],
)
def test_a_lens_that_distorts_is_remarked_upon(tmp_path, lens):
    (tmp_path / "k.json").write_text(f'{{"fx": 600, "fy": 600, "cx": 160, "cy": 120, {lens}}}')
    with pytest.warns(UserWarning, match="says that the lens distorts"):
        read_intrinsics([str(tmp_path / "k.json")], 320, 240)


def test_a_lens_that_does_not_distort_may_say_so(tmp_path, recwarn):
    text = '{"fx": 600, "fy": 600, "cx": 160, "cy": 120, "model": "pinhole", "coeffs": [0, 0.0]}'
    (tmp_path / "k.json").write_text(text)
    assert read_intrinsics([str(tmp_path / "k.json")], 320, 240)[0, 0] == 600
    assert not recwarn.list


@pytest.mark.parametrize("first_line", ["%YAML 1.0", "%YAML:1.0"])
def test_intrinsics_as_opencv_writes_them(tmp_path, recwarn, first_line):
    """The second first line is that of its versions before 3.2."""
    expected = np.array([[615.0, 0, 320], [0, 614, 240], [0, 0, 1]])
    path = tmp_path / "calibration.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("camera_matrix", expected)
    file.write("distortion_coefficients", np.zeros((1, 5)))
    file.release()
    _, _, rest = path.read_text().partition("\n")
    path.write_text(f"{first_line}\n{rest}")
    np.testing.assert_array_equal(read_intrinsics([str(path)], 640, 480), expected)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("K: [615", "cannot be read as YAML"),
        ("K: !!python/name:os.system", "cannot be read as YAML"),
        ("K: [" + 400 * "9" + ", 0, 160, 0, 600, 120, 0, 0, 1]", "K: holds 9.*expected a number"),
        ("K: [false, 0, 160, 0, 600, 120, 0, 0, 1]", "K: holds False, expected a number"),
        ('K: ["600", 0, 160, 0, 600, 120, 0, 0, 1]', "K: holds '600', expected a number"),
        ("K: [600, 0, x, 160, 0, 600, 120, 0, 0, 1]", "K: holds 10 numbers"),
        ("K: " + 900 * "[" + 900 * "]", "K: holds 1 numbers|cannot be read as YAML"),
        ("K: {rows: 3}", "K: holds 1 numbers"),
        ("# " + 200_000 * "x", r"^\S+k.yaml: has more than 100000 bytes"),
    ],
)
def test_a_hostile_intrinsics_file_is_one_sentence(tmp_path, text, message):
    (tmp_path / "k.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_intrinsics([str(tmp_path / "k.yaml")], 320, 240)


def test_a_pose_in_millimetres_is_refused(tmp_path):
    T_WC = OVERHEAD.copy()
    T_WC[:3, 3] = (500, 0, 800)
    np.savetxt(tmp_path / "pose.txt", T_WC)
    with pytest.raises(UserError, match="stands 943.4 m from the world's origin.* in millimetres"):
        read_pose(tmp_path / "pose.txt")


def test_the_point_may_lie_beside_an_image_whose_size_the_intrinsics_name(tmp_path):
    values = {"fx": 600, "fy": 600, "cx": 330, "cy": 120, "width": 320, "height": 240}
    (tmp_path / "k.json").write_text(json.dumps(values))
    assert read_intrinsics([str(tmp_path / "k.json")], 320, 240)[0, 2] == 330
    (tmp_path / "k.json").write_text(json.dumps(values | {"cx": 481}))
    with pytest.raises(UserError, match="far outside"):
        read_intrinsics([str(tmp_path / "k.json")], 320, 240)


@pytest.mark.parametrize(
    "text",
    [
        "T_WC: &a [1, 2]\nb: *a\n",  # an alias: nested, ten lines stand for a billion numbers
        "T_WC: " + 5000 * "[",
        "T_WC: 2020-99-99\n",
        "T_WC: !!python/object/apply:os.system [id]\n",
        "T_WC: [" + 16 * "[9e999], " + "]\n",
        20_000 * "1 ",
    ],
)
def test_a_hostile_pose_is_one_sentence(tmp_path, text):
    path = tmp_path / "pose.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="pose.yaml"):
        read_pose(path)
