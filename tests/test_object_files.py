"""Object files: what is wrong with one is named in one sentence."""

import pytest

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
    ],
)
def test_a_bad_urdf_is_named(tmp_path, content, message):
    path = tmp_path / "bad.urdf"
    path.write_text(content)
    with pytest.raises(ObjectError, match=message):
        read_object(path)
