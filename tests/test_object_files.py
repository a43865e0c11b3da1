"""Object files: what is wrong with one is named in one sentence."""

import pytest
import trimesh

from envs.object_bodies import load_object
from envs.object_files import read_object
from envs.object_meshes import ObjectError

MISSING_MESH = """<robot name="r"><link name="l"><collision><geometry>
<mesh filename="mesh/box.obj"/></geometry></collision></link></robot>"""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<robot", "bad.urdf cannot be read"),
        ('<robot name="r"><link name="l"/></robot>', "bad.urdf has neither"),
        (MISSING_MESH, "box.obj does not exist"),
        (f"<robot name='r'>{301 * '<geometry/>'}</robot>", "301 geometries, expected at most 300"),
    ],
)
def test_a_bad_urdf_is_named(tmp_path, content, message):
    path = tmp_path / "bad.urdf"
    path.write_text(content)
    with pytest.raises(ObjectError, match=message):
        read_object(path)


def test_a_urdf_with_collision_geometry_alone_is_shown_by_it(tmp_path):
    """The body of the table's picture is the box that collides."""
    (tmp_path / "box.urdf").write_text(
        '<robot name="r"><link name="l"><collision><geometry><box size="0.04 0.05 0.06"/>'
        "</geometry></collision></link></robot>"
    )
    visual = load_object(tmp_path / "box.urdf", cache_dir=tmp_path).fine_visual
    mesh = trimesh.load_mesh(visual.path)
    assert mesh.extents * visual.scale == pytest.approx([0.04, 0.05, 0.06])
