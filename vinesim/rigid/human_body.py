"""One person in MuJoCo's world: kinematic head, trunk and legs, and two hands on springs.

A hand is a free body. It follows its controller until it touches something; then a spring pulls it to its controller,
so
that its force follows from how far it is held back: 100 N/m up to 100 N by default (CANOPIES D6.4, section 3.1.1). It
holds rigid objects by a weld; what is lifted hangs from the same spring. Gravity does not act on a hand itself.

Head, trunk and legs are kinematic: exactly where the tracked points put them, whatever pushes them
(``docs/decisions/hands.md``). Those of a remote person stop a robot, but push with a bounded force while they move, and
pass through rigid bodies while its messages let them jump or push with more.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.hand_body import HandBody
from vinesim.rigid.human_posture import PostureSolver
from vinesim.rigid.human_shapes import BODY_PARTS, SIDES, body_shapes, hand_shapes
from vinesim.rigid.passing_parts import HEAVY_PART_MASS, PassingParts
from vinesim.rigid.recompile import WorldNames
from vinesim.rigid.static_world import ALL_BITS, GROUND, REMOTE_HAND, ROBOTS, contact_friction, geom_user
from vinesim.scene import appearance
from vinesim.scene.appearance import SHEARS_PARTS
from vinesim.scene.materials import Material
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import POINT_NAMES, HandSample, HumanPose, HumanSpec, Shape

KINEMATIC_MASS = HEAVY_PART_MASS
"""[kg, kg m^2] Mass and inertia of the kinematic parts. They are free bodies with a velocity, not bodies without
joints: those have no velocity in MuJoCo, and a leg would sink centimetres into what it kicks. No force changes the
motion of a body as heavy as this within a step, and each step starts from the prescribed poses. Those of a remote
person weigh less while they move: see :mod:`vinesim.rigid.passing_parts`."""
MAX_REMOTE_FORCE = 150.0
"""[N] A remote person's parts that push with more together pass through from the next step on. READ: ISO/TS 15066,
table A.2, allows 110 to 160 N between robots and trunk, arms and hands for contacts that last, twice that for
shorter ones."""
_SOLIMP = [0.99, 0.999, 0.001, 0.5, 2.0]
_KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}


class HumanError(ValueError):
    """A person that cannot be added or moved as asked."""


class HumanBody:
    """One person: poses of the kinematic parts, both hands, and their indices in MuJoCo's arrays."""

    def __init__(
        self,
        spec: HumanSpec,
        code: int,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        is_remote: bool = False,
    ) -> None:
        """``code``: of :data:`HUMAN_CODES`.

        ``is_remote``: another client moves the person and computes what the hands hold. Raises :class:`HumanError` for
        numbers that cannot be, :class:`vinesim.scene.appearance.AppearanceError` for an unknown outfit.
        """
        stiffness = parameters.hand_stiffness if spec.stiffness is None else spec.stiffness
        force = parameters.hand_force if spec.force is None else spec.force
        for name, value in (("height", spec.height), ("stiffness", stiffness), ("force", force)):
            if not (math.isfinite(value) and value > 0.0):
                raise HumanError(f"human {spec.name!r}: {name} is {value}; give a number above 0")
        self.spec = spec
        self.code = code
        self.is_remote = is_remote
        self.parameters = parameters
        self.hands = tuple(HandBody(side, stiffness, force, parameters) for side in SIDES)
        self.bodies: dict[str, int] = {}
        self.part_bodies = np.zeros(0, int)
        """[part] MuJoCo's bodies of :data:`BODY_PARTS`."""
        self.part_dofs = np.zeros((0, 6), int)
        """[part, 6] MuJoCo's degrees of freedom of the same."""
        self._part_q = self._hand_q = np.zeros((0, 7), int)
        self._passing = PassingParts(len(BODY_PARTS))
        self._part_force = np.full(len(BODY_PARTS), np.inf)  # not known before the first step
        self._pushes_too_hard = np.zeros(len(BODY_PARTS), bool)
        self._posture = PostureSolver(spec.height)
        outfit = spec.outfit or appearance.outfit_of(spec.name)
        self.looks = appearance.load_human_model(spec.height, outfit=outfit)
        """Its shapes, in its outfit."""
        self._shears = appearance.load_shears()
        self.set_pose(spec.pose)
        self._last_poses = self._poses

    @property
    def part_poses(self) -> np.ndarray:
        """Poses [part, 7] of :data:`BODY_PARTS`."""
        return self._poses[: len(BODY_PARTS)]

    def controller_pose(self, hand: HandBody) -> np.ndarray:
        """Pose [7] of a hand's controller."""
        return self._poses[len(BODY_PARTS) + self.hands.index(hand)]

    def controller_velocity(self, hand: HandBody, dt: float) -> np.ndarray:
        """Velocity [3] m/s of a hand's controller in this step of ``dt`` [s]."""
        at = len(BODY_PARTS) + self.hands.index(hand)
        return (self._poses[at, :3] - self._last_poses[at, :3]) / dt

    def set_pose(self, pose: HumanPose) -> None:
        """Set the tracked points: the body takes its pose at once, the hands are pulled. Raises :class:`HumanError`."""
        points = [getattr(pose, name) for name in POINT_NAMES]
        square = np.array([np.nan if np.shape(at) != (7,) else 0.0 * at[:3].sum() + at[3:] @ at[3:] for at in points])
        if not (abs(square - 1.0) < 1e-3).all():
            worst = int(np.argmin(abs(square - 1.0) < 1e-3))
            raise HumanError(
                f"human {self.spec.name!r}: {POINT_NAMES[worst]} is {points[worst]}; give seven finite "
                f"numbers, position "
                "and unit quaternion (x, y, z, w)"
            )
        self._fingers = (*pose.left_fingers, *pose.right_fingers)
        self._poses = np.concatenate([self._posture.body_parts(pose), [pose.left, pose.right]])
        """Poses of :data:`BODY_PARTS`, then of both controllers."""
        for hand in self.hands:
            hand.has_shears = bool(getattr(pose, f"{hand.side}_shears"))
            hand.is_squeezed = bool(getattr(pose, f"{hand.side}_closed"))
            hand.closed = hand.is_squeezed and not (hand.has_shears or self.is_remote)
            hand.busy = bool(getattr(pose, f"{hand.side}_busy")) and self.is_remote

    @property
    def shears_parts(self) -> tuple[str, ...]:
        """Links of the shears that the hands have."""
        return tuple(f"{hand.side}_{part}" for hand in self.hands if hand.has_shears for part in SHEARS_PARTS)

    def visual_poses(self, hands: np.ndarray) -> np.ndarray:
        """Poses [part, 7] of :data:`VISUAL_PARTS`, then of :attr:`shears_parts`, for palms at ``hands`` [2, 7]."""
        chest = self.part_poses[BODY_PARTS.index("chest")]
        head = self.part_poses[BODY_PARTS.index("head")]
        poses = [self._posture.visual_parts(chest, head, hands, self._fingers)]
        for hand, palm in zip(self.hands, hands, strict=True):
            if hand.has_shears:
                halves = self._shears.closed if hand.is_squeezed else self._shears.open
                poses.append(frames.compose(palm, halves))
        return np.concatenate(poses)

    def hand(self, side: str) -> HandBody:
        """The left or the right hand; :class:`HumanError` otherwise."""
        if side not in SIDES:
            raise HumanError(f"human {self.spec.name!r} has no {side!r} hand; it has: {', '.join(SIDES)}")
        return self.hands[SIDES.index(side)]

    def hand_sample(self, hand: HandBody, d: mujoco.MjData) -> HandSample:
        """A hand after the last step."""
        return hand.sample(d, self.controller_pose(hand))

    # ------------------------------------------------------------------ in MuJoCo

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the person's bodies to a world."""
        name = self.spec.name
        me = self.code
        p = self.parameters
        meets = ALL_BITS & ~me & ~REMOTE_HAND if self.is_remote else ALL_BITS & ~me
        never = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        for part, shape, pose in zip(BODY_PARTS, body_shapes(self.spec.height), self.part_poses, strict=True):
            body = spec.worldbody.add_body(
                name=f"{name}/{part}",
                pos=pose[:3],
                quat=frames.to_wxyz(pose[3:]),
                mass=KINEMATIC_MASS,
                ipos=np.zeros(3),
                inertia=[KINEMATIC_MASS] * 3,
                explicitinertial=True,
                gravcomp=1.0,
                sleep=never,
            )
            body.add_freejoint(name=f"{name}/{part}")
            _add_geom(body, shape, (me, meets & ~GROUND), p.friction, Material.UNKNOWN)
        for hand in self.hands:
            hand.collision_bits = (REMOTE_HAND, meets & ~ROBOTS) if self.is_remote else (me, meets)
            at = self.controller_pose(hand)
            body = spec.worldbody.add_body(
                name=f"{name}/{hand.link}",
                pos=at[:3],
                quat=frames.to_wxyz(at[3:]),
                mass=p.hand_mass,
                ipos=np.zeros(3),
                inertia=[p.hand_inertia] * 3,
                explicitinertial=True,
                gravcomp=1.0,
                sleep=never,
            )
            body.add_freejoint(name=f"{name}/{hand.link}")
            for shape in hand_shapes(hand.side):
                _add_geom(body, shape, hand.collision_bits, p.friction, Material.HAND)
            spec.add_equality(
                name=f"{name}/{hand.link}",
                type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1=f"{name}/{hand.link}",
                active=False,
                solref=[0.02, 1.0],
                solimp=_SOLIMP,
            )

    def find_indices(self, m: mujoco.MjModel, names: WorldNames) -> None:
        """Find the person's bodies and joints in a world that was compiled anew."""
        name = self.spec.name
        self.part_bodies = np.array([names.body[f"{name}/{part}"] for part in BODY_PARTS], int)
        joints = [names.joint[f"{name}/{part}"] for part in BODY_PARTS]
        self._part_q = m.jnt_qposadr[joints].astype(int)[:, None] + np.arange(7)
        self.part_dofs = m.jnt_dofadr[joints].astype(int)[:, None] + np.arange(6)
        self.bodies = dict(zip(BODY_PARTS, self.part_bodies.tolist(), strict=True))
        if self.is_remote:
            self._passing.find_indices(m, self.part_bodies)
        for hand in self.hands:
            hand.find_indices(m, names, name)
            self.bodies[hand.link] = hand.body
        self._hand_q = np.stack([np.arange(hand.qpos.start, hand.qpos.stop) for hand in self.hands])
        self.update_hand_collisions(m)

    def update_hand_collisions(self, m: mujoco.MjModel) -> None:
        """Let empty hands touch what they can, unless their own client says that they are busy."""
        for hand in self.hands:
            if hand.held is None:
                hand.set_collision(m, enabled=not hand.busy)

    # ------------------------------------------------------------------ the step

    def apply_controls(self, m: mujoco.MjModel, d: mujoco.MjData, dt: float) -> None:
        """Before a step: place the kinematic parts at its start with their velocity, and drive both hands."""
        p = self.parameters
        has_teleported = self._last_poses is not self._poses and self._has_teleported()
        if has_teleported:
            self._teleport(d)
        at = d.qpos[self._hand_q]
        at[:, 3:] = frames.from_wxyz(at[:, 3:])
        parts = len(BODY_PARTS)
        start = self._last_poses[: len(BODY_PARTS)]
        on_spring = np.array([[hand.is_on_spring] for hand in self.hands])
        goal = np.where(on_spring, self._poses[parts:], self._last_poses[parts:])
        way, turn, turn_within = self._posture.difference((self._last_poses, at), (self._poses, goal))
        velocity = way[:parts] / dt
        speed = np.sqrt((velocity * velocity).sum(1, keepdims=True))
        if self.is_remote:
            jumped = (speed[:, 0] > p.max_body_speed) | has_teleported
            self._passing.update(
                m, d, self._poses[:parts, :3], speed[:, 0], self._part_force, jumped | self._pushes_too_hard
            )
        self._place_parts(d, start)
        d.qvel[self.part_dofs[:, :3]] = velocity * np.minimum(
            1.0, p.max_body_speed / np.maximum(speed, p.max_body_speed)
        )
        d.qvel[self.part_dofs[:, 3:]] = turn_within[:parts] / dt
        for i, hand in enumerate(self.hands):
            error = (way[i - 2], turn[i - 2])
            motion = (way[parts + i], turn[parts + i])
            hand.apply_control(m, d, at[i], error, motion)

    def measure(self, d: mujoco.MjData) -> None:
        """After a step: place the kinematic parts at its end and read the forces of the hands."""
        self._last_poses = self._poses
        if self.is_remote:
            force = d.qfrc_constraint[self.part_dofs[:, :3]]
            self._part_force = force = np.sqrt((force * force).sum(1))
            self._pushes_too_hard = (force > 0.0) & self._passing.is_light & (force.sum() > MAX_REMOTE_FORCE)
        self._place_parts(d, self.part_poses)
        for hand in self.hands:
            hand.measure(d)

    def _has_teleported(self) -> bool:
        moved = self._poses[0, :3] - self._last_poses[0, :3]  # of the head
        return float(moved @ moved) > self.parameters.teleport_distance * self.parameters.teleport_distance

    def _teleport(self, d: mujoco.MjData) -> None:
        """Place the whole person without a velocity; hands that hold something stay where they are."""
        self._last_poses = self._poses
        for hand in self.hands:
            if hand.held is None:
                hand.place(d, self.controller_pose(hand))
                hand.steps_since_contact = hand.contact_steps

    def _place_parts(self, d: mujoco.MjData, parts: np.ndarray) -> None:
        d.qpos[self._part_q[:, :3]] = parts[:, :3]
        d.qpos[self._part_q[:, 3:]] = frames.to_wxyz(parts[:, 3:])


def _add_geom(body: mujoco.MjsBody, shape: Shape, bits: tuple[int, int], friction: float, material: Material) -> None:
    """Add a collision shape; ``bits``: contype and conaffinity."""
    size = [*shape.size, 0.0, 0.0][:3]
    body.add_geom(
        type=_KINDS[shape.kind],
        size=size,
        pos=shape.pose[:3],
        quat=frames.to_wxyz(shape.pose[3:]),
        mass=0.0,
        contype=bits[0],
        conaffinity=bits[1],
        friction=contact_friction(friction),
        priority=1,
        solimp=_SOLIMP,
        userdata=geom_user(material),
    )
