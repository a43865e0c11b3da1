"""Object files: what is wrong with one is named in one sentence."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from envs.object_bodies import load_object
from envs.object_files import read_object
from envs.object_meshes import ObjectError, surface_colour
from envs.objects import load_object_set

MISSING_MESH = """<robot name="r"><link name="l"><collision><geometry>
<mesh filename="mesh/box.obj"/></geometry></collision></link></robot>"""


def shape(text: str) -> str:
    return f"<collision><geometry>{text}</geometry></collision>"


def test_what_others_read_is_read(tmp_path):
    """Commas between numbers, an empty scale, four angles, a dummy of no size, and elements
    of other programs that have the names of a URDF's."""
    write_textured(tmp_path)
    path = tmp_path / "good.urdf"
    foreign = "<mass>1</mass><box><size>1 1 1</size></box><link name='l'/><mesh/>"
    box = shape("<box size='0.04, 0.05, 0.06'/>").replace("<geo", "<origin rpy='0 0 0 1'/><geo")
    rest = shape("<cylinder radius='0' length='0.1'/>") + shape(
        "<mesh filename='box.obj' scale=''/>"
    )
    path.write_text(
        f"<robot name=''><gazebo>{foreign}</gazebo><link name='l'>{box}{rest}</link></robot>"
    )
    assert len(read_object(path).mesh.faces) >= 12


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<robot", "bad.urdf cannot be read"),
        ('<robot name="r"><link name="l"/></robot>', "bad.urdf has neither"),
        (MISSING_MESH, r"bad\.urdf: mesh .*box.obj does not exist"),
        (f"<robot name='r'>{301 * '<geometry/>'}</robot>", "301 geometries, expected at most 300"),
        ("<robot><link name='l'/></robot>", "bad.urdf is no URDF"),
        ("<sdf name='r'/>", "bad.urdf is no URDF"),
        (
            "<joint name='j'><parent link='l'/><child link='m'/></joint>",
            "the child of its joint 'j'",
        ),
        (shape("<mesh/>"), "filename of a <mesh> is '', expected a file"),
        (shape("<mesh filename='https://x.org/a.obj'/>"), "a <mesh> is 'https.*copy the mesh"),
        (shape("<cylinder radius='wide' length='0.1'/>"), "radius of a <cylinder> is 'wide'"),
        (shape("<cylinder radius='0' length='0.1'/>"), "bad.urdf has neither .* of any size"),
        (shape("<box size='0.05 0.05'/>"), "size of a <box> is '0.05 0.05', expected three"),
        (shape("<box/>"), "size of a <box> is None"),
        (shape("<mesh filename='a.obj' scale='1 0 1'/>"), "scale of a <mesh> is 0"),
        ("<contact><lateral_friction/></contact>", "value of a <lateral_friction> is None"),
        ("<inertial><mass value='heavy'/></inertial>", "value of a <mass> is 'heavy', expected a"),
        ("<inertial><inertia ixy='much'/></inertial>", "ixy of a <inertia> is 'much'"),
    ],
)
def test_a_bad_urdf_is_named(tmp_path, content, message):
    path = tmp_path / "bad.urdf"
    if not content.startswith(("<robot", "<sdf")):
        inside = content if content.startswith("<joint") else ""
        own = "" if inside else content
        content = f"<robot name='r'><link name='l'>{own}</link>{inside}</robot>"
    path.write_text(content)
    with pytest.raises(ObjectError, match=message):
        read_object(path)


COLOUR = '<material name="m"><color rgba="1 0 0"/></material>'


@pytest.mark.parametrize(
    ("mesh", "material", "message"),
    [
        (
            'filename="box.obj" scale="1 1"',
            "",
            r"bad.urdf.* scale of a <mesh> is '1 1', expected one number or three",
        ),
        ('filename="box.obj"', COLOUR, r"bad.urdf .* colour of a visual is \[1. 0. 0.\]"),
        (f'filename="{300 * "b"}.obj"', "", "b.obj does not exist"),
        (f'filename="package://{300 * "b"}/other.obj"', "", "other.obj does not exist"),
    ],
)
def test_a_bad_visual_is_named_and_can_be_skipped(tmp_path, mesh, material, message):
    write_textured(tmp_path)  # whose picture spares yourdfpy the colour
    (tmp_path / "bad.urdf").write_text(
        '<robot name="r"><link name="l"><collision><geometry><box size="0.04 0.05 0.06"/>'
        f"</geometry></collision><visual><geometry><mesh {mesh}/></geometry>{material}</visual>"
        "</link></robot>"
    )
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "good.stl")
    with pytest.raises(ObjectError, match=message):
        read_object(tmp_path / "bad.urdf")
    objects = load_object_set(str(tmp_path), cache_dir=tmp_path / "cache", skip_broken=True)
    with pytest.warns(UserWarning, match=message):
        assert objects[0].name != "bad"


def test_a_urdf_with_collision_geometry_alone_is_shown_by_it(tmp_path):
    """The body of the table's picture is the box that collides."""
    (tmp_path / "box.urdf").write_text(
        '<robot name="r"><link name="l"><collision><geometry><box size="0.04 0.05 0.06"/>'
        "</geometry></collision></link></robot>"
    )
    visual = load_object(tmp_path / "box.urdf", cache_dir=tmp_path).fine_visual
    mesh = trimesh.load_mesh(visual.path)
    assert mesh.extents * visual.scale == pytest.approx([0.04, 0.05, 0.06])


TEXTURED = """mtllib box.mtl
v 0 0 0
v 0.06 0 0
v 0.06 0.04 0
v 0 0.04 0
v 0.03 0.02 0.05
vt 0.25 0.5
vt 0.75 0.5
usemtl picture
f 1/1 3/1 2/1
f 1/1 4/1 3/1
f 1/2 2/2 5/2
f 2/2 3/2 5/2
f 3/2 4/2 5/2
f 4/2 1/2 5/2
"""


def write_textured(folder, image="map_Kd picture.png"):
    """A pyramid whose base shows the left half of a picture, red, and whose sides the right one."""
    (folder / "box.obj").write_text(TEXTURED)
    (folder / "box.mtl").write_text(f"newmtl picture\n{image}\n")
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, :4], picture[:, 4:] = (200, 0, 0), (0, 0, 100)
    Image.fromarray(picture).save(folder / "picture.png")
    return folder / "box.obj"


# Of the base, and of two sides each: their heights are the root of 0.05^2 + 0.02^2 or + 0.03^2.
BASE = 0.06 * 0.04
SIDES = 0.06 * np.hypot(0.05, 0.02) + 0.04 * np.hypot(0.05, 0.03)


def test_an_object_has_the_mean_colour_of_its_texture(tmp_path):
    """Weighted by the surface that shows it, by hand."""
    red, blue = 200 / 255 * BASE / (BASE + SIDES), 100 / 255 * SIDES / (BASE + SIDES)
    path = write_textured(tmp_path)
    assert load_object(path, cache_dir=tmp_path).color == pytest.approx((red, 0, blue, 1))
    urdf = tmp_path / "white.urdf"
    urdf.write_text(
        '<robot name="r"><link name="l"><visual><geometry><mesh filename="box.obj"/></geometry>'
        '<material name="m"><color rgba="1 1 1 1"/></material></visual></link></robot>'
    )
    assert load_object(urdf, cache_dir=tmp_path).color == pytest.approx((red, 0, blue, 1))


def test_an_object_has_the_colour_of_its_faces(tmp_path):
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    mesh.visual.face_colors = (51, 102, 153, 255)
    mesh.export(tmp_path / "box.ply")
    colour = load_object(tmp_path / "box.ply", cache_dir=tmp_path).color
    assert colour == pytest.approx((0.2, 0.4, 0.6, 1))


def test_an_object_has_the_colour_of_its_material(tmp_path):
    path = write_textured(tmp_path, "Kd 0.8 0.2 0.4")
    colour = load_object(path, cache_dir=tmp_path).color
    assert colour == pytest.approx((0.8, 0.2, 0.4, 1), abs=1 / 255)


def test_a_part_counts_as_large_as_it_stands_in_the_scene(tmp_path):
    """Two cubes alike, a red one scaled to 2 cm and a blue one to 6: nine times the surface."""
    scene = trimesh.Scene()
    for colour, side in (((255, 0, 0, 255), 0.02), ((0, 0, 255, 255), 0.06)):
        cube = trimesh.creation.box((1, 1, 1))
        cube.visual.face_colors = colour
        scene.add_geometry(cube, transform=np.diag([side, side, side, 1.0]))
    scene.export(tmp_path / "cubes.glb")
    assert surface_colour(tmp_path / "cubes.glb") == pytest.approx((0.1, 0, 0.9, 1))


def test_coordinates_of_a_texture_that_is_not_there_say_nothing_of_a_colour(tmp_path):
    path = write_textured(tmp_path)
    path.write_text(
        "\n".join(line for line in TEXTURED.splitlines() if "mtl" not in line), encoding="utf-8"
    )
    urdf = tmp_path / "red.urdf"
    urdf.write_text(
        '<robot name="r"><link name="l"><visual><geometry><mesh filename="box.obj"/></geometry>'
        '<material name="m"><color rgba="0.9 0.1 0.1 1"/></material></visual></link></robot>'
    )
    assert load_object(urdf, cache_dir=tmp_path).color == pytest.approx((0.9, 0.1, 0.1, 1))


@pytest.mark.parametrize("broken", ["", "map_Kd nowhere.png", "map_Kd box.obj", "Kd red"])
def test_a_picture_that_cannot_be_read_leaves_the_colour_of_the_name(tmp_path, broken):
    path = write_textured(tmp_path, broken)
    plain = tmp_path / "plain" / "box.obj"
    plain.parent.mkdir()
    trimesh.creation.box((0.04, 0.05, 0.06)).export(plain)
    colour = load_object(plain, cache_dir=tmp_path).color
    assert load_object(path, cache_dir=tmp_path).color == colour
