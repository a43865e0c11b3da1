"""The Panda's description: masses, shapes beside pybullet_data's meshes, and both simulators."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.show_robot import directions, stock_hulls, support
from envs.panda_model import ARM_LINKS, FINGERS, HAND, INERTIALS, panda_links
from envs.panda_urdf import welded, write_panda
from utils.geometry import ConvexSolid, GripperGeometry, intersect_lines
from utils.transforms import transform_points

GRIPPER = GripperGeometry()
LINKS = {link.name: link for link in panda_links(GRIPPER)}
WELDED = {link.name: link for link in welded(panda_links(GRIPPER))}
TIP = 0.1122  # m from the hand's frame to the fingertips


# --- Masses ---------------------------------------------------------------------------------------


def test_masses():
    """Franka's data sheet says about 18 kg with the base; the moving links are 16.06 of them."""
    assert sum(INERTIALS[name].mass for name in ARM_LINKS) == pytest.approx(16.06, abs=0.01)
    assert INERTIALS[HAND].mass == 0.73  # product manual of the Franka Hand


@pytest.mark.parametrize("name", INERTIALS)
def test_inertias_are_of_real_bodies(name):
    small, middle, large = np.linalg.eigvalsh(INERTIALS[name].tensor())
    assert small > 0
    assert large <= small + middle + 1e-12


def test_a_welded_body_has_the_momentum_of_its_parts():
    """Angular momentum about the last arm link's origin at a turn rate, summed over the parts."""
    turn = np.array([0.3, -1.1, 0.7])

    def momentum(inertial, T) -> np.ndarray:
        centre, R = transform_points(T, np.array(inertial.centre)), T[:3, :3]
        own = R @ inertial.tensor() @ R.T @ turn
        return own + inertial.mass * np.cross(centre, np.cross(turn, centre))

    last, whole = ARM_LINKS[-1], WELDED[ARM_LINKS[-1]].inertial
    parts = momentum(INERTIALS[last], np.eye(4)) + momentum(INERTIALS[HAND], LINKS[HAND].T)
    np.testing.assert_allclose(momentum(whole, np.eye(4)), parts, atol=1e-12)
    assert whole.mass == pytest.approx(INERTIALS[last].mass + INERTIALS[HAND].mass)


# --- Shapes ---------------------------------------------------------------------------------------


def solid(name: str) -> ConvexSolid:
    (hull,) = LINKS[name].hulls()
    return ConvexSolid.from_vertices(hull)


@pytest.fixture(scope="module")
def stock() -> dict[str, np.ndarray]:
    pytest.importorskip("pybullet_data")
    return stock_hulls()


def test_arm_links_lie_within_a_centimetre_of_the_stock_meshes(stock):
    D = directions(5000, seed=1)
    for link in LINKS.values():
        for shape in link.shapes:
            off = support(shape.hull, D) - support(stock[shape.part], D)
            assert off.min() > -0.008 and off.max() < 0.007, shape.part


def test_the_palm_lies_within_a_millimetre_of_the_stock_mesh(stock):
    """Where it can touch an object: up to 0.11 m above the tips. The mesh itself is 0.6 mm off its
    own mirror image, which the real hand equals."""
    D = directions(5000, seed=1)
    (hull,) = LINKS[HAND].hulls()
    low = stock["hand"][(D @ stock["hand"].T).argmax(axis=1), 2] > TIP - 0.11
    off = (support(hull, D) - support(stock["hand"], D))[low]
    assert abs(off).max() < 0.0007
    assert np.sqrt((off**2).mean()) < 0.0003


def test_fingers_are_the_stock_mesh_with_a_straight_pad(stock):
    """A tenth of a millimetre where objects are touched; 0.6 mm where the mesh is not symmetric."""
    (hull,) = LINKS[FINGERS[0]].hulls()
    axes = np.vstack([np.eye(3), -np.eye(3)])[[0, 2, 3, 4]]  # both sides, tip, pad
    D = np.vstack([directions(5000, seed=1), axes])
    off = support(hull, D) - support(stock["finger"], D)
    assert abs(off[-4:]).max() < 1.4e-4  # the mesh's pads reach 0.13 mm beyond their middle plane
    assert abs(off).max() < 0.0006


def test_the_fingertips_by_hand():
    """Flat pads 17.4 mm wide and 17.6 mm high that meet when the hand is closed; the right finger
    is the left one after half a turn; tips 0.1122 m below the hand's frame, 7.2 mm below E."""
    (left,), (right,) = (LINKS[name].hulls() for name in FINGERS)
    np.testing.assert_allclose(left.min(axis=0), [-0.0105, 0, 0], atol=1e-9)
    np.testing.assert_allclose(left.max(axis=0), [0.0105, 0.0264, 0.0538], atol=1e-9)
    pad = left[np.isclose(left[:, 1], 0)]
    assert np.ptp(pad[:, 0]) == pytest.approx(0.0174) and np.ptp(pad[:, 2]) == pytest.approx(0.0176)
    np.testing.assert_allclose(right, left * (-1, -1, 1), atol=1e-9)
    assert LINKS[FINGERS[0]].T[2, 3] + 0.0538 == pytest.approx(TIP)


def test_the_gripper_that_planners_know_is_the_hand_of_the_simulators():
    """The undersides of `GripperGeometry`, looked at from below on a grid of points."""
    across, along = (
        axis.ravel()
        for axis in np.meshgrid(np.linspace(-0.0316, 0.0316, 41), np.linspace(-0.1, 0.1, 201))
    )
    columns = np.column_stack([across, along, 0 * across])
    base = LINKS[FINGERS[0]].T[2, 3]
    for name, offset, claimed in (
        (FINGERS[0], base, GRIPPER.finger_underside(np.maximum(along, 0))),
        (HAND, 0.0, GRIPPER.palm_underside(across)),
    ):
        hits = intersect_lines(solid(name), columns, (0.0, 0.0, 1.0))
        true = TIP - offset - hits.leave
        assert (claimed[hits.hit] - true[hits.hit]).max() < 0.0004  # nowhere above the shape
        middle = hits.hit & (abs(across) < 0.005) & (abs(along) < 0.08)
        np.testing.assert_allclose(claimed[middle], true[middle], atol=0.0006)


def test_a_wider_hand_opens_wider():
    for opening in (0.04, 0.08, 0.10):
        wide = panda_links(GripperGeometry(max_opening=opening))
        limits = [link.joint.upper for link in wide if link.name in FINGERS]
        assert limits == [opening / 2, opening / 2]


# --- Simulators -----------------------------------------------------------------------------------


def in_mujoco(folder: Path) -> dict[str, list[np.ndarray]]:
    """Vertices (V, 3) of each link's collision shapes in its frame, as MuJoCo has compiled them."""
    mujoco = pytest.importorskip("mujoco")
    from envs.mujoco_panda import panda_spec

    model = panda_spec(GRIPPER).compile()
    found = {}
    for geom in range(model.ngeom):
        assert model.geom_contype[geom] and model.geom_conaffinity[geom]
        assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        mesh = model.mesh(model.geom_dataid[geom])
        begin, count = mesh.vertadr[0], mesh.vertnum[0]
        w, x, y, z = model.geom_quat[geom]
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        vertices = model.mesh_vert[begin : begin + count] @ R.T + model.geom_pos[geom]
        found.setdefault(model.body(model.geom_bodyid[geom]).name, []).append(vertices)
    # PyBullet has hand and last arm link as one.
    flange = [transform_points(LINKS[HAND].T, hull) for hull in found.pop(HAND)]
    found[ARM_LINKS[-1]] += flange
    return found


def in_pybullet(folder: Path) -> dict[str, list[np.ndarray]]:
    """The same as PyBullet has loaded them."""
    pybullet = pytest.importorskip("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(
        str(write_panda(folder, GRIPPER)), useFixedBase=True,
        flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client,
    )  # fmt: skip
    found = {}
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getBodyInfo(body, physicsClientId=client)[0]
        if link >= 0:
            info = pybullet.getJointInfo(body, link, physicsClientId=client)[12]
        inertial = pybullet.getDynamicsInfo(body, link, physicsClientId=client)[3:5]
        for shape in pybullet.getCollisionShapeData(body, link, physicsClientId=client):
            *_, kind, _, file, position, quaternion = shape
            assert kind == pybullet.GEOM_MESH
            lines = Path(file.decode()).read_text().splitlines()
            vertices = np.array([line.split()[1:] for line in lines if line[0] == "v"], dtype=float)
            for p, q in ((position, quaternion), inertial):  # shape to centre of mass to link
                vertices = Rotation.from_quat(q).apply(vertices) + p
            found.setdefault(info.decode(), []).append(vertices)
    pybullet.disconnect(physicsClientId=client)
    return found


@pytest.mark.parametrize("simulator", [in_mujoco, in_pybullet])
def test_simulators_have_these_shapes(simulator, tmp_path):
    """The same support function in 100 directions for every link, so also as each other."""
    D = directions(100, seed=2)
    found = simulator(tmp_path)
    assert found.keys() == WELDED.keys()
    for name, link in WELDED.items():
        assert len(found[name]) == len(link.shapes)
        for ours, theirs in zip(link.hulls(), found[name]):
            np.testing.assert_allclose(support(theirs, D), support(ours, D), atol=2e-6)


def test_files_are_written_once_and_never_mixed(tmp_path):
    narrow, wide = (write_panda(tmp_path, GripperGeometry(max_opening=m)) for m in (0.08, 0.10))
    assert narrow.parent != wide.parent
    written = narrow.stat().st_mtime_ns
    assert write_panda(tmp_path, GRIPPER) == narrow
    assert narrow.stat().st_mtime_ns == written
    assert max(map(len, narrow.read_text().splitlines())) < 1000  # PyBullet reads no longer line


def test_pictures_show_detailed_meshes_where_there_are_any(tmp_path):
    plain = write_panda(tmp_path, GRIPPER)
    detailed = write_panda(tmp_path, GRIPPER, meshes={"hand": tmp_path / "hand.stl"})
    plain, detailed = (path.read_text() for path in (plain, detailed))
    assert plain.count('hand.obj"') == 2 and "hand.stl" not in plain
    assert detailed.count('hand.obj"') == detailed.count("hand.stl") == 1
