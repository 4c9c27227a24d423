"""One person in MuJoCo's world: kinematic head, trunk and legs, and two hands on springs.

A hand is a free body. It follows its controller until it touches something. Then a spring pulls it to its controller,
so that its force depends on the distance from the controller: 100 N/m up to 100 N by default (CANOPIES D6.4, section
3.1.1). It holds rigid objects by a weld, so a lifted object hangs from this spring. Gravity does not act on the hand.

Head, trunk and legs are kinematic: the tracked points determine their poses, and forces do not move them
(``docs/decisions/hands.md``). The kinematic parts of a remote person stop a robot, but push with a bounded force while
they move. They pass through rigid bodies while messages make them jump or push harder than the bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.human_posture import BODY_PARTS, HAND_HALF_THICKNESS, SIDES, PostureSolver, body_shapes, hand_shapes
from vinesim.rigid.recompile import WorldNames, wake_body
from vinesim.rigid.static_world import ALL_BITS, GROUND, REMOTE_HAND, ROBOTS, contact_friction, geom_user
from vinesim.scene import appearance
from vinesim.scene.appearance import SHEARS_PARTS
from vinesim.scene.materials import Material
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import POINT_NAMES, HandSample, HumanPose, HumanSpec, Shape

# Body parts of a remote person: how hard they push, and when they pass through other bodies.
#
# Kinematic parts do not yield, so a part that a message moves against a robot would push the robot with unlimited
# force. Therefore a moving part is light. It becomes heavy again when it stands still and touches nothing, so that a
# standing person stops a robot. A part that jumps, or pushes too hard while it moves, passes through rigid bodies until
# it overlaps no robot.


HEAVY_PART_MASS = 1e4
"""Mass [kg] of a heavy body part of a person: so large that no force changes its motion within a step."""
LIGHT_PART_MASS = 0.3
"""Mass m [kg] of a light body part of a remote person, which bounds its force on a robot.

Its pose is prescribed at every step; within a step a contact only slows it down. So its force on a robot of any mass is
at most m (v 2/tau + depth/tau^2), with its speed v, penetration depth and MuJoCo's time constant tau of contacts (20
ms). DERIVED: two legs that walk at 1.5 m/s push with 80 N, half of :data:`MAX_REMOTE_FORCE`.
"""
STILL_SPEED = 0.05
"""Speed [m/s] below which a body part counts as standing still. TUNED: more than the noise of tracked points."""


class YieldingParts:
    """Decides which body parts [k] of one remote person have a small mass (are *light*), and which pass through other
    bodies.
    """

    def __init__(self, count: int) -> None:
        self.is_passing = np.zeros(count, bool)
        self.is_light = np.ones(count, bool)
        self._bodies = self._geoms = self._obstacles = np.zeros(0, int)
        self._bits = np.zeros((count, 2), int)

    def find_indices(self, m: mujoco.MjModel, bodies: np.ndarray) -> None:
        """Look up the geoms of the parts' MuJoCo ``bodies`` [k], and the geoms of robots, in a recompiled world."""
        self._bodies = bodies
        self._geoms = m.body_geomadr[bodies]
        self._bits = np.stack([m.geom_contype[self._geoms], m.geom_conaffinity[self._geoms]], 1)
        self._obstacles = np.flatnonzero(m.geom_contype & ROBOTS)
        self._apply(m)

    def update(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        places: np.ndarray,
        speed: np.ndarray,
        force: np.ndarray,
        released: np.ndarray,
    ) -> None:
        """Decide for this step which parts have the small mass of a light part, and which pass through other bodies.

        Args:
            m: MuJoCo's model.
            d: MuJoCo's data.
            places: [k, 3] m, origins of the parts at the end of this step.
            speed: [k] m/s, speeds of the parts.
            force: [k] N, forces on the parts in the last step.
            released: [k] bool, parts that shall pass through other bodies until they overlap no robot.
        """
        passing = released | self.is_passing
        if passing.any():
            passing = released | (passing & self._overlaps(m, d, places))
        light = passing | (speed > STILL_SPEED) | (self.is_light & (force > 0.0))
        if (passing != self.is_passing).any() or (light != self.is_light).any():
            self.is_passing = passing
            self.is_light = light
            self._apply(m)

    def _overlaps(self, m: mujoco.MjModel, d: mujoco.MjData, places: np.ndarray) -> np.ndarray:
        """Returns [k] whether the bounding sphere of each part (in any orientation) overlaps a robot geom's bounding
        box."""
        reach = m.geom_rbound[self._geoms] + np.linalg.norm(m.geom_pos[self._geoms], axis=1)
        others = self._obstacles
        axes = d.geom_xmat[others].reshape(-1, 3, 3)
        offset = np.einsum("gij,kgi->kgj", axes, places[:, None] - d.geom_xpos[others])
        outside = np.maximum(abs(offset - m.geom_aabb[others, :3]) - m.geom_aabb[others, 3:], 0.0)
        return (np.sqrt((outside * outside).sum(2)) < reach[:, None]).any(1)

    def _apply(self, m: mujoco.MjModel) -> None:
        bits = np.where(self.is_passing[:, None], 0, self._bits)
        m.geom_contype[self._geoms] = m.body_contype[self._bodies] = bits[:, 0]
        m.geom_conaffinity[self._geoms] = m.body_conaffinity[self._bodies] = bits[:, 1]
        mass = np.where(self.is_light, LIGHT_PART_MASS, HEAVY_PART_MASS)
        m.body_mass[self._bodies] = m.body_subtreemass[self._bodies] = mass
        m.dof_M0[m.body_dofadr[self._bodies][:, None] + np.arange(3)] = mass[:, None]  # MuJoCo reads the mass here
        m.body_invweight0[self._bodies, 0] = 1.0 / mass  # softness of contacts


KINEMATIC_MASS = HEAVY_PART_MASS
"""Mass [kg] and inertia [kg m^2] of the kinematic parts of people.

The parts are free bodies, because bodies without joints have no velocity in MuJoCo, so that a leg would sink
centimetres into an object that it kicks. No force changes the motion of such a heavy body within a step, and each step
starts from the prescribed poses. Parts of a remote person are lighter while they move, see :class:`YieldingParts`.
"""
MAX_REMOTE_FORCE = 150.0
"""Largest total force [N] of a remote person's moving parts; parts that push harder pass through other bodies from the
next step. READ: ISO/TS 15066, table A.2, allows 110 to 160 N between robots and trunk, arms and hands for lasting
contacts, and twice that for short ones."""
_SOLIMP = [0.99, 0.999, 0.001, 0.5, 2.0]
_KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}


class HumanError(ValueError):
    """Error: a person cannot be added or moved as requested."""


class HumanBody:
    """One person in a MuJoCo world: poses of the kinematic parts, both hands, and their indices in MuJoCo's arrays."""

    def __init__(
        self,
        spec: HumanSpec,
        code: int,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        is_remote: bool = False,
    ) -> None:
        """``code``: collision code, one of :data:`HUMAN_CODES`; ``is_remote``: another client moves the person and
        computes its grasps.

        Raises :class:`HumanError` for invalid numbers, :class:`vinesim.scene.appearance.AppearanceError` for an unknown
        outfit.
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
        """[part] Indices of the MuJoCo bodies of :data:`BODY_PARTS`."""
        self.part_dofs = np.zeros((0, 6), int)
        """[part, 6] MuJoCo's degrees of freedom of :data:`BODY_PARTS`."""
        self._part_q = self._hand_q = np.zeros((0, 7), int)
        self._passing = YieldingParts(len(BODY_PARTS))
        self._part_force = np.full(len(BODY_PARTS), np.inf)  # unknown before the first step
        self._pushes_too_hard = np.zeros(len(BODY_PARTS), bool)
        self._posture = PostureSolver(spec.height)
        outfit = spec.outfit or appearance.outfit_of(spec.name)
        self.looks = appearance.load_human_model(spec.height, outfit=outfit)
        """Visible shapes of the person in the colours of the outfit."""
        self._shears = appearance.load_shears()
        self.set_pose(spec.pose)
        self._last_poses = self._poses

    @property
    def part_poses(self) -> np.ndarray:
        """Poses [part, 7] of :data:`BODY_PARTS`."""
        return self._poses[: len(BODY_PARTS)]

    def controller_pose(self, hand: HandBody) -> np.ndarray:
        """Returns the pose [7] of a hand's controller."""
        return self._poses[len(BODY_PARTS) + self.hands.index(hand)]

    def controller_velocity(self, hand: HandBody, dt: float) -> np.ndarray:
        """Returns the velocity [3] m/s of a hand's controller in this step of ``dt`` [s]."""
        at = len(BODY_PARTS) + self.hands.index(hand)
        return (self._poses[at, :3] - self._last_poses[at, :3]) / dt

    def set_pose(self, pose: HumanPose) -> None:
        """Set the tracked points: the body moves there at once, the hands are pulled there by their springs.

        Raises :class:`HumanError` for numbers that are not finite or no unit quaternions.
        """
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
        """Link names of the shears in the hands."""
        return tuple(f"{hand.side}_{part}" for hand in self.hands if hand.has_shears for part in SHEARS_PARTS)

    def visual_poses(self, hands: np.ndarray) -> np.ndarray:
        """Returns the poses [part, 7] of :data:`VISUAL_PARTS`, then of :attr:`shears_parts`, for palms at ``hands`` [2,
        7]."""
        chest = self.part_poses[BODY_PARTS.index("chest")]
        head = self.part_poses[BODY_PARTS.index("head")]
        poses = [self._posture.visual_parts(chest, head, hands, self._fingers)]
        for hand, palm in zip(self.hands, hands, strict=True):
            if hand.has_shears:
                halves = self._shears.closed if hand.is_squeezed else self._shears.open
                poses.append(frames.compose(palm, halves))
        return np.concatenate(poses)

    def hand(self, side: str) -> HandBody:
        """Returns the left or the right hand; :class:`HumanError` for any other ``side``."""
        if side not in SIDES:
            raise HumanError(f"human {self.spec.name!r} has no {side!r} hand; it has: {', '.join(SIDES)}")
        return self.hands[SIDES.index(side)]

    def hand_sample(self, hand: HandBody, d: mujoco.MjData) -> HandSample:
        """Returns the state of a hand after the last step."""
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
        """Look up the indices of the person's bodies and joints in a recompiled world."""
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
        """Enable collisions of empty hands, except hands that the person's own client reports as busy."""
        for hand in self.hands:
            if hand.held is None:
                hand.set_collision(m, enabled=not hand.busy)

    # ------------------------------------------------------------------ the step

    def apply_controls(self, m: mujoco.MjModel, d: mujoco.MjData, dt: float) -> None:
        """Before a step of ``dt`` [s]: set poses and velocities of the kinematic parts, and drive both hands."""
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
        """After a step: set the kinematic parts to their prescribed poses, and store the forces of the hands."""
        self._last_poses = self._poses
        if self.is_remote:
            force = d.qfrc_constraint[self.part_dofs[:, :3]]
            self._part_force = force = np.sqrt((force * force).sum(1))
            self._pushes_too_hard = (force > 0.0) & self._passing.is_light & (force.sum() > MAX_REMOTE_FORCE)
        self._place_parts(d, self.part_poses)
        for hand in self.hands:
            hand.measure(d)

    def _has_teleported(self) -> bool:
        moved = self._poses[0, :3] - self._last_poses[0, :3]  # motion of the head
        return float(moved @ moved) > self.parameters.teleport_distance * self.parameters.teleport_distance

    def _teleport(self, d: mujoco.MjData) -> None:
        """Place the whole person at the tracked points, at rest, except hands that hold something."""
        self._last_poses = self._poses
        for hand in self.hands:
            if hand.held is None:
                hand.place(d, self.controller_pose(hand))
                hand.steps_since_contact = hand.contact_steps

    def _place_parts(self, d: mujoco.MjData, parts: np.ndarray) -> None:
        d.qpos[self._part_q[:, :3]] = parts[:, :3]
        d.qpos[self._part_q[:, 3:]] = frames.to_wxyz(parts[:, 3:])


def _add_geom(body: mujoco.MjsBody, shape: Shape, bits: tuple[int, int], friction: float, material: Material) -> None:
    """Add a collision shape to a MuJoCo ``body``; ``bits``: contype and conaffinity."""
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


# One hand of a person: a free body that a spring pulls to its controller, and a weld to the object that it holds.


class HandBody:
    """State of one hand and its indices in MuJoCo's arrays.

    A free hand follows its controller. When it touches something, a spring pulls it to its controller
    instead, until it has touched nothing for ``hand_contact_duration``. A hand that holds something does not collide.
    """

    def __init__(self, side: str, stiffness: float, max_force: float, parameters: PhysicsParameters) -> None:
        """``side``: left or right; ``stiffness`` [N/m] and ``max_force`` [N]: of the hand's spring."""
        p = self.parameters = parameters
        self.side = side
        self.stiffness = stiffness
        self.max_force = max_force
        self.damping = 2.0 * math.sqrt(stiffness * p.hand_mass)
        """[N s/m] Damping of the spring. It is critical, so that an empty hand returns without overshoot."""
        self.torsional_damping = 2.0 * math.sqrt(p.hand_torsional_stiffness * p.hand_inertia)
        """[N m s/rad] Critical damping of the torsional spring."""
        self.contact_steps = p.steps(p.hand_contact_duration)
        self.closed = False
        """Whether the hand is commanded to grasp objects near it."""
        self.has_shears = self.is_squeezed = False
        """Whether the hand is closed around shears or an object. ``has_shears``: whether the hand has shears. Both only
        affect the drawn hand.
        """
        self.busy = False
        """Whether a remote person's hand is busy: its own client reports that it pushes a robot or holds an object. A
        busy hand does not collide in this world.
        """
        self.steps_since_contact = self.contact_steps
        self.force = np.zeros(3)
        """[3] N, force of the hand on its surroundings in the last step, world axes."""
        self.held: tuple[str, str] | None = None
        """Actor and link that the hand holds."""
        self.grasp_pose = np.zeros(7)
        """[7] pose of the hand in the frame of the object that it holds."""
        self.on_plant = False
        """Whether the hand holds a plant and moves with it, see :mod:`vinesim.interaction.hand_grasp`."""
        self.collision_bits: tuple[int, int] = (0, 0)
        """MuJoCo's contype and conaffinity while the hand can touch something."""
        self.body = self.weld = -1
        self.qpos = self.dofs = slice(0)

    @property
    def link(self) -> str:
        """Name of the hand's link."""
        return f"{self.side}_hand"

    @property
    def is_on_spring(self) -> bool:
        """Whether the spring pulls the hand, because it touched something within ``hand_contact_duration``."""
        return self.steps_since_contact < self.contact_steps

    def find_indices(self, m: mujoco.MjModel, names: WorldNames, actor: str) -> None:
        """Look up the MuJoCo indices of the hand of ``actor`` in a recompiled world."""
        name = f"{actor}/{self.link}"
        joint = names.joint[name]
        self.body = names.body[name]
        self.weld = names.equality[name]
        qpos = int(m.jnt_qposadr[joint])
        dof = int(m.jnt_dofadr[joint])
        self.qpos = slice(qpos, qpos + 7)
        self.dofs = slice(dof, dof + 6)

    # ------------------------------------------------------------------ the step

    def apply_control(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        pose: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Before a step: set the spring's force, or the velocity of a free hand.

        Args:
            m: MuJoCo's model.
            d: MuJoCo's data.
            pose: [7] pose of the hand.
            error: translation [m] and rotation vector [rad] from the hand to its goal.
            motion: translation [m] and rotation vector [rad] of the controller in this step.
        """
        velocity = d.qvel[self.dofs]
        if self.on_plant:
            velocity[:] = d.xfrc_applied[self.body] = 0.0
        elif self.is_on_spring:
            self._pull(d, pose, velocity, error, motion)
        else:
            self._return(m, d, pose, velocity, error, motion)

    def _pull(
        self,
        d: mujoco.MjData,
        pose: np.ndarray,
        velocity: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Set the wrench of the spring, limited to the largest force and moment of the hand."""
        p = self.parameters
        dt = self.parameters.dt
        offset, angle = error
        step, spin = motion
        turning = frames.rotate(pose[3:], velocity[3:])
        force = self.stiffness * offset + self.damping * (step / dt - velocity[:3])
        moment = p.hand_torsional_stiffness * angle + self.torsional_damping * (spin / dt - turning)
        d.xfrc_applied[self.body, :3] = _limited(self.max_force, force)
        d.xfrc_applied[self.body, 3:] = _limited(p.hand_moment, moment)

    def _return(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        pose: np.ndarray,
        velocity: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Set the velocity of a free hand: the velocity of its controller, plus a velocity towards the controller."""
        p = self.parameters
        dt = self.parameters.dt
        offset, angle = error
        step, spin = motion
        step = step + offset * dt / max(p.hand_return_time, math.sqrt(offset @ offset) / p.hand_return_speed)
        velocity[:3] = self._clip_to_obstacle(m, d, pose[:3], step) / dt
        velocity[3:] = frames.rotate(frames.conjugate(pose[3:]), spin / dt + angle / p.hand_return_time)
        d.xfrc_applied[self.body] = 0.0

    def _clip_to_obstacle(self, m: mujoco.MjModel, d: mujoco.MjData, at: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Returns the translation ``step`` [3] m of a fast free hand at ``at`` [3] m, shortened if an obstacle is in
        its way."""
        length = float(np.linalg.norm(step))
        if length < HAND_HALF_THICKNESS or self.busy:
            return step
        way = step / length
        gone = 0.0
        geom = np.zeros(1, np.int32)
        while gone < length + HAND_HALF_THICKNESS:
            ahead = mujoco.mj_ray(m, d, at + gone * way, way, None, 1, self.body, geom)
            if ahead < 0.0 or gone + ahead > length + HAND_HALF_THICKNESS:
                return step
            if m.geom_contype[geom[0]] & self.collision_bits[1]:  # not the own body, nor visible shapes
                return way * max(gone + ahead - 0.8 * HAND_HALF_THICKNESS, 0.0)
            gone += ahead + 1e-3
        return step

    def place(self, d: mujoco.MjData, pose: np.ndarray) -> None:
        """Put the hand at ``pose`` [7], at rest."""
        d.qpos[self.qpos] = np.concatenate([pose[:3], frames.to_wxyz(pose[3:])])
        d.qvel[self.dofs] = 0.0

    def measure(self, d: mujoco.MjData) -> None:
        """After a step: store the force that the hand exerts on what it touches or holds."""
        if not self.on_plant:
            reaction = d.qfrc_constraint[self.dofs] + d.qfrc_applied[self.dofs]
            self.force = -reaction[:3]
            self.steps_since_contact = 0 if self.held is not None or reaction.any() else self.steps_since_contact + 1

    def sample(self, d: mujoco.MjData, controller: np.ndarray) -> HandSample:
        """Returns the state of the hand after the last step; ``controller`` [7] is the pose of its controller."""
        pose = np.concatenate([d.qpos[self.qpos][:3], frames.from_wxyz(d.qpos[self.qpos][3:])])
        return HandSample(pose, controller.copy(), self.force.copy(), self.steps_since_contact == 0, self.held)

    # ------------------------------------------------------------------ holding

    def weld_to(self, m: mujoco.MjModel, d: mujoco.MjData, body: int | None) -> None:
        """Weld the hand to a MuJoCo ``body`` at ``grasp_pose``; None: the hand holds a plant and moves with it."""
        self.on_plant = body is None
        self.steps_since_contact = 0
        d.eq_active[self.weld] = body is not None
        if body is not None:
            m.eq_obj2id[self.weld] = body
            m.eq_data[self.weld, :3], m.eq_data[self.weld, 3:6] = self.grasp_pose[:3], 0.0
            m.eq_data[self.weld, 6:10] = frames.to_wxyz(frames.conjugate(self.grasp_pose[3:]))
            m.eq_data[self.weld, 10] = 1.0
            wake_body(m, d, body)
        self.set_collision(m, enabled=False)

    def release(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Open the hand; it stays on its spring for ``hand_contact_duration`` and then returns to its controller."""
        self.held = None
        self.on_plant = False
        self.steps_since_contact = 0
        if d.eq_active[self.weld]:
            wake_body(m, d, m.eq_obj2id[self.weld])
        d.eq_active[self.weld] = 0
        self.set_collision(m, enabled=True)

    def set_collision(self, m: mujoco.MjModel, *, enabled: bool) -> None:
        """Enable or disable collisions of the hand."""
        geoms = slice(m.body_geomadr[self.body], m.body_geomadr[self.body] + m.body_geomnum[self.body])
        bit, meets = self.collision_bits if enabled else (0, 0)
        m.geom_contype[geoms] = m.body_contype[self.body] = bit
        m.geom_conaffinity[geoms] = m.body_conaffinity[self.body] = meets


def _limited(limit: float, vector: np.ndarray) -> np.ndarray:
    """Returns a vector [3], shortened to the length ``limit`` if it is longer."""
    length = float(np.linalg.norm(vector))
    return vector * (limit / length) if length > limit else vector


# Wrenches of a person's hands on links of robots, from contacts and from welds to held links.


def hand_wrenches(
    m: mujoco.MjModel, d: mujoco.MjData, human: HumanBody, links: Mapping[int, tuple[str, str]]
) -> tuple[dict[str, dict[str, np.ndarray]], tuple[bool, bool]]:
    """Returns a person's wrenches on robots in the last step, by robot and link, and whether each hand (left, right)
    exerted one.

    ``links``: robot and link by MuJoCo body. A wrench [6] is a force [N] and a moment about the
    link's centre of mass [N m], in world axes, at the poses at the start of the step.
    """
    wrenches: dict[str, dict[str, np.ndarray]] = {}
    applying = {hand.body: False for hand in human.hands}

    def add(hand: int, body: int, force: np.ndarray, moment: np.ndarray, at: np.ndarray) -> None:
        robot, link = links[body]
        wrench = np.concatenate([force, moment + frames.cross(at - d.xipos[body], force)])
        here = wrenches.setdefault(robot, {})
        here[link] = here.get(link, 0.0) + wrench
        applying[hand] = True

    if d.ncon:
        bodies = m.geom_bodyid[d.contact.geom]
        wrench = np.zeros(6)
        for number in np.flatnonzero(np.isin(bodies, list(applying)).any(1)).tolist():
            one, other = bodies[number].tolist()
            hand, body, sign = (one, other, 1.0) if one in applying else (other, one, -1.0)
            if body in links and d.contact.efc_address[number] >= 0:
                mujoco.mj_contactForce(m, d, number, wrench)
                axes = d.contact.frame[number].reshape(3, 3)
                add(hand, body, sign * wrench[:3] @ axes, sign * wrench[3:] @ axes, d.contact.pos[number])
    for hand in human.hands:
        if d.eq_active[hand.weld] and (body := int(m.eq_obj2id[hand.weld])) in links:
            pull = -d.qfrc_constraint[hand.dofs]
            turn = frames.from_wxyz(d.xquat[hand.body])
            add(hand.body, body, pull[:3], frames.rotate(turn, pull[3:]), d.xpos[hand.body])
    left, right = applying.values()
    return wrenches, (left, right)
