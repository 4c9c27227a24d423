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
    """Time stamp of the sender [s]; 0 if the sender gave none."""
    linear: np.ndarray
    """[3] m/s"""
    angular: np.ndarray
    """[3] rad/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class ForwardCommand:
    """Values for all joints of a forward controller (std_msgs/Float64MultiArray)."""

    controller: str
    values: np.ndarray
    """[joint] Positions, velocities or efforts [rad or m, rad/s or m/s, N m or N] in the controller's order of joints.
    NaN leaves a joint alone."""


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
    """Position of the motor, converted to the output of the gear [rad or m]."""


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
    """Tolerance at the end, for a goal of an action; None: the controller's tolerance."""
    goal_time_tolerance: float | None = None
    """[s] Permitted delay of the arrival, for a goal of an action; None: the controller's."""
    goal: bytes | None = None
    """Id of the action's goal; None: it came on a topic, so no client waits for its result."""


@dataclasses.dataclass(frozen=True, slots=True)
class GripperGoal:
    """A goal of a gripper (control_msgs/action/GripperCommand). Its meaning depends on the kind of gripper."""

    controller: str
    goal: bytes
    position: float
    max_effort: float | None
    """Largest effort; None: the own limit of the gripper."""


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
    """Sound to be played after the sound that plays now (audio_common_msgs/AudioData on speaker/audio)."""

    pcm: bytes
    """PCM16 of 16 kHz, mono."""


@dataclasses.dataclass(frozen=True, slots=True)
class CancelGoal:
    """Request to cancel a goal."""

    goal: bytes


Command = (
    BaseVelocity
    | ForwardCommand
    | ImpedanceCommand
    | ElasticCommand
    | JointTrajectory
    | GripperGoal
    | LightsPattern
    | LightsColor
    | LightsSound
    | LoudspeakerSound
    | CancelGoal
)


class GoalStatus(enum.StrEnum):
    """How a goal ended, as action_msgs/GoalStatus has it."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELED = "canceled"


@dataclasses.dataclass(frozen=True, slots=True)
class GoalResult:
    """How a goal ended, on its way back to the action server."""

    goal: bytes
    status: GoalStatus
    code: int
    """Error code of control_msgs/action/FollowJointTrajectory."""
    text: str = ""
    gripper: GripperState | None = None


class SimulationAction(enum.StrEnum):
    """Kinds of requests of a node to the simulation, named as in simulation_interfaces."""

    GET_STATE = "get_simulation_state"
    PLAY = "play"
    PAUSE = "pause"
    STEP = "step_simulation"
    CANCEL_STEPS = "cancel_steps"
    """End a :attr:`STEP` before its last step. The request has the number of the STEP request, which is answered."""
    GET_ENTITIES = "get_entities"
    GET_SPAWNABLES = "get_spawnables"
    SPAWN = "spawn_entity"
    DELETE = "delete_entity"
    SET_ENTITY_STATE = "set_entity_state"
    RESET = "reset_simulation"


class Refusal(enum.StrEnum):
    """Reasons for which a request was not done, as in the results of simulation_interfaces."""

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
    """A request was not done: ``kind`` for programs, the text for people."""

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
    """Something in the world that has a name, a pose and a velocity."""

    name: str
    category: EntityCategory
    pose: np.ndarray
    """[7] m, 1 in the map"""
    velocity: np.ndarray
    """[6] m/s, rad/s, world axes; NaN where it is not known"""
    description: str = ""
    """What it is, for people."""


@dataclasses.dataclass(frozen=True, slots=True)
class Spawnable:
    """Something that can be added to the world."""

    uri: str
    description: str
    low: tuple[float, float, float]
    """[m] Lower corner of its bounding box, relative to its pose."""
    high: tuple[float, float, float]
    """[m] Upper corner of its bounding box, relative to its pose."""


@dataclasses.dataclass(frozen=True, slots=True)
class EntityArguments:
    """Arguments of :attr:`SimulationAction.SPAWN`, ``DELETE`` and ``SET_ENTITY_STATE``."""

    name: str
    pose: np.ndarray | None = None
    """[7] m, 1 in the map, not checked yet."""
    velocity: np.ndarray | None = None
    """[6] m/s, rad/s, world axes, not checked yet."""
    uri: str = ""
    allow_renaming: bool = False


@dataclasses.dataclass(frozen=True, slots=True)
class SimulationRequest:
    """A request to the simulation; it is answered between two steps."""

    number: int
    action: SimulationAction
    steps: int = 0
    """Number of steps of a :attr:`SimulationAction.STEP`."""
    wants_progress: bool = False
    """For :attr:`SimulationAction.STEP`: whether the simulation sends a :class:`StepProgress` after each step."""
    entity: EntityArguments | None = None
    keep_state: bool = False
    """For :attr:`SimulationAction.RESET`: only spawned entities are removed."""
    keep_spawned: bool = False
    """For :attr:`SimulationAction.RESET`: spawned entities stay, at the place where they were spawned."""


@dataclasses.dataclass(frozen=True, slots=True)
class StepProgress:
    """How far the steps of the request of the same number are; its answer follows after the last."""

    number: int
    completed: int
    remaining: int


@dataclasses.dataclass(frozen=True, slots=True)
class SimulationReply:
    """The answer to a request of the same number."""

    number: int
    time: float
    """[s] of the world"""
    is_paused: bool
    refusal: str = ""
    """Why it was not done, in one line; empty if it was."""
    kind: Refusal = Refusal.INCORRECT_STATE
    """Of the refusal, if there is one."""
    name: str = ""
    """Of the entity that was spawned."""
    spawnables: tuple[Spawnable, ...] = ()
    entities: tuple[Entity, ...] = ()
