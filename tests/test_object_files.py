"""Object files: what is wrong with one is named in one sentence."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from envs.object_bodies import load_object
from envs.object_files import object_files, read_object
from envs.object_meshes import ObjectError, load_mesh, surface_colour
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
        (
            shape("<box size='0.1 -0.1 0.1'/>"),
            "a <box> is '0.1 -0.1 0.1', expected three .* or more",
        ),
        (shape("<cylinder radius='0.03' length='-0.05'/>"), "length of a <cylinder> is '-0.05'"),
        (shape("<sphere radius='0'/>"), "radius of a <sphere> is '0', expected a number over 0"),
        (shape("<tolerance/>"), "a <geometry> holds no box, cylinder"),
        (
            "<joint name='j'><parent link='l'/><child link='l'/></joint>",
            "every link hangs from another one",
        ),
        (2 * "<joint name='j'><parent link='l'/><child link='l'/></joint>", "link 'l' hangs from"),
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


def colour(rgba: str) -> str:
    return f'<material name="{rgba}"><color rgba="{rgba}"/></material>'


RGBA = "bad.urdf.* rgba of a <color> is '{}', expected four numbers of 0 to 1"


@pytest.mark.parametrize(
    ("mesh", "material", "message"),
    [
        (
            'filename="box.obj" scale="1 1"',
            "",
            r"bad.urdf.* scale of a <mesh> is '1 1', expected one number or three",
        ),
        ('filename="box.obj"', colour("1 0 0"), RGBA.format("1 0 0")),
        ('filename="box.obj"', colour("200 100 50 255"), RGBA.format("200 100 50 255")),
        ('filename="box.obj"', colour("0 0 -1 1"), RGBA.format("0 0 -1 1")),
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


def test_a_colour_that_cannot_be_seen_is_none(tmp_path):
    """The next one counts, opaque, or that of the name."""
    found = []
    for rest in ("", colour("0 1 0 0.5"), ""):
        path = tmp_path / "box.urdf"
        box = "<geometry><box size='0.04 0.05 0.06'/></geometry>"
        visuals = [f"<visual>{box}{one}</visual>" for one in (colour("1 0 0 0"), rest)]
        path.write_text(f"<robot name='r'><link name='l'>{''.join(visuals)}</link></robot>")
        found.append(load_object(path, cache_dir=tmp_path).color)
    assert found[1] == (0, 1, 0, 1)
    assert found[0] == found[2] != (1, 0, 0, 0) and found[0][3] == 1


def test_objects_behind_links_to_folders_are_found_once(tmp_path):
    """Also where links run in a circle, or to what is there anyway."""
    sets, chosen = tmp_path / "sets", tmp_path / "chosen"
    for folder in (sets / "mugs", chosen / "b"):
        folder.mkdir(parents=True)
        trimesh.creation.box((0.04, 0.05, 0.06)).export(folder / "box.stl")
    (chosen / "mugs").symlink_to(sets / "mugs")
    (chosen / "a").symlink_to(chosen / "b")
    (sets / "mugs" / "back").symlink_to(chosen)
    assert object_files(chosen) == [chosen / "b" / "box.stl", chosen / "mugs" / "box.stl"]


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


def test_a_textured_glb_has_the_mean_colour_of_its_texture(tmp_path):
    trimesh.load_scene(write_textured(tmp_path), process=False).export(tmp_path / "box.glb")
    expected = surface_colour(tmp_path / "box.obj")
    assert surface_colour(tmp_path / "box.glb") == pytest.approx(expected)


def numbers(text: str, start: str) -> str:
    """Those of the lines of an OBJ file that begin so."""
    found = [line.split(maxsplit=1)[1] for line in text.splitlines() if line.startswith(start)]
    return " ".join(found)


def write_dae(folder, unit=""):
    """The pyramid of `write_textured` as a DAE file."""
    write_textured(folder)
    corners = [int(one) - 1 for one in numbers(TEXTURED, "f ").replace("/", " ").split()]
    sources = "".join(
        f"""<source id="{name}"><float_array id="{name}s" count="{count * len(axes)}">
        {numbers(TEXTURED, start)}</float_array><technique_common><accessor source="#{name}s"
        count="{count}" stride="{len(axes)}">
        {"".join(f'<param name="{axis}" type="float"/>' for axis in axes)}
        </accessor></technique_common></source>"""
        for name, start, count, axes in (("place", "v ", 5, "XYZ"), ("uv", "vt ", 2, "ST"))
    )
    (folder / "box.dae").write_text(
        f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
        <asset>{unit}</asset>
        <library_images><image id="image"><init_from>picture.png</init_from></image>
        </library_images>
        <library_effects><effect id="effect"><profile_COMMON>
        <newparam sid="surface"><surface type="2D"><init_from>image</init_from></surface></newparam>
        <newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>
        <technique sid="common"><lambert><diffuse><texture texture="sampler" texcoord="UV"/>
        </diffuse></lambert></technique></profile_COMMON></effect></library_effects>
        <library_materials><material id="material"><instance_effect url="#effect"/></material>
        </library_materials>
        <library_geometries><geometry id="box"><mesh>{sources}
        <vertices id="vertices"><input semantic="POSITION" source="#place"/></vertices>
        <triangles material="symbol" count="{len(corners) // 6}">
        <input semantic="VERTEX" source="#vertices" offset="0"/>
        <input semantic="TEXCOORD" source="#uv" offset="1" set="0"/>
        <p>{" ".join(map(str, corners))}</p></triangles></mesh></geometry></library_geometries>
        <library_visual_scenes><visual_scene id="scene"><node><instance_geometry url="#box">
        <bind_material><technique_common><instance_material symbol="symbol" target="#material"/>
        </technique_common></bind_material></instance_geometry></node></visual_scene>
        </library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""
    )
    return folder / "box.dae"


def test_a_textured_dae_has_the_mean_colour_of_its_texture(tmp_path):
    path = write_dae(tmp_path)
    assert surface_colour(path) == pytest.approx(surface_colour(tmp_path / "box.obj"))


INCH = '<unit name="inch" meter="0.0254"/>'


def test_a_dae_is_as_large_as_its_unit_says(tmp_path):
    plain = load_mesh(write_dae(tmp_path)).vertices
    assert plain.min(axis=0) == pytest.approx(0) and plain.max() == pytest.approx(0.06)
    metre = load_mesh(write_dae(tmp_path, '<unit name="meter" meter="1"/>')).vertices
    assert metre.tobytes() == plain.tobytes()
    inch = load_mesh(write_dae(tmp_path, INCH)).vertices
    assert inch == pytest.approx(0.0254 * plain)
    for wrong in ("inch", "0", "-1", "nan"):
        with pytest.raises(ObjectError, match=f"box.dae states a unit of '{wrong}' metres, expec"):
            load_mesh(write_dae(tmp_path, f'<unit meter="{wrong}"/>'))


@pytest.mark.parametrize("scale", ["", "scale='30 20 20'"])
@pytest.mark.parametrize("kinds", [["visual"], ["visual", "collision"], ["visual"] * 2])
def test_a_urdf_takes_a_dae_as_large_as_its_unit_says(tmp_path, kinds, scale):
    """To grasp, and in the picture."""
    write_dae(tmp_path, INCH)
    urdf = tmp_path / "box.urdf"
    items = (
        f"<{one}><geometry><mesh filename='box.dae' {scale}/></geometry></{one}>" for one in kinds
    )
    urdf.write_text(f"<robot name='r'><link name='l'>{''.join(items)}</link></robot>")
    sides = 0.0254 * np.array([0.06, 0.04, 0.05]) * ([30, 20, 20] if scale else 1)
    assert read_object(urdf).mesh.extents == pytest.approx(sides)
    visual = load_object(urdf, cache_dir=tmp_path).fine_visual
    shown = trimesh.load_mesh(visual.path)
    assert shown.extents * visual.scale == pytest.approx(sides, rel=1e-4)


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
