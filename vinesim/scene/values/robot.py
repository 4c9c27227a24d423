"""Robots: their description for the physics, and their own measurements."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping

import numpy as np

from vinesim.scene.values.world import Contact


@dataclasses.dataclass(frozen=True, slots=True)
class Drive:
    """One actuated joint of a robot: a servo with limits."""

    joint: str
    stiffness: float
    """Position gain [N m/rad or N/m]."""
    damping: float
    """Velocity gain [N m s/rad or N s/m]."""
    effort: float
    """Largest effort [N m or N]."""
    velocity: float
    """Largest speed [rad/s or m/s]."""
    lower: float
    """Lower limit of the joint [rad or m]."""
    upper: float
    """Upper limit of the joint [rad or m]."""
    armature: float = 0.0
    """Inertia of motor and gear at the joint [kg m2 or kg]. It grows with the square of the gear ratio.

    A stiff servo at its effort limit needs an armature: a hand of 0.02 kg m2 without one gains 20 rad/s in a tick under
    40 N m.
    """
    series_stiffness: float = 0.0
    """Stiffness of the spring between gear and joint [N m/rad or N/m]; 0: the position gain is used instead."""
    series_damping: float = 0.0
    """Damping of the spring between gear and joint [N m s/rad or N s/m]; unused if ``series_stiffness`` is 0."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotSpec:
    """Description of a robot for the physics. ``robot/description/description.py`` makes one from a URDF."""

    name: str
    """The actor's name, which is a prefix of the names of its bodies."""
    index: int
    """Index of the robot in label images (:func:`vinesim.scene.ids.label`)."""
    urdf: str
    """URDF as text, every mesh by absolute path."""
    base: str
    """Name of the root link, whose origin stands on the ground (base_footprint)."""
    pose: np.ndarray
    """[7] start pose of the base in the world."""
    drives: tuple[Drive, ...]
    """Drives, in the order of all joint arrays (commands, samples, updates)."""
    home: np.ndarray
    """[joint] rad or m, position of each joint at the start, in the order of ``drives``."""
    base_effort: tuple[float, float] = (800.0, 400.0)
    """Largest force [N] and moment [N m] with which the tracks hold or drive the base."""
    meshes: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Corners [face, 3, 3] m of meshes that were received over the network because this machine lacks their files, by
    the file name in the URDF."""
    is_copy: bool = False
    """Whether the robot is a copy of a robot that another client simulates. The links of a copy do not collide with
    each other and the ground: the received states already include these contacts, and the boxes that replace meshes in
    a copy would collide wrongly."""
    has_free_base: bool = False
    """Whether the base moves freely and the robot stands on its legs. Otherwise the base is driven, or bolted down."""


class ControllerKind(enum.StrEnum):
    """Kind of a robot's controller, with the name of ros2_controllers if one exists."""

    JOINT_TRAJECTORY = "joint_trajectory"
    GRIPPER = "gripper"
    FORWARD_POSITION = "forward_position"
    FORWARD_VELOCITY = "forward_velocity"
    FORWARD_EFFORT = "forward_effort"
    IMPEDANCE = "impedance"
    SERIES_ELASTIC = "series_elastic"
    TOPIC_BASED = "topic_based"
    """No controller of vinesim: the joints are hardware of another controller manager, by two topics."""


FORWARD_KINDS = (ControllerKind.FORWARD_POSITION, ControllerKind.FORWARD_VELOCITY, ControllerKind.FORWARD_EFFORT)
"""Kinds of controllers that send the command for each joint unchanged to its drive."""


@dataclasses.dataclass(frozen=True, slots=True)
class HardwareTopics:
    """Topics by which joints are the hardware of another controller manager, with the default names of
    ``topic_based_ros2_control`` and ``joint_state_topic_hardware_interface``."""

    commands: str = "robot_joint_commands"
    """Topic of the commands (sensor_msgs/JointState), relative to the robot's namespace."""
    states: str = "robot_joint_states"
    """Topic of the states (sensor_msgs/JointState), relative to the robot's namespace."""
    timeout: float = 0.5
    """Time after the last command at which a joint with a velocity or an effort stops [s]. Positions are held."""


@dataclasses.dataclass(frozen=True, slots=True)
class ControllerSpec:
    """One controller of a robot: prefix of its topics and actions, kind, and the joints that it moves."""

    name: str
    kind: ControllerKind
    joints: tuple[str, ...]
    """Joints in the order of the controller's commands; empty for a gripper without joints, such as a cutter."""
    group: str = ""
    """Name of the joint group of the gripper; empty if the controller does not control a gripper."""
    gripper: str = ""
    """Kind of the gripper, see :mod:`vinesim.robot.description.grippers`; empty for other controllers."""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict, compare=False)
    """Names of joints by those that they have in the robot file, where these are not valid in ROS. Commands may use
    either."""
    hardware: HardwareTopics | None = None
    """Topics of a controller of the kind ``topic_based``; None for other controllers."""


@dataclasses.dataclass(frozen=True, slots=True)
class JointSample:
    """Measured state of the joints of one robot at one instant, in the order of ``names``."""

    time: float
    names: tuple[str, ...]
    position: np.ndarray
    """[joint] rad or m, joint positions."""
    velocity: np.ndarray
    """[joint] rad/s or m/s, joint velocities."""
    effort: np.ndarray
    """[joint] N m or N, effort of the drive. At rest it is the load by gravity minus J^T f, the load by contact forces
    f with the contact Jacobian J."""
    contact: np.ndarray
    """[joint] N m or N, load by the contact forces f alone: J^T f with the contact Jacobian J."""


@dataclasses.dataclass(frozen=True, slots=True)
class JointReference:
    """Positions and velocities that a robot's controllers command to its joints in one step, in the order of
    :attr:`RobotSpec.drives`.
    """

    position: np.ndarray
    """[joint] rad or m, joint positions."""
    velocity: np.ndarray
    """[joint] rad/s or m/s, joint velocities."""


@dataclasses.dataclass(frozen=True, slots=True)
class GripperState:
    """Progress or result of a gripper's goal (control_msgs/GripperCommand).

    :mod:`vinesim.robot.control.gripper_controllers` defines the meaning of the values for each kind of gripper.
    """

    position: float
    effort: float
    stalled: bool = False
    """Whether the gripper stopped before it reached its goal."""
    reached_goal: bool = False

    @property
    def is_done(self) -> bool:
        """Whether the goal has ended."""
        return self.stalled or self.reached_goal


@dataclasses.dataclass(frozen=True, slots=True)
class ElasticSample:
    """Series elastic elements of all joints at one instant (D6.4 section 3.1): springs between motor and link."""

    time: float
    names: tuple[str, ...]
    stiffness: np.ndarray
    """[joint] N m/rad or N/m, stiffness of the spring."""
    motor: np.ndarray
    """[joint] rad or m, position of the motor after its gear; the link is at ``motor - deflection``."""
    deflection: np.ndarray
    """[joint] rad or m, deflection of the spring."""
    torque: np.ndarray
    """[joint] N m or N, stiffness times deflection: the effort that the spring transmits to the joint."""


@dataclasses.dataclass(frozen=True, slots=True)
class Wrench:
    """Reading of a force-torque sensor: the wrench of all bodies beyond it, including weight and inertia."""

    time: float
    name: str
    frame: str
    force: np.ndarray
    """[3] N, force on the sensor, in its frame; a hand at rest pulls downwards."""
    torque: np.ndarray
    """[3] N m, torque about the frame's origin."""


@dataclasses.dataclass(frozen=True, slots=True)
class Imu:
    """Reading of an inertial measurement unit (sensor_msgs/Imu), without noise."""

    time: float
    name: str
    frame: str
    orientation: np.ndarray
    """[4] orientation of the frame in the world."""
    angular_velocity: np.ndarray
    """[3] rad/s, angular velocity in the axes of the sensor's frame."""
    linear_acceleration: np.ndarray
    """[3] m/s2, acceleration in the axes of the sensor's frame; at rest 9.81 upwards (REP-145)."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotSample:
    """Proprioception of a robot at one instant."""

    actor: str
    joints: JointSample
    base_q: np.ndarray
    """[7] pose of base_footprint in the world (= ``map``)."""
    base_qd: np.ndarray
    """[6] velocity of base_footprint, world axes."""
    odom_q: np.ndarray
    """[7] pose of base_footprint by odometry, in the frame ``odom``."""
    odom_qd: np.ndarray
    """[6] velocity by odometry, in the axes of base_footprint; 0 along axes that odometry does not measure."""
    odom_covariance: np.ndarray
    """[2, 3, 3] covariances of x, y and yaw by odometry, m and rad: first of ``odom_q``, then of ``odom_qd``."""
    transforms: tuple[tuple[str, str], ...]
    """Names (parent frame, child frame) of the transform of every moving joint. The same tuple object in every tick, so
    that it can be compared by identity."""
    transform_q: np.ndarray
    """[transform, 7] pose of the child frame in the parent frame."""
    contacts: tuple[Contact, ...] = ()
    elements: ElasticSample | None = None
    wrenches: tuple[Wrench, ...] = ()
    imus: tuple[Imu, ...] = ()
    reference: JointReference | None = None
    odom_is_spatial: bool = False
    """Whether odometry measures z, roll and pitch too, as exactly as x: the robot stands on legs."""
