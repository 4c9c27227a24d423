"""Reads an SRDF, the file in which MoveIt keeps what a URDF lacks: joint groups, home poses and pairs of links."""

from __future__ import annotations

import pathlib
from collections.abc import Collection, Mapping

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.names import rename_references
from vinesim.robot.description.sidecar import JointGroup
from vinesim.robot.description.urdf import DescriptionError, Joint, description_error, read_xml

FOLDERS = (".", "srdf", "../srdf", "config", "../config")
"""Folders, relative to that of the URDF, in which its SRDF is searched."""
HOME_STATES = ("home", "ready", "stand", "standing", "half_sitting")
"""Names of group states that are taken as home poses, the best one first."""


def find_srdf(file: pathlib.Path, robot: str | None) -> pathlib.Path | None:
    """Returns the SRDF that belongs to a robot ``file``: of the same name, or of the robot's name, beside it or in a
    folder ``srdf`` or ``config``; None if there is none."""
    stem = file.name.split(".")[0]
    for folder in FOLDERS:
        for name in dict.fromkeys((stem, robot)):
            found = file.parent / folder / f"{name}.srdf"
            if name and found.is_file() and (folder == "." or _robot_of(found) in (None, robot)):
                return found
    return None


def _robot_of(file: pathlib.Path) -> str | None:
    """Returns the name of the robot that an SRDF is for; None if it cannot be read."""
    try:
        return read_xml(file).get("name")
    except (DescriptionError, OSError):
        return None


def read_srdf(file: pathlib.Path, originals: Mapping[str, str]) -> etree._Element:
    """Returns the root of an SRDF, with the valid names of links and joints. ``originals``: the names that were
    replaced, by their valid name. Raises :class:`DescriptionError` if the file is missing or no SRDF."""
    if not file.is_file():
        raise description_error(file, "this SRDF is missing", "correct its path")
    root = read_xml(file)
    renamed = {old: new for new, old in originals.items()}
    for kind in ("link", "joint"):
        rename_references(root, kind, renamed)
    return root


def merge_disabled_collisions(root: etree._Element, srdf: etree._Element, name: str, notes: list[str]) -> None:
    """Copy the ``disable_collisions`` of an SRDF called ``name`` into the URDF, for links that exist in the URDF. Adds
    this to ``notes``.

    Physics, ROS and other clients read the pairs from the URDF.
    """
    pairs = srdf.findall("disable_collisions")
    links = {link.get("name") for link in root.iterfind("link")}
    known = [pair for pair in pairs if links.issuperset((pair.get("link1"), pair.get("link2")))]
    for pair in known:
        etree.SubElement(root, "disable_collisions", link1=pair.get("link1"), link2=pair.get("link2"))
    unknown = f", {len(pairs) - len(known)} more name links that it lacks" if len(known) < len(pairs) else ""
    notes.append(f"{len(known)} pairs of links never touch by {name}{unknown}")


def srdf_floats(srdf: etree._Element) -> bool:
    """Returns whether an SRDF says that its robot moves freely in the world."""
    return any(joint.get("type") == "floating" for joint in srdf.iterfind("virtual_joint"))


def srdf_hands(srdf: etree._Element) -> tuple[str, ...]:
    """Returns the names of the groups of an SRDF that are end effectors."""
    return tuple(effector.get("group", "") for effector in srdf.iterfind("end_effector"))


def srdf_groups(srdf: etree._Element, order: Collection[Joint], driven: Collection[str]) -> dict[str, JointGroup]:
    """Returns the joint groups of an SRDF that have driven joints, each joint in one group.

    A group that consists of other groups, or has a joint of a smaller group, is left out. The home pose of a group is
    its own state, else that of another group with all its joints, such as the whole body. ``order``: joints of the
    robot. ``driven``: names of its driven joints.
    """
    elements = {group.get("name", ""): group for group in srdf.iterfind("group")}
    of_child = {joint.child: joint for joint in order}
    rank = {name: number for number, name in enumerate(driven)}
    joints = {name: _joints(name, elements, of_child, rank, ()) for name in elements}
    effectors = srdf.findall("end_effector")
    hands = srdf_hands(srdf)
    tools = {effector.get("parent_group") or "": effector.get("parent_link", "") for effector in effectors}
    composed = {name for name, group in elements.items() if group.find("group") is not None}
    groups: dict[str, JointGroup] = {}
    taken: set[str] = set()
    states = {(state.get("group", ""), state.get("name", "").lower()): state for state in srdf.iterfind("group_state")}
    links = {joint.child for joint in order}
    for name in sorted((one for one in elements if joints[one]), key=lambda one: (one in composed, len(joints[one]))):
        if taken & joints[name]:
            continue
        taken |= joints[name]
        ordered = tuple(sorted(joints[name], key=lambda joint: rank[joint]))
        tip = next((chain.get("tip_link", "") for chain in elements[name].iterfind("chain")), tools.get(name, ""))
        own = [states[name, pose] for pose in HOME_STATES if (name, pose) in states]
        larger = [state for pose in HOME_STATES for (_, one), state in states.items() if one == pose]
        homes = (_home(state, ordered) for state in (*own, *larger))
        home = next((home for home in homes if home is not None), None)
        is_hand = name in hands
        groups[name] = JointGroup(joints=ordered, tool=tip if tip in links and not is_hand else "", home=home)
    return {name: groups[name] for name in elements if name in groups}


def _joints(
    name: str,
    elements: Mapping[str, etree._Element],
    of_child: Mapping[str, Joint],
    driven: Collection[str],
    above: tuple[str, ...],
) -> set[str]:
    """Returns the driven joints of a group: those of its chains, joints, links and groups."""
    if name not in elements or name in above:
        return set()
    found: set[str] = set()
    for part in elements[name]:
        if part.tag == "joint":
            found.add(part.get("name", ""))
        elif part.tag == "link" and part.get("name") in of_child:
            found.add(of_child[part.get("name")].name)
        elif part.tag == "group":
            found |= _joints(part.get("name", ""), elements, of_child, driven, (*above, name))
        elif part.tag == "chain":
            link = part.get("tip_link")
            while link in of_child and link != part.get("base_link"):
                found.add(of_child[link].name)
                link = of_child[link].parent
    return found.intersection(driven)


def _home(state: etree._Element, joints: tuple[str, ...]) -> tuple[float, ...] | None:
    """Returns the positions [rad or m] of a group state; None if it does not give one for each of ``joints``."""
    try:
        given = {one.get("name"): float(one.get("value", "").split()[0]) for one in state.iterfind("joint")}
    except (ValueError, IndexError):
        return None
    return tuple(given[joint] for joint in joints) if set(joints) <= given.keys() else None
