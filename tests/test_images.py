"""Files of a user's image, images at another pixel size and from above, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from models.photographs import WORKSPACE
from tests.helpers.photographs import BOX, GREY, RED, photographed
from utils.camera_files import intrinsics_matrix
from utils.errors import UserError
from utils.images import PixelScaling, open_image, overhead_view, read_depth, read_rgb
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


def test_16_bits_that_a_program_has_read_into_more_are_unknown_where_they_are_full(tmp_path):
    np.save(tmp_path / "depth.npy", np.array([[65535, 800], [0, 700]], np.int32))
    np.testing.assert_allclose(read_depth(tmp_path / "depth.npy", None), [[0, 0.8], [0, 0.7]])


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
