"""Writes ros/moveit/vinebot.srdf: groups and home positions of data/robots/vinebot.toml, and pairs of links that MoveIt
need not check.

As in MoveIt's Setup Assistant, links that a joint connects are not checked, nor are pairs that touch in all random
configurations, or in none. "In none" is believed only of two links of one arm, and of two links of the body, because
few joints move these against each other. Arms are always checked against each other and against the body: they meet in
one of ten thousand configurations only.

PYTHONPATH=. python tools/make_vinebot_srdf.py
"""

from __future__ import annotations

import itertools
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from vinesim.robot.description.loader import load_description

TARGET = Path(__file__).resolve().parents[1] / "ros" / "moveit" / "vinebot.srdf"
SAMPLES = 20_000
SEED = 7
ALWAYS = 0.95
"""Share of the configurations from which on a pair counts as always touching, as in the Setup Assistant."""


def part(link: str) -> str:
    """The part of the robot that a link belongs to: left, right or body."""
    return next((side for side in ("left", "right") if f"_{side}_" in link), "body")


def touching(urdf: str, pose: dict[str, float] | None = None) -> tuple[list[str], dict[frozenset[str], float]]:
    """Returns the links with collision shapes, and for pairs of them the share of random configurations in which
    they touch; or whether they touch in one ``pose``, the positions of joints by name."""
    root = ElementTree.fromstring(urdf)
    for visual in [(link, one) for link in root.iterfind("link") for one in link.findall("visual")]:
        visual[0].remove(visual[1])
    options = ElementTree.SubElement(root, "mujoco")
    ElementTree.SubElement(options, "compiler", fusestatic="false", discardvisual="true", strippath="false")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    data = mujoco.MjData(model)
    links = [link.get("name", "") for link in root.iterfind("link") if link.find("collision") is not None]
    names = {body: model.body(body).name for body in range(model.nbody)}
    poses = np.random.default_rng(SEED).uniform(*model.jnt_range.T, (SAMPLES, model.nq))
    if pose is not None:
        poses = np.array([[pose[model.joint(joint).name] for joint in range(model.njnt)]])
    counts: dict[frozenset[str], int] = {}
    for row in poses:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        bodies = model.geom_bodyid[np.array(data.contact.geom).reshape(-1, 2)]
        for pair in {frozenset((names[a], names[b])) for a, b in bodies if a != b}:
            counts[pair] = counts.get(pair, 0) + 1
    return links, {pair: count / len(poses) for pair, count in counts.items()}


def srdf() -> str:
    """The whole SRDF as text."""
    robot = load_description("vinebot")
    root = ElementTree.Element("robot", name="vinebot")

    def add(tag: str, parent: ElementTree.Element = root, **given: str) -> ElementTree.Element:
        return ElementTree.SubElement(parent, tag, given)

    add("virtual_joint", name="base", type="planar", parent_frame="odom", child_link=robot.base)
    for side in ("left", "right"):
        group = add("group", name=f"arm_{side}")
        add("chain", group, base_link="torso_lift_link", tip_link=f"gripper_{side}_grasping_link")
    for side in ("left", "right"):
        group = add("group", name=f"arm_{side}_torso")
        add("chain", group, base_link="torso_fixed_link", tip_link=f"gripper_{side}_grasping_link")
    for name in ("torso", "head", "gripper_left", "gripper_right"):
        group = add("group", name=name)
        for joint in robot.groups[name].joints:
            add("joint", group, name=joint)
    for name, group in robot.groups.items():
        state = add("group_state", name="home", group=name)
        for joint, value in zip(group.joints, group.home or (), strict=True):
            add("joint", state, name=joint, value=f"{value:g}")
    for side in ("left", "right"):
        add(
            "end_effector",
            name=f"hand_{side}",
            parent_link=f"gripper_{side}_grasping_link",
            group=f"gripper_{side}",
            parent_group=f"arm_{side}",
        )

    links, shares = touching(robot.urdf)
    joints = ElementTree.fromstring(robot.urdf).iterfind("joint")
    connected = {frozenset((one.find("parent").get("link"), one.find("child").get("link"))) for one in joints}
    for pair in itertools.combinations(links, 2):
        share = shares.get(frozenset(pair), 0.0)
        if frozenset(pair) in connected:
            reason = "Adjacent"
        elif share >= ALWAYS:
            reason = "Always"
        elif share == 0.0 and part(pair[0]) == part(pair[1]):
            reason = "Never"
        else:
            continue
        add("disable_collisions", link1=pair[0], link2=pair[1], reason=reason)
    ElementTree.indent(root)
    note = "<!-- Written by tools/make_vinebot_srdf.py: change it there. -->"
    return f'<?xml version="1.0"?>\n{note}\n{ElementTree.tostring(root, encoding="unicode")}\n'


if __name__ == "__main__":
    TARGET.write_text(srdf())
