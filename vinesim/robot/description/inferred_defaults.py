"""Joint groups, cameras and lidars, guessed from the names in a URDF without a TOML file."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.sidecar import JointGroup
from vinesim.scene.values import CameraMount, LidarMount, RenderedMount


def guess_groups(joints: list[str], links: Container[str]) -> dict[str, JointGroup]:
    """Returns joint groups guessed from joint names in the style of PAL Robotics: ``arm_left_3_joint`` belongs to
    ``arm_left``.

    ``links``: names of all links, in which the tool of an arm is searched.
    """

    def tool(group: str) -> str:
        names = (group.replace("arm", "gripper") + "_grasping_link", group + "_tool_link")
        return next((name for name in names if name in links), "")

    groups: dict[str, list[str]] = {}
    for joint in joints:
        hand = re.match(r"(gripper|hand)_(left|right)", joint)
        stem = hand.group() if hand else re.sub(r"(_lift)?(_?\d+)?(_joint)?$", "", joint)
        groups.setdefault(stem or joint, []).append(joint)
    return {name: JointGroup(joints=tuple(members), tool=tool(name)) for name, members in groups.items()}


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
    """Returns a VLP-16 lidar in the first link whose name has ``lidar`` or ``laser`` in it (a front one is
    preferred). Adds the guess to ``notes``."""
    links = [link.get("name", "") for link in root.iterfind("link")]
    found = sorted((link for link in links if re.search(r"lidar|laser|velodyne", link)), key=lambda n: "front" not in n)
    if not found:
        return ()
    notes.append(f"a vlp16 is assumed to be mounted on {found[0]!r}")
    return (LidarMount("lidar", found[0], "vlp16"),)


SENSOR_GUESSES: dict[str, Callable[[etree._Element, list[str]], tuple[RenderedMount, ...]]] = {
    CameraMount.kind: guess_cameras,
    LidarMount.kind: guess_lidars,
}
"""Functions that guess the sensors of a robot, by kind of sensor. Sensors of other kinds are not guessed."""
