"""Files in MJCF: masses and inertias by hand, the same as from a URDF, and one sentence for each
fault."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from envs.mujoco_files import read_mjcf, referred_files
from envs.object_bodies import load_object
from envs.object_files import object_files
from envs.object_meshes import ObjectError
from envs.object_primitives import FAMILIES, make_primitive
from tests.helpers.object_files import SIDES, box_moments

BOX = '<geom type="box" size="0.02 0.025 0.03" {}/>'  # half of SIDES
VOLUME = float(np.prod(SIDES))


def write(folder: Path, body: str, before: str = "", name: str = "thing.xml") -> Path:
    """A file in MJCF of one body with this content."""
    path = folder / name
    path.write_text(
        f"<mujoco>{before}<worldbody><body><freejoint/>{body}</body></worldbody></mujoco>"
    )
    return path


def load(folder: Path, body: str, before: str = "", **settings):
    return load_object(write(folder, body, before), cache_dir=folder / "cache", **settings)


# --- Mass and inertia -----------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 0.9])
def test_a_density_is_that_of_a_box(tmp_path, scale):
    model = load(tmp_path, BOX.format('density="500"'), scale=scale, density=5000)
    assert model.mass == pytest.approx(500 * VOLUME * scale**3)
    assert model.inertia == pytest.approx(box_moments(500 * VOLUME) * scale**5)
    assert model.extents == pytest.approx(np.multiply(SIDES, scale)) and not model.remarks


@pytest.mark.parametrize(
    ("stated", "density"),
    [('density="300"', 300), ('mass="0.036"', 300), ('density="2e8"', None)],
)
def test_a_density_counts_as_it_stands_where_lengths_are_millimetres(tmp_path, stated, density):
    geom = f'<geom type="box" size="20 25 30" {stated}/>'
    if density is None:
        with pytest.raises(ObjectError, match="states densities, which make 2e[+]08 kg/m3"):
            load(tmp_path, geom, scale=0.001)
        return
    model = load(tmp_path, geom, scale=0.001)
    assert model.mass == pytest.approx(density * VOLUME)
    assert model.inertia == pytest.approx(box_moments(density * VOLUME))


def test_fit_scales_mass_and_inertia(tmp_path):
    model = load(tmp_path, BOX.format('mass="0.4"'), fit=0.04)  # its middle side is 5 cm
    assert model.mass == pytest.approx(0.4 * 0.8**3)
    assert model.inertia == pytest.approx(box_moments(0.4) * 0.8**5)


def test_two_geoms_are_one_body(tmp_path):
    """A cube of 2 cm, 0.3 kg, on the box, 0.1 kg: by the parallel axis theorem. A body without a
    joint is a part of the one that holds it."""
    cube = '<geom type="box" size="0.01 0.01 0.01" mass="0.3"/>'
    for on_top in (f'<body pos="0 0 0.04">{cube}</body>', cube.replace("/", ' pos="0 0 0.04"/')):
        model = load(tmp_path, BOX.format('mass="0.1"') + on_top)
        centre = 0.3 * 0.04 / 0.4
        sideways = 0.1 * centre**2 + 0.3 * (0.04 - centre) ** 2
        own = box_moments(0.1) + 0.3 * 0.02**2 / 6
        assert model.mass == pytest.approx(0.4)
        assert model.inertia == pytest.approx(own + [sideways, sideways, 0])
        assert np.concatenate(model.parts)[:, 2].max() == pytest.approx(0.05 - centre)


@pytest.mark.parametrize("factor", [0.3, 1.0, 1.8])
def test_an_inertial_counts_whatever_the_geoms_weigh(tmp_path, factor):
    moments = " ".join(map(str, box_moments(0.4, factor)))
    inertial = f'<inertial pos="0.005 0 -0.01" mass="0.4" diaginertia="{moments}"/>'
    model = load(tmp_path, BOX.format('mass="3"') + inertial, scale=0.9)
    assert model.mass == pytest.approx(0.4 * 0.9**3) and not model.remarks
    assert model.inertia == pytest.approx(box_moments(0.4, factor) * 0.9**5)
    middle = (np.concatenate(model.parts).max(axis=0) + np.concatenate(model.parts).min(axis=0)) / 2
    assert middle == pytest.approx(0.9 * np.array([-0.005, 0, 0.01]), abs=1e-6)


@pytest.mark.parametrize("moments", ["1e-3 1e-3 1e-3", "2e-4 5e-5 5e-5", "0 0 0"])
def test_an_impossible_inertia_is_that_of_even_density(tmp_path, moments):
    inertial = f'<inertial pos="0 0 0" mass="0.4" diaginertia="{moments}"/>'
    model = load(tmp_path, BOX.format("") + inertial)
    assert model.mass == pytest.approx(0.4) and "inertia" in model.remarks[0]
    assert model.inertia == pytest.approx(box_moments(0.4))


def test_what_collides_with_nothing_has_the_mass_that_it_states_and_no_other(tmp_path):
    visual = BOX.format('contype="0" conaffinity="0" {}')
    assert load(tmp_path, BOX.format("") + visual.format("")).mass == pytest.approx(700 * VOLUME)
    for massless in ('mass="0"', 'density="0"', ""):
        model = load(tmp_path, BOX.format('mass="0.2"') + visual.format(massless))
        assert model.mass == pytest.approx(0.2)
    model = load(tmp_path, BOX.format('mass="0.2"') + visual.format('mass="0.1"'))
    assert model.mass == pytest.approx(0.3)


def test_the_density_fills_in_only_what_is_open(tmp_path):
    """MuJoCo's own 1000 kg/m3 never counts; where nothing is stated, overlaps count once."""
    turned = '<geom type="box" size="0.02 0.025 0.03" pos="0.02 0 0"/>'
    model = load(tmp_path, BOX.format("") + turned, density=800)
    assert model.mass == pytest.approx(800 * 1.5 * VOLUME)
    model = load(tmp_path, BOX.format('mass="0.1"') + turned, density=800)
    assert model.mass == pytest.approx(0.1 + 800 * VOLUME)
    for classes in (
        '<default><geom density="300"/></default>',
        '<default class="main"><geom density="200"/><default class="part">'
        '<geom density="300"/></default></default>',
    ):
        inside = BOX.format('class="part"' if "part" in classes else "")
        assert load(tmp_path, inside, classes).mass == pytest.approx(300 * VOLUME)
    total = '<compiler settotalmass="0.5"/>'
    assert load(tmp_path, BOX.format(""), total).mass == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("sphere", "0.03", 4 / 3 * np.pi * 0.03**3),
        ("cylinder", "0.03 0.04", np.pi * 0.03**2 * 0.08),
        ("capsule", "0.02 0.03", np.pi * 0.02**2 * 0.06 + 4 / 3 * np.pi * 0.02**3),
        ("ellipsoid", "0.02 0.03 0.04", 4 / 3 * np.pi * 0.02 * 0.03 * 0.04),
    ],
)
def test_round_geoms_are_solids(tmp_path, kind, size, volume):
    """MuJoCo weighs them exactly; what collides is a solid of few faces."""
    geom = f'<geom type="{kind}" size="{size}" density="1000" friction="0.4"/>'
    model = load(tmp_path, geom)
    assert model.mass == pytest.approx(1000 * volume) and model.friction == pytest.approx(0.4)
    hull = trimesh.convex.convex_hull(np.concatenate(model.parts))
    assert 0.9 * volume < hull.volume < volume


# --- The same as a URDF ---------------------------------------------------------------------------


def test_a_urdf_and_an_mjcf_of_one_body_are_one_object(tmp_path):
    """Two turned geoms of meshes, an inertial, friction, colour, and a visual mesh."""
    (tmp_path / "parts").mkdir()
    for name, sides in {"low": (4, 5, 2), "high": (2, 2, 4), "shown": (4, 5, 6)}.items():
        trimesh.creation.box(sides).export(tmp_path / "parts" / f"{name}.obj")
    turn = Rotation.from_euler("xyz", (0, 0, 0.3)).as_quat(scalar_first=True)
    (tmp_path / "thing.urdf").write_text(
        """<robot name="t"><link name="a"><contact><lateral_friction value="0.4"/></contact>
<inertial><origin xyz="0.002 0 0.01"/><mass value="0.3"/>
  <inertia ixx="1.1e-4" iyy="1.2e-4" izz="9e-5"/></inertial>
<visual><origin xyz="0 0 0.01" rpy="0 0 0.3"/>
  <geometry><mesh filename="parts/shown.obj" scale="0.01 0.01 0.01"/></geometry>
  <material name="m"><color rgba="0 1 0 1"/></material></visual>
<collision><origin xyz="0 0 0.01" rpy="0 0 0.3"/>
  <geometry><mesh filename="parts/low.obj" scale="0.01 0.01 0.01"/></geometry></collision>
<collision><origin xyz="0.005 0 0.04" rpy="0 0 0.3"/>
  <geometry><mesh filename="parts/high.obj" scale="0.01 0.01 0.01"/></geometry></collision>
</link></robot>"""
    )
    pose = f'quat="{" ".join(map(str, turn))}" type="mesh"'
    mjcf = write(
        tmp_path,
        f"""<inertial pos="0.002 0 0.01" mass="0.3" diaginertia="1.1e-4 1.2e-4 9e-5"/>
<geom class="visual" mesh="shown" pos="0 0 0.01" {pose} material="green"/>
<geom mesh="low" pos="0 0 0.01" {pose}/><geom mesh="high" pos="0.005 0 0.04" {pose}/>""",
        """<compiler meshdir="parts"/>
<default><geom friction="0.4 0.01 0.001"/><mesh scale="0.01 0.01 0.01"/>
<default class="visual"><geom contype="0" conaffinity="0" group="2"/></default></default>
<asset><mesh file="low.obj"/><mesh name="high" file="high.obj"/><mesh file="shown.obj"/>
<texture name="t" type="2d" file="missing.png"/>
<material name="green" rgba="0 1 0 1" texture="t"/></asset>""",
    )
    one, other = (
        load_object(path, cache_dir=tmp_path / "cache") for path in (tmp_path / "thing.urdf", mjcf)
    )
    assert one.remarks == other.remarks == ()
    assert one.mass == pytest.approx(other.mass) and one.friction == other.friction
    assert one.color == other.color and one.name == other.name
    np.testing.assert_allclose(one.inertia, other.inertia, rtol=1e-6)
    np.testing.assert_allclose(one.extents, other.extents, atol=1e-7)
    assert len(one.parts) == len(other.parts) == 2
    corners = [
        sorted(tuple(np.round(corner, 6) + 0.0) for part in model.parts for corner in part)
        for model in (one, other)
    ]
    np.testing.assert_allclose(*corners, atol=2e-6)
    assert one.fine_visual.path == other.fine_visual.path
    vertices = trimesh.load_mesh(one.fine_visual.path).vertices
    shown = [
        Rotation.from_quat(visual.quaternion).apply(visual.scale * vertices) + visual.position
        for visual in (one.fine_visual, other.fine_visual)
    ]
    np.testing.assert_allclose(*shown, atol=1e-7)


def test_convex_pieces_of_a_mug_leave_it_hollow(tmp_path):
    parts = make_primitive(FAMILIES.index("mug")).parts
    names = [f"piece_{number}" for number in range(len(parts))]
    for name, part in zip(names, parts):
        trimesh.convex.convex_hull(part).export(tmp_path / f"{name}.stl")
    assets = "".join(f'<mesh file="{name}.stl"/>' for name in names)
    body = "".join(f'<geom type="mesh" mesh="{name}" density="900"/>' for name in names)
    model = load(tmp_path, body, f"<asset>{assets}</asset>")
    volume = sum(trimesh.convex.convex_hull(part).volume for part in parts)
    assert model.mass == pytest.approx(900 * volume, rel=1e-4)
    held = sum(trimesh.convex.convex_hull(part).volume for part in model.parts)
    assert held == pytest.approx(volume, rel=0.07)
    assert trimesh.convex.convex_hull(np.concatenate(parts)).volume > 2 * volume


def test_geometry_without_collision_is_solid_and_a_mesh_with_a_frame_is_drawn_in_it(tmp_path):
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "box.obj")
    model = load(
        tmp_path,
        '<geom type="mesh" mesh="box" contype="0" conaffinity="0" rgba="1 0 0 1"/>'
        '<geom type="box" size="1 1 1" contype="0" conaffinity="0" rgba="0 0 1 0"/>',  # invisible
        '<asset><mesh file="box.obj" refpos="0.02 0 0"/></asset>',
    )
    assert model.mass == pytest.approx(700 * VOLUME) and model.color == (1, 0, 0, 1)
    drawn = trimesh.load_mesh(model.fine_visual.path).bounds + model.fine_visual.position
    assert drawn == pytest.approx(np.array([[-0.5], [0.5]]) * SIDES, abs=1e-6)


@pytest.mark.parametrize("where", ["geom", "material"])
def test_a_geom_that_cannot_be_seen_gives_no_colour_and_no_picture(tmp_path, where):
    rgba = 'rgba="1 0 0 0"'
    assets = f'<asset><material name="clear" {rgba if where == "material" else ""}/></asset>'
    clear = 'material="clear"' if where == "material" else rgba
    hidden = f'<geom type="box" size="1 1 1" contype="0" conaffinity="0" {clear}/>'
    model = load(tmp_path, BOX.format('rgba="0 0 1 0.5"') + hidden, assets)
    assert model.color == (0, 0, 1, 1)
    shown = trimesh.load_mesh(model.fine_visual.path)
    assert shown.extents == pytest.approx(SIDES, abs=1e-6)
    assert load(tmp_path, BOX.format(clear), assets).color[3] == 1


# --- Folders --------------------------------------------------------------------------------------


def test_a_folder_lists_the_files_that_no_other_one_names(tmp_path):
    (tmp_path / "mug" / "meshes").mkdir(parents=True)
    for name in ("body", "handle"):
        trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "mug" / "meshes" / f"{name}.stl")
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "mug" / "other.stl")
    (tmp_path / "mug" / "assets.xml").write_text(
        '<mujoco><compiler assetdir="meshes"/><asset><mesh file="body.stl"/></asset></mujoco>'
    )
    (tmp_path / "mug" / "package.xml").write_text("<package/>")
    geoms = '<geom type="mesh" mesh="body"/><geom type="mesh" mesh="handle" pos="0.04 0 0"/>'
    mug = write(
        tmp_path / "mug",
        geoms,
        '<include file="assets.xml"/><asset><mesh file="handle.stl"/></asset>',
        "mug.xml",
    )
    assert object_files(tmp_path) == [mug, tmp_path / "mug" / "other.stl"]
    assert {file.name for file in referred_files(mug)} == {"assets.xml", "body.stl", "handle.stl"}
    assert read_mjcf(mug, 700).mesh.volume == pytest.approx(2 * VOLUME)


def test_a_folder_of_sdf_alone_says_how_to_convert_it(tmp_path):
    (tmp_path / "model.sdf").write_text("<sdf/>")
    with pytest.raises(ObjectError, match="holds no object; .* .SDF becomes MJCF by sdf2mjcf"):
        object_files(tmp_path)


# --- What is refused ------------------------------------------------------------------------------

BALL = "<body><geom size='0.03'/></body>"  # MuJoCo's default geom is a sphere
MESH = "<geom type='mesh' mesh='m'/>"
ASSET = "<asset><mesh name='m' {}/></asset>"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<mujoco", "thing.xml cannot be read"),
        ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco/>', "document type"),
        ("<sdf/>", "root is <sdf>, expected <mujoco>"),
        ("<mujoco/>", "0 bodies"),
        (f"<mujoco><worldbody>{BALL}{BALL}</worldbody></mujoco>", "2 bodies and 0 geoms"),
        (f"<mujoco><worldbody>{BALL}<geom size='1'/></worldbody></mujoco>", "1 bodies and 1 geoms"),
        ("<mujoco>" + 100_000 * "<a>" + 100_000 * "</a>" + "</mujoco>", "0 bodies"),
    ],
)
def test_what_is_no_body_is_named(tmp_path, content, message):
    path = tmp_path / "thing.xml"
    path.write_text(content)
    with pytest.raises(ObjectError, match=message) as error:
        read_mjcf(path, 700)
    assert "\n" not in str(error.value) and "thing.xml" in str(error.value)


@pytest.mark.parametrize(
    ("body", "before", "message"),
    [
        ("", "", "neither collision nor visual"),
        (f"<joint name='hinge'/>{BOX}", "", "joint 'hinge' lets parts move"),
        (f"{BOX}<body><joint/>{BOX}</body>", "", "joint '' lets parts move"),
        ("<geom type='plane' size='1 1 1' name='floor'/>", "", "'floor' is a plane"),
        (f"<replicate count='1000000000'>{BOX}</replicate>", "", "<replicate>, expected body"),
        (MESH, ASSET.format("builtin='sphere' params='9'"), "builtin mesh"),
        (MESH, ASSET.format("file='m.obj'"), "m.obj does not exist"),
        (MESH, ASSET.format("file='../m.obj'"), "names ../m.obj, which is outside"),
        (MESH, ASSET.format("file='/m.obj'"), "names /m.obj, which is outside"),
        (MESH, "", "mesh 'm' not found"),
        (2001 * BALL, "", "2,001 geoms"),
        (BOX, "<include file='other.xml'/>", "other.xml cannot be read"),
        (BOX, "<include file='../other.xml'/>", "outside its folder"),
        (BOX, "<include file='thing.xml'/>", "includes thing.xml twice"),
        (BOX, "<compiler autolimits='often'/>", "invalid keyword"),
        ("<geom size='nan'/>", "", "nan size"),
        ("<geom size='0.03' mass='nan'/>", "", "holds a NaN"),
        ("<geom size='0.03' mass='-1'/>", "", "negative"),
        ("<geom size='0.03' mass='0'/>", "", "0 kg in all"),
        ("<geom size='0.03' friction='-1'/>", "", "friction is -1"),
        (f"{BOX}<inertial pos='0 0 0' mass='-1' diaginertia='1 1 1'/>", "", "mass of its body"),
    ],
)
def test_a_bad_body_is_one_sentence(tmp_path, monkeypatch, body, before, message):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, body.replace("{}", ""), before)
    with pytest.raises(ObjectError, match=message) as error:
        read_mjcf(path, 700)
    assert "\n" not in str(error.value)
    assert [file.name for file in tmp_path.iterdir()] == ["thing.xml"], "MuJoCo writes no log"
