"""What comes in from ROS, as plain values: no room above or beside needs to know a message type.

Times are simulation seconds, arrays are numpy float64.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True)
class BaseVelocity:
    """Wanted velocity of the base, in its own axes (geometry_msgs/TwistStamped on mobile_base_controller/cmd_vel)."""

    time: float
    """Stamp of the sender; 0 if it gave none."""
    linear: np.ndarray
    """[3] m/s"""
    angular: np.ndarray
    """[3] rad/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class JointPositions:
    """Wanted positions of all joints of a forward controller (std_msgs/Float64MultiArray)."""

    controller: str
    positions: np.ndarray
    """[joint] rad or m, in the controller's order of joints"""


@dataclasses.dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Way points of some joints (trajectory_msgs/JointTrajectory); no points means: stop where you are."""

    controller: str
    time: float
    """When it starts; 0 means now."""
    joints: tuple[str, ...]
    times: np.ndarray
    """[point] s after the start, rising"""
    positions: np.ndarray
    """[point, joint] rad or m"""
    velocities: np.ndarray | None
    """[point, joint] rad/s or m/s, or None if no point gives any."""


Command = BaseVelocity | JointPositions | JointTrajectory
