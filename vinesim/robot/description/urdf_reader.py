"""URDF as XML: parsed, its numbers checked, its wheels fixed."""

from __future__ import annotations

import math
import pathlib
import re
from collections.abc import Mapping

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.errors import description_error

MOVABLE_JOINT_TYPES = ("revolute", "continuous", "prismatic")
"""Types of URDF joints that move about or along one axis."""

SOLIDS = ("box", "sphere", "cylinder", "capsule", "mesh")
"""Elements of a geometry."""
NUMBER_COUNTS = {
    ("origin", "xyz"): 3,
    ("origin", "rpy"): 3,
    ("axis", "xyz"): 3,
    ("mass", "value"): 1,
    **{("inertia", key): 1 for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")},
    **{("limit", key): 1 for key in ("lower", "upper", "effort", "velocity")},
    ("mimic", "multiplier"): 1,
    ("mimic", "offset"): 1,
    ("box", "size"): 3,
    ("sphere", "radius"): 1,
    **{(solid, key): 1 for solid in ("cylinder", "capsule") for key in ("radius", "length")},
    ("mesh", "scale"): 3,
    ("mesh", "bounds"): 6,
    ("mesh", "faces"): 1,
}
"""Count of numbers in each attribute, by element and attribute."""

MAX_NUMBER = 1e6
"""Largest number of a URDF [m, kg, kg m2, rad]: more makes the numbers of all that touches the robot inexact."""
MAX_LIMIT = 1e17
"""Largest limit: files give 1e16 where there is none."""


def read_xml(file: pathlib.Path) -> etree._Element:
    """The root element; :class:`DescriptionError` if the file is not XML or its root is not ``<robot>``."""
    try:
        root = etree.fromstring(file.read_bytes(), etree.XMLParser(remove_comments=True, resolve_entities=False))
    except etree.XMLSyntaxError as error:
        raise description_error(
            file, f"not well-formed XML: {error.msg}", "mend that line (is it a xacro? expand it)"
        ) from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise description_error(file, "it declares a document type (DTD)", "remove <!DOCTYPE ...>: a URDF needs none")
    if root.tag != "robot":
        raise description_error(
            file, f"its root is <{root.tag}>, not <robot>", "give a URDF (MJCF and SDF are not read)"
        )
    return root


def check_friction(root: etree._Element, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless the coefficients that links are given are finite numbers of 0 or more."""
    given = [
        (element, element.get("value") if element.get("value") is not None else element.text)
        for element in (*root.iterfind("gazebo/mu1"), *root.iterfind("link/contact/lateral_friction"))
    ]
    for element, text in given:
        try:
            fits = 0.0 <= float(text or "") < math.inf
        except ValueError:
            fits = False
        if not fits:
            owner = next(up for up in element.iterancestors() if up.tag in ("gazebo", "link"))
            where = f"{element.tag} of {owner.get('reference') or owner.get('name')!r}"
            raise description_error(file, f"{where} is {text!r}", "give a friction coefficient of 0 or more")


def set_friction(root: etree._Element, friction: Mapping[str, float], file: pathlib.Path) -> None:
    """Write the coefficients by link of a TOML ``file`` into the URDF as Gazebo's ``mu1``, instead of its own ones."""
    links = {link.get("name") for link in root.iterfind("link")}
    for name, coefficient in friction.items():
        if name not in links:
            raise description_error(file, f"friction is given for {name!r}", "name a link of the URDF")
        for old in root.xpath("gazebo[@reference=$name]/mu1", name=name):
            old.getparent().remove(old)
        gazebo = etree.SubElement(root, "gazebo", reference=name)
        etree.SubElement(gazebo, "mu1").text = repr(float(coefficient))


def merge_disabled_collisions(root: etree._Element, file: pathlib.Path, notes: list[str]) -> None:
    """Copy the ``disable_collisions`` of an SRDF ``file`` between links of the URDF into its text; adds to ``notes``.

    So they reach whatever reads that text. Raises :class:`DescriptionError` if the file is missing or no SRDF.
    """
    if not file.is_file():
        raise description_error(file, "this SRDF is missing", "mend its path in the robot's TOML file")
    pairs = read_xml(file).findall("disable_collisions")
    links = {link.get("name") for link in root.iterfind("link")}
    known = [pair for pair in pairs if links.issuperset((pair.get("link1"), pair.get("link2")))]
    for pair in known:
        etree.SubElement(root, "disable_collisions", link1=pair.get("link1"), link2=pair.get("link2"))
    unknown = f", {len(pairs) - len(known)} more name links that it lacks" if len(known) < len(pairs) else ""
    notes.append(f"{len(known)} pairs of links never touch by {file.name}{unknown}")


def check_numbers(root: etree._Element, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless all numbers are complete and bounded, and all sizes above 0."""
    for element in root.iter(*{tag for tag, _ in NUMBER_COUNTS}):
        for (tag, key), count in NUMBER_COUNTS.items():
            text = element.get(key) if element.tag == tag else None
            if text is None:
                continue
            owner = next((up for up in element.iterancestors() if up.get("name")), root)
            where = f'<{tag} {key}="{text}"> of {owner.tag} {owner.get("name")!r}'
            try:
                numbers = [float(word) for word in text.split()]
            except ValueError as error:
                raise description_error(
                    file, f"{where} is no number", "write decimal numbers (is it a xacro? expand it)"
                ) from error
            if len(numbers) != count:
                raise description_error(file, f"{where} has {len(numbers)} of {count} numbers", "give all of them")
            if not all(map(math.isfinite, numbers)):
                raise description_error(file, f"{where} is not finite", "give a number")
            largest = MAX_LIMIT if tag == "limit" else MAX_NUMBER
            if max(map(abs, numbers)) > largest:
                raise description_error(file, f"{where} is beyond {largest:g}", "give what a robot can have")
            if tag in SOLIDS and key != "bounds" and min(map(abs, numbers) if tag == "mesh" else numbers) <= 0.0:
                raise description_error(file, f"{where} is no size", "give numbers above 0")


def fix_wheels(root: etree._Element, notes: list[str]) -> None:
    """Make the joints of wheels and casters fixed, because the base is driven as one body; adds to ``notes``."""
    wheels = [
        joint
        for joint in root.iterfind("joint")
        if joint.get("type") in MOVABLE_JOINT_TYPES and re.search(r"wheel|caster", joint.get("name", ""))
    ]
    for joint in wheels:
        joint.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "dynamics", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
    if wheels:
        notes.append(f"{len(wheels)} wheel and caster joints are fixed: the base is driven as a whole")
