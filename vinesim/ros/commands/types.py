"""Commands from ROS as plain values, so that other packages need no message types.

Times are simulation seconds, arrays are numpy float64.
"""

from __future__ import annotations

import dataclasses
import enum

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
class ForwardCommand:
    """Values for all joints of a forward controller (std_msgs/Float64MultiArray)."""

    controller: str
    values: np.ndarray
    """[joint] rad or m, rad/s or m/s, N m or N, in the controller's order of joints; NaN leaves a joint alone"""


@dataclasses.dataclass(frozen=True, slots=True)
class ImpedanceCommand:
    """Gains or equilibrium of all joints of an impedance controller (std_msgs/Float64MultiArray)."""

    controller: str
    what: str
    """``"stiffness"`` [N m/rad or N/m], ``"damping"`` [N m s/rad or N s/m], ``"equilibrium"`` [rad or m]"""
    values: np.ndarray
    """[joint]"""


@dataclasses.dataclass(frozen=True, slots=True)
class ElasticCommand:
    """Position of the motor of one series elastic joint (sensor_msgs/JointState on see/<joint>/command)."""

    controller: str
    joint: str
    position: float
    """rad or m, seen from behind the gear"""


@dataclasses.dataclass(frozen=True, slots=True)
class JointTolerances:
    """Permitted errors of some joints (control_msgs/JointTolerance), each [joint]; infinite: no limit."""

    position: np.ndarray
    """rad or m"""
    velocity: np.ndarray
    """rad/s or m/s"""


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
    path_tolerance: JointTolerances | None = None
    goal_tolerance: JointTolerances | None = None
    """Of an action's goal; None: the controller's."""
    goal_time_tolerance: float | None = None
    """[s] Likewise."""
    goal: bytes | None = None
    """Id of the action's goal; None: it came on a topic, and nobody waits for its end."""


@dataclasses.dataclass(frozen=True, slots=True)
class GripperGoal:
    """A goal of a gripper or cutter (control_msgs/action/GripperCommand)."""

    controller: str
    goal: bytes
    position: float
    """Opening between the fingers [m or rad]; of no meaning for a cutter, which closes once."""
    max_effort: float | None
    """[N or N m] a finger, or of the blades; None: all there is."""


@dataclasses.dataclass(frozen=True, slots=True)
class CancelGoal:
    """A goal is to end."""

    goal: bytes


Command = BaseVelocity | ForwardCommand | ImpedanceCommand | ElasticCommand | JointTrajectory | GripperGoal | CancelGoal


class GoalStatus(enum.StrEnum):
    """How a goal ended, as action_msgs/GoalStatus has it."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELED = "canceled"


@dataclasses.dataclass(frozen=True, slots=True)
class GripperResult:
    """Fields of control_msgs/action/GripperCommand's result and feedback."""

    position: float
    effort: float
    stalled: bool
    reached_goal: bool


@dataclasses.dataclass(frozen=True, slots=True)
class GoalResult:
    """How a goal ended, on its way back to the action server."""

    goal: bytes
    status: GoalStatus
    code: int
    """Error code of control_msgs/action/FollowJointTrajectory."""
    text: str = ""
    gripper: GripperResult | None = None
