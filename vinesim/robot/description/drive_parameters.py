"""Parameters of the drives: home positions, carried inertia, and gains for joints without gains in the TOML file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.repairs import some_names
from vinesim.robot.description.sidecar import JointGroup
from vinesim.robot.description.urdf import Joint, Robot, joint_limits
from vinesim.scene.values import Drive

ACCELERATION_TIME = 0.02
"""[s] Time in which full effort accelerates a drive to full speed, by which an armature that is not given is
derived. GUESSED"""
FULL_EFFORT_ANGLE = 0.05
"""[rad] Position error at which the servo of a revolute joint reaches full effort, by which gains that are not given
are derived. GUESSED"""
FULL_EFFORT_DISTANCE = 0.005
"""[m] Position error at which the servo of a prismatic joint reaches full effort, by which gains that are not given
are derived. GUESSED"""
STANDARD_GRAVITY = 9.80665
"""[m/s2] Standard acceleration of gravity, from which the weight on a drive is computed."""
CENTRED_SHARE = 0.1
"""Share of a joint's range within which the middle of the range counts as 0, so that the home position is 0."""


def home_positions(driven: list[Joint], groups: dict[str, JointGroup]) -> np.ndarray:
    """Returns the home positions [joint] rad or m of the driven joints: those given by their groups, else the middle
    of the range (see :func:`_default_home`)."""
    home = np.array([_default_home(joint) for joint in driven])
    order = {joint.name: index for index, joint in enumerate(driven)}
    for group in groups.values():
        if group.home is not None:
            home[[order[joint] for joint in group.joints]] = group.home
    return home


def _default_home(joint: Joint) -> float:
    """Returns the middle of a joint's range [rad or m], so that an elbow is bent in its only direction. Returns 0 if
    the middle is near 0 or the joint is continuous."""
    if joint.type == "continuous":
        return 0.0
    limits = joint_limits(joint)
    middle = 0.5 * (limits.lower + limits.upper)
    return middle if abs(middle) > CENTRED_SHARE * (limits.upper - limits.lower) else 0.0


def make_drives(
    robot: Robot,
    driven: list[Joint],
    description: RobotDescription,
    feet: Mapping[str, np.ndarray],
    notes: list[str],
    assumed: list[str],
) -> tuple[Drive, ...]:
    """Returns the drives of the driven joints, with the gains of their groups. Missing gains are derived, which is
    added to ``notes``.

    If a drive is too weak for the weight that it carries at home, the joint is assumed to have a counterbalance: the
    weight is added to the drive's effort, and the joint is added to ``assumed``. Drives of legs also carry the robot,
    which stands on its ``feet`` (see :func:`vinesim.robot.description.extent.feet`).
    """
    gains: dict[str, tuple[float, float]] = {}
    armatures: dict[str, float] = {}
    springs: dict[str, tuple[float, float]] = {}
    for group in description.groups.values():
        for i, joint in enumerate(group.joints):
            if group.stiffness is not None and group.damping is not None:
                gains[joint] = group.stiffness[i], group.damping[i]
            if group.armature is not None:
                armatures[joint] = group.armature[i]
            if group.series_stiffness is not None and group.series_damping is not None:
                springs[joint] = group.series_stiffness[i], group.series_damping[i]
    inertia, weight = _carried_loads(robot, description)
    standing = _standing_loads(robot, description, feet)
    derived = [joint.name for joint in driven if joint.name not in gains]
    if derived:
        notes.append(f"servo gains of {len(derived)} joints are derived from effort limits and inertia")
    drives = [
        _make_drive(
            joint,
            gains.get(joint.name),
            armatures.get(joint.name),
            springs.get(joint.name),
            inertia[joint.name],
            standing[joint.name] if standing[joint.name] >= joint_limits(joint).effort else 0.0,
        )
        for joint in driven
    ]
    limit = {joint.name: joint_limits(joint).effort for joint in driven}
    weak = [i for i, drive in enumerate(drives) if weight[drive.joint] >= drive.effort]
    for i in weak:
        drives[i] = dataclasses.replace(drives[i], effort=drives[i].effort + weight[drives[i].joint])
    weak = [i for i, drive in enumerate(drives) if drive.effort > limit[drive.joint]]
    if weak:
        assumed.append(f"{some_names([drives[i].joint for i in weak])} is too weak for its weight: counterbalanced")
    return tuple(drives)


def _make_drive(
    joint: Joint,
    gains: tuple[float, float] | None,
    armature: float | None,
    spring: tuple[float, float] | None,
    inertia: float,
    support: float,
) -> Drive:
    """Returns one drive. ``inertia`` [kg m2 or kg]: inertia that the drive carries, from which missing gains are
    derived with critical damping. ``support`` [N m or N]: effort that is added to the joint's limit."""
    limits = joint_limits(joint)
    limits = dataclasses.replace(limits, effort=limits.effort + support)
    if armature is None:
        armature = ACCELERATION_TIME * limits.effort / limits.velocity
    if gains is None:
        stiffness = limits.effort / (FULL_EFFORT_DISTANCE if joint.type == "prismatic" else FULL_EFFORT_ANGLE)
        gains = stiffness, 2.0 * math.sqrt(stiffness * (inertia + armature))
    return Drive(
        joint=joint.name,
        stiffness=gains[0],
        damping=gains[1],
        effort=limits.effort,
        velocity=limits.velocity,
        lower=limits.lower,
        upper=limits.upper,
        armature=armature,
        series_stiffness=spring[0] if spring else 0.0,
        series_damping=spring[1] if spring else 0.0,
    )


def _standing_loads(robot: Robot, description: RobotDescription, feet: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Returns the effort [N m or N] of each moving joint that carries the robot, which stands at home with an equal
    share of its weight on each of its ``feet``."""
    load = dict.fromkeys(description.moving_joints.names, 0.0)
    if not feet:
        return load
    poses = description.link_poses(description.home)
    share = STANDARD_GRAVITY * description.mass / len(feet)
    spans = _spans(description)
    first = np.array([spans[foot][0] for foot in feet])
    ground = np.array(list(feet.values())).reshape(-1, 3)
    joints = {joint.name: joint for joint in robot.joints}
    for name, (_, child) in zip(description.moving_joints.names, description.moving_joints.frames, strict=True):
        axis = frames.rotate(poses[child][3:], joints[name].axis / np.linalg.norm(joints[name].axis))
        carrying = ground[(spans[child][0] <= first) & (first < spans[child][1])]
        if joints[name].type == "prismatic":
            load[name] = share * len(carrying) * abs(float(axis[2]))
        else:
            lever = (carrying - poses[child][:3]).sum(axis=0)
            load[name] = share * abs(float(lever[1] * axis[0] - lever[0] * axis[1]))
    return load


def _carried_loads(robot: Robot, description: RobotDescription) -> tuple[dict[str, float], dict[str, float]]:
    """Returns the load of each moving joint with the robot at home, as two dictionaries: mass [kg] or inertia about the
    joint's origin [kg m2], and magnitude of the effort that the weight requires [N or N m].

    The inertia is about the worst axis through the joint, since the gains must suit any posture of an arm.
    """
    poses = description.link_poses(description.home)
    spans = _spans(description)
    bodies = [(link.name, link.inertial) for link in robot.links if link.inertial is not None and link.inertial.mass]
    mass = np.array([inertial.mass for _, inertial in bodies])
    centre = np.empty((len(bodies), 3))
    own = np.zeros(len(bodies))
    for i, (link, inertial) in enumerate(bodies):
        offset = inertial.origin[:3, 3] if inertial.origin is not None else np.zeros(3)
        centre[i] = frames.compose(poses[link], frames.pose(offset))[:3]
        own[i] = np.linalg.norm(inertial.inertia, 2) if inertial.inertia is not None else 0.0
    first = np.array([spans[description.link_anchors[link][0]][0] for link, _ in bodies], int)
    joints = {joint.name: joint for joint in robot.joints}
    carried = {}
    weight = {}
    for name, (_, child) in zip(description.moving_joints.names, description.moving_joints.frames, strict=True):
        distal = (spans[child][0] <= first) & (first < spans[child][1])
        axis = frames.rotate(poses[child][3:], joints[name].axis / np.linalg.norm(joints[name].axis))
        if joints[name].type == "prismatic":
            carried[name] = float(mass[distal].sum())
            weight[name] = STANDARD_GRAVITY * carried[name] * abs(float(axis[2]))
        else:
            lever = centre[distal] - poses[child][:3]
            carried[name] = float(mass[distal] @ (lever**2).sum(axis=1) + own[distal].sum())
            moment = mass[distal] @ lever
            weight[name] = STANDARD_GRAVITY * abs(float(moment[1] * axis[0] - moment[0] * axis[1]))
    return carried, weight


def _spans(description: RobotDescription) -> dict[str, tuple[int, int]]:
    """Returns the span [first, end) of each moving link, and of the root link, in a walk through the tree that visits a
    link before those it carries. So a link carries those whose first number is in its span, itself included."""
    children: dict[str, list[str]] = {}
    for parent, child in description.moving_joints.frames:
        children.setdefault(description.link_anchors[parent][0], []).append(child)
    first: dict[str, int] = {}
    spans: dict[str, tuple[int, int]] = {}
    waiting = [description.base]
    while waiting:
        link = waiting[-1]
        if link not in first:
            first[link] = len(first)
            waiting += children.get(link, ())
        else:
            spans[link] = first[link], len(first)
            waiting.pop()
    return spans
