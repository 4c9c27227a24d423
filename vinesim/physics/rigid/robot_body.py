"""Robots in the rigid world: a base that tracks hold, joints that servos pull, links that may feel.

MuJoCo's integrator damps a servo as if its D were larger by dt K, which keeps stiff servos and what they hold quiet. A
compliant joint must swing as it was told to instead: for these :func:`split` takes the surplus back.
"""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.rigid import recompile
from vinesim.physics.rigid.static_world import ALL_BITS, GROUND, REMOTE_HAND, ROUGH
from vinesim.physics.rigid.urdf import RobotError, check, shapes_of, touchable
from vinesim.scene.values import RobotSpec

GIVE = 0.01
"""The tracks hold the base like a spring that reaches its full effort at this offset [m or rad], then they slip."""
FOLLOW_GIVE = 0.05
"""The same for the copy of a remote robot: how far ahead of the copy the pull starts [m or rad]."""
TRACK_TIME = 0.05
"""Ratio of the base servo's damping to its stiffness [s]."""

_PLANAR = ("x", "y", "yaw")


@dataclasses.dataclass
class LinkSensor:
    """What a link felt in a tick, as MuJoCo tells it, with its places at the start of that tick."""

    inner: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    """Moment about the robot's centre of mass and force of the parent on the link, world axes."""
    arm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    """From the link's origin to that centre."""
    turn: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    acceleration: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))

    @property
    def wrench(self) -> np.ndarray:
        """Force [N] and moment about the link's origin [N m] of the link on its parent [6], in the link's axes."""
        (x, y, z), (u, v, w) = self.arm.tolist(), self.inner[3:].tolist()
        moment = self.inner[:3] + np.array([y * w - z * v, z * u - x * w, x * v - y * u])
        return -np.concatenate([self.inner[3:] @ self.turn, moment @ self.turn])

    def feel(self, m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
        """Keep what MuJoCo's ``body`` felt in the tick that ends, while its places are still those of its start."""
        self.inner[:] = d.cfrc_int[body]
        np.subtract(d.subtree_com[m.body_rootid[body]], d.xpos[body], out=self.arm)
        self.turn[:] = d.xmat[body].reshape(3, 3)
        mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, self.acceleration, 1)


class RobotBody:
    """One robot: what it was asked for, and where its numbers lie in MuJoCo's arrays."""

    def __init__(self, spec: RobotSpec, bit: int) -> None:
        check(spec)
        joints, pose = len(spec.drives), np.asarray(spec.pose, float)
        self.spec, self.bit = spec, bit
        try:
            self._parsed = _parsed(spec, 1 << bit)
        except ValueError as error:
            raise build_error(spec, error) from error
        self.shapes = shapes_of(spec.urdf)
        self.stiffness = np.array([d.stiffness for d in spec.drives], float)
        self.damping = np.array([d.damping for d in spec.drives], float)
        self.effort = np.array([d.effort for d in spec.drives], float)
        """[joint] limit of the servos, at most ``most``."""
        self.most = self.effort.copy()
        """[joint] limit of the drives: servo and weight together."""
        self.target = np.array(spec.home, float)
        """[joint] position the drives pull to."""
        self.target_velocity = np.zeros(joints)
        self.forward = np.zeros(joints)
        """[joint] effort beside that of the springs [N m or N]."""
        self.control = np.zeros(joints)
        """[joint] what MuJoCo was asked for in the last tick; less K q and D v it is what the servo gave."""
        self.base_target = np.array([pose[0], pose[1], frames.to_yaw(pose[3:])])
        """[3] x, y, yaw where the tracks hold; moves with ``base_velocity``."""
        self.base_velocity = np.zeros(3)
        """[3] vx, vy, wz in the base's own axes."""
        self.tracks = _tracks(spec)
        """Stiffness and damping [3] of the base's servos along x, y and about z."""
        self.give = GIVE
        self.exact = np.zeros(joints, bool)
        """[joint] bool: the scheme must not add to its damping."""
        self.late = np.zeros(0)
        """[joint] the part of the damping that acts on the velocity at the start of the tick."""
        self.soon = np.zeros(0)
        """[joint] the part that MuJoCo applies to the velocity at its end, beside the spring at its end."""
        self.q = self.v = self.actuator = np.zeros(0, int)
        self.diagonal = np.zeros(0, int)
        """Where the drives' own inertias lie in MuJoCo's sparse mass matrix."""
        self.base_q = self.base_v = self.base_actuator = np.zeros(0, int)
        self.bodies: dict[str, int] = {}
        self.link_sensors: dict[str, LinkSensor] = {}
        """What links with sensors felt in the last tick."""
        self.remote_wrenches: dict[str, np.ndarray] = {}
        """Wrenches [6] on links by people whom other clients move: see :meth:`Rigid.bear`."""

    # ------------------------------------------------------------------ in MuJoCo

    def attach(self, spec: mujoco.MjSpec) -> None:
        """Set the robot on a planar base and give it its servos."""
        given, name = self.spec, self.spec.name
        base = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, float(given.pose[2])])
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        axes = zip(_PLANAR, (slide, slide, hinge), np.eye(3), strict=True)
        for axis, kind, direction in axes:
            base.add_joint(name=f"{name}:{axis}", type=kind, axis=direction)
        spec.copy_during_attach = True
        spec.attach(self._parsed, prefix=f"{name}/", frame=base.add_frame())
        for drive, stiffness, damping in zip(given.drives, self.stiffness, self.damping, strict=True):
            _add_servo(spec, f"{name}/{drive.joint}", stiffness, damping, drive.effort)
        stiffness, damping = self.tracks
        for i, axis in enumerate(_PLANAR):
            _add_servo(spec, f"{name}:{axis}", stiffness[i], damping[i], given.base_effort[i // 2])

    def locate(self, m: mujoco.MjModel) -> None:
        """Find the robot's numbers in a world that was compiled anew."""
        name = self.spec.name
        joints = [m.joint(f"{name}/{drive.joint}") for drive in self.spec.drives]
        planar = [m.joint(f"{name}:{axis}") for axis in _PLANAR]
        self.q = np.array([j.qposadr[0] for j in joints], int)
        self.v = np.array([j.dofadr[0] for j in joints], int)
        self.diagonal = (m.M_rowadr + m.M_rownnz - 1)[self.v]
        self.actuator = np.array([m.actuator(f"{name}/{drive.joint}").id for drive in self.spec.drives], int)
        self.base_q = np.array([j.qposadr[0] for j in planar], int)
        self.base_v = np.array([j.dofadr[0] for j in planar], int)
        self.base_actuator = np.array([m.actuator(f"{name}:{axis}").id for axis in _PLANAR], int)
        names = recompile.object_names(m, m.name_bodyadr)
        self.bodies = {n.removeprefix(name + "/"): i for i, n in enumerate(names) if n.startswith(name + "/")}
        self._set_gains(m)

    def place(self, m: mujoco.MjModel, d: mujoco.MjData, pose: np.ndarray, position: np.ndarray) -> None:
        """Be somewhere, at rest and asking for nothing else: base ``pose`` [7], ``position`` [joint]."""
        self.target[:] = d.qpos[self.q] = position
        self.base_target[:] = d.qpos[self.base_q] = pose[0], pose[1], frames.to_yaw(pose[3:])
        d.qvel[self.v] = d.qvel[self.base_v] = 0.0
        self.target_velocity[:] = self.base_velocity[:] = 0.0
        self.control[:] = self.stiffness * self.target + self.forward
        for joint, (source, coefficients) in self._mimics(m).items():
            polynomial = np.polynomial.Polynomial(coefficients)
            d.joint(joint).qpos[0] = polynomial(d.joint(source).qpos[0])

    def drive(self, d: mujoco.MjData, dt: float) -> None:
        """Before a tick: turn the targets into MuJoCo's controls."""
        pull = self.stiffness * self.target + (self.soon + self.late) * self.target_velocity
        self.control[:] = pull - self.late * d.qvel[self.v] + self.forward
        d.ctrl[self.actuator] = self.control
        q = d.qpos[self.base_q]
        c, s = math.cos(q[2]), math.sin(q[2])
        vx, vy, wz = self.base_velocity.tolist()
        velocity = np.array([c * vx - s * vy, s * vx + c * vy, wz])
        # held back too far, the tracks slip: the place they hold comes along
        held = np.minimum(self.base_target + dt * velocity, q + self.give)
        np.maximum(held, q - self.give, out=self.base_target)
        stiffness, damping = self.tracks
        d.ctrl[self.base_actuator] = stiffness * self.base_target + damping * velocity

    def effort_given(self, d: mujoco.MjData) -> np.ndarray:
        """[joint] what the drives transmitted in the last tick: servo and their share of gravity compensation."""
        # implicit servos: over the tick they gave the force of its end, not that of its start
        servo = self.control - self.stiffness * d.qpos[self.q] - self.soon * d.qvel[self.v]
        servo = np.clip(servo, -self.effort, self.effort)
        return np.clip(servo + d.qfrc_gravcomp[self.v], -self.most, self.most)

    # ------------------------------------------------------------------ what it is asked to do

    def command(self, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Pull the joints to ``position`` [joint] moving with ``velocity`` [joint] (standing, unless given)."""
        self.target[:] = position
        self.target_velocity[:] = 0.0 if velocity is None else velocity

    def follow(self, d: mujoco.MjData, base_q: np.ndarray, base_qd: np.ndarray) -> None:
        """Pull the base to where the original's is: ``base_q`` [7], ``base_qd`` [6] world axes."""
        yaw = frames.to_yaw(base_q[3:])
        turns = np.round((d.qpos[self.base_q[2]] - yaw) / (2.0 * np.pi))
        self.base_target[:] = base_q[0], base_q[1], yaw + 2.0 * np.pi * turns
        c, s = np.cos(yaw), np.sin(yaw)
        self.base_velocity[:] = c * base_qd[0] + s * base_qd[1], c * base_qd[1] - s * base_qd[0], base_qd[5]
        self.give = FOLLOW_GIVE

    def set_gains(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        gains: tuple[np.ndarray, np.ndarray, np.ndarray],
        limit: np.ndarray | None,
        exact: np.ndarray | None,
    ) -> None:
        """Take other ``gains``: stiffness, damping and an effort beside; what was given in the last tick stays so."""
        before = self.stiffness.copy()
        self.stiffness[:], self.damping[:], self.forward[:] = gains
        if limit is not None:
            self.effort[:] = np.minimum(limit, self.most)
        if exact is not None:
            self.exact[:] = exact
        q, v = d.qpos[self.q], d.qvel[self.v]
        given = self.control - before * q - self.soon * v
        self._set_gains(m)
        self.control[:] = given + self.stiffness * q + self.soon * v

    def set_remote_wrenches(self, d: mujoco.MjData, wrenches: dict[str, np.ndarray]) -> None:
        """Feel other ``wrenches`` from afar than before; :class:`RobotError` if there is no such link."""
        if unknown := sorted(wrenches.keys() - self.bodies.keys()):
            raise RobotError(f"robot {self.spec.name!r} is pushed at {unknown[0]!r}, a link that it has not")
        for link in self.remote_wrenches.keys() - wrenches.keys():
            d.xfrc_applied[self.bodies[link]] = 0.0
        for link, wrench in wrenches.items():
            d.xfrc_applied[self.bodies[link]] = wrench
        self.remote_wrenches = wrenches

    def effort_from_afar(self, m: mujoco.MjModel, d: mujoco.MjData) -> np.ndarray:
        """[dof] generalised force of the wrenches from afar."""
        total = np.zeros(m.nv)
        for link, wrench in self.remote_wrenches.items():
            body = self.bodies[link]
            mujoco.mj_applyFT(m, d, wrench[:3], wrench[3:], d.xipos[body], body, total)
        return total

    # ------------------------------------------------------------------ inside

    def _set_gains(self, m: mujoco.MjModel) -> None:
        """Turn gains and limits into MuJoCo's constants."""
        dt = m.opt.timestep
        soon, late = split_damping(self.stiffness, self.damping, m.dof_damping[self.v], m.dof_armature[self.v], dt)
        self.soon = np.where(self.exact, soon, self.damping)
        self.late = np.where(self.exact, late, 0.0)
        m.actuator_biasprm[self.actuator, 1] = -self.stiffness
        m.actuator_biasprm[self.actuator, 2] = -self.soon
        m.actuator_forcerange[self.actuator, 0] = -self.effort
        m.actuator_forcerange[self.actuator, 1] = self.effort

    def _mimics(self, m: mujoco.MjModel) -> dict[str, tuple[str, np.ndarray]]:
        """Joints that copy another joint: name -> (source, polynomial)."""
        joints = {}
        for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT):
            joint, source = m.joint(m.eq_obj1id[e]).name, m.joint(m.eq_obj2id[e]).name
            if joint.startswith(self.spec.name + "/"):
                joints[joint] = (source, m.eq_data[e, :5].copy())
        return joints


def _parsed(given: RobotSpec, bit: int) -> mujoco.MjSpec:
    """A robot without base and servos, as its URDF says; its shapes carry the collision ``bit``."""
    child = mujoco.MjSpec.from_string(touchable(given.urdf, frozenset(drive.joint for drive in given.drives)))
    for geom in child.geoms:
        geom.contype, geom.conaffinity = bit, ALL_BITS & ~bit & ~GROUND & ~REMOTE_HAND
        geom.friction = ROUGH
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
    return child


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


def split_damping(
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


def build_error(spec: RobotSpec, error: ValueError) -> RobotError:
    """What MuJoCo says against a robot, in one line."""
    return RobotError(f"robot {spec.name!r}: MuJoCo cannot build it from its URDF: {' '.join(str(error).split())}")
