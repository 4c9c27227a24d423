"""People in the rigid world: hands that push and pull, and a body that nothing moves.

A hand is a free body. While nothing touches it, it is where its controller is. From the first touch on it is pulled to
its controller by a spring, so that the force it gives follows from how far it is held back: 100 N/m up to 100 N unless
told otherwise (CANOPIES D6.4, section 3.1.1). What it closes on it holds by a weld, and what is lifted hangs from the
same spring: the heavier, the further the real hand must go. A hand's own weight is never felt.

Head, trunk and legs are kinematic: exactly where the tracked points put them, whoever pushes
(``docs/decisions/hands.md``).
"""

from __future__ import annotations

import dataclasses
import functools
import math

import mujoco
import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels import human_posture as kernels
from vinesim.kernels.launch import bind_launch
from vinesim.physics.rigid.static_world import ALL_BITS, GROUND, REMOTE_HAND, ROUGH
from vinesim.scene import appearance
from vinesim.scene.appearance import PHALANGES
from vinesim.scene.values import POINT_NAMES, HandSample, HumanPose, HumanSpec, Shape

SIDES = ("left", "right")
MASS = 0.4
"""[kg] A hand (0.6 % of a person's mass: Winter, Biomechanics and Motor Control, 2009)."""
INERTIA = 0.02
"""[kg m2] With it turns the forearm."""
TURN = 10.0
"""Moment of a touching hand per angle from its controller [N m/rad]: GUESSED, as is the most that a wrist can do."""
MOMENT = 10.0
"""[N m]"""
LINGER = 5
"""[tick] So long after its last touch a hand still hangs on its spring: what bounces is not set free in between."""
RETURN = 0.1
"""[s] Set free, a hand closes this fast on its controller, by :data:`HURRY` at most."""
HURRY = 1.5
"""[m/s]"""
HEAVY = 1e4
"""[kg, kg m2] Head, trunk and legs are moved as told. Within a tick they have a velocity, as bodies without joints have
not in MuJoCo (a leg would run centimetres into what it kicks), and are so heavy that no force changes it.
"""
THICK = 0.012
"""[m] Half of a hand's thickness. A free hand that goes further in a tick looks first for what is in its way."""
WAKE_COUNTER = -1 - mujoco.mjMINAWAKE
"""What MuJoCo counts up in ``tree_asleep`` of who has just been woken: so many ticks must pass before he may sleep."""
HAND = 0.13
"""[m] From the middle of the palm to the tips of the fingers."""
FINGERS = np.array([[0.0, 0.0, 0.0], [0.085, 0.0, 0.0]])
"""[m] Middle of the palm and of the fingers, in the palm's frame."""
JUMP = 0.5
"""[m] A head that comes further in a tick has not moved but been put elsewhere: no speed, and nothing in between."""
FASTEST = 5.0
"""[m/s] No part of a body pushes faster, whatever its trackers say."""
SKIN = (0.85, 0.62, 0.5, 1.0)
CLOTH = (0.98, 0.47, 0.16, 1.0)

BODY_PARTS = (
    "head", "chest", "hips", "left_thigh", "left_shank", "left_foot", "right_thigh", "right_shank", "right_foot",
)  # fmt: skip
"""What of a person is kinematic, in the order of :func:`posture`."""
VISUAL_PARTS = (
    "neck", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm",
    *(f"{side}_{finger}_{k + 1}" for side in SIDES for finger in appearance.FINGERS for k in range(PHALANGES)),
)  # fmt: skip
"""What is only seen: it hangs between head, chest and hands, and touches nothing."""
# shares of a person's height (Winter 2009, after Drillis and Contini)
THIGH, SHANK, ANKLE, HIP, TRUNK = 0.245, 0.246, 0.039, 0.095, 0.288
_BACK, _DOWN = 0.09, 0.02
"""[m] From between the eyes to the middle of the head."""
_SHARES = {"head": 0.939, "hips": 0.53}
"""Height of the eyes and of the hip joints of somebody who stands."""
_KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "box": mujoco.mjtGeom.mjGEOM_BOX,
}  # fmt: skip
_NECK = -0.2
"""[m] Height of the neck above the eyes."""
TURN_DAMPING = 2.0 * math.sqrt(TURN * INERTIA)
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


class HumanError(ValueError):
    """A person that cannot join or move as asked."""


# ---------------------------------------------------------------------- what of a body touches, and where it is


def standing_pose(root: np.ndarray, height: float = 1.75) -> HumanPose:
    """Somebody who stands on ``root`` [7] and holds the hands out in front of the hips, palms down."""

    def at(x: float, y: float, z: float) -> np.ndarray:
        return frames.compose(root, frames.pose(np.array([x, y, z])))

    side, hip = HIP * height, _SHARES["hips"] * height
    return HumanPose(
        root=np.asarray(root, float), head=at(_BACK, 0.0, _SHARES["head"] * height), hips=at(0.0, 0.0, hip),
        left=at(0.35, 0.2, hip + 0.1), right=at(0.35, -0.2, hip + 0.1),
        left_foot=at(0.0, side, ANKLE * height), right_foot=at(0.0, -side, ANKLE * height),
    )  # fmt: skip


@functools.cache
def body_shapes(height: float) -> tuple[Shape, ...]:
    """One shape for each of :data:`PARTS`, in its frame: x along a limb, origin where it begins."""

    def limb(share: float, radius: float) -> Shape:
        half = 0.5 * share * height
        return Shape("capsule", (radius, half), frames.pose(np.array([half, 0.0, 0.0]), _Z_TO_X), CLOTH)

    legs = (
        limb(THIGH, 0.07), limb(SHANK, 0.05),
        Shape("box", (0.13, 0.045, 0.5 * ANKLE * height), frames.pose(np.array([0.06, 0.0, -0.5 * ANKLE * height])),
              CLOTH),
    )  # fmt: skip
    half = 0.5 * TRUNK * height
    return (
        Shape("ellipsoid", (0.1, 0.078, 0.115), frames.pose(np.array([-_BACK, 0.0, -_DOWN])), SKIN),
        Shape("ellipsoid", (0.12, 0.17, half + 0.03), frames.pose(np.array([0.0, 0.0, half])), CLOTH),
        Shape("ellipsoid", (0.12, 0.16, 0.12), frames.pose(np.zeros(3)), CLOTH),
        *legs, *legs,
    )  # fmt: skip


@functools.cache
def hand_shapes(side: str) -> tuple[Shape, ...]:
    """Palm, fingers and thumb in the frame of the palm."""
    thumb = np.array([0.02, 0.05 if side == "right" else -0.05, -0.006])
    # flat faces: MuJoCo lets a capsule that lies along another touch it in one point only, and it rocks
    return (
        Shape("box", (0.05, 0.04, THICK), frames.pose(np.zeros(3)), SKIN),
        Shape("box", (0.04, 0.036, THICK - 0.003), frames.pose(FINGERS[1]), SKIN),
        Shape("capsule", (0.01, 0.025), frames.pose(thumb, _Z_TO_X), SKIN),
    )  # fmt: skip


def posture(height: float, pose: HumanPose) -> np.ndarray:
    """Poses [part, 7] of :data:`PARTS`: knees bend forward by as much as hips and ankles ask."""
    return _Motion(height).posture(pose)


class _Motion:
    """Kernels about one person, bound to their arrays."""

    def __init__(self, height: float) -> None:
        points, poses = len(POINT_NAMES) - 3, len(BODY_PARTS) + 2 * len(SIDES)
        self._tracked, self._parts = np.zeros((points, 7)), np.zeros((len(BODY_PARTS), 7))
        self._start, self._goal = np.zeros((poses, 7)), np.zeros((poses, 7))
        self._apart = np.zeros((3, poses, 3))

        def shared(data: np.ndarray) -> wp.array:
            return wp.array(data, dtype=wp.float64, device="cpu", copy=False)

        self._stand = bind_launch(
            kernels.pose_torso_and_legs,
            [THIGH * height, SHANK * height, HIP * height, wp.vec3d(-_BACK, 0.0, _NECK), shared(self._tracked)],
            [shared(self._parts)],
        )
        self._differ = bind_launch(
            kernels.pose_difference, [shared(self._start), shared(self._goal)], [shared(rows) for rows in self._apart]
        )
        looks = appearance.load_human_model(height)
        self._held, self._closed = np.zeros((4, 7)), np.zeros(2 * len(appearance.FINGERS))
        self._limbs, limbs = np.zeros((len(VISUAL_PARTS), 7)), looks.limbs
        bones = [np.ascontiguousarray(table) for table in (looks.root, looks.length, looks.bent)]
        self._hang = bind_launch(
            kernels.pose_arms_and_fingers,
            [
                limbs.upper_arm, limbs.forearm, *map(wp.vec3d, (limbs.shoulder, limbs.wrist, limbs.elbow)), limbs.neck,
                wp.vec3d(limbs.nape), *map(shared, bones), shared(self._held), shared(self._closed),
            ],
            [shared(self._limbs)],
        )  # fmt: skip

    def posture(self, pose: HumanPose) -> np.ndarray:
        """Poses [part, 7] of :data:`PARTS`."""
        self._tracked[:] = pose.head, pose.hips, pose.left_foot, pose.right_foot
        self._stand(3)
        return self._parts.copy()

    def limbs(self, chest: np.ndarray, head: np.ndarray, hands: np.ndarray, closed: tuple[float, ...]) -> np.ndarray:
        """Poses [limb, 7] of :data:`LIMBS`, for hands [2, 7] and how far their fingers are bent [2 * finger]."""
        self._held[0], self._held[1], self._held[2:], self._closed[:] = chest, head, hands, closed
        self._hang(3 + len(self._closed))
        return self._limbs.copy()

    def apart(self, start: tuple[np.ndarray, ...], goal: tuple[np.ndarray, ...]) -> np.ndarray:
        """From poses to poses [k, 7]: way [m], turn [rad] in world axes, turn in the first pose's axes; [3, k, 3].

        The array is written anew by the next call.
        """
        np.concatenate(start, out=self._start)
        np.concatenate(goal, out=self._goal)
        self._differ(len(self._start))
        return self._apart


# ---------------------------------------------------------------------- one person


@dataclasses.dataclass(eq=False)
class HandBody:
    """One hand: where it is wanted, what it holds, and where its numbers lie in MuJoCo's arrays."""

    side: str
    closed: bool = False
    busy: bool = False
    """Of a copy: it touches nothing, for at home it pushes a robot or holds something."""
    steps_since_contact: int = LINGER
    """[tick] since the last touch."""
    force: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    held: tuple[str, str] | None = None
    """Actor and link."""
    grasp_pose: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(7))
    """[7] of the hand in what it holds."""
    on_plant: bool = False
    """On a plant, to which it gives its force: see :mod:`vinesim.physics.rigid.hand_grasp`."""
    body: int = -1
    weld: int = -1
    q: slice = dataclasses.field(default_factory=lambda: slice(0))
    v: slice = dataclasses.field(default_factory=lambda: slice(0))

    @property
    def link(self) -> str:
        """Name of the hand's link."""
        return f"{self.side}_hand"


class HumanBody:
    """One person in MuJoCo's world: two hands that are free bodies, and a kinematic body."""

    def __init__(self, spec: HumanSpec, bit: int, *, is_remote: bool = False) -> None:
        """``is_remote``: another client moves the person, and says what the hands hold and how they push robots."""
        for name in ("height", "stiffness", "force"):
            value = getattr(spec, name)
            if not (math.isfinite(value) and value > 0.0):
                raise HumanError(f"human {spec.name!r}: {name} is {value}; give a number above 0")
        self.spec, self.bit, self.is_remote = spec, bit, is_remote
        self.damping = 2.0 * math.sqrt(spec.stiffness * MASS)
        """[N s/m] of the hand against its controller: an empty hand comes back without swinging over."""
        self.hands = tuple(HandBody(side) for side in SIDES)
        self.bodies: dict[str, int] = {}
        self.part_bodies = np.zeros(0, int)
        """MuJoCo's bodies of :data:`PARTS`."""
        self.part_dofs = np.zeros((0, 6), int)
        """MuJoCo's degrees of freedom of the same."""
        self._part_q = self._hand_q = np.zeros((0, 7), int)
        self._hand_bits = 0, 0
        """What the hands are, and what they meet."""
        self._motion = _Motion(spec.height)
        self.move(spec.pose)
        self._before = self._now

    @property
    def part_poses(self) -> np.ndarray:
        """Poses [part, 7] of :data:`PARTS`."""
        return self._now[: len(BODY_PARTS)]

    def controller(self, hand: HandBody) -> np.ndarray:
        """Pose [7] that a hand is wanted at."""
        return self._now[len(BODY_PARTS) + self.hands.index(hand)]

    def move(self, pose: HumanPose) -> None:
        """Take over where the tracked points are: the body is there at once, the hands try to be."""
        points = [getattr(pose, name) for name in POINT_NAMES]
        square = np.array([np.nan if np.shape(at) != (7,) else 0.0 * at[:3].sum() + at[3:] @ at[3:] for at in points])
        if not (abs(square - 1.0) < 1e-3).all():
            worst = int(np.argmin(abs(square - 1.0) < 1e-3))
            raise HumanError(
                f"human {self.spec.name!r}: {POINT_NAMES[worst]} is {points[worst]}; give seven finite numbers, position "
                "and unit quaternion (x, y, z, w)"
            )
        self._fingers = (*pose.left_fingers, *pose.right_fingers)
        self._now = np.concatenate([self._motion.posture(pose), [pose.left, pose.right]])
        """Poses of :data:`PARTS`, then of both controllers."""
        for hand in self.hands:
            hand.closed = bool(getattr(pose, f"{hand.side}_closed")) and not self.is_remote
            hand.busy = bool(getattr(pose, f"{hand.side}_busy")) and self.is_remote

    def limbs(self, hands: np.ndarray) -> np.ndarray:
        """Poses [limb, 7] of :data:`LIMBS`, with the hands [2, 7] where they are."""
        chest, head = self.part_poses[BODY_PARTS.index("chest")], self.part_poses[BODY_PARTS.index("head")]
        return self._motion.limbs(chest, head, hands, self._fingers)

    def speed(self, hand: HandBody, dt: float) -> np.ndarray:
        """Velocity [3] of a controller in this tick, m/s."""
        at = len(BODY_PARTS) + self.hands.index(hand)
        return (self._now[at, :3] - self._before[at, :3]) / dt

    def hand(self, side: str) -> HandBody:
        """The left or the right hand."""
        if side not in SIDES:
            raise HumanError(f"human {self.spec.name!r} has no {side!r} hand; it has: {', '.join(SIDES)}")
        return self.hands[SIDES.index(side)]

    # ------------------------------------------------------------------ in MuJoCo

    def attach(self, spec: mujoco.MjSpec, robots: int) -> None:
        """Add the person's bodies; ``robots``: the bits of all robots."""
        name, me = self.spec.name, 1 << self.bit
        meets = ALL_BITS & ~me & ~REMOTE_HAND if self.is_remote else ALL_BITS & ~me
        self._hand_bits = (REMOTE_HAND, meets & ~robots) if self.is_remote else (me, meets)
        for part, shape, pose in zip(BODY_PARTS, body_shapes(self.spec.height), self.part_poses, strict=True):
            body = spec.worldbody.add_body(
                name=f"{name}/{part}", pos=pose[:3], quat=frames.to_wxyz(pose[3:]), mass=HEAVY, ipos=np.zeros(3),
                inertia=[HEAVY] * 3, explicitinertial=True, gravcomp=1.0, sleep=mujoco.mjtSleepPolicy.mjSLEEP_NEVER,
            )  # fmt: skip
            body.add_freejoint(name=f"{name}/{part}")
            _add(body, shape, (me, meets & ~GROUND))
        for hand in self.hands:
            at = self.controller(hand)
            body = spec.worldbody.add_body(
                name=f"{name}/{hand.link}", pos=at[:3], quat=frames.to_wxyz(at[3:]), mass=MASS, ipos=np.zeros(3),
                inertia=[INERTIA] * 3,
                explicitinertial=True, gravcomp=1.0, sleep=mujoco.mjtSleepPolicy.mjSLEEP_NEVER,
            )  # fmt: skip
            body.add_freejoint(name=f"{name}/{hand.link}")
            for shape in hand_shapes(hand.side):
                _add(body, shape, self._hand_bits)
            spec.add_equality(
                name=f"{name}/{hand.link}", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1=f"{name}/{hand.link}", active=False, solref=[0.02, 1.0], solimp=[0.99, 0.999, 0.001, 0.5, 2.0],
            )  # fmt: skip

    def locate(self, m: mujoco.MjModel) -> None:
        """Find the person's numbers in a world that was compiled anew."""
        name = self.spec.name
        self.part_bodies = np.array([m.body(f"{name}/{part}").id for part in BODY_PARTS], int)
        joints = [m.joint(f"{name}/{part}") for part in BODY_PARTS]
        self._part_q = np.array([j.qposadr[0] for j in joints])[:, None] + np.arange(7)
        self.part_dofs = np.array([j.dofadr[0] for j in joints])[:, None] + np.arange(6)
        self.bodies = dict(zip(BODY_PARTS, self.part_bodies.tolist(), strict=True))
        for hand in self.hands:
            joint = m.joint(f"{name}/{hand.link}")
            hand.body = self.bodies[hand.link] = m.body(f"{name}/{hand.link}").id
            hand.weld = m.equality(f"{name}/{hand.link}").id
            hand.q = slice(joint.qposadr[0], joint.qposadr[0] + 7)
            hand.v = slice(joint.dofadr[0], joint.dofadr[0] + 6)
        self._hand_q = np.stack([np.arange(hand.q.start, hand.q.stop) for hand in self.hands])
        self.excuse(m)

    def drive(self, m: mujoco.MjModel, d: mujoco.MjData, dt: float) -> None:
        """Before a tick: the body where it is told to be, each hand free at its controller or on its spring."""
        if self._before is not self._now and _far(self._before[0, :3], self._now[0, :3]):
            self._appear(d)
        at = d.qpos[self._hand_q]
        at[:, 3:] = frames.from_wxyz(at[:, 3:])
        parts, start = len(BODY_PARTS), self._before[: len(BODY_PARTS)]
        held = np.array([[hand.steps_since_contact < LINGER] for hand in self.hands])
        goal = np.where(held, self._now[parts:], self._before[parts:])
        way, turn, within = self._motion.apart((self._before, at), (self._now, goal))
        speed = way[:parts] / dt
        size = np.sqrt((speed * speed).sum(1, keepdims=True))
        self._place(d, start)
        d.qvel[self.part_dofs[:, :3]] = speed * np.minimum(1.0, FASTEST / np.maximum(size, FASTEST))
        d.qvel[self.part_dofs[:, 3:]] = within[:parts] / dt
        steps, turns, offsets, angles = way[parts:-2], turn[parts:-2], way[-2:], turn[-2:]
        for hand, here, offset, angle, step, spin in zip(self.hands, at, offsets, angles, steps, turns, strict=True):
            velocity = d.qvel[hand.v]
            if hand.on_plant:
                velocity[:] = d.xfrc_applied[hand.body] = 0.0
            elif hand.steps_since_contact < LINGER:
                turning = frames.rotate(here[3:], velocity[3:])
                force = self.spec.stiffness * offset + self.damping * (step / dt - velocity[:3])
                moment = TURN * angle + TURN_DAMPING * (spin / dt - turning)
                d.xfrc_applied[hand.body, :3] = _at_most(self.spec.force, force)
                d.xfrc_applied[hand.body, 3:] = _at_most(MOMENT, moment)
            else:
                step = step + offset * dt / max(RETURN, math.sqrt(offset @ offset) / HURRY)
                velocity[:3] = self._look(m, d, hand, here[:3], step) / dt
                velocity[3:] = frames.rotate(frames.conjugate(here[3:]), spin / dt + angle / RETURN)
                d.xfrc_applied[hand.body] = 0.0

    def _appear(self, d: mujoco.MjData) -> None:
        """Be elsewhere all at once, hands too, but for those that hold something."""
        self._before = self._now
        for hand in self.hands:
            if hand.held is None:
                at = self.controller(hand)
                d.qpos[hand.q] = np.concatenate([at[:3], frames.to_wxyz(at[3:])])
                d.qvel[hand.v] = 0.0
                hand.steps_since_contact = LINGER

    def _look(
        self, m: mujoco.MjModel, d: mujoco.MjData, hand: HandBody, at: np.ndarray, step: np.ndarray
    ) -> np.ndarray:
        """A step [3] m of a fast free hand, shortened if something is in its way."""
        length = float(np.linalg.norm(step))
        if length < THICK or hand.busy:
            return step
        way, gone, geom = step / length, 0.0, np.zeros(1, np.int32)
        while gone < length + THICK:
            ahead = mujoco.mj_ray(m, d, at + gone * way, way, None, 1, hand.body, geom)
            if ahead < 0.0 or gone + ahead > length + THICK:
                return step
            if m.geom_contype[geom[0]] & self._hand_bits[1]:  # neither one's own body nor what is only to be seen
                return way * max(gone + ahead - 0.8 * THICK, 0.0)
            gone += ahead + 1e-3
        return step

    def feel(self, d: mujoco.MjData) -> None:
        """After a tick: with what force the hands met the world, held it, or were held."""
        self._before = self._now
        self._place(d, self.part_poses)
        for hand in self.hands:
            if not hand.on_plant:
                felt = d.qfrc_constraint[hand.v] + d.qfrc_applied[hand.v]
                hand.force = -felt[:3]
                hand.steps_since_contact = 0 if hand.held is not None or felt.any() else hand.steps_since_contact + 1

    def _place(self, d: mujoco.MjData, parts: np.ndarray) -> None:
        d.qpos[self._part_q[:, :3]] = parts[:, :3]
        d.qpos[self._part_q[:, 3:]] = frames.to_wxyz(parts[:, 3:])

    def sample(self, hand: HandBody, d: mujoco.MjData) -> HandSample:
        """What is known of a hand."""
        pose = np.concatenate([d.qpos[hand.q][:3], frames.from_wxyz(d.qpos[hand.q][3:])])
        return HandSample(
            pose, self.controller(hand).copy(), hand.force.copy(), hand.steps_since_contact == 0, hand.held
        )

    # ------------------------------------------------------------------ holding

    def grasp(self, m: mujoco.MjModel, d: mujoco.MjData, hand: HandBody, body: int | None) -> None:
        """Weld a hand to a MuJoCo body at ``hand.grasp_pose``; None: it only stops touching, and rides on a plant.

        A hand that holds meets nothing: what it holds does.
        """
        hand.on_plant, hand.steps_since_contact = body is None, 0
        d.eq_active[hand.weld] = body is not None
        if body is not None:
            m.eq_obj2id[hand.weld] = body
            m.eq_data[hand.weld, :3], m.eq_data[hand.weld, 3:6] = hand.grasp_pose[:3], 0.0
            m.eq_data[hand.weld, 6:10] = frames.to_wxyz(frames.conjugate(hand.grasp_pose[3:]))
            m.eq_data[hand.weld, 10] = 1.0
            wake_body(m, d, body)
        self._touchable(m, hand, yes=False)

    def release(self, m: mujoco.MjModel, d: mujoco.MjData, hand: HandBody) -> None:
        """Open a hand; it hangs on its spring a little longer and then returns to its controller."""
        hand.held, hand.on_plant, hand.steps_since_contact = None, False, 0
        if d.eq_active[hand.weld]:
            wake_body(m, d, m.eq_obj2id[hand.weld])
        d.eq_active[hand.weld] = 0
        self._touchable(m, hand, yes=True)

    def excuse(self, m: mujoco.MjModel) -> None:
        """Let nothing touch the hands that are busy elsewhere."""
        for hand in self.hands:
            if hand.held is None:
                self._touchable(m, hand, yes=not hand.busy)

    def _touchable(self, m: mujoco.MjModel, hand: HandBody, *, yes: bool) -> None:
        geoms = slice(m.body_geomadr[hand.body], m.body_geomadr[hand.body] + m.body_geomnum[hand.body])
        bit, meets = self._hand_bits if yes else (0, 0)
        m.geom_contype[geoms] = m.body_contype[hand.body] = bit
        m.geom_conaffinity[geoms] = m.body_conaffinity[hand.body] = meets


def _add(body: mujoco.MjsBody, shape: Shape, bits: tuple[int, int]) -> None:
    size = [*shape.size, 0.0, 0.0][:3]
    body.add_geom(
        type=_KINDS[shape.kind], size=size, pos=shape.pose[:3], quat=frames.to_wxyz(shape.pose[3:]), mass=0.0,
        contype=bits[0], conaffinity=bits[1], friction=ROUGH, priority=1,
        solimp=[0.99, 0.999, 0.001, 0.5, 2.0],
    )  # fmt: skip


def wake_body(m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
    """Wake a body: MuJoCo does when the two arrays that it keeps of sleep disagree.

    One that is awake but still, as what is held is, would fall asleep in the very tick in which it is let go.
    """
    tree = m.body_treeid[body]
    if tree >= 0:
        d.tree_awake[tree] = 1
        if d.tree_asleep[tree] < 0:
            d.tree_asleep[tree] = WAKE_COUNTER


def _far(a: np.ndarray, b: np.ndarray) -> bool:
    return float((b - a) @ (b - a)) > JUMP * JUMP


def _at_most(limit: float, vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector * (limit / length) if length > limit else vector
