"""Files of a user's image, images at another pixel size and from above, against closed forms."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from models.photographs import WORKSPACE
from tests.helpers.photographs import BOX, GREY, RED, photographed
from utils.errors import UserError
from utils.images import (
    PixelScaling,
    intrinsics_matrix,
    open_image,
    overhead_view,
    read_depth,
    read_intrinsics,
    read_pose,
    read_rgb,
)
from utils.transforms import deproject, look_at, project

OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))


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


def test_scaled_intrinsics_see_the_same_points():
    K = intrinsics_matrix([600, 560, 301, 251], 640, 480)
    scaling = PixelScaling.to_focal_length(K, 300)
    assert scaling.intrinsics(K)[0, 0] == pytest.approx(scaling.intrinsics(K)[1, 1])
    pixel = np.array([123.4, 56.7])
    point = deproject(pixel, 0.9, K, OVERHEAD)
    seen, _ = project(point, scaling.intrinsics(K), OVERHEAD)
    np.testing.assert_allclose(seen, scaling.pixels(pixel))


# --- Files ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "unit", "scale"),
    [
        ("metres.tiff", 1.0, None), ("mm.tif", 1e-3, None), ("mm.png", 1e-3, None),
        ("tenths.png", 1e-4, 1e-4), ("metres.npy", 1.0, None), ("mm.npy", 1e-3, None),
        ("metres.tiff", 1.0, 1.0),
    ],
)  # fmt: skip
def test_depth_files_of_every_kind_hold_the_same(tmp_path, name, unit, scale):
    metres = np.linspace(0.5, 0.9, 48, dtype=np.float32).reshape(6, 8)
    metres[0, :2] = 0.0
    values = metres if unit == 1.0 else np.rint(metres / unit).astype(np.uint16)
    if name.endswith(".npy"):
        np.save(tmp_path / name, values.astype(float if unit == 1.0 else np.int32)[..., None])
    else:
        Image.fromarray(values).save(tmp_path / name)
    depth = read_depth(tmp_path / name, scale)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, metres, atol=0.0006)
    assert (depth[0, :2] == 0).all()


@pytest.mark.parametrize("name", ["big.npy", "little.npy", "big.tiff", "depth.png", "depth.pgm"])
def test_the_largest_number_of_16_bits_is_unknown_in_every_file(tmp_path, name):
    millimetres, path = np.array([[500, 65535, 0], [65534, 1, 800]], np.uint16), tmp_path / name
    big = millimetres.astype(">u2")
    if path.suffix == ".npy":
        np.save(path, big if name == "big.npy" else millimetres)
    elif path.suffix == ".pgm":
        path.write_bytes(b"P5\n3 2\n65535\n" + big.tobytes())
    else:
        mode = "I;16B" if name == "big.tiff" else "I;16"
        data = big if name == "big.tiff" else millimetres
        Image.frombytes(mode, (3, 2), data.tobytes()).save(path)
    expected = [[0.5, 0, 0], [65.534, 0.001, 0.8]]
    np.testing.assert_allclose(read_depth(path), expected, rtol=1e-6)


@pytest.mark.parametrize("largest", [300, 4095, 10000, 65535])
def test_depth_in_a_pgm_is_not_stretched_to_its_largest_value(tmp_path, largest):
    millimetres = np.array([[0, 1, 299], [256, 17, 300]], ">u2")
    (tmp_path / "depth.pgm").write_bytes(b"P5\n3 2\n%d\n" % largest + millimetres.tobytes())
    np.testing.assert_allclose(read_depth(tmp_path / "depth.pgm"), millimetres / 1000, rtol=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("value", "scale"), [(1000, 1e300), (1e300, None), (1e300, 1e100)])
def test_depths_too_large_for_any_length_are_refused(tmp_path, value, scale):
    np.save(tmp_path / "depth.npy", np.full((2, 3), value))
    with pytest.raises(UserError, match="depth.npy: depths of up to .* are too large .*0.001"):
        read_depth(tmp_path / "depth.npy", scale)


def test_a_length_of_65535_is_known_where_numbers_have_more_bits(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((2, 3), 65535, np.int32))
    np.testing.assert_allclose(read_depth(tmp_path / "depth.npy", 1e-5), 0.65535)


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
         "  cols: 3\n  data: [615, 0, 320, 0, 614, 240, 0, 0, 1]\n"),
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
        ('{"K": [600, 0, 160, 0, 600, 120, 0, 0, NaN]}', "without skew"),
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


@pytest.mark.parametrize("lens", ['"coeffs": [0.1, 0]', '"D": {"data": [[-0.2]]}'])
def test_a_lens_that_distorts_is_remarked_upon(tmp_path, lens):
    (tmp_path / "k.json").write_text(f'{{"fx": 600, "fy": 600, "cx": 160, "cy": 120, {lens}}}')
    with pytest.warns(UserWarning, match="says that the lens distorts"):
        read_intrinsics([str(tmp_path / "k.json")], 320, 240)


def test_a_lens_that_does_not_distort_may_say_so(tmp_path, recwarn):
    text = '{"fx": 600, "fy": 600, "cx": 160, "cy": 120, "model": "pinhole", "coeffs": [0, 0.0]}'
    (tmp_path / "k.json").write_text(text)
    assert not recwarn.list
    assert read_intrinsics([str(tmp_path / "k.json")], 320, 240)[0, 0] == 600


def test_an_intrinsics_file_in_yaml_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "k.yaml").write_text("%YAML:1.0\nK: !!opencv-matrix\n")
    with pytest.raises(UserError, match="cannot be read as YAML"):
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


# --- From above ------------------------------------------------------------------------------


def test_the_view_from_above_shows_the_top_of_a_box_where_it_is():
    _, frame = photographed()
    view = overhead_view(frame, WORKSPACE, 0.0018)
    assert view.depth.shape == (120, 120)  # 0.22 m
    high = view.depth < 0.8 - BOX[2] + 1e-3
    v, u = np.nonzero(high)
    corners, _ = project(np.array([[-0.03, 0.08, 0.08], [0.03, -0.08, 0.08]]), view.K, view.T_WC)
    assert (u.min(), v.min()) == pytest.approx(corners[0], abs=1.5)
    assert (u.max(), v.max()) == pytest.approx(corners[1], abs=1.5)
    assert high.sum() == pytest.approx(np.prod(corners[1] - corners[0]), rel=0.05)
    assert (view.rgb[high] == RED).all()


def test_what_the_box_hides_is_bare_table():
    _, frame = photographed()
    view = overhead_view(frame, WORKSPACE, 0.0018)
    (hidden,), _ = project(np.array([[0.0, 0.1, 0.0]]), view.K, view.T_WC)  # 2 cm behind
    u, v = np.rint(hidden).astype(int)
    assert view.depth[v, u] == pytest.approx(0.8, abs=1e-3)
    assert tuple(view.rgb[v, u]) == GREY


@pytest.mark.filterwarnings("error")
def test_what_is_above_the_view_from_above_does_not_appear():
    _, frame = photographed()
    higher = frame.T_WC.copy()
    higher[2, 3] = 0.83
    frame = replace(frame, T_WC=higher)
    before = overhead_view(frame, WORKSPACE, 0.0018)
    near = frame.depth.copy()
    near[:8, :8] = 0.001  # at the photograph's camera
    view = overhead_view(replace(frame, depth=near), WORKSPACE, 0.0018)
    np.testing.assert_array_equal(view.depth, before.depth)


# --- Hostile files --------------------------------------------------------------------------------


def test_a_small_file_that_stands_for_many_pixels_is_refused(tmp_path):
    """100 million black pixels take 100 kB as PNG, and 300 MB in memory."""
    path = tmp_path / "bomb.png"
    Image.new("1", (10_000, 10_000)).save(path)
    with pytest.raises(UserError, match="bomb.png: 10000 x 10000 pixels, expected 1 to 50,000,000"):
        open_image(path)


def test_a_format_whose_reader_runs_another_program_is_refused(tmp_path):
    """Pillow hands PostScript to Ghostscript, whatever a file is called."""
    path = tmp_path / "colour.png"
    Image.new("RGB", (8, 8)).save(path, format="EPS")
    with pytest.raises(UserError, match="colour.png: not a readable image"):
        read_rgb(path)


def test_arrays_of_objects_or_of_more_numbers_than_the_file_has_are_refused(tmp_path):
    path = tmp_path / "depth.npy"
    np.save(path, np.array([print], dtype=object), allow_pickle=True)
    with pytest.raises(UserError, match="not a readable array"):
        read_depth(path)
    np.save(path, np.ones((12, 16), np.float32))
    path.write_bytes(path.read_bytes().replace(b"(12, 16), }  ", b"(10**9, 99), }"[:13]))
    with pytest.raises(UserError, match="not a readable array"):
        read_depth(path)
    np.save(path, np.ones((0, 16), np.float32))
    with pytest.raises(UserError, match=r"depth.npy"):
        read_depth(path)


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
