"""Commands from ROS as plain values, so that other packages need no message types.

Times are simulation seconds, arrays are numpy float64.
"""

from __future__ import annotations

import dataclasses
import enum

import numpy as np

from vinesim.scene.values import GripperState, LightPattern


@dataclasses.dataclass(frozen=True, slots=True)
class BaseVelocity:
    """Commanded velocity of the base, in its own axes (TwistStamped on mobile_base_controller/cmd_vel)."""

    time: float
    """Header stamp [s]; 0 if the sender gave none."""
    linear: np.ndarray
    """Linear velocity [3] m/s."""
    angular: np.ndarray
    """Angular velocity [3] rad/s."""


@dataclasses.dataclass(frozen=True, slots=True)
class ForwardCommand:
    """Values for all joints of a forward controller (std_msgs/Float64MultiArray)."""

    controller: str
    values: np.ndarray
    """[joint] Positions, velocities or efforts [rad or m, rad/s or m/s, N m or N] in the controller's order of
    joints. NaN leaves a joint as it is."""


@dataclasses.dataclass(frozen=True, slots=True)
class HardwareCommand:
    """Commands of another controller manager for some joints (sensor_msgs/JointState). NaN: no command. A joint with
    several commands obeys its position, else its velocity."""

    controller: str
    joints: tuple[str, ...]
    position: np.ndarray
    """[joint] Positions [rad or m], NaN for none."""
    velocity: np.ndarray
    """[joint] Velocities [rad/s or m/s], NaN for none."""
    effort: np.ndarray
    """[joint] Efforts [N m or N], NaN for none."""


@dataclasses.dataclass(frozen=True, slots=True)
class ImpedanceCommand:
    """Gains or equilibrium of all joints of an impedance controller (std_msgs/Float64MultiArray)."""

    controller: str
    what: str
    """Quantity that is set: ``"stiffness"`` [N m/rad or N/m], ``"damping"`` [N m s/rad or N s/m] or
    ``"equilibrium"`` [rad or m]."""
    values: np.ndarray
    """[joint] Values in the controller's order of joints, in the unit of ``what``."""


@dataclasses.dataclass(frozen=True, slots=True)
class ElasticCommand:
    """Position of the motor of one series elastic joint (sensor_msgs/JointState on see/<joint>/command)."""

    controller: str
    joint: str
    position: float
    """Position of the motor, converted to the output of the gear [rad or m]."""


@dataclasses.dataclass(frozen=True, slots=True)
class JointTolerances:
    """Largest permitted errors of some joints (control_msgs/JointTolerance); infinite where there is no limit."""

    position: np.ndarray
    """[joint] Largest permitted position errors, rad or m."""
    velocity: np.ndarray
    """[joint] Largest permitted velocity errors, rad/s or m/s."""


@dataclasses.dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Waypoints of some joints (trajectory_msgs/JointTrajectory). A trajectory without points stops the joints at
    their present positions."""

    controller: str
    time: float
    """Start time [s]; 0: at once."""
    joints: tuple[str, ...]
    times: np.ndarray
    """[point] Times of the waypoints, s after the start, increasing."""
    positions: np.ndarray
    """[point, joint] Positions at the waypoints, rad or m."""
    velocities: np.ndarray | None
    """[point, joint] Velocities at the waypoints, rad/s or m/s; None if the message has none."""
    path_tolerance: JointTolerances | None = None
    """Tolerance on the way, for a goal of an action; None: the controller's tolerance."""
    goal_tolerance: JointTolerances | None = None
    """Tolerance at the end, for a goal of an action; None: the controller's tolerance."""
    goal_time_tolerance: float | None = None
    """[s] Permitted delay of the arrival, for a goal of an action; None: the controller's permitted delay."""
    goal: bytes | None = None
    """Id of the action goal; None: the trajectory came on a topic, so no action client waits for a result."""


@dataclasses.dataclass(frozen=True, slots=True)
class GripperGoal:
    """A goal of control_msgs/action/GripperCommand. The meaning of its values depends on the kind of gripper."""

    controller: str
    goal: bytes
    position: float
    max_effort: float | None
    """Largest effort; None: the gripper's own limit."""


@dataclasses.dataclass(frozen=True, slots=True)
class PlantWork:
    """Work on the wood at the robot's cutter (std_msgs/String on plant_work/command)."""

    what: str
    """``"tie"``, ``"untie"`` or ``"take_leaves"``."""


@dataclasses.dataclass(frozen=True, slots=True)
class LightsPattern:
    """Pattern of the indicator lights (std_msgs/String on indicator_lights/command)."""

    pattern: LightPattern


@dataclasses.dataclass(frozen=True, slots=True)
class LightsColor:
    """Colour of the indicator lights (std_msgs/ColorRGBA on indicator_lights/color)."""

    color: tuple[float, float, float] | None
    """sRGB from 0 to 1; None: the colour of the pattern."""


@dataclasses.dataclass(frozen=True, slots=True)
class LightsSound:
    """Whether a tone sounds while the indicator lights are lit (std_msgs/Bool on indicator_lights/sound)."""

    is_on: bool


@dataclasses.dataclass(frozen=True, slots=True)
class LoudspeakerSound:
    """Sound for the loudspeaker (audio_common_msgs/AudioData on speaker/audio), played after sound that arrived
    earlier."""

    pcm: bytes
    """Samples as PCM16 of 16 kHz, mono."""


@dataclasses.dataclass(frozen=True, slots=True)
class CancelGoal:
    """Request to cancel a goal of an action, by the id of the goal."""

    goal: bytes


Command = (
    BaseVelocity
    | ForwardCommand
    | HardwareCommand
    | ImpedanceCommand
    | ElasticCommand
    | JointTrajectory
    | GripperGoal
    | PlantWork
    | LightsPattern
    | LightsColor
    | LightsSound
    | LoudspeakerSound
    | CancelGoal
)


class GoalStatus(enum.StrEnum):
    """Final state of a goal, named as in action_msgs/GoalStatus."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELED = "canceled"


@dataclasses.dataclass(frozen=True, slots=True)
class GoalResult:
    """Result of a goal, sent from the client to the action server."""

    goal: bytes
    status: GoalStatus
    code: int
    """Error code of control_msgs/action/FollowJointTrajectory."""
    text: str = ""
    """Reason if the goal did not succeed; otherwise empty."""
    gripper: GripperState | None = None
    """State of the gripper, for a goal of a gripper; otherwise None."""


class SimulationAction(enum.StrEnum):
    """Kinds of requests from a ROS node to the simulation, named as in simulation_interfaces."""

    GET_STATE = "get_simulation_state"
    PLAY = "play"
    PAUSE = "pause"
    STEP = "step_simulation"
    CANCEL_STEPS = "cancel_steps"
    """End a :attr:`STEP` request before its last step. This request has the same number as the STEP request, and
    only the STEP request is answered."""
    GET_ENTITIES = "get_entities"
    GET_SPAWNABLES = "get_spawnables"
    SPAWN = "spawn_entity"
    DELETE = "delete_entity"
    SET_ENTITY_STATE = "set_entity_state"
    RESET = "reset_simulation"


class Refusal(enum.StrEnum):
    """Reasons to refuse a request, as in the results of simulation_interfaces."""

    UNSUPPORTED = "feature unsupported"
    NOT_FOUND = "not found"
    INCORRECT_STATE = "incorrect state"
    FAILED = "operation failed"
    NAME_NOT_UNIQUE = "name not unique"
    NAME_INVALID = "name invalid"
    UNSUPPORTED_FORMAT = "unsupported format"
    NO_RESOURCE = "no resource"
    RESOURCE_PARSE_ERROR = "resource parse error"
    MISSING_ASSETS = "missing assets"
    INVALID_POSE = "invalid pose"


class RequestRefused(Exception):
    """The simulation refuses a request. ``kind`` is the reason for programs, the message the reason for people."""

    def __init__(self, kind: Refusal, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class EntityCategory(enum.StrEnum):
    """Kinds of entities, as simulation_interfaces/EntityCategory names them."""

    OBJECT = "object"
    ROBOT = "robot"
    HUMAN = "human"
    DYNAMIC_OBJECT = "dynamic_object"


@dataclasses.dataclass(frozen=True, slots=True)
class Entity:
    """A named object, robot or person in the world, with its pose and velocity."""

    name: str
    category: EntityCategory
    pose: np.ndarray
    """Pose in the map [7] m, 1."""
    velocity: np.ndarray
    """Linear and angular velocity [6] m/s, rad/s in world axes; NaN if unknown."""
    description: str = ""
    """Description for people."""


@dataclasses.dataclass(frozen=True, slots=True)
class Spawnable:
    """A kind of entity that can be added to the world."""

    uri: str
    description: str
    low: tuple[float, float, float]
    """[m] Lower corner of the entity's bounding box, relative to the entity's pose."""
    high: tuple[float, float, float]
    """[m] Upper corner of the entity's bounding box, relative to the entity's pose."""


@dataclasses.dataclass(frozen=True, slots=True)
class EntityArguments:
    """Arguments of :attr:`SimulationAction.SPAWN`, ``DELETE`` and ``SET_ENTITY_STATE``."""

    name: str
    pose: np.ndarray | None = None
    """Requested pose in the map [7] m, 1. It has not been checked."""
    velocity: np.ndarray | None = None
    """Requested linear and angular velocity [6] m/s, rad/s in world axes. It has not been checked."""
    uri: str = ""
    allow_renaming: bool = False


@dataclasses.dataclass(frozen=True, slots=True)
class SimulationRequest:
    """A request to the simulation, which answers it between two steps."""

    number: int
    action: SimulationAction
    steps: int = 0
    """Number of steps of a :attr:`SimulationAction.STEP`."""
    wants_progress: bool = False
    """For :attr:`SimulationAction.STEP`: whether the simulation sends a :class:`StepProgress` after each step."""
    entity: EntityArguments | None = None
    keep_state: bool = False
    """For :attr:`SimulationAction.RESET`: whether spawned entities are removed and everything else stays as it is."""
    keep_spawned: bool = False
    """For :attr:`SimulationAction.RESET`: whether spawned entities are kept, at the pose where they were spawned."""


@dataclasses.dataclass(frozen=True, slots=True)
class StepProgress:
    """Progress of the step request with the same number. The :class:`SimulationReply` follows after the last step."""

    number: int
    completed: int
    remaining: int


@dataclasses.dataclass(frozen=True, slots=True)
class SimulationReply:
    """The answer to the request with the same number."""

    number: int
    time: float
    """Time of the world [s]."""
    is_paused: bool
    refusal: str = ""
    """Reason of a refusal, in one line; empty if the request was carried out."""
    kind: Refusal = Refusal.INCORRECT_STATE
    """Reason of a refusal, for programs. It has no meaning if ``refusal`` is empty."""
    name: str = ""
    """Name of the entity that was spawned."""
    spawnables: tuple[Spawnable, ...] = ()
    entities: tuple[Entity, ...] = ()
