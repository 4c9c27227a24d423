"""Commands from ROS as plain values, so that other packages need no message types.

Times are simulation seconds, arrays are numpy float64.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True)
class BaseVelocity:
    """Commanded velocity of the base, in its own axes (TwistStamped on mobile_base_controller/cmd_vel)."""

    time: float
    """Stamp of the sender [s]; 0 if it gave none."""
    linear: np.ndarray
    """[3] m/s"""
    angular: np.ndarray
    """[3] rad/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class JointPositions:
    """Commanded positions of all joints of a forward controller (std_msgs/Float64MultiArray)."""

    controller: str
    positions: np.ndarray
    """[joint] rad or m, in the controller's order of joints"""


@dataclasses.dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Way points of some joints (trajectory_msgs/JointTrajectory); no points: stop at the present positions."""

    controller: str
    time: float
    """Time of its start [s]; 0: now."""
    joints: tuple[str, ...]
    times: np.ndarray
    """[point] s after the start, rising"""
    positions: np.ndarray
    """[point, joint] rad or m"""
    velocities: np.ndarray | None
    """[point, joint] rad/s or m/s, or None if no point gives any."""


Command = BaseVelocity | JointPositions | JointTrajectory
