"""Conversion of command messages to plain values, by pure functions that raise :class:`CommandError` for invalid
messages."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from vinesim.ros.commands.types import (
    BaseVelocity,
    ElasticCommand,
    ForwardCommand,
    GripperGoal,
    HardwareCommand,
    ImpedanceCommand,
    JointTolerances,
    JointTrajectory,
    LightsColor,
    LightsPattern,
    LoudspeakerSound,
)
from vinesim.ros.messages.convert import seconds
from vinesim.scene.values import LightPattern

MAX_SOUND = 960_000
"""Largest size of the sound in one message [B]: half a minute."""


class CommandError(ValueError):
    """A command message that contradicts itself or the robot. The text gives the reason."""


def base_velocity(message: TwistStamped) -> BaseVelocity:
    """Convert a velocity command of the base, which must be finite."""
    linear = message.twist.linear
    angular = message.twist.angular
    velocity = np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    if not np.isfinite(velocity).all():
        raise CommandError(f"cmd_vel is not finite: {velocity.tolist()}")
    return BaseVelocity(seconds(message.header.stamp), velocity[:3], velocity[3:])


def lights_pattern(message: String) -> LightsPattern:
    """Convert the name of a pattern of the indicator lights."""
    try:
        return LightsPattern(LightPattern[message.data.strip().upper()])
    except KeyError:
        known = ", ".join(one.name.lower() for one in LightPattern)
        raise CommandError(f"no pattern of lights {message.data!r}; give one of {known}") from None


def lights_color(message: ColorRGBA) -> LightsColor:
    """Convert a colour of the indicator lights, sRGB and alpha from 0 to 1. Alpha 0 selects the colour of the
    pattern."""
    color = message.r, message.g, message.b
    if not all(0.0 <= part <= 1.0 for part in (*color, message.a)):
        raise CommandError(f"colour of lights {(*color, message.a)}; give four numbers from 0 to 1")
    return LightsColor(color if message.a > 0.0 else None)


def loudspeaker_sound(message: Any) -> LoudspeakerSound:
    """Convert sound for the loudspeaker: whole samples of PCM16, at most :data:`MAX_SOUND` bytes."""
    pcm = bytes(message.data)
    if len(pcm) % 2 or len(pcm) > MAX_SOUND:
        raise CommandError(f"sound of {len(pcm)} B; give PCM16 of 16 kHz, mono, at most {MAX_SOUND} B at a time")
    return LoudspeakerSound(pcm)


def _joint_values(message: Float64MultiArray, controller: str, joints: Sequence[str], *, nan: bool) -> np.ndarray:
    """Returns one value for each of ``joints``, which must be finite, or NaN if ``nan``."""
    values = np.array(message.data, float)
    if len(values) != len(joints):
        raise CommandError(f"{controller}: {len(values)} values; give one for each of {', '.join(joints)}")
    if np.isinf(values).any() or (np.isnan(values).any() and not nan):
        raise CommandError(f"{controller}: values are not finite: {values.tolist()}")
    return values


def forward_command(message: Float64MultiArray, controller: str, joints: Sequence[str]) -> ForwardCommand:
    """Convert the values for the ``joints`` of a forward controller. Each is finite, or NaN to leave the joint as it
    is."""
    return ForwardCommand(controller, _joint_values(message, controller, joints, nan=True))


def impedance_command(
    message: Float64MultiArray, controller: str, joints: Sequence[str], what: str
) -> ImpedanceCommand:
    """Convert gains or equilibrium positions for the ``joints`` of an impedance controller. They must be finite, and
    gains not below 0."""
    values = _joint_values(message, controller, joints, nan=False)
    if what != "equilibrium" and (values < 0.0).any():
        raise CommandError(f"{controller}: {what} below zero: {values.tolist()}; give 0 or more")
    return ImpedanceCommand(controller, what, values)


def elastic_command(message: JointState, controller: str, joint: str) -> ElasticCommand:
    """Convert the position of one motor: the only position in the message, or the one named ``joint``."""
    names = list(message.name)
    positions = list(message.position)
    place = names.index(joint) if joint in names else 0
    if place >= len(positions) or (names and joint not in names) or not np.isfinite(positions[place]):
        raise CommandError(f"{controller}/{joint}: positions {positions} of {names}; give a finite position of {joint}")
    return ElasticCommand(controller, joint, positions[place])


def hardware_command(
    message: JointState,
    controller: str,
    joints: Sequence[str],
    mimics: Container[str],
    renamed: Mapping[str, str] = {},
) -> HardwareCommand:
    """Convert commands for some of ``joints``. Each of position, velocity and effort is empty, or has one value for
    each name, NaN for none. Names in ``mimics``, of joints that follow others, are left out. ``renamed``: see
    :attr:`ControllerSpec.renamed`."""
    names = [renamed.get(name, name) for name in message.name]
    unknown = [name for name in names if name not in joints and name not in mimics]
    if unknown or len(set(names)) < len(names):
        found = f"commands for {', '.join(unknown) or 'a joint twice'}"
        raise CommandError(f"{controller}: {found}; name each joint once, among {', '.join(joints)}")
    kept = [place for place, name in enumerate(names) if name in joints]
    parts = {}
    for part in ("position", "velocity", "effort"):
        values = np.array(getattr(message, part), float)
        if len(values) not in (0, len(names)):
            raise CommandError(
                f"{controller}: {len(values)} values of {part} for {len(names)} joints; give one each, NaN for none "
                "(joint_state_topic_hardware_interface does so)"
            )
        if np.isinf(values).any():
            raise CommandError(f"{controller}: values of {part} are not finite: {values.tolist()}")
        parts[part] = values[kept] if len(values) else np.full(len(kept), np.nan)
    return HardwareCommand(controller, tuple(names[place] for place in kept), **parts)


def joint_trajectory(
    message: JointTrajectoryMessage,
    controller: str,
    known: Sequence[str],
    goal: bytes | None = None,
    renamed: Mapping[str, str] = {},
) -> JointTrajectory:
    """Convert a trajectory for some of the ``known`` joints of a controller. Each point must have one position per
    joint, and the times must increase from 0. ``renamed``: see :attr:`ControllerSpec.renamed`."""
    joints = tuple(renamed.get(joint, joint) for joint in message.joint_names)
    unknown = [joint for joint in joints if joint not in known]
    if unknown or len(set(joints)) < len(joints) or (message.points and not joints):
        raise CommandError(
            f"{controller}: a trajectory for {', '.join(joints) or 'nothing'}; "
            f"name joints among {', '.join(known)}, each at most once"
        )
    for i, point in enumerate(message.points):
        if len(point.positions) != len(joints) or len(point.velocities) not in (0, len(joints)):
            raise CommandError(
                f"{controller}: point {i} has {len(point.positions)} positions and {len(point.velocities)} velocities "
                f"for {len(joints)} joints; give one of each per joint, or no velocities"
            )
    start = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
    times = np.array(start, float)
    if (np.diff(times) <= 0.0).any() or (len(times) and times[0] < 0.0):
        raise CommandError(f"{controller}: time_from_start does not increase from 0: {start}")
    positions = np.array([p.positions for p in message.points], float).reshape(len(times), len(joints))
    with_velocity = len(times) > 0 and all(len(p.velocities) for p in message.points) and len(joints) > 0
    velocities = np.array([p.velocities for p in message.points], float) if with_velocity else None
    if not np.isfinite(positions).all() or (velocities is not None and not np.isfinite(velocities).all()):
        raise CommandError(f"{controller}: the trajectory is not finite")
    return JointTrajectory(controller, seconds(message.header.stamp), joints, times, positions, velocities, goal=goal)


def trajectory_goal(
    request: Any, controller: str, known: Sequence[str], goal: bytes, renamed: Mapping[str, str] = {}
) -> JointTrajectory:
    """Convert a goal of control_msgs/action/FollowJointTrajectory with its tolerances. Its trajectory must have at
    least one point. ``renamed``: see :attr:`ControllerSpec.renamed`."""
    plain = joint_trajectory(request.trajectory, controller, known, goal, renamed)
    if len(plain.times) == 0:
        raise CommandError(f"{controller}: a goal without points; give at least one, or cancel the previous goal")
    late = request.goal_time_tolerance.sec + 1e-9 * request.goal_time_tolerance.nanosec
    return JointTrajectory(
        controller,
        plain.time,
        plain.joints,
        plain.times,
        plain.positions,
        plain.velocities,
        path_tolerance=_tolerances(request.path_tolerance, plain.joints, controller, renamed),
        goal_tolerance=_tolerances(request.goal_tolerance, plain.joints, controller, renamed),
        goal_time_tolerance=late if late > 0.0 else None,
        goal=goal,
    )


def _tolerances(
    given: Iterable[Any], joints: tuple[str, ...], controller: str, renamed: Mapping[str, str]
) -> JointTolerances | None:
    """Returns tolerances in the order of ``joints``, or None if none is given. In ``given``, 0 means not specified
    and a negative value means unlimited."""
    position = np.full(len(joints), np.inf)
    velocity = np.full(len(joints), np.inf)
    said = False
    for one in given:
        name = renamed.get(one.name, one.name)
        if name not in joints:
            raise CommandError(f"{controller}: a tolerance for {one.name!r}, which the trajectory does not move")
        place = joints.index(name)
        for values, limit in ((position, one.position), (velocity, one.velocity)):
            if np.isnan(limit):
                raise CommandError(f"{controller}: the tolerance for {one.name!r} is not a number")
            if limit > 0.0:
                values[place] = limit
                said = True
    return JointTolerances(position, velocity) if said else None


def gripper_goal(request: Any, controller: str, goal: bytes) -> GripperGoal:
    """Convert a goal of control_msgs/action/GripperCommand. A max_effort of 0 or below means the gripper's own
    limit."""
    command = request.command
    if not np.isfinite([command.position, command.max_effort]).all():
        raise CommandError(f"{controller}: position {command.position}, max_effort {command.max_effort}: not finite")
    return GripperGoal(controller, goal, command.position, command.max_effort if command.max_effort > 0.0 else None)
