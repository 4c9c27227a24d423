"""Names of links and joints that ROS and TOML accept: letters of ASCII, digits and underscores, no digit first.

Names of topics and parameters are made of the names in a robot file, so a name with a blank, a hyphen or a letter of
another alphabet is replaced once, when the file is read. All other parts of vinesim see the new names only.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from typing import TypeVar

import msgspec
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

VALID = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_REFERENCES = {
    "link": (
        ("joint/parent", "link"),
        ("joint/child", "link"),
        ("gazebo", "reference"),
        ("disable_collisions", "link1"),
        ("disable_collisions", "link2"),
        (".//chain", "base_link"),
        (".//chain", "tip_link"),
        ("group/link", "name"),
        ("end_effector", "parent_link"),
    ),
    "joint": (
        ("joint/mimic", "joint"),
        ("gazebo", "reference"),
        ("ros2_control/joint", "name"),
        ("transmission/joint", "name"),
        ("group/joint", "name"),
        ("group_state/joint", "name"),
    ),
}
"""Places that refer to links and joints, by what they refer to: path of an element, and its attribute."""
_HOLDERS = frozenset({"frame", "tool", "joints", "friction"})
"""Keys of a robot's TOML file whose values (for ``friction``: keys) are names of links or joints."""

T = TypeVar("T")


def make_names_valid(root: etree._Element, assumed: list[str]) -> dict[str, str]:
    """Replace all names of links and moving joints of a URDF, and its own, that are not :data:`VALID`. Adds this to
    ``assumed``. Returns the original name of each replaced one, by its new name."""
    originals: dict[str, str] = {}
    for kind in ("link", "joint"):
        elements = [one for one in root.iterfind(kind) if one.get("type") != "fixed"]  # no topic has their names
        given = [element.get("name", "") for element in elements]
        renamed = valid_names(given, kind)
        for element, name in zip(elements, given, strict=True):
            if name in renamed:
                element.set("name", renamed[name])
        rename_references(root, kind, renamed)
        originals |= {new: old for old, new in renamed.items()}
    if originals:
        first = next(iter(originals))
        assumed.append(
            f"{len(originals)} names are not valid in ROS and are replaced, first {originals[first]!r} by {first!r}"
        )
    name = root.get("name")
    if name and not VALID.fullmatch(name):
        root.set("name", next(iter(valid_names([name], "robot").values())))
    return originals


def rename_references(root: etree._Element, kind: str, renamed: Mapping[str, str]) -> None:
    """Replace the names of links or joints (``kind``) in all places of a URDF or SRDF that refer to them."""
    for path, attribute in _REFERENCES[kind]:
        for element in root.iterfind(path):
            if element.get(attribute) in renamed:
                element.set(attribute, renamed[element.get(attribute)])


def valid_names(names: Iterable[str], kind: str) -> dict[str, str]:
    """Returns a valid name for each of ``names`` that is not valid, unlike all other names. ``kind``: first word of the
    new name where the old one has no letter of ASCII."""
    names = list(names)
    taken = {name for name in names if VALID.fullmatch(name)}
    renamed: dict[str, str] = {}
    for name in names:
        if not name or VALID.fullmatch(name) or name in renamed:
            continue
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
        stem = re.sub(r"[^A-Za-z0-9_]+", "_", plain).strip("_")
        if not stem or stem[0].isdigit():
            stem = f"{kind}_{stem}".rstrip("_")
        number = 1
        new = stem
        while new in taken:
            number += 1
            new = f"{stem}_{number}"
        taken.add(new)
        renamed[name] = new
    return renamed


def rename_in_sidecar(sidecar: T, originals: Mapping[str, str]) -> T:
    """Returns the content of a TOML file with the new names of links and joints where it has the original ones."""
    if not originals:
        return sidecar
    renamed = {old: new for new, old in originals.items()}

    def convert(value: object, holds_names: bool) -> object:
        if isinstance(value, str):
            return renamed.get(value, value) if holds_names else value
        if isinstance(value, tuple):
            return tuple(convert(one, holds_names) for one in value)
        if isinstance(value, dict):
            return {(renamed.get(key, key) if holds_names else key): convert(one, False) for key, one in value.items()}
        if isinstance(value, msgspec.Struct):
            fields = {name: convert(getattr(value, name), name in _HOLDERS) for name in value.__struct_fields__}
            return msgspec.structs.replace(value, **fields)
        return value

    return convert(sidecar, False)  # pyright: ignore[reportReturnType] of the type of its argument
