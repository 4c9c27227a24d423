"""One robot in MuJoCo's world: a planar base on servos, driven joints, sensors in links. On uneven ground the base also
follows the ground (:mod:`vinesim.rigid.ground_following`). A robot on legs has a free base instead
(:mod:`vinesim.rigid.free_base`).

MuJoCo's integrator damps a servo of stiffness K as if its damping D were larger by dt K. This keeps stiff servos and
their loads from oscillating. A compliant joint, however, must swing with exactly the damping D; for such a joint
:func:`split_damping` removes the additional damping.
"""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.rigid import joint_servos
from vinesim.rigid import ground_following, mujoco_contacts, recompile
from vinesim.rigid.free_base import FreeBase
from vinesim.rigid.ground_following import GroundFollower
from vinesim.rigid.static_world import ALL_BITS, GROUND, REMOTE_HAND, contact_friction, geom_user
from vinesim.rigid.urdf import RobotError, check, collision_materials, collision_urdf, link_friction, shapes_of_robot
from vinesim.scene.materials import Material
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.terrain import Terrain
from vinesim.scene.triangles import to_stl
from vinesim.scene.values import RobotSpec, Shape
from vinesim.scene.values.signals import UNLIT, Color

MIN_FRICTION = 1e-5
"""Smallest friction coefficient of a link, which is the smallest that MuJoCo accepts."""
MAX_FRICTION = 10.0
"""Largest friction coefficient of a link, which practically prevents slip; URDF files contain values up to 1e14."""
MAX_HULL_VERTICES = 64
"""Largest number of vertices of a mesh's convex hull, which bounds the cost of contacts. TUNED."""
CONTACT_IMPEDANCE = (0.95, 0.99)
"""Smallest and largest impedance of a link's contacts (MuJoCo's ``solimp``). TUNED: with MuJoCo's 0.9 and 0.95 an arm
that pushes against its own torso at full effort penetrates by 3 mm, with these by less than 1 mm."""
COPY_EFFORT_SHARE = 0.999
"""Largest effort of a servo in the local copy of a remote robot, as a fraction of the servo's effort limit."""
_PLANAR = ("x", "y", "yaw")


class RobotBody:
    """One robot: targets and gains of its drives, and its indices in MuJoCo's arrays."""

    def __init__(
        self,
        spec: RobotSpec,
        code: int,
        parameters: PhysicsParameters = PhysicsParameters(),
        terrain: Terrain | None = None,
    ) -> None:
        """``code``: collision code, one of :data:`ROBOT_CODES`; ``terrain``: the uneven ground that the base follows.
        Raises :class:`RobotError` if MuJoCo cannot read the URDF."""
        check(spec)
        joints = len(spec.drives)
        pose = np.asarray(spec.pose, float)
        self.spec = spec
        self.code = code
        self.parameters = parameters
        try:
            self._parsed = _parse(spec, code, parameters.friction, 0.0 if terrain is not None else float(pose[2]))
            footprint = None if terrain is None else ground_following.footprint(self._parsed)
        except ValueError as error:
            raise build_error(spec, error) from error
        self.shapes = shapes_of_robot(spec)
        """Visible shapes by link while the indicator lights are off."""
        self._shown_shapes: dict[Color | None, dict[str, tuple[Shape, ...]]] = {None: self.shapes}
        self.indicator_color: Color | None = None
        self.stiffness = np.array([d.stiffness for d in spec.drives], float)
        self.damping = np.array([d.damping for d in spec.drives], float)
        self.servo_limit = np.array([d.effort for d in spec.drives], float)
        """[joint] N m or N, effort limit of the servos, at most ``effort_limit``."""
        self.effort_limit = self.servo_limit.copy()
        """[joint] N m or N, effort limit of the drives for servo and gravity compensation together."""
        self.target = np.array(spec.home, float)
        """[joint] rad or m, target position of the servos."""
        self.target_velocity = np.zeros(joints)
        self.feedforward = np.zeros(joints)
        """[joint] N m or N, effort that is added to the effort of the servos."""
        self.control = np.zeros(joints)
        """[joint] N m or N, MuJoCo's control in the last step; the servo's effort is the control minus K q minus D v.
        """
        self.base_target = np.array([pose[0], pose[1], frames.to_yaw(pose[3:])])
        """[3] x, y, yaw (m, m, rad), target of the base's servos; it moves with ``base_velocity``."""
        self.base_height = float(pose[2])
        """[m] Height z of the base, which moves in a horizontal plane."""
        self.base_velocity = np.zeros(3)
        """[3] vx, vy, wz (m/s, m/s, rad/s), commanded velocity in the base's own axes."""
        is_driven = not spec.has_free_base
        self.follower = (
            GroundFollower(terrain, footprint) if is_driven and terrain is not None and footprint is not None else None
        )
        """Lets a driven base follow uneven ground; None: the base moves in a plane at constant height, or freely."""
        self.start_pose = pose
        """[7] Pose of the base at the start. On uneven ground a free base stands as steep as the ground."""
        if spec.has_free_base and not spec.is_copy and terrain is not None and footprint is not None:
            self.start_pose = terrain.resting_pose(pose[0], pose[1], frames.to_yaw(pose[3:]), footprint)
        self._level_velocity = self.base_velocity if self.follower is None else np.zeros(3)
        """[3] The commanded velocity seen from above, in axes with the base's yaw."""
        self.base_gains = _base_gains(spec, parameters)
        """Stiffness and damping [3] of the base's servos along x, y and about z."""
        self.free_base: FreeBase | None = None
        """The base of a robot that stands on its legs; None: the base is driven."""
        if spec.has_free_base:
            linear_and_angular = np.repeat([0, 2], 3)
            stiffness, damping = (gains[linear_and_angular] for gains in self.base_gains)
            self.free_base = FreeBase(stiffness, damping, np.repeat(spec.base_effort, 3))
        self._base_slip = np.array([parameters.base_slip])
        self.has_exact_damping = np.zeros(joints, bool)
        """[joint] bool, whether the joint is damped by exactly the set damping; see :func:`split_damping`."""
        self.damping_at_start = np.zeros(joints)
        """[joint] N m s/rad, part of the damping that acts on the velocity at the start of the step."""
        self.damping_at_end = np.zeros(joints)
        """[joint] N m s/rad, part of the damping that acts on the velocity at the end of the step."""
        self.q = self.v = self.actuator = np.zeros(0, int)
        """[joint] Indices of the drives in MuJoCo's qpos, qvel and ctrl."""
        self.inertia_index = np.zeros(0, int)
        """[joint] Index of the drive's own inertia in MuJoCo's sparse mass matrix."""
        self.base_q = self.base_v = self.base_actuator = np.zeros(0, int)
        """[3] Indices of a driven base's x, y and yaw in MuJoCo's qpos, qvel and ctrl."""
        self.bodies: dict[str, int] = {}
        self.sensor_links: list[str] = []
        """Links with a sensor, see :meth:`RigidWorld.add_link_sensor`."""
        self._controls_of: mujoco.MjData | None = None
        self.remote_wrenches: dict[str, np.ndarray] = {}
        """Wrenches [6] that remote people exert on the robot, by name of the link; see
        :meth:`RigidWorld.set_remote_wrenches`.
        """

    @property
    def base_slip(self) -> float:
        """Largest distance [m or rad] between the base and its target, at which the base's servos have full effort."""
        return float(self._base_slip[0])

    @base_slip.setter
    def base_slip(self, slip: float) -> None:
        self._base_slip[0] = slip

    @property
    def shown_shapes(self) -> dict[str, tuple[Shape, ...]]:
        """Returns the visible shapes by link with indicator lights in their present colour; equal colours return the
        same objects."""
        color = self.indicator_color
        if color not in self._shown_shapes:
            kept = {None: self.shapes, UNLIT: self._shown_shapes.get(UNLIT, _with_lamps(self.shapes, UNLIT))}
            self._shown_shapes = kept if color == UNLIT else kept | {color: _with_lamps(self.shapes, color)}
        return self._shown_shapes[color]

    # ------------------------------------------------------------------ in MuJoCo

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the robot to a world, on its base and with its servos."""
        given = self.spec
        base = self._add_driven_base(spec) if self.free_base is None else self.free_base.add_to(spec, given.name)
        spec.copy_during_attach = True
        spec.attach(self._parsed, prefix=f"{given.name}/", frame=base.add_frame())
        for drive, stiffness, damping in zip(given.drives, self.stiffness, self.damping, strict=True):
            _add_servo(spec, f"{given.name}/{drive.joint}", stiffness, damping, drive.effort)
        if self.free_base is None:
            self._add_base_servos(spec)

    def _add_driven_base(self, spec: mujoco.MjSpec) -> mujoco.MjsBody:
        """Add the body of a driven base, with its joints, and return it."""
        given = self.spec
        name = given.name
        height = float(given.pose[2]) if self.follower is None else 0.0
        base = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, height])
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        axes = zip(_PLANAR, (slide, slide, hinge), np.eye(3), strict=True)
        for axis, kind, direction in axes:
            if kind == hinge and self.follower is not None:
                base.add_joint(name=f"{name}:z", type=slide, axis=[0.0, 0.0, 1.0])
            base.add_joint(name=f"{name}:{axis}", type=kind, axis=direction)
        if self.follower is not None:
            base.add_joint(name=f"{name}:pitch", type=hinge, axis=[0.0, 1.0, 0.0])
            base.add_joint(name=f"{name}:roll", type=hinge, axis=[1.0, 0.0, 0.0])
        return base

    def _add_base_servos(self, spec: mujoco.MjSpec) -> None:
        name = self.spec.name
        stiffness, damping = self.base_gains
        for i, axis in enumerate(_PLANAR):
            _add_servo(spec, f"{name}:{axis}", stiffness[i], damping[i], self.spec.base_effort[i // 2])
        if self.follower is not None:
            for axis in ground_following.AXES:  # GroundFollower.find_indices() sets the gains
                _add_servo(spec, f"{name}:{axis}", 0.0, 0.0, ground_following.MAX_EFFORT)

    def find_indices(self, m: mujoco.MjModel, names: recompile.WorldNames) -> None:
        """Look up the MuJoCo indices of the robot's bodies and joints in a recompiled world."""
        name = self.spec.name
        driven = [f"{name}/{drive.joint}" for drive in self.spec.drives]
        planar = [] if self.free_base is not None else [f"{name}:{axis}" for axis in _PLANAR]
        joints, base = ([names.joint[joint] for joint in some] for some in (driven, planar))
        self.q = m.jnt_qposadr[joints].astype(int)
        self.v = m.jnt_dofadr[joints].astype(int)
        self.inertia_index = (m.M_rowadr + m.M_rownnz - 1)[self.v]
        self.actuator = np.array([names.actuator[joint] for joint in driven], int)
        self.base_q = m.jnt_qposadr[base].astype(int)
        self.base_v = m.jnt_dofadr[base].astype(int)
        self.base_actuator = np.array([names.actuator[joint] for joint in planar], int)
        mine = name + "/"
        self.bodies = {n.removeprefix(mine): i for i, n in enumerate(names.bodies) if n.startswith(mine)}
        if self.free_base is not None:
            self.free_base.find_indices(m, names, name)
        if self.follower is not None:
            self.follower.find_indices(m, names, name, self.base_actuator[:2], self.spec.base_effort[0])
        self._set_gains(m)
        self._controls_of = None

    def place(self, m: mujoco.MjModel, d: mujoco.MjData, pose: np.ndarray, position: np.ndarray) -> None:
        """Put the robot at base ``pose`` [7] and ``position`` [joint], at rest, and make these its targets."""
        self.target[:] = d.qpos[self.q] = position
        self.base_target[:] = pose[0], pose[1], frames.to_yaw(pose[3:])
        d.qvel[self.v] = 0.0
        if self.free_base is not None:
            self.free_base.place(d, np.asarray(pose, float))
        else:
            d.qpos[self.base_q] = self.base_target
            d.qvel[self.base_v] = 0.0
        if self.follower is not None:
            self.follower.place(d, self.base_target)
        self.target_velocity[:] = self.base_velocity[:] = 0.0
        self.control[:] = self.stiffness * self.target + self.feedforward
        for joint, (source, coefficients) in self._mimics(m).items():
            polynomial = np.polynomial.Polynomial(coefficients)
            d.joint(joint).qpos[0] = polynomial(d.joint(source).qpos[0])

    def apply_controls(self, d: mujoco.MjData, dt: float) -> None:
        """Before a step of ``dt`` [s]: compute MuJoCo's controls from the targets."""
        if self._controls_of is not d:
            self._bind_controls(d, dt)
        if self.follower is not None:
            self._level_velocity[:] = self.follower.level_velocity(d, self.base_velocity)
            self.follower.apply_controls(d, d.qpos[self.base_q], d.qvel[self.base_v], dt)
        self._apply_controls()

    def _bind_controls(self, d: mujoco.MjData, dt: float) -> None:
        """Capture the kernel that writes MuJoCo's controls on the arrays of ``d``, which replaces twenty NumPy
        calls."""
        self._controls_of = d
        (stiffness, damping) = self.base_gains
        drives = SharedArrays(
            joint_servos.JointDrives,
            stiffness=self.stiffness,
            damping_at_start=self.damping_at_start,
            damping_at_end=self.damping_at_end,
            target=self.target,
            target_velocity=self.target_velocity,
            feedforward=self.feedforward,
            v=self.v,
            actuator=self.actuator,
        )
        base = SharedArrays(
            joint_servos.BaseDrive,
            stiffness=stiffness,
            damping=damping,
            velocity=self._level_velocity,
            slip=self._base_slip,
            q=self.base_q,
            actuator=self.base_actuator,
        )
        apply = KernelLaunch(
            joint_servos.apply_controls,
            [dt, drives.struct, base.struct, share(d.qpos, wp.float64), share(d.qvel, wp.float64)],
            [share(values, wp.float64) for values in (self.control, self.base_target, d.ctrl)],
            threads=1,
        )
        self._apply_controls = KernelGraph(apply)

    def transmitted_effort(self, d: mujoco.MjData) -> np.ndarray:
        """Returns the effort [joint] N m or N of the drives in the last step: servo plus gravity compensation."""
        # the servos are implicit: their force over the step is the force at the end of the step
        servo = self.control - self.stiffness * d.qpos[self.q] - self.damping_at_end * d.qvel[self.v]
        servo = np.minimum(np.maximum(servo, -self.servo_limit), self.servo_limit)  # three times as fast as np.clip
        return np.minimum(np.maximum(servo + d.qfrc_gravcomp[self.v], -self.effort_limit), self.effort_limit)

    def take_over(self, other: RobotBody) -> None:
        """Copy targets, gains, limits and sensors from ``other``, the same robot with other shapes."""
        for name in (
            "stiffness",
            "damping",
            "servo_limit",
            "target",
            "target_velocity",
            "feedforward",
            "control",
            "base_target",
            "base_velocity",
            "has_exact_damping",
        ):
            getattr(self, name)[:] = getattr(other, name)
        self.base_slip = other.base_slip
        self.base_height = other.base_height
        if self.free_base is not None and other.free_base is not None:
            self.free_base.take_over(other.free_base)
        self.indicator_color = other.indicator_color
        self.sensor_links = other.sensor_links
        self.remote_wrenches = other.remote_wrenches

    def base_state(self, d: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose [7] and the velocity [6] (world axes) of the base link."""
        if self.free_base is not None:
            return self.free_base.state(d)
        x, y, yaw = d.qpos[self.base_q].tolist()
        vx, vy, wz = d.qvel[self.base_v].tolist()
        if self.follower is not None:
            return self.follower.base_state(d, (x, y, yaw), (vx, vy, wz))
        half = 0.5 * yaw
        pose = np.array([x, y, self.base_height, 0.0, 0.0, math.sin(half), math.cos(half)])
        return pose, np.array([vx, vy, 0.0, 0.0, 0.0, wz])

    # ------------------------------------------------------------------ commands

    def command(self, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Set the targets of the servos: ``position`` [joint] and ``velocity`` [joint] (zero unless given)."""
        self.target[:] = position
        self.target_velocity[:] = 0.0 if velocity is None else velocity

    def follow_remote(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        base_q: np.ndarray,
        base_qd: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
    ) -> None:
        """Let the servos pull the copy of a remote robot to the state that its client has sent; see
        :meth:`RigidWorld.follow_remote`.
        """
        self.command(position, velocity)
        # MuJoCo treats a servo that is at its effort limit at the start of the step as explicit; a light joint that
        # catches up would then overshoot its target
        servo = self.servo_limit
        most = self.effort_limit
        weight = d.qfrc_gravcomp[self.v]
        low = np.maximum(-servo, -most - weight)
        high = np.minimum(servo, most - weight)
        pull = self.stiffness * (self.target - d.qpos[self.q]) + self.damping * (self.target_velocity - d.qvel[self.v])
        excess = pull - np.clip(pull, COPY_EFFORT_SHARE * low, COPY_EFFORT_SHARE * high)
        self.target -= excess / np.where(self.stiffness > 0.0, self.stiffness, np.inf)
        if self.free_base is not None:
            self.free_base.follow(m, base_q, base_qd)
            return
        yaw = frames.to_yaw(base_q[3:])
        turns = np.round((d.qpos[self.base_q[2]] - yaw) / (2.0 * np.pi))
        self.base_target[:] = base_q[0], base_q[1], yaw + 2.0 * np.pi * turns
        if self.follower is None:
            c = np.cos(yaw)
            s = np.sin(yaw)
            self.base_velocity[:] = c * base_qd[0] + s * base_qd[1], c * base_qd[1] - s * base_qd[0], base_qd[5]
        else:
            back = frames.conjugate(base_q[3:])
            ahead, left, _ = frames.rotate(back, base_qd[:3])
            self.base_velocity[:] = ahead, left, frames.rotate(back, base_qd[3:])[2]
        self.base_slip = self.parameters.remote_base_slip

    def set_gains(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        gains: tuple[np.ndarray, np.ndarray, np.ndarray],
        limit: np.ndarray | None,
        exact: np.ndarray | None,
    ) -> None:
        """Set ``gains`` (stiffness, damping, feedforward) of the servos; see :meth:`RigidWorld.set_gains`.

        :meth:`transmitted_effort` of the last step does not change.
        """
        before = self.stiffness.copy()
        self.stiffness[:], self.damping[:], self.feedforward[:] = gains
        if limit is not None:
            self.servo_limit[:] = np.minimum(limit, self.effort_limit)
        if exact is not None:
            self.has_exact_damping[:] = exact
        q = d.qpos[self.q]
        v = d.qvel[self.v]
        given = self.control - before * q - self.damping_at_end * v
        self._set_gains(m)
        self.control[:] = given + self.stiffness * q + self.damping_at_end * v

    def set_remote_wrenches(self, d: mujoco.MjData, wrenches: dict[str, np.ndarray]) -> None:
        """Set the wrenches [6] (force [N], moment [N m]) that remote people exert on the robot, by name of the link.
        Raises :class:`RobotError` if a link does not exist.
        """
        if unknown := sorted(wrenches.keys() - self.bodies.keys()):
            raise RobotError(f"robot {self.spec.name!r} is pushed at {unknown[0]!r}, which is not one of its links")
        for link in self.remote_wrenches.keys() - wrenches.keys():
            d.xfrc_applied[self.bodies[link]] = 0.0
        for link, wrench in wrenches.items():
            d.xfrc_applied[self.bodies[link]] = wrench
        self.remote_wrenches = wrenches

    def remote_effort(self, m: mujoco.MjModel, d: mujoco.MjData) -> np.ndarray:
        """Returns the generalised force [dof] N or N m of the wrenches that remote people exert on the robot."""
        total = np.zeros(m.nv)
        for link, wrench in self.remote_wrenches.items():
            body = self.bodies[link]
            mujoco.mj_applyFT(m, d, wrench[:3], wrench[3:], d.xipos[body], body, total)
        return total

    # ------------------------------------------------------------------ inside

    def _set_gains(self, m: mujoco.MjModel) -> None:
        """Write the servos' gains and effort limits into MuJoCo's model."""
        dt = m.opt.timestep
        at_end, at_start = split_damping(
            self.stiffness, self.damping, m.dof_damping[self.v], m.dof_armature[self.v], dt
        )
        self.damping_at_end[:] = np.where(self.has_exact_damping, at_end, self.damping)
        self.damping_at_start[:] = np.where(self.has_exact_damping, at_start, 0.0)
        m.actuator_biasprm[self.actuator, 1] = -self.stiffness
        m.actuator_biasprm[self.actuator, 2] = -self.damping_at_end
        m.actuator_forcerange[self.actuator, 0] = -self.servo_limit
        m.actuator_forcerange[self.actuator, 1] = self.servo_limit

    def _mimics(self, m: mujoco.MjModel) -> dict[str, tuple[str, np.ndarray]]:
        """Returns the robot's mimic joints by name, each with the name of its source joint and MuJoCo's polynomial
        [5]."""
        joints = {}
        for e in np.flatnonzero(m.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)):
            joint = m.joint(m.eq_obj1id[e]).name
            source = m.joint(m.eq_obj2id[e]).name
            if joint.startswith(self.spec.name + "/"):
                joints[joint] = (source, m.eq_data[e, :5].copy())
        return joints


def _parse(given: RobotSpec, code: int, friction: float, clearance: float) -> mujoco.MjSpec:
    """Returns a robot parsed from its URDF, without base and servos; its shapes have the collision ``code``.
    ``clearance``: height of the base above the ground [m]."""
    text = collision_urdf(given.urdf, frozenset(drive.joint for drive in given.drives))
    child = mujoco.MjSpec.from_string(text, assets={name: to_stl(corners) for name, corners in given.meshes.items()})
    own_friction = link_friction(given.urdf)
    materials = {link: iter(found) for link, found in collision_materials(given.urdf).items()}
    for geom in child.geoms:
        geom.contype = code
        geom.conaffinity = ALL_BITS & ~code & ~GROUND & ~REMOTE_HAND
        own = own_friction.get(geom.parent.name)
        geom.friction = contact_friction(friction if own is None else min(max(own, MIN_FRICTION), MAX_FRICTION))
        material = next(materials.get(geom.parent.name, iter(())), Material.UNKNOWN)
        geom.userdata = geom_user(material, has_own_friction=own is not None)
        geom.priority = int(own is not None)  # otherwise MuJoCo uses the larger coefficient of the two geoms
        geom.solimp[:2] = CONTACT_IMPEDANCE
    for mesh in child.meshes:  # the URDF gives the inertia of bodies; thin or open meshes have no volume
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        mesh.maxhullvert = MAX_HULL_VERTICES
    for body in child.bodies[1:]:
        body.gravcomp = 1.0
    driven = {drive.joint: drive for drive in given.drives}
    for joint in child.joints:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if joint.name in driven:
            joint.actgravcomp = True
            joint.armature = driven[joint.name].armature
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.actfrcrange = [-driven[joint.name].effort, driven[joint.name].effort]
    if not given.is_copy:
        mujoco_contacts.let_links_collide(child, given, code, clearance)
    return child


def lowest_point(spec: RobotSpec) -> float | None:
    """Returns the height [m] of the lowest point of a robot at home, above the origin of its root link; None if nothing
    of it collides. Raises :class:`RobotError` if MuJoCo cannot read the URDF."""
    check(spec)
    alone = dataclasses.replace(spec, is_copy=True)
    try:
        return mujoco_contacts.lowest_point(_parse(alone, 1, PhysicsParameters().friction, 0.0), alone)
    except ValueError as error:
        raise build_error(spec, error) from error


def _base_gains(spec: RobotSpec, parameters: PhysicsParameters) -> tuple[np.ndarray, np.ndarray]:
    """Returns the stiffness and damping [3] of the base's servos along x, y and about z."""
    force, moment = spec.base_effort
    stiffness = np.array([force, force, moment]) / parameters.base_slip
    return stiffness, parameters.base_damping_time * stiffness


def _add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, effort: float) -> None:
    """Add a servo to ``joint`` with effort = control - stiffness q - damping v, limited to ``effort`` [N m or N].

    The control is stiffness times target position plus damping times target velocity.
    """
    bias = np.zeros(10)
    bias[1:3] = -stiffness, -damping
    gain = np.zeros(10)
    gain[0] = 1.0
    spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=gain,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=bias,
        forcelimited=True,
        forcerange=[-effort, effort],
        ctrllimited=False,
    )


def split_damping(
    stiffness: np.ndarray, damping: np.ndarray, friction: np.ndarray, armature: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Split a servo's damping into parts [joint] for the end and the start of the step, so that its decay is exact.

    MuJoCo evaluates the spring at the end of the step, at q + dt v, which damps as if D were larger by dt K. So dt K is
    subtracted from the part at the end, which makes this share of the spring explicit. Half of the damping (including
    ``friction`` of the joint) acts on the velocity at the start. This is the trapezoidal rule, whose decay is exact to
    third order in dt D / M.

    The scheme is not stable for every inertia M. With A and B the parts at the end (before dt K is subtracted) and at
    the start, stability needs A - B >= dt K / 2 - 2 M / dt, where M is at least ``armature``. So B is reduced, and if
    that is not enough A is increased: a joint that is too stiff for the step has more damping than requested.
    """
    asked = damping + friction
    needed = np.maximum(0.0, 0.5 * dt * stiffness - 2.0 * armature / dt)
    late = np.clip(0.5 * (asked - needed), 0.0, 0.5 * armature / dt)
    return np.maximum(asked, needed) - late - friction - dt * stiffness, late


def build_error(spec: RobotSpec, error: ValueError) -> RobotError:
    """Returns a :class:`RobotError` with MuJoCo's error about a robot, in one line."""
    return RobotError(f"robot {spec.name!r}: MuJoCo cannot build it from its URDF: {' '.join(str(error).split())}")


def _with_lamps(shapes: dict[str, tuple[Shape, ...]], color: Color | None) -> dict[str, tuple[Shape, ...]]:
    """Returns the shapes by link with all indicator lights in ``color``; they emit light unless it is :data:`UNLIT`.

    For links without indicator lights the tuples are the same objects.
    """
    if color is None:
        return shapes
    red, green, blue = (part / 255.0 for part in color)
    surface = "plastic" if color == UNLIT else "lamp"

    def lit(pieces: tuple[Shape, ...]) -> tuple[Shape, ...]:
        if not any(piece.is_indicator for piece in pieces):
            return pieces
        return tuple(
            dataclasses.replace(piece, rgba=(red, green, blue, 1.0), surface=surface) if piece.is_indicator else piece
            for piece in pieces
        )

    return {link: lit(pieces) for link, pieces in shapes.items()}
