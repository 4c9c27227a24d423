"""Joint groups, cameras and lidars, guessed from the names in a URDF without a TOML file."""

from __future__ import annotations

import collections
import math
import re
from collections.abc import Callable, Container, Iterator, Mapping, Sequence

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.controllers import MIN_ARM_JOINTS
from vinesim.robot.description.sidecar import JointGroup
from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint
from vinesim.scene.values import CameraMount, ImuMount, LidarMount, RenderedMount


def guess_groups(joints: list[str], links: Container[str], order: Sequence[Joint] = ()) -> dict[str, JointGroup]:
    """Returns joint groups guessed from joint names in the style of PAL Robotics: ``arm_left_3_joint`` belongs to
    ``arm_left``. Short groups that follow each other along a chain without branches become one group, as those of
    ``shoulder_pan_joint`` and ``elbow_joint``.

    ``links``: names of all links, in which the tool of an arm is searched. ``order``: all joints from the root
    outwards.
    """

    def tool(group: str) -> str:
        names = (group.replace("arm", "gripper") + "_grasping_link", group + "_tool_link")
        return next((name for name in names if name in links), "")

    named: dict[str, list[str]] = {}
    for joint in joints:
        hand = re.match(r"(gripper|hand)_(left|right)", joint)
        stem = hand.group() if hand else re.sub(r"(_lift)?(_?\d+)?(_joint)?$", "", joint)
        named.setdefault(stem or joint, []).append(joint)
    groups: dict[str, list[str]] = {}
    for name, members in _merged_along_chains(named, _chains(joints, order)):
        free = name
        number = 1
        while free in groups:
            number += 1
            free = f"{name}_{number}"
        groups[free] = members
    return {name: JointGroup(joints=tuple(members), tool=tool(name)) for name, members in groups.items()}


def _chains(joints: Sequence[str], order: Sequence[Joint]) -> list[list[str]]:
    """Returns the driven ``joints`` as chains without branches, each from the root outwards."""
    of_child = {joint.child: joint for joint in order}
    moving = [joint for joint in order if joint.type in MOVABLE_JOINT_TYPES]
    above: dict[str, str | None] = {}
    for joint in moving:
        link = joint.parent
        while link in of_child and of_child[link].type not in MOVABLE_JOINT_TYPES:
            link = of_child[link].parent
        above[joint.name] = of_child[link].name if link in of_child else None
    branches = collections.Counter(above.values())
    chain_of: dict[str, list[str]] = {}
    chains: list[list[str]] = []
    driven = set(joints)
    for joint in moving:
        parent = above[joint.name]
        if parent is not None and branches[parent] == 1:
            chain = chain_of[parent]
        else:
            chain = []
            chains.append(chain)
        chain_of[joint.name] = chain
        if joint.name in driven:
            chain.append(joint.name)
    return [chain for chain in chains if chain]


def _merged_along_chains(
    named: Mapping[str, list[str]], chains: Sequence[list[str]]
) -> Iterator[tuple[str, list[str]]]:
    """Yields names and joints of groups: those ``named`` by their joints, of which short ones along one chain are
    merged."""
    group_of = {joint: name for name, members in named.items() for joint in members}
    chain_of = {joint: number for number, chain in enumerate(chains) for joint in chain}
    arms = sum(len(chain) >= MIN_ARM_JOINTS for chain in chains)
    merged: dict[str, tuple[str, list[str]]] = {}
    for number, chain in enumerate(chains):
        run: list[str] = []
        for name in [*dict.fromkeys(group_of[joint] for joint in chain), ""]:
            members = named.get(name, [])
            is_short = name != "" and len(members) < MIN_ARM_JOINTS and not re.search(r"gripper|hand|finger", name)
            if is_short and all(chain_of.get(joint) == number for joint in members):
                run.append(name)
                continue
            if len(run) > 1:
                together = [joint for joint in chain if group_of[joint] in run]
                merged |= {one: (_arm_name(together, run[0], arms), together) for one in run}
            run = []
    said = set()
    for name, members in named.items():
        if name in merged:
            if merged[name][1][0] not in said:
                said.add(merged[name][1][0])
                yield merged[name]
        elif len(members) >= MIN_ARM_JOINTS:
            yield _arm_name(members, name, arms), members
        else:
            yield name, members


def _arm_name(joints: list[str], name: str, arms: int) -> str:
    """Returns the name of a group of ``joints`` that form a chain, as MoveIt's configurations call it: the words that
    their names have in common (``panda_arm`` for ``panda_joint1``), or ``manipulator`` if the only arm has none.
    ``name``: name of the group by its first joint. ``arms``: number of arms."""
    words = [
        [word for word in joint.split("_") if re.sub(r"\d+$", "", word).lower() not in _NO_NAMES] for joint in joints
    ]
    common = []
    for column in zip(*words, strict=False):
        stems = {re.sub(r"\d+$", "", word) for word in column}
        if len(stems) > 1:
            break
        common.append(column[0] if len(set(column)) == 1 else stems.pop())
    stem = "_".join(common)
    if not stem:
        return "manipulator" if arms <= 1 and len(joints) >= MIN_ARM_JOINTS else name
    is_arm = arms == 1 and len(joints) > MIN_ARM_JOINTS and not re.search(r"arm|leg|hand|torso|manipulator|head", stem)
    return f"{stem}_arm" if is_arm else stem


_NO_NAMES = frozenset({"joint", "axis", "link", "motor", "a", "j", "q", ""})
"""Words in the names of joints that do not name an arm."""


def guess_cameras(root: etree._Element, notes: list[str]) -> tuple[CameraMount, ...]:
    """Returns a D435 camera in the first optical frame (a colour frame is preferred), or else in the first link whose
    name has ``camera`` in it. Adds the guess to ``notes``.

    In the second case an optical frame is added to ``root``.
    """
    links = [link.get("name", "") for link in root.iterfind("link")]
    optical = [link for link in links if link.endswith("optical_frame")]
    colour = [link for link in optical if re.search(r"rgb|color|colour", link)]
    found = next(
        iter(colour or optical or [link for link in links if re.search(r"camera.*_link$|camera$", link)]), None
    )
    if found is None:
        notes.append("no camera: no link is called camera or optical")
        return ()
    name = re.sub(r"(_(rgb|color|colour|depth))?(_optical_frame|_link|_frame)$", "", found)
    notes.append(f"a d435 is assumed to be mounted on {found!r}")
    if not optical:
        found, link = f"{name}_optical_frame", found
        etree.SubElement(root, "link", name=found)
        joint = etree.SubElement(root, "joint", name=f"{name}_optical_joint", type="fixed")
        etree.SubElement(joint, "parent", link=link)
        etree.SubElement(joint, "child", link=found)
        etree.SubElement(joint, "origin", xyz="0 0 0", rpy=f"{-math.pi / 2} 0 {-math.pi / 2}")
    return (CameraMount(name, found, "d435"),)


def guess_lidars(root: etree._Element, notes: list[str]) -> tuple[LidarMount, ...]:
    """Returns a VLP-16 lidar in the first link whose name has ``lidar`` or ``laser`` in it (a front one is preferred).
    If its name has ``scan`` in it, as ``base_scan`` of TurtleBot3, the lidar has one level laser. Adds the guess to
    ``notes``."""
    links = [link.get("name", "") for link in root.iterfind("link")]
    found = [link for link in links if re.search(r"lidar|laser|velodyne|(^|_)scan(_|$|ner)|rplidar|hokuyo", link)]
    found.sort(key=lambda name: "front" not in name)
    if not found:
        return ()
    if "scan" in found[0]:
        notes.append(f"a lidar with one level laser is assumed to be mounted on {found[0]!r}")
        return (LidarMount("lidar", found[0], "vlp16", columns=720, elevations=(0.0,)),)
    notes.append(f"a vlp16 is assumed to be mounted on {found[0]!r}")
    return (LidarMount("lidar", found[0], "vlp16"),)


def guess_imus(root: etree._Element, notes: list[str]) -> tuple[ImuMount, ...]:
    """Returns an IMU in the first link whose name has the word ``imu`` in it. Adds the guess to ``notes``."""
    links = [link.get("name", "") for link in root.iterfind("link")]
    found = next((link for link in links if re.search(r"(^|_)imu(_|$|\d)", link.lower())), None)
    if found is None:
        return ()
    notes.append(f"an IMU is assumed to be mounted on {found!r}")
    return (ImuMount("imu", found),)


SENSOR_GUESSES: dict[str, Callable[[etree._Element, list[str]], tuple[RenderedMount, ...]]] = {
    CameraMount.kind: guess_cameras,
    LidarMount.kind: guess_lidars,
}
"""Functions that guess the sensors of a robot, by kind of sensor. Sensors of other kinds are not guessed."""
