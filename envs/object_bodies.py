"""Object bodies: one rigid body from a file or from a procedural solid.

A body's frame has its origin at the centre of mass and the axes of its source. What a file states
of size, mass and inertia is checked here, and replaced where no body of that shape can have it.
This module knows neither robot nor scene, no object set and no file format.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from envs.cell_layout import ObjectModel
from envs.object_files import DEFAULT_DENSITY, Inertial, colour, fine_visual, read_object
from envs.object_meshes import ObjectError, decompose, write_parts_obj
from envs.object_parts import MassProperties
from envs.object_primitives import Primitive, random_color
from envs.object_shapes import NativeShape

# An inertia below this share of that of a solid of even density is a placeholder, too.
LEAST_INERTIA = 0.1
IMPOSSIBLE_INERTIA = (
    "states an inertia that no body of its mass and shape can have; that of an even density is "
    "taken instead"
)
# Products of inertia below this share of the smallest moment are no reason to turn its axes.
LEAST_PRODUCT = 0.01
# Bullet solves contacts badly between bodies whose masses differ much, and a finger pushes hard.
MIN_MASS = 0.02
SMALLEST_OBJECT, LARGEST_OBJECT = 1e-4, 3.0  # m
USUAL_OBJECT = 0.1  # m, to which a guess of a file's unit is to lead
# Units of length, m. A scale of the user's tells more of them apart than a length can: of a box
# that is 4 long, inches would be as likely as centimetres.
GUESSED_UNITS = (0.001, 0.01, 100.0, 1000.0)
SCALED_UNITS = (*GUESSED_UNITS, 0.0254, 0.1, 10.0)
# kg/m3: foam has 10, platinum 21,500.
LIGHTEST, DENSEST = 1.0, 25_000.0
# A lever arm in metres, for round bodies, which would otherwise roll for ever. Others go without:
# Bullet's rolling and spinning friction cost a scene of five objects two thirds of its speed.
ROLLING_FRICTION = 0.0005


def load_object(
    path: str | Path,
    *,
    scale: float = 1.0,
    fit: float | None = None,
    density: float = DEFAULT_DENSITY,
    any_mass: bool = False,
    cache_dir: str | Path,
) -> ObjectModel:
    """One URDF (all its links at zero joint angles, as one rigid body), MJCF or mesh file.

    scale, fit, density: as in `load_object_set`. A mass that the file states is that of the body
    in the file's unit, see `_file_unit`, and is scaled with the volume. any_mass: take it even
    where no material is as heavy or as light. Raises ObjectError naming the file.
    """
    path, cache_dir = Path(path), Path(cache_dir)
    name = path.parent.name if path.stem == "model" else path.stem  # many sets have NAME/model.xml
    source = read_object(path, density)
    side = float(np.ptp(source.mesh.vertices, axis=0).max())
    unit = _file_unit(side, scale)
    if fit is not None:
        scale *= fit / float(np.sort(source.mesh.bounding_box_oriented.primitive.extents)[1])
    _check_size(path, scale * side, scale, fit)
    cut = decompose(source.mesh, cache_dir, str(path))
    stated = None
    if source.inertial is not None:
        # A density times a volume is in the file's unit already, and a mass that makes sense in
        # metres is of a body in metres, which a scale only shrinks.
        density_in_metres = source.inertial.mass / cut.solid.volume
        in_metres = side <= LARGEST_OBJECT and LIGHTEST <= density_in_metres <= DENSEST
        unit = 1.0 if in_metres or source.inertial.from_density else unit
        stated = in_unit(source.inertial, unit)
        if not any_mass:
            _check_density(path, source.inertial, stated.mass / cut.solid.volume, unit)
    inertial = body_of(stated, cut.solid, source.mesh, density)
    parts = tuple(scale * (part - inertial.centre_of_mass) for part in cut.parts)
    mass = max(inertial.mass * scale**3, MIN_MASS)
    moments, principal = principal_moments(inertial.inertia)
    remarks = [cut.remark] if cut.remark else []
    if stated is not None and stated.states_inertia and inertial is not stated:
        remarks.append(IMPOSSIBLE_INERTIA)
    return ObjectModel(
        name=name,
        parts=parts,
        mass=mass,
        inertia=moments * scale**2 * (mass / inertial.mass),
        principal=principal,
        friction=source.friction,
        color=colour(path, source) or random_color(np.random.default_rng(list(name.encode()))),
        collision=write_parts_obj(parts, cache_dir),
        fine_visual=fine_visual(path, source, scale, inertial.centre_of_mass, cache_dir),
        extents=np.ptp(np.concatenate(parts), axis=0),
        remarks=tuple(remarks),
    )


def native_object(
    name: str,
    shape: NativeShape,
    density: float,
    friction: float,
    color: tuple[float, float, float, float],
) -> ObjectModel:
    """A shape that simulators collide in closed form, of even density (kg/m3), or of a higher one
    that makes MIN_MASS."""
    solid = shape.mesh("fine")
    density = max(density, MIN_MASS / float(solid.volume))
    vertices = np.asarray(shape.mesh().vertices)
    return ObjectModel(
        name=name,
        parts=(vertices,),
        mass=density * float(solid.volume),
        inertia=density * np.diag(solid.moment_inertia),
        friction=friction,
        color=color,
        collision=shape,
        fine_visual=None,
        extents=np.asarray(solid.extents),
        rolling_friction=0.0 if shape.kind == "box" else ROLLING_FRICTION,
    )


def compound_object(shape: Primitive, cache_dir: Path) -> ObjectModel:
    """A procedural solid of convex parts, of even density, or of a higher one that makes
    MIN_MASS."""
    hulls = [trimesh.convex.convex_hull(part) for part in shape.parts]
    # The parts touch but do not overlap, but for goggles, whose strap runs into the frames: by less
    # than 1 % of their volume, which counts twice.
    solid = trimesh.util.concatenate(hulls)
    centre = np.asarray(solid.center_mass)
    parts = tuple(part - centre for part in shape.parts)
    density = max(shape.density, MIN_MASS / float(solid.volume))
    moments, principal = principal_moments(density * solid.moment_inertia)
    return ObjectModel(
        name=shape.name,
        parts=parts,
        mass=density * float(solid.volume),
        inertia=moments,
        principal=principal,
        friction=shape.friction,
        color=shape.color,
        collision=write_parts_obj(parts, cache_dir),
        fine_visual=None,
        extents=np.ptp(np.concatenate(parts), axis=0),
    )


def principal_moments(
    inertia: np.ndarray,
) -> tuple[np.ndarray, tuple[float, float, float, float] | None]:
    """Principal moments (3,) of an inertia (3, 3), kg m2, and the quaternion (x, y, z, w) that
    turns its axes into the principal ones; None where its own are, or nearly."""
    moments, axes = np.linalg.eigh(inertia)
    if np.abs(inertia - np.diag(np.diag(inertia))).max() < LEAST_PRODUCT * moments[0]:
        return np.diag(inertia).copy(), None
    axes[:, 0] *= np.linalg.det(axes)  # right-handed
    x, y, z, w = Rotation.from_matrix(axes).as_quat().tolist()
    return moments, (x, y, z, w)


# --- What a file states ---------------------------------------------------------------------------


def _file_unit(side: float, scale: float) -> float:
    """The unit of a file's lengths, m: the one nearest to a user's scale that is far from 1; else,
    of a body longer than LARGEST_OBJECT, the one in which it is as large as things usually are."""
    if not 0.1 < scale < 10:
        return min(SCALED_UNITS, key=lambda unit: abs(math.log(scale / unit)))
    return _unit_of(side) if side > LARGEST_OBJECT else 1.0


def _unit_of(side: float) -> float:
    """The unit in which something of this length would be as large as things usually are."""
    return min(GUESSED_UNITS, key=lambda unit: abs(math.log(side * unit / USUAL_OBJECT)))


def _check_size(path: Path, side: float, scale: float, fit: float | None) -> None:
    if not SMALLEST_OBJECT < side < LARGEST_OBJECT:
        advice = (
            f"its lengths may be in another unit: try objects.scale={scale * _unit_of(side):g}, or "
            "objects.fit=0.06"
            if fit is None
            else f"objects.fit={fit:g} is in metres: try objects.fit=0.06"
        )
        raise ObjectError(
            f"object {path} is {side:.3g} m long, expected {SMALLEST_OBJECT:g} to "
            f"{LARGEST_OBJECT:g} m; {advice}"
        )


def _check_density(path: Path, stated: Inertial, density: float, unit: float) -> None:
    """density: kg/m3, of the stated mass in the file's mesh with its lengths in `unit`, m."""
    if not LIGHTEST <= density <= DENSEST:
        cause = (
            "in grams, or the mesh smaller than the body"
            if density > DENSEST
            else ("in tonnes, or the mesh larger than the body")
        )
        what = (
            "densities, which make" if stated.from_density else f"{stated.mass:g} kg, which makes"
        )
        lengths = "" if unit == 1.0 else f" with lengths in units of {unit:g} m"
        raise ObjectError(
            f"object {path} states {what} {density:.3g} kg/m3 in its mesh{lengths}, expected "
            f"{LIGHTEST:g} to {DENSEST:g}; the mass may be {cause}: correct the file, or let it "
            "state none, so that objects.density counts"
        )


def in_unit(stated: Inertial, unit: float) -> Inertial:
    """Return what a file states of a body that is `unit` (in metres) times as large as its lengths
    say: the same mass over volume, for a body of these lengths in metres."""
    return replace(stated, mass=stated.mass / unit**3, inertia=stated.inertia / unit**5)


def body_of(
    stated: Inertial | None, solid: MassProperties, mesh: trimesh.Trimesh, density: float
) -> Inertial:
    """Mass, centre of mass and inertia of an object as its file states them.

    density: kg/m3 where it states no mass. Where the inertia is a placeholder or none, so may the
    centre of mass be: both are then those of a solid of even density and of the stated mass.
    """
    mass = density * solid.volume if stated is None else stated.mass
    if stated is not None and stated.states_inertia and is_possible(stated, solid, mesh):
        return stated
    return Inertial(mass, solid.centre_of_mass, mass / solid.volume * solid.inertia)


def is_possible(stated: Inertial, solid: MassProperties, mesh: trimesh.Trimesh) -> bool:
    """Whether a body of this shape, however its mass is spread, can have a stated inertia.

    Its centre of mass lies within the bounding box. No principal moment is larger than the sum of
    the two others, or than that of all the mass in the vertex that is farthest from the axis; none
    is below LEAST_INERTIA of that of even density. Three equal moments of a body that is not as
    long as it is wide, such as 1e-3 in many data sets, are a placeholder, too.
    """
    lower, upper = mesh.bounds
    if not ((lower <= stated.centre_of_mass) & (stated.centre_of_mass <= upper)).all():
        return False
    moments, axes = np.linalg.eigh(stated.inertia)
    even = np.linalg.eigvalsh(solid.inertia) * stated.mass / solid.volume
    along = (mesh.vertices - stated.centre_of_mass) @ axes
    squared = (along**2).sum(axis=1, keepdims=True) - along**2
    isotropic = np.ptp(moments) < 1e-6 * moments.max() and even.max() > 1.2 * even.min()
    return bool(
        not isotropic
        and (moments >= LEAST_INERTIA * even).all()
        and (moments <= stated.mass * squared.max(axis=0)).all()
        and moments[0] + moments[1] >= (1 - 1e-6) * moments[2]
    )
