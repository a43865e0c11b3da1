"""One object from a file: known masses and inertias, units, and what no body can have."""

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from envs.object_bodies import MIN_MASS, load_object
from envs.object_meshes import ObjectError
from tests.helpers.object_files import box_moments, urdf_box, urdf_inertia


def test_mass_and_inertia_of_a_mesh_box_are_the_closed_form(tmp_path):
    box = trimesh.creation.box((0.04, 0.05, 0.06))
    box.apply_translation((1, 2, 3))
    box.export(tmp_path / "box.stl")
    model = load_object(tmp_path / "box.stl", density=500, cache_dir=tmp_path)
    assert model.mass == pytest.approx(500 * 0.04 * 0.05 * 0.06, rel=1e-4)
    a, b, c = 0.04**2, 0.05**2, 0.06**2
    closed_form = model.mass / 12 * np.array([b + c, a + c, a + b])
    assert model.inertia == pytest.approx(closed_form, rel=1e-4)  # STL has single precision
    assert np.concatenate(model.parts).mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
    assert model.extents == pytest.approx([0.04, 0.05, 0.06], abs=1e-6)


def test_a_file_called_model_has_the_name_of_its_folder(tmp_path):
    folder = tmp_path / "blue_mug"
    folder.mkdir()
    trimesh.creation.box((0.04, 0.05, 0.06)).export(folder / "model.stl")
    assert load_object(folder / "model.stl", cache_dir=tmp_path).name == "blue_mug"


def test_a_light_object_is_given_the_least_mass_and_the_inertia_that_goes_with_it(tmp_path):
    trimesh.creation.box((0.01, 0.01, 0.01)).export(tmp_path / "dice.stl")
    model = load_object(tmp_path / "dice.stl", cache_dir=tmp_path)
    assert model.mass == pytest.approx(0.02)
    assert model.inertia == pytest.approx([0.02 * 0.01**2 / 6] * 3, rel=1e-4)


@pytest.mark.parametrize("factor", [0.3, 1.0, 1.8])
def test_a_stated_mass_and_inertia_count_and_grow_with_the_size(tmp_path, factor):
    """A mass grows with the cube of the size, its inertia with the fifth power."""
    path = urdf_box(
        tmp_path, "0.4", urdf_inertia(box_moments(0.4, factor)), '<origin xyz="0.005 0 -0.01"/>'
    )
    model = load_object(path, scale=0.9, density=5000, cache_dir=tmp_path)
    assert model.mass == pytest.approx(0.4 * 0.9**3) and not model.remarks
    assert model.inertia == pytest.approx(box_moments(0.4, factor) * 0.9**5)
    middle = (np.concatenate(model.parts).max(axis=0) + np.concatenate(model.parts).min(axis=0)) / 2
    assert middle == pytest.approx(0.9 * np.array([-0.005, 0, 0.01]), abs=1e-6)


@pytest.mark.parametrize(
    ("inertia", "origin"),
    [
        ((1e-3,) * 3, ""),  # more than all of the mass in a corner would have
        ((1e-4,) * 3, ""),  # a placeholder: the box is half as high again as it is wide
        ((1.0, 1.0, 0.0), ""),  # as random_urdfs has it
        (box_moments(0.4, 0.05), ""),  # all of the mass near the middle
        ((2e-4, 5e-5, 5e-5), ""),  # more than the two others together
        (box_moments(0.4), '<origin xyz="0.1 0 0"/>'),  # a centre of mass outside
    ],
)
def test_of_an_impossible_inertia_the_mass_alone_counts(tmp_path, inertia, origin):
    path = urdf_box(tmp_path, "0.4", urdf_inertia(inertia), origin)
    model = load_object(path, cache_dir=tmp_path)
    assert model.mass == pytest.approx(0.4) and "inertia" in model.remarks[0]
    assert model.inertia == pytest.approx(box_moments(0.4))
    assert np.concatenate(model.parts).mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("moment", [math.nan, math.inf])
def test_an_inertia_that_is_no_number_is_refused(tmp_path, moment):
    path = urdf_box(tmp_path, "0.4", urdf_inertia((moment, 1e-4, 1e-4)))
    with pytest.raises(ObjectError, match="ixx of a <inertia> is"):
        load_object(path, cache_dir=tmp_path)


@pytest.mark.parametrize("mass", ["-0.1", "nan"])
def test_a_mass_that_is_none_is_refused(tmp_path, mass):
    with pytest.raises(ObjectError, match="mass of its link a|value of a <mass> is 'nan'"):
        load_object(urdf_box(tmp_path, mass, urdf_inertia(box_moments(0.4))), cache_dir=tmp_path)


def test_the_narrowest_width_of_a_turned_box_is_its_smallest_side(tmp_path):
    box = trimesh.creation.box((0.03, 0.05, 0.12))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))
    box.export(tmp_path / "box.stl")
    model = load_object(tmp_path / "box.stl", cache_dir=tmp_path)
    assert model.extents.min() > 0.05
    assert model.narrowest == pytest.approx(0.03, abs=1e-6)


@pytest.mark.parametrize(
    ("side", "scale", "advice"),
    [
        (92.0, 1.0, "0.001"),  # a mug in millimetres
        (9.2, 1.0, "0.01"),  # in centimetres
        (9.2, 0.5, "0.005"),
        (9.2e-5, 1.0, "1000"),
    ],
)
def test_a_mesh_in_another_unit_is_told_the_scale_to_try(tmp_path, side, scale, advice):
    trimesh.creation.box((0.8 * side, 0.9 * side, side)).export(tmp_path / "mug.stl")
    size = f"{side * scale:.3g}".replace("+", r"\+")
    message = f"mug.stl is {size} m long, expected .* to 3 m; .* try objects.scale={advice},"
    with pytest.raises(ObjectError, match=message) as error:
        load_object(tmp_path / "mug.stl", scale=scale, cache_dir=tmp_path)
    assert "\n" not in str(error.value)
    load_object(tmp_path / "mug.stl", scale=float(advice), cache_dir=tmp_path)


def test_a_mass_stays_that_of_the_body_where_lengths_are_millimetres(tmp_path):
    path = urdf_box(tmp_path, "0.4", urdf_inertia(box_moments(0.4)))
    text = path.read_text().replace("0.04 0.05 0.06", "40 50 60")
    path.write_text(text)
    model = load_object(path, scale=0.001, cache_dir=tmp_path)
    assert model.mass == pytest.approx(0.4) and not model.remarks
    assert model.inertia == pytest.approx(box_moments(0.4))
    half = load_object(path, scale=0.0005, cache_dir=tmp_path)
    assert half.mass == pytest.approx(0.4 / 8)


@pytest.mark.parametrize(
    ("sides", "mass", "scale"),
    [
        ((8, 3, 3), 0.5, 0.0254),  # a box in inches
        ((2.5, 2.5, 2.5), 0.03, 0.01),  # a die in centimetres, shorter than 3
        ((45, 8, 8), 2.0, 0.01),  # a long box in centimetres, which might be millimetres
        ((1.0, 0.8, 0.6), 0.4, 0.1),  # in decimetres
    ],
)
def test_a_scale_far_from_1_is_the_unit_of_the_lengths(tmp_path, sides, mass, scale):
    path = urdf_box(tmp_path, str(mass), "", sides=sides)
    model = load_object(path, scale=scale, cache_dir=tmp_path)
    assert model.mass == pytest.approx(mass)
    a, b, c = np.square(np.multiply(sides, scale))
    assert model.inertia == pytest.approx(mass / 12 * np.array([b + c, a + c, a + b]))


@pytest.mark.parametrize("scale", [0.11, 0.1, 0.05])
def test_a_scale_only_shrinks_what_makes_sense_in_metres(tmp_path, scale):
    """A chair of 40 kg/m3."""
    path = urdf_box(tmp_path, "9", "", sides=(0.5, 0.5, 0.9))
    model = load_object(path, scale=scale, cache_dir=tmp_path)
    assert model.mass == pytest.approx(max(9 * scale**3, MIN_MASS))


def test_the_unit_that_was_taken_is_named_where_no_material_is_as_dense(tmp_path):
    path = urdf_box(tmp_path, "500", "", sides=(8, 3, 3))
    with pytest.raises(ObjectError, match="in its mesh with lengths in units of 0.0254 m, exp"):
        load_object(path, scale=0.0254, cache_dir=tmp_path)


def test_an_inertia_that_is_not_stated_is_that_of_even_density_without_a_remark(tmp_path):
    model = load_object(urdf_box(tmp_path, "0.4", ""), cache_dir=tmp_path)
    assert model.mass == pytest.approx(0.4) and not model.remarks
    assert model.inertia == pytest.approx(box_moments(0.4))


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        ("0", "box.urdf .*0 kg in all"),
        ("400", "box.urdf states 400 kg, .* 3.33e\\+06 kg/m3 .* to 25000; .* in grams"),
        ("1e-5", "box.urdf states 1e-05 kg, .* 0.0833 kg/m3 .* expected 1 to .* in tonnes"),
    ],
)
def test_a_mass_that_no_body_of_that_size_has_is_refused(tmp_path, mass, message):
    path = urdf_box(tmp_path, mass, urdf_inertia(box_moments(0.4)))
    with pytest.raises(ObjectError, match=message):
        load_object(path, cache_dir=tmp_path)


def test_products_of_inertia_turn_the_axes_of_the_moments(tmp_path):
    """A rod that lies at 30 degrees in its file has the moments of one that lies straight."""
    turn = trimesh.transformations.rotation_matrix(np.pi / 6, (0, 0, 1))
    rod = trimesh.creation.box((0.2, 0.02, 0.03))
    rod.export(tmp_path / "straight.stl")
    rod.apply_transform(turn)
    rod.export(tmp_path / "turned.stl")
    straight, turned = (
        load_object(tmp_path / f"{name}.stl", density=700, cache_dir=tmp_path)
        for name in ("straight", "turned")
    )
    a, b, c = 0.2**2, 0.02**2, 0.03**2
    closed_form = np.diag(0.7 * 0.12 / 12 * np.array([b + c, a + c, a + b]))
    assert straight.principal is None
    assert np.diag(straight.inertia) == pytest.approx(closed_form, rel=1e-4)
    axes = Rotation.from_quat(turned.principal).as_matrix()
    whole = axes @ np.diag(turned.inertia) @ axes.T
    assert whole == pytest.approx(turn[:3, :3] @ closed_form @ turn[:3, :3].T, rel=1e-3, abs=1e-9)
