"""Everything rigid, in one MuJoCo world: ground, poles and trunks, picking boxes, robots, people.

A tick is split in two, with the shared contact solve of :mod:`vinesim.physics.touching` between the halves:
:meth:`Rigid.prep` predicts the velocity at the end of the tick as if no plant were there, :meth:`Rigid.inverse`
says how an impulse changes that prediction, and :meth:`Rigid.finish` integrates with the contact forces known.

MuJoCo's integrator ``discrete`` is implicit in joint damping and in the servos: the metric of the tick is
M^ = M + dt D + dt^2 K, not M. With plain M a gripper closes with 6.6 N where its servos give 40 N.

That damps a servo as if D were larger by dt K, which keeps stiff servos and what they hold quiet. A compliant joint
must swing as it was told to instead: for these :func:`_split` takes the surplus back.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.people import HAND, PARTS, ROUSED, Hand, HumanError, Person, figure, hand_shapes, rouse
from vinesim.physics.urdf import RobotError, check, shapes_of, touchable
from vinesim.world.ids import Organ
from vinesim.world.model import Model
from vinesim.world.values import HandSample, HumanPose, HumanSpec, Link, RobotSpec, Shape

FRICTION = 0.8
"""Coulomb coefficient of rubber pads, plastic crates and bark alike."""
CRATE_WALL = 0.012
"""Thickness of a picking box's bottom and walls [m]."""
BED = 0.08
"""[m] How far down a crate's bottom goes on for bunches alone. One that falls a metre is four centimetres deeper
after a tick: in the middle of a bottom as thin as it looks, it would be pushed out below.
"""
GIVE = 0.01
"""The tracks hold the base like a spring that reaches its full effort at this offset [m or rad], then they slip."""
FOLLOW_GIVE = 0.05
"""The same for the copy of a remote robot: how far ahead of the copy the pull starts [m or rad]."""
WIDE = 1e6
"""[m] The ground reaches so far from the middle."""
TRACK_TIME = 0.05
"""Ratio of the base servo's damping to its stiffness [s]."""
WAITING = 12
"""Free bodies that wait asleep for bunches to come. Every compilation makes so many; when all are taken, the next bunch
has to wait for one, some ten milliseconds.
"""
LUMPS = 12
"""Shapes that a waiting body has room for."""
ROLLING = 0.004
"""[m] Arm of the rolling resistance of a bunch: GUESSED, half the distance between two berries that it lies on is 10 mm
and gives way. Without it a bunch of round shapes rolls on for ever.
"""
SOFT = (0.02, 3.0)
"""Time constant [s] and damping ratio of a loose bunch's contacts. With MuJoCo's own ratio of 1 one that falls from a
metre, centimetres deep in the crate after one tick, leaves it at up to 110 m/s; a longer time never comes to rest.
"""
PARKED = -100.0
"""[m] Where waiting bodies sleep: under the ground, where nothing is."""

# collision bits: what stands, what lies about, and one bit for each robot, so that a robot never meets itself; loose
# bunches meet the thick bed of a crate where all others meet its thin sole
_GROUND, _FIXED, _BOX, _SOLE, _LOOSE = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 4
_FIRST_ROBOT, _LAST_BIT = 5, 30
_ALL = (1 << (_LAST_BIT + 1)) - 1
_FREE = mujoco.mjtJoint.mjJNT_FREE
_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_INIT, _ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_INIT), int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)
_CONE = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)
_PLANAR = ("x", "y", "yaw")


@dataclasses.dataclass
class _Felt:
    """What a link felt in a tick, as MuJoCo tells it, with its places at the start of that tick."""

    inner: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    """Moment about the robot's centre of mass and force of the parent on the link, world axes."""
    arm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    """From the link's origin to that centre."""
    turn: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    acceleration: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))


@dataclasses.dataclass
class _Robot:
    """One robot: what it was asked for, and where its numbers lie in MuJoCo's arrays."""

    spec: RobotSpec
    parsed: mujoco.MjSpec
    """As MuJoCo read its URDF; every compilation takes a copy."""
    bit: int
    shapes: dict[str, tuple[Shape, ...]]
    stiffness: np.ndarray
    damping: np.ndarray
    effort: np.ndarray
    """[joint] limit of the servos, at most ``most``."""
    most: np.ndarray
    """[joint] limit of the drives: servo and weight together."""
    target: np.ndarray
    """[joint] position the drives pull to."""
    target_velocity: np.ndarray
    forward: np.ndarray
    """[joint] effort beside that of the springs [N m or N]."""
    control: np.ndarray
    """[joint] what MuJoCo was asked for in the last tick; less K q and D v it is what the servo gave."""
    base_target: np.ndarray
    """[3] x, y, yaw where the tracks hold; moves with ``base_velocity``."""
    base_velocity: np.ndarray
    """[3] vx, vy, wz in the base's own axes."""
    tracks: tuple[np.ndarray, np.ndarray]
    """Stiffness and damping [3] of the base's servos along x, y and about z."""
    give: float = GIVE
    exact: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))
    """[joint] bool: the scheme must not add to its damping."""
    late: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    """[joint] the part of the damping that acts on the velocity at the start of the tick."""
    soon: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    """[joint] the part that MuJoCo applies to the velocity at its end, beside the spring at its end."""
    q: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    v: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    actuator: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    diagonal: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Where the drives' own inertias lie in MuJoCo's sparse mass matrix."""
    base_q: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    base_v: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    base_actuator: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    bodies: dict[str, int] = dataclasses.field(default_factory=dict)
    felt: dict[str, _Felt] = dataclasses.field(default_factory=dict)
    """What links with sensors felt in the last tick."""


@dataclasses.dataclass(frozen=True)
class Loose:
    """A bunch that hangs on no vine: its weight and its round shapes, in the frame that it had as a plant's body."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray
    """[3] kg m^2 about the centre of mass: moments xx, yy, zz."""
    product: np.ndarray
    """[3] kg m^2: entries yz, zx, xy."""
    start: np.ndarray
    """[shape, 3] m; a capsule reaches from here to ``end``, a sphere has both in one place."""
    end: np.ndarray
    radius: np.ndarray
    """[shape] m"""

    @functools.cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Spheres and capsules, in the bunch's frame."""
        axis, middle = self.end - self.start, 0.5 * (self.start + self.end)
        half, rgba = 0.5 * np.linalg.norm(axis, axis=-1), (0.25, 0.05, 0.3, 1.0)
        turn = frames.multiply(frames.aligned(axis), _Z_TO_X)
        return tuple(
            Shape("capsule", (float(r), float(h)), frames.pose(p, q), rgba) if h > 0.0
            else Shape("sphere", (float(r),), frames.pose(p), rgba)
            for r, h, p, q in zip(self.radius, half, middle, turn, strict=True)
        )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Geoms:
    """Rigid shapes that plants can touch, sorted by MuJoCo geom."""

    id: np.ndarray
    """[geom] index in MuJoCo's geom arrays."""
    body: np.ndarray
    """[geom] MuJoCo body."""
    kind: np.ndarray
    """[geom] MuJoCo's type: 0 plane, 2 sphere, 3 capsule, 4 ellipsoid, 5 cylinder, 6 box; a mesh stands as its box."""
    size: np.ndarray
    """[geom, 3] as MuJoCo writes it for the kind."""
    half: np.ndarray
    """[geom, 3] half edges of the box around the shape, in its own axes; of a plane, :data:`WIDE` and no height."""
    center: np.ndarray
    """[geom, 3] middle of the shape in the geom's frame (not zero for meshes)."""
    radius: np.ndarray
    """[geom] of the bounding sphere about the middle."""
    friction: np.ndarray
    dof: np.ndarray
    """[geom] last degree of freedom that moves it (-1: none); its ancestors follow ``dof_parentid``."""
    root: np.ndarray
    """[geom] root body of its kinematic tree, about whose centre of mass MuJoCo writes ``cvel`` and ``cdof``."""
    actor: tuple[str, ...]
    link: tuple[str, ...]


class Rigid:
    """Robots, boxes and what stands, in one MuJoCo world that is compiled anew when an actor comes or goes."""

    def __init__(self, model: Model, *, dt: float = 0.01) -> None:
        self.model = model
        self.dt = dt
        self._robots: dict[str, _Robot] = {}
        self._people: dict[str, Person] = {}
        self._bunches: dict[int, Loose] = {}
        self._waiting = 0
        self._slot: dict[int, int] = {}
        self._scene = _scene(model, dt)
        self.world: mujoco.MjModel
        self.data: mujoco.MjData
        self.faults = 0
        """How many things were stopped because a number of theirs was not finite; ``complaint`` names the last."""
        self.complaint = ""
        self.generation = 0
        """Counts compilations: whoever keeps views of MuJoCo's arrays renews them when this changes."""
        self._compile()

    # ------------------------------------------------------------------ who is here

    @property
    def robots(self) -> tuple[str, ...]:
        """Names in the order of arrival."""
        return tuple(self._robots)

    def add_robot(self, spec: RobotSpec) -> None:
        """Let a robot join, at ``spec.pose`` and ``spec.home``; all others go on exactly where they are.

        Raises :class:`RobotError` and leaves the world as it was if the URDF does not compile.
        """
        bit = self._admit("robot", spec.name, RobotError)
        check(spec)
        pose = np.asarray(spec.pose, float)
        try:
            parsed = _parsed(spec, 1 << bit)
        except ValueError as error:
            raise _unfit(spec, error) from error
        robot = _Robot(
            spec=spec,
            parsed=parsed,
            bit=bit,
            shapes=shapes_of(spec.urdf),
            stiffness=np.array([d.stiffness for d in spec.drives], float),
            damping=np.array([d.damping for d in spec.drives], float),
            effort=np.array([d.effort for d in spec.drives], float),
            most=np.array([d.effort for d in spec.drives], float),
            target=np.array(spec.home, float),
            target_velocity=np.zeros(len(spec.drives)),
            forward=np.zeros(len(spec.drives)),
            control=np.zeros(len(spec.drives)),
            base_target=np.array([pose[0], pose[1], frames.heading(pose[3:])]),
            base_velocity=np.zeros(3),
            tracks=_tracks(spec),
            exact=np.zeros(len(spec.drives), bool),
        )
        self._robots[spec.name] = robot
        try:
            self._compile()
        except ValueError as error:
            del self._robots[spec.name]
            raise _unfit(spec, error) from error
        self.place(spec.name, pose, spec.home)

    def remove_robot(self, name: str) -> None:
        """Let a robot leave; all others go on exactly where they are."""
        self._robot(name)
        del self._robots[name]
        self._compile()

    def place(self, name: str, pose: np.ndarray, position: np.ndarray) -> None:
        """Put a robot somewhere, at rest and asking for nothing else: base ``pose`` [7], ``position`` [joint]."""
        robot, pose = self._robot(name), np.asarray(pose, float)
        robot.target[:] = self.data.qpos[robot.q] = position
        robot.base_target[:] = self.data.qpos[robot.base_q] = pose[0], pose[1], frames.heading(pose[3:])
        self.data.qvel[robot.v] = self.data.qvel[robot.base_v] = 0.0
        robot.target_velocity[:] = robot.base_velocity[:] = 0.0
        robot.control[:] = robot.stiffness * robot.target + robot.forward
        for joint, (source, coefficients) in self._mimics(robot).items():
            polynomial = np.polynomial.Polynomial(coefficients)
            self.data.joint(joint).qpos[0] = polynomial(self.data.joint(source).qpos[0])
        self._fresh = False

    @property
    def people(self) -> tuple[str, ...]:
        """Names in the order of arrival."""
        return tuple(self._people)

    @property
    def actors(self) -> tuple[str, ...]:
        """Robots and people."""
        return (*self._robots, *self._people)

    def person(self, name: str) -> Person:
        """The body of a person who is here."""
        try:
            return self._people[name]
        except KeyError:
            raise HumanError(f"no human {name!r} here; there are: {', '.join(self._people) or 'none'}") from None

    def add_human(self, spec: HumanSpec) -> None:
        """Let a person join, at ``spec.pose``; all others go on exactly where they are. Raises :class:`HumanError`."""
        self._people[spec.name] = Person(spec, self._admit("human", spec.name, HumanError))
        self._compile()

    def remove_human(self, name: str) -> None:
        """Let a person leave, and whatever the hands hold."""
        self.person(name)
        del self._people[name]
        self._compile()

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Tell where a person's tracked points are at the end of the coming tick."""
        self.person(name).move(pose)

    def hand(self, name: str, side: str) -> HandSample:
        """A person's ``"left"`` or ``"right"`` hand after the last tick."""
        person = self.person(name)
        return person.sample(person.hand(side), self.data)

    def hold(self, name: str, side: str, actor: str, link: str) -> None:
        """Let a hand hold a link of an actor, a box or a loose bunch (as :class:`Geoms` names them) as it lies now."""
        person, body = self.person(name), self._body_of(actor, link)
        hand = person.hand(side)
        self._refresh()
        pose = np.concatenate([self.data.xpos[[body, hand.body]], self.data.xquat[[body, hand.body]]], -1)
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        hand.grip, hand.holds = frames.compose(frames.inverse(pose[0]), pose[1]), (actor, link)
        person.grasp(self.world, self.data, hand, body)
        self._list()

    def ride(self, name: str, side: str, body: int) -> None:
        """Let a hand hold a plant's ``body``: it meets nothing, and goes where :meth:`put_hand` says."""
        person = self.person(name)
        hand = person.hand(side)
        hand.holds = ("plants", f"body/{body}")
        person.grasp(self.world, self.data, hand, None)
        self._list()

    def put_hand(self, name: str, side: str, pose: np.ndarray) -> None:
        """Put a hand somewhere, at rest: ``pose`` [7]."""
        hand = self.person(name).hand(side)
        self.data.qpos[hand.q] = np.concatenate([pose[:3], frames.to_wxyz(pose[3:])])
        self.data.qvel[hand.v] = 0.0
        self._fresh = False

    def let_go(self, name: str, side: str) -> None:
        """Open a hand."""
        person = self.person(name)
        person.release(self.world, self.data, person.hand(side))
        self._list()

    def near_hand(self, name: str, side: str, reach: float) -> tuple[float, str, str] | None:
        """What a hand could close on: gap [m] below ``reach``, actor and link of the nearest thing; not the ground."""
        person = self.person(name)
        self._refresh()
        m, d = self.world, self.data
        body = person.hand(side).body
        mine = range(m.body_geomadr[body], m.body_geomadr[body] + m.body_geomnum[body])
        best: tuple[float, str, str] | None = None
        for of in (self.geoms, self.standing):
            apart = np.linalg.norm(d.geom_xpos[of.id] - d.xpos[body], axis=1)
            for i in np.flatnonzero(apart - of.radius < reach + HAND):
                if of.kind[i] != mujoco.mjtGeom.mjGEOM_PLANE and of.actor[i] != name:
                    gap = min(mujoco.mj_geomDistance(m, d, geom, int(of.id[i]), reach, None) for geom in mine)
                    if gap < reach and (best is None or gap < best[0]):
                        best = (gap, of.actor[i], of.link[i])
        return best

    @property
    def loose(self) -> tuple[int, ...]:
        """Bunches that lie, fall or are held, in the order in which they left their vines."""
        return tuple(self._bunches)

    def add_bunch(self, bunch: int, body: Loose, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Take a bunch over from its vine: ``pose`` [7] and ``velocity`` [6] (of its origin, angular; world axes)."""
        if bunch in self._bunches:
            raise ValueError(f"bunch {bunch} is loose already")
        alone = _alone(body)
        taken = set(self._slot.values())
        slot = next((i for i in range(self._waiting) if i not in taken), self._waiting)
        self._bunches[bunch], self._slot[bunch] = body, slot
        if slot == self._waiting:
            self._compile()
        else:
            self._embody(bunch, alone)
            self._list()
        self.place_bunch(bunch, pose, velocity)

    def place_bunch(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put a loose bunch somewhere: ``pose`` [7], ``velocity`` [6] in world axes."""
        joint, pose = self.data.joint(f"loose/{self._slot[bunch]}"), np.asarray(pose, float)
        turn = frames.normalize(pose[3:])
        joint.qpos[:] = np.concatenate([pose[:3], frames.to_wxyz(turn)])
        joint.qvel[:3] = velocity[:3]
        joint.qvel[3:] = frames.rotate(frames.conjugate(turn), np.asarray(velocity[3:], float))
        rouse(self.world, self.data, self.world.body(f"loose/{self._slot[bunch]}").id)
        self._fresh = False

    def remove_bunch(self, bunch: int) -> None:
        """Take a loose bunch out of the world; its body waits for the next one (the world is compiled anew)."""
        del self._bunches[bunch], self._slot[bunch]
        self._compile()

    def bunch_pose(self, bunch: int) -> np.ndarray:
        """World pose [7] of a loose bunch."""
        qpos = self.data.joint(f"loose/{self._slot[bunch]}").qpos
        return np.concatenate([qpos[:3], frames.from_wxyz(qpos[3:])])

    # ------------------------------------------------------------------ what they are asked to do

    def command(self, name: str, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Ask the drives for ``position`` [joint] moving with ``velocity`` [joint] (standing, unless given)."""
        robot = self._robot(name)
        robot.target[:] = position
        robot.target_velocity[:] = 0.0 if velocity is None else velocity

    def tune(
        self,
        name: str,
        stiffness: np.ndarray,
        damping: np.ndarray,
        effort: np.ndarray,
        *,
        limit: np.ndarray | None = None,
        exact: np.ndarray | None = None,
    ) -> None:
        """Give the servos other gains, and an ``effort`` beside (all [joint]): zero gains make a joint effort-driven.

        The effort is added within ``limit`` [joint], which is the drive's own unless a lower one is given. Joints that
        are ``exact`` [joint] swing with just this damping; the others are damped as if it were larger by dt times
        stiffness, as stiff servos should be. All stay until they are given anew.
        """
        robot = self._robot(name)
        before = robot.stiffness.copy()
        robot.stiffness[:], robot.damping[:], robot.forward[:] = stiffness, damping, effort
        if limit is not None:
            robot.effort[:] = np.minimum(limit, robot.most)
        if exact is not None:
            robot.exact[:] = exact
        q, v = self.data.qpos[robot.q], self.data.qvel[robot.v]
        given = robot.control - before * q - robot.soon * v
        self._set_gains(robot)
        robot.control[:] = given + robot.stiffness * q + robot.soon * v  # what was given in the last tick stays so

    def drive_base(self, name: str, velocity: tuple[float, float, float]) -> None:
        """Ask the tracks for (vx, vy, wz) [m/s, m/s, rad/s] in the base's axes; zero holds the place."""
        robot = self._robot(name)
        robot.base_velocity[:] = velocity
        robot.give = GIVE

    def follow(
        self, name: str, base_q: np.ndarray, base_qd: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """Pull the copy of a remote robot to its received state; it stays dynamic, so a vine still holds it back.

        ``base_q`` [7], ``base_qd`` [6] world axes, ``position`` and ``velocity`` [joint].
        """
        robot = self._robot(name)
        base_q, base_qd = np.asarray(base_q, float), np.asarray(base_qd, float)
        self.command(name, position, velocity)
        yaw = frames.heading(base_q[3:])
        turns = np.round((self.data.qpos[robot.base_q[2]] - yaw) / (2.0 * np.pi))
        robot.base_target[:] = base_q[0], base_q[1], yaw + 2.0 * np.pi * turns
        c, s = np.cos(yaw), np.sin(yaw)
        robot.base_velocity[:] = c * base_qd[0] + s * base_qd[1], c * base_qd[1] - s * base_qd[0], base_qd[5]
        robot.give = FOLLOW_GIVE

    def push(self, name: str, link: str, force: np.ndarray, moment: np.ndarray = np.zeros(3)) -> None:
        """A force [N] and a moment [N m] on a link's centre of mass, world axes, until it is set anew."""
        wrench = self.data.xfrc_applied[self._body(name, link)]
        wrench[:3], wrench[3:] = force, moment

    # ------------------------------------------------------------------ what they feel and where they are

    def read(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity, effort and contact of the drives, each [joint] in the order of ``spec.drives``.

        ``effort`` is what the drive transmitted in the last tick: servo and its share of gravity compensation.
        ``contact`` is J^T f of the contacts with plants and with rigid things; at rest the two cancel.
        """
        robot, d = self._robot(name), self.data
        position, velocity = d.qpos[robot.q], d.qvel[robot.v]
        # implicit servos: over the tick they gave the force of its end, not that of its start
        servo = robot.control - robot.stiffness * position - robot.soon * velocity
        servo = np.clip(servo, -robot.effort, robot.effort)
        effort = np.clip(servo + d.qfrc_gravcomp[robot.v], -robot.most, robot.most)
        return position, velocity, effort, self._contact[robot.v]

    def state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity of the drives alone, as :meth:`read` gives them."""
        robot = self._robot(name)
        return self.data.qpos[robot.q], self.data.qvel[robot.v]

    def weight(self, name: str) -> np.ndarray:
        """[joint] what the drives give to carry the robot's own weight [N m or N], part of their effort."""
        return self.data.qfrc_gravcomp[self._robot(name).v]

    def inertia(self, name: str) -> np.ndarray:
        """[joint] what each drive has to speed up if the others stand, rotor included [kg m2 or kg], in this pose."""
        return self.data.M[self._robot(name).diagonal]

    def base(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Pose [7] and velocity [6] (world axes) of the base link."""
        robot, d = self._robot(name), self.data
        x, y, yaw = d.qpos[robot.base_q]
        vx, vy, wz = d.qvel[robot.base_v]
        half = 0.5 * yaw
        pose = np.array([x, y, robot.spec.pose[2], 0.0, 0.0, np.sin(half), np.cos(half)])
        return pose, np.array([vx, vy, 0.0, 0.0, 0.0, wz])

    def link_pose(self, name: str, link: str) -> np.ndarray:
        """World pose [7] of a link, whether or not it can move against its parent."""
        body = self._body(name, link)
        self._refresh()
        return np.concatenate([self.data.xpos[body], frames.from_wxyz(self.data.xquat[body])])

    def jacobian(self, name: str, link: str, point: np.ndarray) -> np.ndarray:
        """[6, joint]: velocity of the world ``point`` [3] of a link, then its angular velocity, per drive's speed."""
        robot, body = self._robot(name), self._body(name, link)
        self._refresh()
        jacobian = np.zeros((6, self.world.nv))
        mujoco.mj_jac(self.world, self.data, jacobian[:3], jacobian[3:], np.asarray(point, float), body)
        return jacobian[:, robot.v]

    def instrument(self, name: str, link: str) -> None:
        """From the next tick on, measure at a link what :meth:`wrench` and :meth:`acceleration` tell."""
        self._body(name, link)
        self._robot(name).felt[link] = _Felt()

    def wrench(self, name: str, link: str) -> np.ndarray:
        """Force [N] and moment about the link's origin [N m] of the link, and all beyond it, on its parent [6].

        In the link's axes, mean of the last tick. Weight, inertia, pushes and contacts with rigid things count; those
        with plants do not: who solves them has them.
        """
        felt = self._felt(name, link)
        (x, y, z), (u, v, w) = felt.arm.tolist(), felt.inner[3:].tolist()
        moment = felt.inner[:3] + np.array([y * w - z * v, z * u - x * w, x * v - y * u])
        return -np.concatenate([felt.inner[3:] @ felt.turn, moment @ felt.turn])

    def acceleration(self, name: str, link: str) -> np.ndarray:
        """Angular [rad/s2] and proper acceleration of a link's origin [m/s2] in its axes [6]; at rest 9.81 upwards."""
        return self._felt(name, link).acceleration.copy()

    def angular_velocity(self, name: str, link: str) -> np.ndarray:
        """[3] rad/s of a link, in its axes."""
        body = self._body(name, link)
        self._refresh()
        jacobian = np.zeros((3, self.world.nv))
        mujoco.mj_jacBody(self.world, self.data, None, jacobian, body)
        return jacobian @ self.data.qvel @ self.data.xmat[body].reshape(3, 3)

    def links(self) -> tuple[Link, ...]:
        """Every robot's and box's bodies that have a shape; the same object until an actor comes or goes."""
        return self._links

    def link_q(self) -> np.ndarray:
        """Poses [link, 7] of :meth:`links`."""
        self._refresh()
        d, body = self.data, self._link_body
        pose = np.empty((len(body), 7))
        pose[:, :3] = d.xpos[body]
        pose[:, 3:] = d.xquat[body][:, [1, 2, 3, 0]]
        for person in self._people.values():  # bit by bit: MuJoCo makes quaternions unit anew
            pose[self._link_row[person.part_bodies]] = person.parts
        return pose

    # ------------------------------------------------------------------ the tick, in two halves

    def prep(self) -> None:
        """First half: positions, native contacts, and the velocity that the tick would end with without plants."""
        m, d = self.world, self.data
        self._servo()
        for person in self._people.values():
            person.drive(m, d, self.dt)
        self._sound[:] = d.qpos
        # still applied from the last tick: what pushed a sleeping box wakes it now
        mujoco.mj_step1(m, d)
        d.qfrc_applied[:] = 0.0
        # the whole forward pass behind the velocity stage: single calls of its parts leave out dt K v
        mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 1)

    @property
    def velocity_free(self) -> np.ndarray:
        """[dof] the prediction of :meth:`prep`; zero for what sleeps, whose ``qacc`` MuJoCo leaves as it was."""
        m, d = self.world, self.data
        velocity = d.qvel + self.dt * d.qacc
        if d.nv_awake < m.nv:
            velocity[d.tree_asleep[m.dof_treeid] >= 0] = 0.0
        return velocity

    @property
    def dof_names(self) -> list[tuple[str, int]]:
        """[dof] joint (or loose bunch) and number in it: they outlive a compilation, their places do not."""
        m = self.world
        bunch_in = {f"loose/{slot}": f"bunch/{bunch}" for bunch, slot in self._slot.items()}
        names = [m.joint(i).name for i in range(m.njnt)]
        of = [bunch_in.get(name, name) for name in names]
        return [(of[i], int(v - m.jnt_dofadr[i])) for v, i in enumerate(m.dof_jntid.tolist())]

    @property
    def group(self) -> np.ndarray:
        """[MuJoCo kinematic tree] a label that two share if a force on one may move the other in this tick."""
        m, d = self.world, self.data
        if d.nefc == 0:
            return self._each
        return np.where(d.tree_island >= 0, m.ntree + d.tree_island, self._each) if d.nisland else 0 * self._each

    def bound(self, bodies: np.ndarray) -> bool:
        """Whether native constraints that are active now bind one of these MuJoCo bodies [k].

        If not, the metric of the tick is M^, of which MuJoCo keeps a sparse factor L^T D L in ``qH``.
        """
        m, d = self.world, self.data
        if d.nefc == 0:
            return False
        tree = m.body_treeid[bodies]
        return d.nisland == 0 or bool((d.tree_island[tree[tree >= 0]] >= 0).any())

    def inverse(self, J: np.ndarray) -> np.ndarray:
        """Change of velocity [dof, k] for unit impulses along the rows of ``J`` [k, dof]: H^-1 J^T.

        H = M^ + Jc^T D Jc holds implicit servos and the stiffness of the native constraints that are active now
        (limits, mimics, robot against pole). Only the kinematic trees concerned are factored.
        """
        dofs = self._coupled(J)
        block = self._blocks.get(dofs.tobytes())
        if block is None:
            block = self._blocks[dofs.tobytes()] = _Block(self.world, dofs)
        change = np.zeros((self.world.nv, len(J)))
        change[dofs] = np.linalg.solve(block.hessian(self.data), J[:, dofs].T)
        return change

    def finish(self, force: np.ndarray | None = None) -> None:
        """Second half: integrate with generalised contact forces of plants, ``force`` [dof]."""
        m, d = self.world, self.data
        if force is not None:
            np.add(force, 0.0, out=d.qfrc_applied)  # +0 for -0, which would keep sleeping boxes awake
        mujoco.mj_step2(m, d)
        self._feel()
        if not np.isfinite(d.qvel).all() or not np.isfinite(d.qpos).all():
            self._roll_back()
            force = None
        self._contact[:] = 0.0 if force is None else force
        if d.ncon:
            native = np.where(d.efc_type >= _CONTACT, d.efc_force, 0.0)
            out = np.zeros(m.nv)
            mujoco.mj_mulJacTVec(m, d, out, native)
            self._contact += out
        for person in self._people.values():
            person.feel(d)
        self._fresh = False

    # ------------------------------------------------------------------ inside

    def _admit(self, kind: str, name: str, error: type[ValueError]) -> int:
        """The collision bit of a newcomer."""
        if name in self.actors:
            raise error(f"{kind} {name!r} is already here; give the newcomer another name")
        if "/" in name or not name:
            raise error(f"{kind} name {name!r} must not be empty nor contain '/', which parts actor and link")
        used = {actor.bit for actor in (*self._robots.values(), *self._people.values())}
        free = [bit for bit in range(_FIRST_ROBOT, _LAST_BIT + 1) if bit not in used]
        if not free:
            raise error(f"{kind} {name!r} is one too many: {len(used)} robots and people share this world, remove one")
        return free[0]

    def _body_of(self, actor: str, link: str) -> int:
        """MuJoCo body of anything that has a name."""
        if actor in self._people:
            return self._people[actor].bodies[link]
        if actor in self._robots:
            return self._body(actor, link)
        kind, _, number = actor.partition("/")
        return (
            0
            if actor == "world"
            else self.world.body(f"loose/{self._slot[int(number)]}" if kind == "bunch" else actor).id
        )

    def _robot(self, name: str) -> _Robot:
        try:
            return self._robots[name]
        except KeyError:
            raise ValueError(f"no robot {name!r} here; there are: {', '.join(self._robots) or 'none'}") from None

    def _body(self, name: str, link: str) -> int:
        robot = self._robot(name)
        try:
            return robot.bodies[link]
        except KeyError:
            raise ValueError(f"robot {name!r} has no link {link!r}; it has: {', '.join(robot.bodies)}") from None

    def _refresh(self) -> None:
        """Poses of the state as it is now: after a step MuJoCo's are those of the step's start."""
        if not self._fresh:
            mujoco.mj_kinematics(self.world, self.data)
            mujoco.mj_comPos(self.world, self.data)
            self._fresh = True

    def _felt(self, name: str, link: str) -> _Felt:
        try:
            return self._robot(name).felt[link]
        except KeyError:
            raise ValueError(f"nothing is measured at {link!r} of robot {name!r}; instrument() it first") from None

    def _feel(self) -> None:
        """Keep what links felt in the tick that ends, while MuJoCo's places are still those of its start."""
        m, d = self.world, self.data
        if not any(robot.felt for robot in self._robots.values()):
            return
        mujoco.mj_rnePostConstraint(m, d)
        for robot in self._robots.values():
            for link, felt in robot.felt.items():
                body = robot.bodies[link]
                felt.inner[:] = d.cfrc_int[body]
                np.subtract(d.subtree_com[m.body_rootid[body]], d.xpos[body], out=felt.arm)
                felt.turn[:] = d.xmat[body].reshape(3, 3)
                mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, felt.acceleration, 1)

    def _roll_back(self) -> None:
        """Stop the kinematic trees with a number that is not finite where the tick began; the others go on."""
        m, d = self.world, self.data
        joint_tree = m.dof_treeid[m.jnt_dofadr]
        width = np.where(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE, 7, 1)
        tree = np.repeat(joint_tree, width)  # of each entry of qpos
        bad = np.zeros(m.ntree, bool)
        bad[m.dof_treeid[~np.isfinite(d.qvel)]] = True
        bad[tree[~np.isfinite(d.qpos)]] = True
        sound = np.where(np.isfinite(self._sound), self._sound, m.qpos0)
        d.qpos[bad[tree]] = sound[bad[tree]]
        dofs = bad[m.dof_treeid]
        for name in _OF_DOFS:
            getattr(d, name)[dofs] = 0.0
        for name, robot in self._robots.items():
            if bad[m.dof_treeid[robot.base_v[0]]]:
                self.place(name, self.base(name)[0], d.qpos[robot.q].copy())
                robot.forward[:] = 0.0
        stopped = [m.body(m.tree_bodyadr[tree]).name for tree in np.flatnonzero(bad)]
        self.faults += len(stopped)
        self.complaint = f"t = {d.time:.2f} s: {', '.join(stopped)} moved by a number that is not finite; stopped"

    def _servo(self) -> None:
        """Turn every robot's targets into MuJoCo's controls."""
        d = self.data
        for robot in self._robots.values():
            pull = robot.stiffness * robot.target + (robot.soon + robot.late) * robot.target_velocity
            robot.control[:] = pull - robot.late * d.qvel[robot.v] + robot.forward
            d.ctrl[robot.actuator] = robot.control
            q = d.qpos[robot.base_q]
            c, s = math.cos(q[2]), math.sin(q[2])
            vx, vy, wz = robot.base_velocity.tolist()
            velocity = np.array([c * vx - s * vy, s * vx + c * vy, wz])
            # held back too far, the tracks slip: the place they hold comes along
            held = np.minimum(robot.base_target + self.dt * velocity, q + robot.give)
            np.maximum(held, q - robot.give, out=robot.base_target)
            stiffness, damping = robot.tracks
            d.ctrl[robot.base_actuator] = stiffness * robot.base_target + damping * velocity

    def _set_gains(self, robot: _Robot) -> None:
        """Turn a robot's gains and limits into MuJoCo's constants."""
        m = self.world
        soon, late = _split(robot.stiffness, robot.damping, m.dof_damping[robot.v], m.dof_armature[robot.v], self.dt)
        robot.soon = np.where(robot.exact, soon, robot.damping)
        robot.late = np.where(robot.exact, late, 0.0)
        m.actuator_biasprm[robot.actuator, 1] = -robot.stiffness
        m.actuator_biasprm[robot.actuator, 2] = -robot.soon
        m.actuator_forcerange[robot.actuator, 0] = -robot.effort
        m.actuator_forcerange[robot.actuator, 1] = robot.effort

    def _mimics(self, robot: _Robot) -> dict[str, tuple[str, np.ndarray]]:
        """Joints of a robot that copy another joint: name -> (source, polynomial)."""
        m = self.world
        joints = {}
        for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT):
            joint, source = m.joint(m.eq_obj1id[e]).name, m.joint(m.eq_obj2id[e]).name
            if joint.startswith(robot.spec.name + "/"):
                joints[joint] = (source, m.eq_data[e, :5].copy())
        return joints

    def _coupled(self, J: np.ndarray) -> np.ndarray:
        """Degrees of freedom [k] that feel an impulse along ``J``: its trees and those in constraint with them."""
        m, d = self.world, self.data
        touched = np.zeros(m.ntree, bool)
        touched[m.dof_treeid[J.any(axis=0)]] = True
        if d.nefc and d.nisland:
            islands = np.unique(d.tree_island[touched])
            touched |= np.isin(d.tree_island, islands[islands >= 0])
        return np.flatnonzero(touched[m.dof_treeid])

    # ------------------------------------------------------------------ building the world

    def _compile(self) -> None:
        """Build the world anew and carry every joint's and body's state over by its name."""
        spec = self._scene.copy()
        for robot in self._robots.values():
            _attach(spec, robot)
        for person in self._people.values():
            person.attach(spec, _ALL & ~(1 << person.bit), _GROUND, [FRICTION, 0.005, 0.0001])
        self._waiting = max(self._slot.values(), default=-1) + 1 + WAITING
        for slot in range(self._waiting):
            _wait(spec, slot)
        before = (self.world, self.data, self._contact) if self.generation else None
        self.world = world = _built(spec)
        # the solver's tolerance is relative to it: whoever joins would change when it stops for everybody else
        world.stat.meaninertia = 1.0
        for slot in range(self._waiting):
            self._untouch(slot)
        for bunch, body in self._bunches.items():
            self._embody(bunch, _alone(body))
        if before is None:
            self.data, self._contact = mujoco.MjData(world), np.zeros(world.nv)
        else:
            parked = {f"loose/{slot}" for slot in range(self._waiting)}
            parked -= {f"loose/{slot}" for slot in self._slot.values()}
            self.data, self._contact = _carried(*before, world, parked)
        self._blocks: dict[bytes, _Block] = {}
        self._each = np.arange(world.ntree, dtype=np.int32)
        self._sound = self.data.qpos.copy()
        self._fresh = False
        for robot in self._robots.values():
            self._locate(robot)
        for person in self._people.values():
            person.locate(world)
        for person in self._people.values():
            for hand in person.hands:
                self._regrasp(person, hand)
        if before is None:
            self.standing = self._list_standing()
        self._list()

    def _regrasp(self, person: Person, hand: Hand) -> None:
        """In a world compiled anew: hold on to what was held, if it is still there."""
        if hand.holds is None:
            return
        try:
            body = None if hand.rides else self._body_of(*hand.holds)
        except (KeyError, ValueError):
            person.release(self.world, self.data, hand)
        else:
            person.grasp(self.world, self.data, hand, body)

    def _list(self) -> None:
        """List anew what is here; whoever keeps views of it takes notice of the new ``generation``."""
        self.generation += 1
        self._links, self._link_body = self._list_links()
        self._link_row = np.zeros(self.world.nbody, int)
        self._link_row[self._link_body] = np.arange(len(self._link_body))
        self.geoms = self._list_geoms()

    def _embody(self, bunch: int, alone: mujoco.MjModel) -> None:
        """Give the waiting body of a bunch its weight and shapes, with all constants that MuJoCo derives from them.

        ``mj_setConst`` would derive some of them, but neither bounding volumes nor the bits by which whole bodies are
        sorted out; so the bunch is compiled in a world of its own and what was derived there is copied.
        """
        m, body = self.world, self.world.body(f"loose/{self._slot[bunch]}").id
        for name in _OF_BODY:
            getattr(m, name)[body] = getattr(alone, name)[1]
        geoms = slice(m.body_geomadr[body], m.body_geomadr[body] + LUMPS)
        for name in _OF_GEOM:
            getattr(m, name)[geoms] = getattr(alone, name)
        spare = slice(geoms.start + len(self._bunches[bunch].radius), geoms.stop)
        m.geom_contype[spare] = m.geom_conaffinity[spare] = 0
        dofs = slice(m.body_dofadr[body], m.body_dofadr[body] + 6)
        for name in ("dof_M0", "dof_invweight0", "dof_length"):
            getattr(m, name)[dofs] = getattr(alone, name)
        volumes = slice(m.body_bvhadr[body], m.body_bvhadr[body] + alone.body_bvhnum[1])
        for name in ("bvh_aabb", "bvh_child", "bvh_depth"):
            getattr(m, name)[volumes] = getattr(alone, name)
        m.bvh_nodeid[volumes] = np.where(alone.bvh_nodeid >= 0, alone.bvh_nodeid + geoms.start, -1)

    def _untouch(self, slot: int) -> None:
        """Let nothing touch a waiting body."""
        m = self.world
        body = m.body(f"loose/{slot}").id
        geoms = slice(m.body_geomadr[body], m.body_geomadr[body] + LUMPS)
        m.body_contype[body] = m.body_conaffinity[body] = m.geom_contype[geoms] = m.geom_conaffinity[geoms] = 0

    def _locate(self, robot: _Robot) -> None:
        m, name = self.world, robot.spec.name
        joints = [m.joint(f"{name}/{drive.joint}") for drive in robot.spec.drives]
        planar = [m.joint(f"{name}:{axis}") for axis in _PLANAR]
        robot.q = np.array([j.qposadr[0] for j in joints], int)
        robot.v = np.array([j.dofadr[0] for j in joints], int)
        robot.diagonal = (m.M_rowadr + m.M_rownnz - 1)[robot.v]
        robot.actuator = np.array([m.actuator(f"{name}/{drive.joint}").id for drive in robot.spec.drives], int)
        robot.base_q = np.array([j.qposadr[0] for j in planar], int)
        robot.base_v = np.array([j.dofadr[0] for j in planar], int)
        robot.base_actuator = np.array([m.actuator(f"{name}:{axis}").id for axis in _PLANAR], int)
        names = [m.body(i).name for i in range(m.nbody)]
        robot.bodies = {n.removeprefix(name + "/"): i for i, n in enumerate(names) if n.startswith(name + "/")}
        self._set_gains(robot)

    def _list_links(self) -> tuple[tuple[Link, ...], np.ndarray]:
        links, bodies = [], []
        for box, size in enumerate(self.model.box_size):
            links.append(Link(f"box/{box}", Organ.BOX, box, crate(size)))
            bodies.append(self.world.body(f"box/{box}").id)
        for name, robot in self._robots.items():
            for link, shapes in robot.shapes.items():
                if shapes:
                    links.append(Link(f"{name}/{link}", Organ.ROBOT, robot.spec.index, shapes))
                    bodies.append(robot.bodies[link])
        for name, person in self._people.items():
            shapes = dict(zip(PARTS, ((shape,) for shape in figure(person.spec.height)), strict=True))
            shapes |= {hand.link: hand_shapes(hand.side) for hand in person.hands}
            for link, drawn in shapes.items():
                links.append(Link(f"{name}/{link}", Organ.HUMAN, person.spec.index, drawn))
                bodies.append(person.bodies[link])
        for bunch, loose in self._bunches.items():
            links.append(Link(f"bunch/{bunch}", Organ.BUNCH, bunch, loose.shapes))
            bodies.append(self.world.body(f"loose/{self._slot[bunch]}").id)
        return tuple(links), np.array(bodies, int)

    def _list_geoms(self) -> Geoms:
        m = self.world
        owner = {m.body(f"box/{i}").id: ("box/" + str(i), "box") for i in range(len(self.model.box_size))}
        for name, robot in self._robots.items():
            owner.update({body: (name, link) for link, body in robot.bodies.items()})
        for name, person in self._people.items():
            owner.update({body: (name, link) for link, body in person.bodies.items()})
        owner.update({m.body(f"loose/{slot}").id: (f"bunch/{i}", "bunch") for i, slot in self._slot.items()})
        ids = np.array([g for g in range(m.ngeom) if m.geom_bodyid[g] in owner and m.geom_contype[g]], int)
        return self._geoms(ids, [owner[int(b)] for b in m.geom_bodyid[ids]])

    def _list_standing(self) -> Geoms:
        """Ground, poles and trunks: MuJoCo's first geoms, whoever comes and goes."""
        m = self.world
        ids = np.array([g for g in range(m.ngeom) if m.geom_bodyid[g] == 0 and m.geom_contype[g]], int)
        return self._geoms(ids, [("world", m.geom(g).name) for g in ids.tolist()])

    def _geoms(self, ids: np.ndarray, names: list[tuple[str, str]]) -> Geoms:
        """What touching must know of some geoms; ``names``: actor and link of each."""
        m = self.world
        last = np.full(m.nbody, -1)
        for body in range(1, m.nbody):
            count = m.body_dofnum[body]
            last[body] = m.body_dofadr[body] + count - 1 if count else last[m.body_parentid[body]]
        body, kind, size = m.geom_bodyid[ids], m.geom_type[ids].copy(), m.geom_size[ids].copy()
        mesh = kind == mujoco.mjtGeom.mjGEOM_MESH
        kind[mesh], size[mesh] = mujoco.mjtGeom.mjGEOM_BOX, m.geom_aabb[ids][mesh, 3:]
        center = np.where(mesh[:, None], m.geom_aabb[ids, :3], 0.0)
        radius = np.where(mesh, np.linalg.norm(size, axis=1), m.geom_rbound[ids])
        half = size.copy()
        round_ = (kind == mujoco.mjtGeom.mjGEOM_SPHERE) | (kind == mujoco.mjtGeom.mjGEOM_CAPSULE)
        half[round_] = size[round_, :1] + size[round_, 1:2] * [0.0, 0.0, 1.0]
        cylinder = kind == mujoco.mjtGeom.mjGEOM_CYLINDER
        half[cylinder] = size[cylinder][:, [0, 0, 1]]
        plane = kind == mujoco.mjtGeom.mjGEOM_PLANE
        half[plane], radius[plane] = (WIDE, WIDE, 0.0), np.inf
        return Geoms(
            id=ids.astype(np.int32),
            body=body.astype(np.int32),
            kind=kind.astype(np.int32),
            size=size,
            half=half,
            center=center,
            radius=radius,
            friction=m.geom_friction[ids, 0].copy(),
            dof=last[body].astype(np.int32),
            root=m.body_rootid[body].astype(np.int32),
            actor=tuple(actor for actor, _ in names),
            link=tuple(link for _, link in names),
        )


class _Block:
    """The metric of one tick for some degrees of freedom, gathered from MuJoCo's sparse arrays."""

    def __init__(self, world: mujoco.MjModel, dofs: np.ndarray) -> None:
        self.count = len(dofs)
        self.at = np.full(world.nv, -1)
        self.at[dofs] = np.arange(len(dofs))
        self.dofs = dofs
        row, column = np.repeat(np.arange(world.nv), world.M_rownnz), world.M_colind
        self.entry = np.flatnonzero(self.at[row] >= 0)
        self.row, self.column = self.at[row[self.entry]], self.at[column[self.entry]]

    def hessian(self, d: mujoco.MjData) -> np.ndarray:
        """[k, k]: M^ and the tangent of the active constraints."""
        H = np.zeros((self.count, self.count))
        diagonal = d.qHDiagInv[self.dofs]
        if diagonal.all():
            H[self.row, self.column] = d.qH[self.entry]
            np.fill_diagonal(H, 1.0)
            H = H.T @ (H / diagonal[:, None])
        else:  # nothing implicit in the whole world: MuJoCo leaves the factor unset and M^ is M
            H[self.row, self.column] = H[self.column, self.row] = d.M[self.entry]
        if d.nefc:
            state = d.efc_state
            stiff = (state == _QUADRATIC) | (state == _CONE)
            row = np.repeat(np.arange(d.nefc), d.efc_J_rownnz)
            column = self.at[d.efc_J_colind[: len(row)]]
            entry = np.flatnonzero(stiff[row] & (column >= 0))
            if len(entry):
                J = np.zeros((d.nefc, self.count))
                J[row[entry], column[entry]] = d.efc_J[: len(row)][entry]
                H += J.T @ (d.efc_D[:, None] * J)
        return H


def _unfit(spec: RobotSpec, error: ValueError) -> RobotError:
    """What MuJoCo says against a robot, in one line."""
    return RobotError(f"robot {spec.name!r}: MuJoCo cannot build it from its URDF: {' '.join(str(error).split())}")


def _scene(model: Model, dt: float) -> mujoco.MjSpec:
    """Ground, poles, trunks and boxes."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # less, and a bunch creeps through the fingers; MuJoCo's noslip stage would hold it too, but piles never rest then
    spec.option.impratio = 1000.0
    # one bad number must not reset the whole world: finish() stops what it belongs to
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # boxes and bunches that lie still cost nothing; robots, being driven, never sleep
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    friction = [FRICTION, 0.005, 0.0001]
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=_GROUND,
        conaffinity=_BOX | _SOLE | _LOOSE,
        friction=friction,
    )  # fmt: skip
    thickness = model.fixed_radius.mean(1)
    for piece in np.flatnonzero(np.isin(model.fixed_organ, [Organ.POLE, Organ.TRUNK])):
        spec.worldbody.add_geom(
            name=f"fixed/{piece}", type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=np.concatenate([model.fixed_start[piece], model.fixed_end[piece]]).astype(float),
            size=[float(thickness[piece]), 0, 0], contype=_FIXED, conaffinity=0, friction=friction,
        )  # fmt: skip
    for box, pose in enumerate(model.box_pose.astype(float)):
        body = spec.worldbody.add_body(name=f"box/{box}", pos=pose[:3], quat=frames.to_wxyz(frames.normalize(pose[3:])))
        body.add_freejoint(name=f"box/{box}")
        walls = crate(model.box_size[box])
        volume = [float(np.prod(wall.size)) for wall in walls]
        for wall, share in zip(walls, volume, strict=True):
            sole = wall is walls[0]
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=wall.size, pos=wall.pose[:3], friction=friction,
                mass=float(model.box_mass[box]) * share / sum(volume), contype=_SOLE if sole else _BOX,
                conaffinity=_ALL & ~_LOOSE if sole else _ALL,
            )  # fmt: skip
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[*walls[0].size[:2], BED / 2], pos=[0.0, 0.0, CRATE_WALL - BED / 2],
            friction=friction, mass=0.0, contype=0, conaffinity=_LOOSE,
        )  # fmt: skip
    return spec


def _built(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile without contacts: MuJoCo tries a step, in which all robots would stand on one another at the origin."""
    spec.option.disableflags |= _CONSTRAINT
    world = spec.compile()
    world.opt.disableflags &= ~_CONSTRAINT
    return world


def crate(size: np.ndarray) -> tuple[Shape, ...]:
    """Bottom and four walls of an open box of outer ``size`` [3] m, origin in the middle of its underside."""
    length, width, height = (float(s) / 2 for s in size)
    t = CRATE_WALL / 2
    walls = [
        ((length, width, t), (0.0, 0.0, t)),
        ((length, t, height - t), (0.0, width - t, height + t)),
        ((length, t, height - t), (0.0, t - width, height + t)),
        ((t, width - 2 * t, height - t), (length - t, 0.0, height + t)),
        ((t, width - 2 * t, height - t), (t - length, 0.0, height + t)),
    ]
    return tuple(Shape("box", half, frames.pose(np.array(at)), (0.75, 0.15, 0.12, 1.0)) for half, at in walls)


def _parsed(given: RobotSpec, bit: int) -> mujoco.MjSpec:
    """A robot without base and servos, as its URDF says; its shapes carry the collision ``bit``."""
    child = mujoco.MjSpec.from_string(touchable(given.urdf, frozenset(drive.joint for drive in given.drives)))
    for geom in child.geoms:
        geom.contype, geom.conaffinity = bit, _ALL & ~bit & ~_GROUND
        geom.friction = [FRICTION, 0.005, 0.0001]
    for body in child.bodies[1:]:
        body.gravcomp = 1.0
    driven = {drive.joint: drive for drive in given.drives}
    for joint in child.joints:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if joint.name in driven:
            joint.actgravcomp = True
            joint.armature = driven[joint.name].rotor
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.actfrcrange = [-driven[joint.name].effort, driven[joint.name].effort]
    return child


def _attach(spec: mujoco.MjSpec, robot: _Robot) -> None:
    """Set a robot on a planar base and give it its servos."""
    given, name = robot.spec, robot.spec.name
    base = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, float(given.pose[2])])
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    axes = zip(_PLANAR, (slide, slide, hinge), np.eye(3), strict=True)
    for axis, kind, direction in axes:
        base.add_joint(name=f"{name}:{axis}", type=kind, axis=direction)
    spec.copy_during_attach = True
    spec.attach(robot.parsed, prefix=f"{name}/", frame=base.add_frame())
    for drive, stiffness, damping in zip(given.drives, robot.stiffness, robot.damping, strict=True):
        _add_servo(spec, f"{name}/{drive.joint}", stiffness, damping, drive.effort)
    stiffness, damping = robot.tracks
    for i, axis in enumerate(_PLANAR):
        _add_servo(spec, f"{name}:{axis}", stiffness[i], damping[i], given.base_effort[i // 2])


def _wait(spec: mujoco.MjSpec, slot: int) -> None:
    """A free body that waits for a bunch: asleep, touched by nothing, its numbers of no meaning yet."""
    body = spec.worldbody.add_body(
        name=f"loose/{slot}", pos=_place_of(slot)[:3], mass=0.5, ipos=[0.05, 0.0, 0.0], inertia=[1e-3, 1e-3, 1e-3],
        explicitinertial=True, sleep=mujoco.mjtSleepPolicy.mjSLEEP_INIT,
    )  # fmt: skip
    body.add_freejoint(name=f"loose/{slot}")
    for _ in range(LUMPS):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0.05, 0.0, 0.0], mass=0.0, contype=_LOOSE,
            conaffinity=_ALL & ~_SOLE,
        )  # fmt: skip  # MuJoCo makes no bounding volumes for what nothing touches: that comes after compiling


def _place_of(slot: int) -> np.ndarray:
    """Where a body waits: position and quaternion (w first) [7]."""
    return np.array([float(slot), 0.0, PARKED, 1.0, 0.0, 0.0, 0.0])


def _alone(loose: Loose) -> mujoco.MjModel:
    """A bunch in a world of its own."""
    spec = mujoco.MjSpec()
    _drop(spec, loose)
    return spec.compile()


def _drop(spec: mujoco.MjSpec, loose: Loose) -> None:
    """A bunch as a free body of round shapes.

    Harder than MuJoCo's own ``solimp`` it would be held a few micrometres deep, and a hand that moves would lose touch
    for a tick: fingers that hold with 25 N then are 3 mm further, and the bunch falls.
    """
    if not 0 < len(loose.radius) <= LUMPS:
        raise ValueError(f"a bunch of {len(loose.radius)} shapes; a loose one has 1 to {LUMPS}")
    yz, zx, xy = loose.product
    body = spec.worldbody.add_body(
        mass=loose.mass, ipos=loose.com, fullinertia=[*loose.inertia, xy, zx, yz], explicitinertial=True
    )
    body.add_freejoint()
    for start, end, radius in zip(loose.start, loose.end, loose.radius, strict=True):
        kind, place = mujoco.mjtGeom.mjGEOM_SPHERE, {"pos": start}
        if (start != end).any():
            kind, place = mujoco.mjtGeom.mjGEOM_CAPSULE, {"fromto": np.concatenate([start, end])}
        body.add_geom(
            type=kind, size=[float(radius), 0, 0], mass=0.0, contype=_LOOSE, conaffinity=_ALL & ~_SOLE, condim=6,
            friction=[FRICTION, 0.005, ROLLING], priority=1, solref=SOFT, solimp=[0.99, 0.999, 0.001, 0.5, 2],
            **place,
        )  # fmt: skip
    for _ in range(LUMPS - len(loose.radius)):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], pos=loose.start[0], mass=0.0, contype=_LOOSE,
            conaffinity=_ALL & ~_SOLE,
        )  # fmt: skip


def _tracks(spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and damping [3] of the base's servos along x, y and about z."""
    force, moment = spec.base_effort
    stiffness = np.array([force, force, moment]) / GIVE
    return stiffness, TRACK_TIME * stiffness


def _add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, effort: float) -> None:
    """Effort = control - stiffness q - damping v, cut off at ``effort``; the control carries both targets."""
    bias = np.zeros(10)
    bias[1:3] = -stiffness, -damping
    gain = np.zeros(10)
    gain[0] = 1.0
    spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=gain, biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=bias,
        forcelimited=True, forcerange=[-effort, effort], ctrllimited=False,
    )  # fmt: skip


def _split(
    stiffness: np.ndarray, damping: np.ndarray, friction: np.ndarray, rotor: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """How a servo's damping is split so that the joint swings as asked: parts [joint] at the tick's end and start.

    With the spring at the end of the tick, q + dt v, the scheme damps as if D were larger by dt K. So much is taken
    from the part at the end, which makes the spring's share explicit. Half of the damping (``friction`` of the joint
    included) acts on the velocity at the start: the trapezoidal rule, whose decay is right to third order in dt D / M.
    The price is that the scheme is not stable for every inertia M. A - B >= dt K / 2 - 2 M / dt is needed, A and B
    being the parts at the end (without - dt K) and at the start; M is at least ``rotor``, so B is cut down, and if
    that does not suffice A is raised: a joint that is too stiff for its tick is damped more than asked.
    """
    asked = damping + friction
    needed = np.maximum(0.0, 0.5 * dt * stiffness - 2.0 * rotor / dt)
    late = np.clip(0.5 * (asked - needed), 0.0, 0.5 * rotor / dt)
    return np.maximum(asked, needed) - late - friction - dt * stiffness, late


_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))
_OF_BODY = (
    "body_mass", "body_ipos", "body_iquat", "body_inertia", "body_subtreemass", "body_sameframe", "body_invweight0",
    "body_contype", "body_conaffinity",
)  # fmt: skip
_OF_GEOM = (
    "geom_type", "geom_contype", "geom_conaffinity", "geom_condim", "geom_priority", "geom_size", "geom_pos",
    "geom_quat", "geom_aabb", "geom_rbound", "geom_sameframe", "geom_friction", "geom_solimp", "geom_solref",
)  # fmt: skip
_OF_DOFS = (
    "qvel", "qacc", "qacc_smooth", "qacc_warmstart", "qfrc_smooth", "qfrc_applied", "qfrc_gravcomp",
    "qfrc_actuator",
)  # fmt: skip


def _carried(
    old: mujoco.MjModel, old_data: mujoco.MjData, old_contact: np.ndarray, new: mujoco.MjModel, parked: set[str]
) -> tuple[mujoco.MjData, np.ndarray]:
    """State and contact efforts [dof] of a new world: all joints, bodies and sleepers of the old, bit by bit.

    ``parked`` names joints that only seem to be the same ones.
    """
    joints = {old.joint(i).name: i for i in range(old.njnt)}
    pairs = [(i, joints[name]) for i in range(new.njnt) if (name := new.joint(i).name) in joints and name not in parked]
    asleep = _sleepers(old, old_data, new, pairs)
    leaning = _leaning(old, old_data, pairs)
    # Only making its data lets MuJoCo take things for asleep. They lie where they are and depend on nothing.
    for i, j in pairs:
        if new.jnt_type[i] == _FREE:
            to, source, tree = new.jnt_qposadr[i], old.jnt_qposadr[j], int(new.dof_treeid[new.jnt_dofadr[i]])
            new.qpos0[to : to + 7] = old_data.qpos[source : source + 7]
            new.tree_sleep_policy[tree] = _INIT if tree in asleep else _ALLOWED
    new.opt.disableflags |= _CONSTRAINT
    data = mujoco.MjData(new)
    new.opt.disableflags &= ~_CONSTRAINT
    contact = np.zeros(new.nv)
    data.time = old_data.time
    for i, j in pairs:
        q, v = (7, 6) if new.jnt_type[i] == _FREE else (1, 1)
        to_q, from_q, to_v, from_v = new.jnt_qposadr[i], old.jnt_qposadr[j], new.jnt_dofadr[i], old.jnt_dofadr[j]
        data.qpos[to_q : to_q + q] = old_data.qpos[from_q : from_q + q]
        for name in _OF_DOFS:
            getattr(data, name)[to_v : to_v + v] = getattr(old_data, name)[from_v : from_v + v]
        contact[to_v : to_v + v] = old_contact[from_v : from_v + v]
        tree, was = new.dof_treeid[to_v], old.dof_treeid[from_v]
        if tree in asleep:
            data.tree_asleep[tree] = asleep[tree]
        elif old_data.tree_asleep[was] < 0:
            data.tree_asleep[tree] = ROUSED if was in leaning else old_data.tree_asleep[was]
    bodies = {old.body(i).name: i for i in range(1, old.nbody)}
    for i in range(1, new.nbody):
        if (j := bodies.get(new.body(i).name)) is not None and new.body(i).name not in parked:
            data.xfrc_applied[i] = old_data.xfrc_applied[j]
            if new.body_mocapid[i] >= 0 and old.body_mocapid[j] >= 0:
                data.mocap_pos[new.body_mocapid[i]] = old_data.mocap_pos[old.body_mocapid[j]]
                data.mocap_quat[new.body_mocapid[i]] = old_data.mocap_quat[old.body_mocapid[j]]
    return data, contact


def _leaning(old: mujoco.MjModel, old_data: mujoco.MjData, pairs: list[tuple[int, int]]) -> set[int]:
    """Trees of the old world that were in touch with one that is gone, or held by it: they may not sleep at once."""
    gone = np.setdiff1d(np.arange(old.ntree), old.dof_treeid[old.jnt_dofadr[[j for _, j in pairs]]])
    islands = np.unique(old_data.tree_island[gone])
    return set(np.flatnonzero(np.isin(old_data.tree_island, islands[islands >= 0])).tolist())


def _sleepers(
    old: mujoco.MjModel, old_data: mujoco.MjData, new: mujoco.MjModel, pairs: list[tuple[int, int]]
) -> dict[int, int]:
    """Trees of the new world that sleep: each with the next of those that wake together.

    Whoever slept leaning on something that is gone wakes, and so does whoever somebody has just roused.
    """
    now = {int(old.dof_treeid[old.jnt_dofadr[j]]): int(new.dof_treeid[new.jnt_dofadr[i]]) for i, j in pairs}
    following = old_data.tree_asleep.tolist()
    asleep = {}
    for first in now:
        tree = first
        while following[tree] >= 0 and tree in now and not old_data.tree_awake[tree]:
            tree = following[tree]
            if tree == first:
                asleep[now[first]] = now[following[first]]
                break
    return asleep
