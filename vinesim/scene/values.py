"""What rooms hand each other: small frozen values, so that siblings never import one another.

Times are simulation seconds. Arrays are numpy, poses and velocities as in :mod:`vinesim.frames`.
A value that leaves the physics thread owns its arrays: nobody writes them afterwards.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.ids import LABEL_STRIDE, Organ


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles, seen from where their corners run counter-clockwise."""

    corners: np.ndarray
    """[face, 3, 3] m"""
    normals: np.ndarray
    """[face, 3, 3] of the smooth surface at each corner."""


@dataclasses.dataclass(frozen=True, slots=True)
class Shape:
    """One visible or touchable primitive, in the frame of the link or body that carries it.

    ``kind`` is ``"capsule"`` (size: radius, half length along z), ``"sphere"`` (radius), ``"ellipsoid"``
    (half axes), ``"box"`` (half edges), ``"cylinder"`` (radius, half length along z), ``"cone"`` with round ends
    (radii at -z and +z, half length along z) or ``"mesh"`` (scale; ``file`` or ``mesh``).
    """

    kind: str
    size: tuple[float, ...]
    pose: np.ndarray
    """[7] m, 1"""
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.6, 1.0)
    """sRGB"""
    file: str = ""
    surface: str = ""
    """What it is made of (:data:`vinesim.scene.appearance.SURFACES`); empty: what such things are usually made of."""
    mesh: Mesh | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class RigidVisual:
    """One rigid body as sensors see it: its name, what it is, and its shapes."""

    name: str
    """Full name, ``actor/link`` or ``box/3``."""
    organ: Organ
    index: int
    """Which robot, human or box: the index of its label."""
    shapes: tuple[Shape, ...]


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
    upper: float
    """Limits of the joint [rad or m]."""
    armature: float = 0.0
    """Inertia of motor and gear seen from the joint [kg m2 or kg]: the gear ratio squared makes it the larger part.

    A stiff servo at its effort limit needs it: a bare hand of 0.02 kg m2 under 40 N m gains 20 rad/s in a tick.
    """
    series_stiffness: float = 0.0
    """Stiffness of the spring between gear and joint [N m/rad or N/m]; 0: the position gain stands for it."""
    series_damping: float = 0.0
    """Damping of that spring [N m s/rad or N s/m]; of no meaning if ``series_stiffness`` is 0."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotSpec:
    """A robot as physics needs it. ``robot/description/description.py`` makes one from a URDF."""

    name: str
    """The actor's name: prefix of everything it owns."""
    index: int
    """Index of its label."""
    urdf: str
    """URDF as text, every mesh by absolute path."""
    base: str
    """Name of the root link, whose origin stands on the ground (base_footprint)."""
    pose: np.ndarray
    """[7] start pose of the base in the world."""
    drives: tuple[Drive, ...]
    """In the order of joint arrays everywhere else (commands, samples, updates)."""
    home: np.ndarray
    """[joint] start position."""
    base_effort: tuple[float, float] = (800.0, 400.0)
    """Largest force [N] and moment [N m] with which the tracks hold or drive the base."""


@dataclasses.dataclass(frozen=True, slots=True)
class HumanPose:
    """Where a person's tracked points are at one instant: all that crosses the network (CANOPIES D6.4, section 5.3).

    All poses [7] in the world, x forward, z up for a person who stands upright.
    """

    root: np.ndarray
    """Floor of the tracked space."""
    head: np.ndarray
    """Head-mounted display: between the eyes."""
    left: np.ndarray
    """Controller of the left hand, in the middle of the palm: x along the fingers, z out of the back of the hand."""
    right: np.ndarray
    hips: np.ndarray
    """Middle between the hip joints."""
    left_foot: np.ndarray
    """Ankle, x to the toes."""
    right_foot: np.ndarray
    left_closed: bool = False
    """Whether the hand closes on what it touches; what it holds it keeps until this is false again."""
    right_closed: bool = False
    left_fingers: tuple[float, ...] = (0.0,) * 5
    """How far thumb, index, middle, ring and little finger are bent: 0 straight, 1 all the way. To be seen only."""
    right_fingers: tuple[float, ...] = (0.0,) * 5
    left_busy: bool = False
    """The hand pushes a robot or holds something, says its own client: ``left`` is where the palm then is, not the
    controller, and the copy goes there and touches nothing. Of no meaning where the person is at home."""
    right_busy: bool = False

    @property
    def points(self) -> np.ndarray:
        """[7, 7] all poses, in the order of :data:`POINT_NAMES`."""
        return np.stack([getattr(self, name) for name in POINT_NAMES])

    def with_points(self, points: np.ndarray) -> HumanPose:
        """The same hands and fingers with all poses [7, 7] elsewhere."""
        return dataclasses.replace(self, **dict(zip(POINT_NAMES, points, strict=True)))


POINT_NAMES = ("root", "head", "left", "right", "hips", "left_foot", "right_foot")
"""Poses of a :class:`HumanPose`."""


@dataclasses.dataclass(frozen=True, slots=True)
class HumanSpec:
    """A person as physics needs one."""

    name: str
    """The actor's name: prefix of everything it owns."""
    index: int
    """Index of its label."""
    pose: HumanPose
    """At the start."""
    height: float = 1.75
    """[m] It gives the limbs their lengths."""
    stiffness: float | None = None
    """Force of a hand in contact per offset from its controller [N/m]; None: ``PhysicsParameters.hand_stiffness``."""
    force: float | None = None
    """Largest force of a hand [N]; None: ``PhysicsParameters.hand_force``."""


@dataclasses.dataclass(frozen=True, slots=True)
class HandSample:
    """One hand at the end of a tick."""

    pose: np.ndarray
    """[7] of the palm in the world."""
    controller: np.ndarray
    """[7] where the person holds the controller."""
    force: np.ndarray
    """[3] N with which the hand pushes or pulls the world in this tick, world axes."""
    touching: bool
    held: tuple[str, str] | None
    """Actor and link of what it holds, named as in :class:`Contact`."""


@dataclasses.dataclass(frozen=True, slots=True)
class Haptic:
    """One vibration that a person's controller is asked for."""

    actor: str
    hand: str
    """``"left"`` or ``"right"``."""
    onset: bool
    """A touch has just begun; otherwise it goes on."""
    amplitude: float
    """0 to 1, the share of the hand's greatest force; an onset is never weaker than can be felt."""
    duration: float
    """[s]"""


@dataclasses.dataclass(frozen=True, slots=True)
class Snapshot:
    """The whole world at one instant, as sensors need it: taken by the physics thread, read by any other."""

    time: float
    """[s]"""
    tick: int
    body_q: np.ndarray
    """Plant bodies [body, 7] m, 1."""
    bunch_attached: np.ndarray
    """[bunch] bool"""
    visuals: tuple[RigidVisual, ...]
    """Rigid bodies; the same tuple object as long as no actor comes or goes."""
    visual_q: np.ndarray
    """Their poses [link, 7] m, 1."""
    moved_trees: np.ndarray
    """Indices of the trees that are awake [k]: only these have moved since they fell asleep."""


@dataclasses.dataclass(frozen=True, slots=True)
class Contact:
    """One contact of a rigid body with a plant, as solved in one tick."""

    actor: str
    link: str
    body: int
    """Plant body in the model."""
    position: np.ndarray
    """[3] m, world"""
    force: np.ndarray
    """[3] N on the rigid body, world axes; the plant feels the opposite."""
    distance: float
    """Gap [m], negative when they overlap."""


@dataclasses.dataclass(frozen=True, slots=True)
class Detachment:
    """Something left its plant: a bunch its peduncle, or a cane the rest of its tree."""

    tick: int
    tree: int
    body: int
    """The body that left; what grows on it went with it."""
    bunch: int
    """Which bunch, -1 for a cane."""
    cause: str
    """``"pull"`` (too much force), ``"bend"`` (too much moment), ``"blade"`` (a cutter closed on it), ``"command"``."""
    actor: str
    """Whose doing it was, as far as is known; empty otherwise."""
    force: np.ndarray
    """[3] N that the joint carried at the end, world axes, on what left."""
    moment: np.ndarray
    """[3] N m about the joint."""


@dataclasses.dataclass(frozen=True, slots=True)
class JointSample:
    """Joints of one robot at one instant, in the order of ``names``."""

    time: float
    names: tuple[str, ...]
    position: np.ndarray
    """[joint] rad or m"""
    velocity: np.ndarray
    """[joint] rad/s or m/s"""
    effort: np.ndarray
    """[joint] N m or N: what the drive transmits; at rest gravity load minus J^T f of the contacts."""
    contact: np.ndarray
    """[joint] N m or N: J^T f of the contacts alone."""


@dataclasses.dataclass(frozen=True, slots=True)
class ElasticSample:
    """The series elastic element of every joint at one instant (D6.4 section 3.1): a spring between motor and link."""

    time: float
    names: tuple[str, ...]
    stiffness: np.ndarray
    """[joint] N m/rad or N/m"""
    motor: np.ndarray
    """[joint] rad or m: the motor, seen from behind its gear; the link is at ``motor - deflection``."""
    deflection: np.ndarray
    """[joint] rad or m"""
    torque: np.ndarray
    """[joint] N m or N: stiffness times deflection, all that the joint carries."""


@dataclasses.dataclass(frozen=True, slots=True)
class Wrench:
    """What a force-torque sensor measures: the pull of all that lies beyond it, weight and inertia included."""

    time: float
    name: str
    frame: str
    force: np.ndarray
    """[3] N on the sensor, in its frame: a hand at rest weighs down."""
    torque: np.ndarray
    """[3] N m about the frame's origin."""


@dataclasses.dataclass(frozen=True, slots=True)
class Imu:
    """What an inertial measurement unit measures (sensor_msgs/Imu), without noise."""

    time: float
    name: str
    frame: str
    orientation: np.ndarray
    """[4] of the frame in the world."""
    angular_velocity: np.ndarray
    """[3] rad/s in the frame."""
    linear_acceleration: np.ndarray
    """[3] m/s2 in the frame; at rest it reads 9.81 upwards (REP-145)."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotSample:
    """What a robot knows of itself at one instant."""

    actor: str
    joints: JointSample
    base_q: np.ndarray
    """[7] base_footprint in the world (= ``map``)."""
    base_qd: np.ndarray
    """[6] its velocity, world axes."""
    odom_q: np.ndarray
    """[7] base_footprint as odometry believes it, in ``odom``."""
    transforms: tuple[tuple[str, str], ...]
    """(parent frame, child frame) of every moving joint, the same tuple object every tick."""
    transform_q: np.ndarray
    """[transform, 7] child in parent."""
    contacts: tuple[Contact, ...] = ()
    elements: ElasticSample | None = None
    wrenches: tuple[Wrench, ...] = ()
    imus: tuple[Imu, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True)
class CameraInfo:
    """Pinhole intrinsics (sensor_msgs/CameraInfo; plumb_bob with zero distortion)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    frame_id: str
    """Optical frame: z forward, x right, y down."""


@dataclasses.dataclass(frozen=True, slots=True)
class CameraFrame:
    """One RGB-D picture."""

    time: float
    name: str
    info: CameraInfo
    pose: np.ndarray
    """[7] optical frame in the world when the picture was taken."""
    rgb: np.ndarray
    """[height, width, 3] uint8"""
    depth: np.ndarray
    """[height, width] float32 m along z; NaN no return, -Inf too near, +Inf too far (REP-118)."""
    labels: np.ndarray
    """[height, width] int32, :func:`vinesim.scene.ids.label`; 0 is nothing."""
    exact_depth: np.ndarray | None = None
    """[height, width] float32 m along z, whatever the sensor can measure: no noise, no gaps; +Inf for the sky."""

    @property
    def organs(self) -> np.ndarray:
        """[height, width] :class:`~vinesim.scene.ids.Organ` of each pixel; 0 is nothing."""
        return self.labels // LABEL_STRIDE

    @property
    def instances(self) -> np.ndarray:
        """[height, width] index of the bunch, box, tree or actor of each pixel, counted for each organ from 0."""
        return self.labels % LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class LidarScan:
    """One revolution of a lidar; shots that returned nothing are left out."""

    time: float
    """Time of the first firing [s]."""
    name: str
    frame_id: str
    pose: np.ndarray
    """[7] of the lidar in the world at ``time``."""
    xyz: np.ndarray
    """[point, 3] float32 m, in the lidar's frame (x forward, z up) at the firing of each point."""
    intensity: np.ndarray
    """[point] float32 0..255"""
    ring: np.ndarray
    """[point] uint16"""
    offset: np.ndarray
    """[point] float32 s after ``time``."""
    labels: np.ndarray
    """[point] int32"""
    returned: np.ndarray | None = None
    """[point] uint8: 1 the strongest echo of its shot, 2 another; None if each shot reports one at most."""

    @property
    def organs(self) -> np.ndarray:
        """[point] :class:`~vinesim.scene.ids.Organ` that each point lies on."""
        return self.labels // LABEL_STRIDE


@dataclasses.dataclass(frozen=True, slots=True)
class RobotUpdate:
    """Pose of one robot as it crosses the network: actual joints, never commands (D6.4 section 5.2)."""

    actor: str
    time: float
    base_q: np.ndarray
    """[7]"""
    base_qd: np.ndarray
    """[6]"""
    position: np.ndarray
    """[joint] rad or m"""
    velocity: np.ndarray
    """[joint] rad/s or m/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class HumanUpdate:
    """Pose of one person as it crosses the network (D6.4 section 5.3)."""

    actor: str
    time: float
    pose: HumanPose
    velocity: np.ndarray
    """[7, 6] of all points, m/s and rad/s in world axes, to tell where they are a little later."""

    @property
    def base_q(self) -> np.ndarray:
        """[7] where others take the person to be: the hips."""
        return self.pose.hips


@dataclasses.dataclass(frozen=True, slots=True)
class TreeUpdate:
    """State of one touched tree as it crosses the network."""

    tree: int
    owner: str
    ownership: int
    """Ownership sequence, u16 with wraparound: +1 by grab, pick, cut."""
    authority: int
    """Authority sequence, u16 with wraparound: +1 by touch."""
    time: float
    resting: bool
    """True in the last, reliable record: silence follows."""
    joint_q: np.ndarray
    """[body of the tree, 4]"""
    joint_qd: np.ndarray
    """[body of the tree, 3] rad/s"""
    root: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] numbers in the tree of the bodies that were cut off their parents, in increasing order."""
    root_x: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m, where their origins are in the world."""
    root_xd: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectUpdate:
    """State of one box or loose bunch that moves, as it crosses the network."""

    object: int
    """:func:`vinesim.scene.ids.thing`"""
    owner: str
    ownership: int
    authority: int
    time: float
    pose: np.ndarray
    """[7] in the world"""
    velocity: np.ndarray
    """[6] m/s and rad/s, of its origin, world axes."""


@dataclasses.dataclass(frozen=True, slots=True)
class Measurement:
    """One line of ``vinesim bench``: ours beside a peer that ran in the same process on the same scene."""

    bench: str
    case: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float | None = None
    ratio: float | None = None
    """How many times better than the peer (above 1 is better), whatever the unit."""
