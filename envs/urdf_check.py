"""What of a URDF has to be there, told by the element's name before a library fails over it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from envs.object_meshes import ObjectError


class _Numbers(NamedTuple):
    """What an attribute of the elements at a path below <robot> holds, if it is there. counts: how
    many numbers; more than the first ones are left out by yourdfpy. needed: whether it has to be
    there. lowest, highest: what each number may be."""

    place: str
    attribute: str
    counts: Sequence[int]
    words: str
    needed: bool = True
    lowest: float = -math.inf
    highest: float = math.inf


_SHAPES = "box", "cylinder", "sphere", "capsule", "mesh"
_NUMBERS = (
    _Numbers("link/*/geometry/box", "size", (3,), "three numbers of 0 or more", lowest=0.0),
    _Numbers("link/*/geometry/cylinder", "radius", (1,), "a number of 0 or more", lowest=0.0),
    _Numbers("link/*/geometry/cylinder", "length", (1,), "a number of 0 or more", lowest=0.0),
    _Numbers("link/collision/geometry/sphere", "radius", (1,), "a number over 0", lowest=1e-9),
    _Numbers("link/*/geometry/mesh", "scale", (0, 1, 3), "one number or three", needed=False),
    _Numbers("link/inertial/mass", "value", (1,), "a number of kilograms"),
    _Numbers("link/contact/lateral_friction", "value", (1,), "a number of 0 or more"),
    *(
        _Numbers(
            f"{place}material/color",
            "rgba",
            (4,),
            "four numbers of 0 to 1",
            needed=False,
            lowest=0.0,
            highest=1.0,
        )
        for place in ("link/visual/", "")
    ),
    *(
        _Numbers("link/inertial/inertia", name, (1,), "a number of kg m2", needed=False)
        for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ),
    *(
        _Numbers(f"{place}/origin", name, range(3, 10), "three numbers", needed=False)
        for place in ("link/*", "joint")
        for name in ("xyz", "rpy")
    ),
)


def check_urdf(xml: ElementTree.Element, path: Path) -> None:
    """Raise ObjectError, which names the file and the element, for a URDF with the root `xml` that
    has no name, a joint without its links, links that are no tree, a geometry without a shape, a
    mesh without a file, or numbers that cannot be."""
    if xml.tag != "robot" or xml.get("name") is None:
        raise ObjectError(f"{path} is no URDF, which is a <robot name=...>; repair or remove it")
    links = [link.get("name") for link in xml.findall("link")]
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or named.get("link") not in links:
                raise ObjectError(
                    f"URDF {path}: the {end} of its joint {joint.get('name')!r} is none of its "
                    f"links ({', '.join(map(str, links))}); repair it"
                )
    children = [joint.find("child").get("link") for joint in xml.findall("joint")]
    twice = next((name for name in children if children.count(name) > 1), None)
    if twice is not None or (children and set(links) == set(children)):
        which = "every link" if twice is None else f"its link {twice!r}"
        raise ObjectError(
            f"URDF {path}: {which} hangs from another one, or from two, expected a tree of links "
            "with one at its root; repair its joints"
        )
    for geometry in xml.iterfind("link/*/geometry"):
        if not any(geometry.find(shape) is not None for shape in _SHAPES):
            raise ObjectError(
                f"URDF {path}: a <geometry> holds no {', '.join(_SHAPES)}; repair or remove it"
            )
    for mesh in xml.iterfind("link/*/geometry/mesh"):
        name = mesh.get("filename", "")
        if not name or re.match(r"(?!package:|file:)\w+://", name):
            raise ObjectError(
                f"URDF {path}: the filename of a <mesh> is {name!r}, expected a file beside the "
                "URDF or package://...; copy the mesh there"
            )
        if 0 in (_numbers(mesh.get("scale", "1")) or ()):
            raise ObjectError(f"URDF {path}: the scale of a <mesh> is 0; repair it")
    for wanted in _NUMBERS:
        for element in xml.iterfind(wanted.place):
            text = element.get(wanted.attribute)
            if text is None and not wanted.needed:
                continue
            found = _numbers(text)
            bad = found is None or len(found) not in wanted.counts
            if bad or not all(wanted.lowest <= one <= wanted.highest for one in found or ()):
                raise ObjectError(
                    f"URDF {path}: the {wanted.attribute} of a <{element.tag}> is {text!r}, "
                    f"expected {wanted.words}; repair it"
                )


def _numbers(text: str | None) -> list[float] | None:
    """The finite numbers of a text, with blanks or commas between them; None where it holds others,
    or words."""
    try:
        found = [float(word) for word in (text or "").replace(",", " ").split()]
    except ValueError:
        return None
    return found if all(map(math.isfinite, found)) else None
