"""Everything rigid, in one MuJoCo world: ground, poles and trunks, picking boxes, robots, people.

A tick is split in two, with the shared contact solve of :mod:`vinesim.physics.contact.contact_solver` between the halves:
:meth:`Rigid.prep` predicts the velocity at the end of the tick as if no plant were there, :meth:`Rigid.inverse`
says how an impulse changes that prediction, and :meth:`Rigid.finish` integrates with the contact forces known.

MuJoCo's integrator ``discrete`` is implicit in joint damping and in the servos: the metric of the tick is
M^ = M + dt D + dt^2 K, not M. With plain M a gripper closes with 6.6 N where its servos give 40 N.
"""

from __future__ import annotations

import dataclasses
import threading
from typing import Any

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.contact import collision_geoms
from vinesim.physics.contact.effective_mass import EffectiveMass
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.rigid import free_bunch, hand_wrenches, recompile, static_world
from vinesim.physics.rigid.free_bunch import FreeBunch
from vinesim.physics.rigid.human_body import BODY_PARTS, HAND, VISUAL_PARTS, HandBody, HumanBody, HumanError, wake_body
from vinesim.physics.rigid.robot_body import GIVE, LinkSensor, RobotBody, build_error
from vinesim.physics.rigid.urdf import RobotError
from vinesim.scene import appearance
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import HandSample, HumanPose, HumanSpec, RigidVisual, RobotSpec

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """A world that is compiled and in which nothing has happened yet."""

    robots: tuple[RobotBody, ...]
    humans: tuple[HumanBody, ...]
    bunch_slots: int
    """How many loose bunches have room in it."""
    mj_model: mujoco.MjModel


class RigidWorld:
    """Robots, boxes and what stands, in one MuJoCo world that is compiled anew when an actor comes or goes."""

    def __init__(self, model: Model, *, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        self.model, self.parameters = model, parameters
        self.dt = parameters.dt
        self._robots: dict[str, RobotBody] = {}
        self._humans: dict[str, HumanBody] = {}
        self._free_bunches: dict[int, FreeBunch] = {}
        self._pool_size = 0
        self._bunch_slot: dict[int, int] = {}
        self._static_spec = static_world.build_static_world(model, parameters)
        self._compile_lock = threading.Lock()
        self.mj_model: mujoco.MjModel
        self.mj_data: mujoco.MjData
        self.faults = 0
        """How many things were stopped because a number of theirs was not finite; ``complaint`` names the last."""
        self.last_fault = ""
        self.generation = 0
        """Counts compilations: whoever keeps views of MuJoCo's arrays renews them when this changes."""
        self.owners: dict[int, tuple[str, str]] = {}
        """Actor and link of every MuJoCo body that can come, go or be moved, as :class:`RigidGeoms` names them."""
        self._recompile()

    # ------------------------------------------------------------------ who is here

    @property
    def robots(self) -> tuple[str, ...]:
        """Names in the order of arrival."""
        return tuple(self._robots)

    def add_robot(self, spec: RobotSpec) -> None:
        """Let a robot join, at ``spec.pose`` and ``spec.home``; all others go on exactly where they are.

        Raises :class:`RobotError` and leaves the world as it was if the URDF does not compile.
        """
        while not self.adopt(self.compile_with(spec)):
            pass

    def compile_with(self, spec: RobotSpec | HumanSpec, *, is_remote: bool = False) -> CompiledWorld:
        """The world with one more actor in it, for :meth:`admit`. Any thread may call this while the ticks go on.

        Raises :class:`RobotError` if the URDF does not compile. ``is_remote``: see :meth:`add_human`.
        """
        robots, people = tuple(self._robots.values()), tuple(self._humans.values())
        if isinstance(spec, HumanSpec):
            return self._compile_world(
                robots,
                (
                    *people,
                    HumanBody(spec, self._free_collision_bit("human", spec.name, HumanError), is_remote=is_remote),
                ),
            )
        robot = RobotBody(spec, self._free_collision_bit("robot", spec.name, RobotError))
        try:
            return self._compile_world((*robots, robot), people)
        except ValueError as error:
            raise build_error(spec, error) from error

    def adopt(self, draft: CompiledWorld) -> bool:
        """Between ticks, let the actor in for whom ``draft`` was made, where its ``spec`` says.

        False, and nothing has happened, if others came or went meanwhile: prepare it anew.
        """
        here = (*self._robots.values(), *self._humans.values())
        those = (*draft.robots, *draft.humans)
        (newcomer, *more) = [actor for actor in those if actor not in here] or [None]
        others = tuple(actor for actor in those if actor is not newcomer)
        if (
            newcomer is None
            or more
            or others != here
            or draft.bunch_slots <= max(self._bunch_slot.values(), default=-1)
        ):
            return False
        if isinstance(newcomer, HumanBody):
            self._humans[newcomer.spec.name] = newcomer
            self._replace_world(draft)
            return True
        spec = newcomer.spec
        self._robots[spec.name] = newcomer
        self._replace_world(draft)
        self.place_robot(spec.name, spec.pose, spec.home)
        return True

    def remove_robot(self, name: str) -> None:
        """Let a robot leave; all others go on exactly where they are."""
        self.robot(name)
        del self._robots[name]
        self._recompile()

    def place_robot(self, name: str, pose: np.ndarray, position: np.ndarray) -> None:
        """Put a robot somewhere, at rest and asking for nothing else: base ``pose`` [7], ``position`` [joint]."""
        self.robot(name).place(self.mj_model, self.mj_data, np.asarray(pose, float), position)
        self._kinematics_current = False

    @property
    def humans(self) -> tuple[str, ...]:
        """Names in the order of arrival."""
        return tuple(self._humans)

    @property
    def actors(self) -> tuple[str, ...]:
        """Robots and people."""
        return (*self._robots, *self._humans)

    def actor_position(self, name: str) -> np.ndarray:
        """[3] m where a robot's base or a person's hips are."""
        return (
            self.human(name).part_poses[BODY_PARTS.index("hips"), :3]
            if name in self._humans
            else self.base_state(name)[0][:3]
        )

    def human(self, name: str) -> HumanBody:
        """The body of a person who is here."""
        try:
            return self._humans[name]
        except KeyError:
            raise HumanError(f"no human {name!r} here; there are: {', '.join(self._humans) or 'none'}") from None

    def add_human(self, spec: HumanSpec, *, is_remote: bool = False) -> None:
        """Let a person join, at ``spec.pose``; all others go on exactly where they are. Raises :class:`HumanError`.

        ``is_remote``: another client moves the person; here the hands neither hold anything nor touch robots.
        """
        while not self.adopt(self.compile_with(spec, is_remote=is_remote)):
            pass

    def remove_human(self, name: str) -> None:
        """Let a person leave, and whatever the hands hold."""
        self.human(name)
        del self._humans[name]
        self._recompile()

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Tell where a person's tracked points are at the end of the coming tick."""
        person = self.human(name)
        busy = [hand.busy for hand in person.hands]
        person.move(pose)
        if busy != [hand.busy for hand in person.hands]:
            person.excuse(self.mj_model)
            self._update_tables()

    def hand_sample(self, name: str, side: str) -> HandSample:
        """A person's ``"left"`` or ``"right"`` hand after the last tick."""
        person = self.human(name)
        return person.sample(person.hand(side), self.mj_data)

    def grasp(self, name: str, side: str, actor: str, link: str) -> None:
        """Let a hand hold a link of an actor, a box or a bunch where it is now; names are those of ``RigidGeoms``."""
        person, body = self.human(name), self._body_of_object(actor, link)
        hand = person.hand(side)
        self.update_kinematics()
        pose = np.concatenate([self.mj_data.xpos[[body, hand.body]], self.mj_data.xquat[[body, hand.body]]], -1)
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        hand.grasp_pose, hand.held = frames.compose(frames.inverse(pose[0]), pose[1]), (actor, link)
        person.grasp(self.mj_model, self.mj_data, hand, body)
        self._update_tables()

    def grasp_plant(self, name: str, side: str, body: int) -> None:
        """Let a hand hold a plant's ``body``: it meets nothing, and goes where :meth:`put_hand` says."""
        person = self.human(name)
        hand = person.hand(side)
        hand.held = ("plants", f"body/{body}")
        person.grasp(self.mj_model, self.mj_data, hand, None)
        self._update_tables()

    def place_hand(self, name: str, side: str, pose: np.ndarray) -> None:
        """Put a hand somewhere, at rest: ``pose`` [7]."""
        hand = self.human(name).hand(side)
        self.mj_data.qpos[hand.q] = np.concatenate([pose[:3], frames.to_wxyz(pose[3:])])
        self.mj_data.qvel[hand.v] = 0.0
        self._kinematics_current = False

    def release(self, name: str, side: str) -> None:
        """Open a hand."""
        person = self.human(name)
        person.release(self.mj_model, self.mj_data, person.hand(side))
        self._update_tables()

    def nearest_to_hand(self, name: str, side: str, reach: float) -> tuple[float, str, str] | None:
        """What a hand could close on: gap [m] below ``reach``, actor and link of the nearest thing; not the ground."""
        person = self.human(name)
        self.update_kinematics()
        m, d = self.mj_model, self.mj_data
        body = person.hand(side).body
        mine = range(m.body_geomadr[body], m.body_geomadr[body] + m.body_geomnum[body])
        best: tuple[float, str, str] | None = None
        for of in (self.geoms, self.static_geoms):
            apart = np.linalg.norm(d.geom_xpos[of.id] - d.xpos[body], axis=1)
            for i in np.flatnonzero(apart - of.radius < reach + HAND):
                if of.kind[i] != mujoco.mjtGeom.mjGEOM_PLANE and of.actor[i] != name:
                    gap = min(mujoco.mj_geomDistance(m, d, geom, int(of.id[i]), reach, None) for geom in mine)
                    if gap < reach and (best is None or gap < best[0]):
                        best = (gap, of.actor[i], of.link[i])
        return best

    @property
    def free_bunches(self) -> tuple[int, ...]:
        """Bunches that lie, fall or are held, in the order in which they left their vines."""
        return tuple(self._free_bunches)

    def add_bunch(self, bunch: int, body: FreeBunch, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Take a bunch over from its vine: ``pose`` [7] and ``velocity`` [6] (of its origin, angular; world axes)."""
        self.add_bunches({bunch: (body, pose, velocity)})

    def add_bunches(self, bunches: dict[int, tuple[FreeBunch, np.ndarray, np.ndarray]]) -> None:
        """Several at once, each with its pose [7] and velocity [6]: they are listed but once."""
        if known := sorted(bunches.keys() & self._free_bunches.keys()):
            raise ValueError(f"bunch {known[0]} is loose already")
        derived = {bunch: free_bunch.compile_alone(body) for bunch, (body, _, _) in bunches.items()}
        free = iter(sorted(set(range(self._pool_size + len(bunches))) - set(self._bunch_slot.values())))
        for bunch, (body, _, _) in bunches.items():
            self._free_bunches[bunch], self._bunch_slot[bunch] = body, next(free)
        if max(self._bunch_slot[bunch] for bunch in bunches) >= self._pool_size:
            self._recompile()
        else:
            for bunch, (body, _, _) in bunches.items():
                free_bunch.activate(self.mj_model, self._bunch_slot[bunch], body, derived[bunch])
            self._update_tables()
        for bunch, (_, pose, velocity) in bunches.items():
            self.place_bunch(bunch, pose, velocity)

    def place_bunch(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put a loose bunch somewhere: ``pose`` [7], ``velocity`` [6] in world axes."""
        joint, pose = self._bunch_joint(bunch), np.asarray(pose, float)
        turn = frames.normalize(pose[3:])
        joint.qpos[:] = np.concatenate([pose[:3], frames.to_wxyz(turn)])
        joint.qvel[:3] = velocity[:3]
        joint.qvel[3:] = frames.rotate(frames.conjugate(turn), np.asarray(velocity[3:], float))
        wake_body(self.mj_model, self.mj_data, self._body_of_object(f"bunch/{bunch}", "bunch"))
        self._kinematics_current = False

    def remove_bunch(self, bunch: int) -> None:
        """Take a loose bunch out of the world; its body waits for the next one (the world is compiled anew)."""
        del self._free_bunches[bunch], self._bunch_slot[bunch]
        self._recompile()

    def bunch_pose(self, bunch: int) -> np.ndarray:
        """World pose [7] of a loose bunch."""
        qpos = self._bunch_joint(bunch).qpos
        return np.concatenate([qpos[:3], frames.from_wxyz(qpos[3:])])

    # ------------------------------------------------------------------ what they are asked to do

    def command(self, name: str, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Ask the drives for ``position`` [joint] moving with ``velocity`` [joint] (standing, unless given)."""
        self.robot(name).command(position, velocity)

    def set_gains(
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
        self.robot(name).set_gains(self.mj_model, self.mj_data, (stiffness, damping, effort), limit, exact)

    def command_base(self, name: str, velocity: tuple[float, float, float]) -> None:
        """Ask the tracks for (vx, vy, wz) [m/s, m/s, rad/s] in the base's axes; zero holds the place."""
        robot = self.robot(name)
        robot.base_velocity[:] = velocity
        robot.give = GIVE

    def follow_remote(
        self, name: str, base_q: np.ndarray, base_qd: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """Pull the copy of a remote robot to its received state; it stays dynamic, so a vine still holds it back.

        ``base_q`` [7], ``base_qd`` [6] world axes, ``position`` and ``velocity`` [joint].
        """
        self.command(name, position, velocity)
        self.robot(name).follow(self.mj_data, np.asarray(base_q, float), np.asarray(base_qd, float))

    def apply_wrench(self, name: str, link: str, force: np.ndarray, moment: np.ndarray = np.zeros(3)) -> None:
        """A force [N] and a moment [N m] on a link's centre of mass, world axes, until it is set anew."""
        wrench = self.mj_data.xfrc_applied[self._link_body(name, link)]
        wrench[:3], wrench[3:] = force, moment

    def set_remote_wrenches(self, name: str, pushes: dict[str, np.ndarray]) -> None:
        """Let a robot feel how people push it whom other clients move: wrenches [6] by link, until told anew.

        Force [N] and moment about the link's centre of mass [N m], world axes. They count as contacts in :meth:`read`.
        """
        self.robot(name).set_remote_wrenches(self.mj_data, pushes)

    def hand_wrenches(self, name: str) -> tuple[dict[str, dict[str, np.ndarray]], tuple[bool, bool]]:
        """What a person's hands did to robots in the last tick; see :func:`wrenches.of_hands`."""
        robots = self._robots.items()
        links = {body: (robot, link) for robot, found in robots for link, body in found.bodies.items()}
        return hand_wrenches.hand_wrenches(self.mj_model, self.mj_data, self.human(name), links)

    # ------------------------------------------------------------------ what they feel and where they are

    def joint_measurements(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity, effort and contact of the drives, each [joint] in the order of ``spec.drives``.

        ``effort`` is what the drive transmitted in the last tick: servo and its share of gravity compensation.
        ``contact`` is J^T f of the contacts with plants and with rigid things; at rest the two cancel.
        """
        robot, d = self.robot(name), self.mj_data
        return d.qpos[robot.q], d.qvel[robot.v], robot.effort_given(d), self.contact_force[robot.v]

    def joint_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity of the drives alone, as :meth:`read` gives them."""
        robot = self.robot(name)
        return self.mj_data.qpos[robot.q], self.mj_data.qvel[robot.v]

    def gravity_effort(self, name: str) -> np.ndarray:
        """[joint] what the drives give to carry the robot's own weight [N m or N], part of their effort."""
        return self.mj_data.qfrc_gravcomp[self.robot(name).v]

    def joint_inertia(self, name: str) -> np.ndarray:
        """[joint] what each drive has to speed up if the others stand, rotor included [kg m2 or kg], in this pose."""
        return self.mj_data.M[self.robot(name).diagonal]

    def base_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Pose [7] and velocity [6] (world axes) of the base link."""
        robot, d = self.robot(name), self.mj_data
        x, y, yaw = d.qpos[robot.base_q]
        vx, vy, wz = d.qvel[robot.base_v]
        half = 0.5 * yaw
        pose = np.array([x, y, robot.spec.pose[2], 0.0, 0.0, np.sin(half), np.cos(half)])
        return pose, np.array([vx, vy, 0.0, 0.0, 0.0, wz])

    def link_pose(self, name: str, link: str) -> np.ndarray:
        """World pose [7] of a link, whether or not it can move against its parent."""
        body = self._link_body(name, link)
        self.update_kinematics()
        return np.concatenate([self.mj_data.xpos[body], frames.from_wxyz(self.mj_data.xquat[body])])

    def jacobian(self, name: str, link: str, point: np.ndarray) -> np.ndarray:
        """[6, joint]: velocity of the world ``point`` [3] of a link, then its angular velocity, per drive's speed."""
        robot, body = self.robot(name), self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((6, self.mj_model.nv))
        mujoco.mj_jac(self.mj_model, self.mj_data, jacobian[:3], jacobian[3:], np.asarray(point, float), body)
        return jacobian[:, robot.v]

    def add_link_sensor(self, name: str, link: str) -> None:
        """From the next tick on, measure at a link what :meth:`wrench` and :meth:`acceleration` tell."""
        self._link_body(name, link)
        self.robot(name).link_sensors[link] = LinkSensor()

    def link_wrench(self, name: str, link: str) -> np.ndarray:
        """Force [N] and moment about the link's origin [N m] of the link, and all beyond it, on its parent [6].

        In the link's axes, mean of the last tick. Weight, inertia, pushes and contacts with rigid things count; those
        with plants do not: who solves them has them.
        """
        return self._link_sensor(name, link).wrench

    def link_acceleration(self, name: str, link: str) -> np.ndarray:
        """Angular [rad/s2] and proper acceleration of a link's origin [m/s2] in its axes [6]; at rest 9.81 upwards."""
        return self._link_sensor(name, link).acceleration.copy()

    def link_angular_velocity(self, name: str, link: str) -> np.ndarray:
        """[3] rad/s of a link, in its axes."""
        body = self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((3, self.mj_model.nv))
        mujoco.mj_jacBody(self.mj_model, self.mj_data, None, jacobian, body)
        return jacobian @ self.mj_data.qvel @ self.mj_data.xmat[body].reshape(3, 3)

    def penetrations(self) -> list[tuple[str, str, float]]:
        """Who stood in whom when the tick began, as :meth:`prep` found it: actors or things, and how deep [m]."""
        m, d = self.mj_model, self.mj_data
        found = []
        for contact in d.contact:
            bodies = [m.geom_bodyid[geom] for geom in contact.geom]
            pairs = zip(bodies, contact.geom, strict=True)
            names = [self.owners[body][0] if body in self.owners else m.geom(geom).name for body, geom in pairs]
            found.append((names[0], names[1], -float(contact.dist)))
        return found

    def update_kinematics(self) -> None:
        """Bring MuJoCo's poses to the state as it is now: after a step they are those of the step's start."""
        if not self._kinematics_current:
            mujoco.mj_kinematics(self.mj_model, self.mj_data)
            mujoco.mj_comPos(self.mj_model, self.mj_data)
            self._kinematics_current = True

    def visuals(self) -> tuple[RigidVisual, ...]:
        """Every robot's and box's bodies that have a shape; the same object until an actor comes or goes."""
        return self._visuals

    def visual_q(self) -> np.ndarray:
        """Poses [link, 7] of :meth:`links`."""
        self.update_kinematics()
        d, body = self.mj_data, self._visual_body
        pose = np.empty((len(body), 7))
        pose[:, :3] = d.xpos[body]
        pose[:, 3:] = d.xquat[body][:, [1, 2, 3, 0]]
        for person in self._humans.values():  # bit by bit: MuJoCo makes quaternions unit anew
            pose[self._visual_row[person.part_bodies]] = person.part_poses
            hands = self._visual_row[[hand.body for hand in person.hands]]
            first = hands[-1] + 1
            pose[first : first + len(VISUAL_PARTS)] = person.limbs(pose[hands])
        return pose

    # ------------------------------------------------------------------ the tick, in two halves

    def apply_controls(self) -> None:
        """Turn every robot's targets into MuJoCo's controls."""
        for robot in self._robots.values():
            robot.drive(self.mj_data, self.dt)

    def predict(self) -> None:
        """First half: positions, native contacts, and the velocity that the tick would end with without plants."""
        m, d = self.mj_model, self.mj_data
        self.apply_controls()
        for person in self._humans.values():
            person.drive(m, d, self.dt)
        self._valid_qpos[:] = d.qpos
        # still applied from the last tick: what pushed a sleeping box wakes it now
        mujoco.mj_step1(m, d)
        d.qfrc_applied[:] = 0.0
        # the whole forward pass behind the velocity stage: single calls of its parts leave out dt K v
        mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 1)

    @property
    def velocity_free(self) -> np.ndarray:
        """[dof] the prediction of :meth:`prep`; zero for what sleeps, whose ``qacc`` MuJoCo leaves as it was."""
        m, d = self.mj_model, self.mj_data
        velocity = d.qvel + self.dt * d.qacc
        if d.nv_awake < m.nv:
            velocity[d.tree_asleep[m.dof_treeid] >= 0] = 0.0
        return velocity

    @property
    def dof_names(self) -> list[tuple[str, int]]:
        """[dof] joint (or loose bunch) and number in it: they outlive a compilation, their places do not."""
        m = self.mj_model
        bunch_in = {free_bunch.slot_name(slot): f"bunch/{bunch}" for bunch, slot in self._bunch_slot.items()}
        names = [m.joint(i).name for i in range(m.njnt)]
        of = [bunch_in.get(name, name) for name in names]
        return [(of[i], int(v - m.jnt_dofadr[i])) for v, i in enumerate(m.dof_jntid.tolist())]

    @property
    def islands(self) -> np.ndarray:
        """See :meth:`EffectiveMass.island_labels`."""
        return self._effective_mass.island_labels(self.mj_data)

    def is_constrained(self, bodies: np.ndarray) -> bool:
        """See :meth:`EffectiveMass.is_constrained`."""
        return self._effective_mass.is_constrained(self.mj_data, bodies)

    def impulse_response(self, J: np.ndarray) -> np.ndarray:
        """Change of velocity [dof, k] for unit impulses along the rows of ``J`` [k, dof]; see :class:`EffectiveMass`."""
        return self._effective_mass.impulse_response(self.mj_data, J)

    def integrate(self, force: np.ndarray | None = None) -> None:
        """Second half: integrate with generalised contact forces of plants, ``force`` [dof]."""
        m, d = self.mj_model, self.mj_data
        if force is not None:
            np.add(force, 0.0, out=d.qfrc_applied)  # +0 for -0, which would keep sleeping boxes awake
        mujoco.mj_step2(m, d)
        self._measure()
        if not np.isfinite(d.qvel).all() or not np.isfinite(d.qpos).all():
            self._roll_back()
            force = None
        self.contact_force[:] = 0.0 if force is None else force
        if d.ncon:
            native = np.where(d.efc_type >= _CONTACT, d.efc_force, 0.0)
            out = np.zeros(m.nv)
            mujoco.mj_mulJacTVec(m, d, out, native)
            self.contact_force += out
        for robot in self._robots.values():
            if robot.remote_wrenches:
                self.contact_force += robot.effort_from_afar(m, d)
        for person in self._humans.values():
            person.feel(d)
        self._kinematics_current = False

    def rebind(self, world: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Let the robots live in another world, in which their joints and bodies have the same names."""
        self.mj_model, self.mj_data, self.contact_force, self._kinematics_current = (
            world,
            data,
            np.zeros(world.nv),
            False,
        )
        for robot in self._robots.values():
            robot.locate(world)

    def invalidate_kinematics(self) -> None:
        """Whoever steps MuJoCo by hand says so: its poses are those of the step's start."""
        self._kinematics_current = False

    # ------------------------------------------------------------------ inside

    def _free_collision_bit(self, kind: str, name: str, error: type[ValueError]) -> int:
        """The collision bit of a newcomer."""
        if name in self.actors:
            raise error(f"{kind} {name!r} is already here; give the newcomer another name")
        if "/" in name or not name:
            raise error(f"{kind} name {name!r} must not be empty nor contain '/', which parts actor and link")
        used = {actor.bit for actor in (*self._robots.values(), *self._humans.values())}
        free = [bit for bit in range(static_world.FIRST_ACTOR, static_world.LAST_ACTOR + 1) if bit not in used]
        if not free:
            raise error(f"{kind} {name!r} is one too many: {len(used)} robots and people share this world, remove one")
        return free[0]

    def _body_of_object(self, actor: str, link: str) -> int:
        """MuJoCo body of anything that has a name."""
        if actor in self._humans:
            return self._humans[actor].bodies[link]
        if actor in self._robots:
            return self._link_body(actor, link)
        kind, _, number = actor.partition("/")
        if actor == "world":
            return 0
        return self.mj_model.body(free_bunch.slot_name(self._bunch_slot[int(number)]) if kind == "bunch" else actor).id

    def _bunch_joint(self, bunch: int) -> Any:  # MuJoCo does not name its views
        return self.mj_data.joint(free_bunch.slot_name(self._bunch_slot[bunch]))

    def robot(self, name: str) -> RobotBody:
        try:
            return self._robots[name]
        except KeyError:
            raise ValueError(f"no robot {name!r} here; there are: {', '.join(self._robots) or 'none'}") from None

    def _link_body(self, name: str, link: str) -> int:
        robot = self.robot(name)
        try:
            return robot.bodies[link]
        except KeyError:
            raise ValueError(f"robot {name!r} has no link {link!r}; it has: {', '.join(robot.bodies)}") from None

    def _link_sensor(self, name: str, link: str) -> LinkSensor:
        try:
            return self.robot(name).link_sensors[link]
        except KeyError:
            raise ValueError(f"nothing is measured at {link!r} of robot {name!r}; instrument() it first") from None

    def _measure(self) -> None:
        """Keep what links felt in the tick that ends, while MuJoCo's places are still those of its start."""
        m, d = self.mj_model, self.mj_data
        if not any(robot.link_sensors for robot in self._robots.values()):
            return
        mujoco.mj_rnePostConstraint(m, d)
        for robot in self._robots.values():
            for link, felt in robot.link_sensors.items():
                felt.feel(m, d, robot.bodies[link])

    def _roll_back(self) -> None:
        """Stop the kinematic trees with a number that is not finite where the tick began; the others go on."""
        m, d = self.mj_model, self.mj_data
        joint_tree = m.dof_treeid[m.jnt_dofadr]
        width = np.where(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE, 7, 1)
        tree = np.repeat(joint_tree, width)  # of each entry of qpos
        bad = np.zeros(m.ntree, bool)
        bad[m.dof_treeid[~np.isfinite(d.qvel)]] = True
        bad[tree[~np.isfinite(d.qpos)]] = True
        sound = np.where(np.isfinite(self._valid_qpos), self._valid_qpos, m.qpos0)
        d.qpos[bad[tree]] = sound[bad[tree]]
        dofs = bad[m.dof_treeid]
        for name in recompile.DOF_ARRAYS:
            getattr(d, name)[dofs] = 0.0
        for name, robot in self._robots.items():
            if bad[m.dof_treeid[robot.base_v[0]]]:
                self.place_robot(name, self.base_state(name)[0], d.qpos[robot.q].copy())
                robot.forward[:] = 0.0
        stopped = [m.body(m.tree_bodyadr[tree]).name for tree in np.flatnonzero(bad)]
        self.faults += len(stopped)
        self.last_fault = f"t = {d.time:.2f} s: {', '.join(stopped)} moved by a number that is not finite; stopped"

    # ------------------------------------------------------------------ building the world

    def _compile_world(self, robots: tuple[RobotBody, ...], people: tuple[HumanBody, ...]) -> CompiledWorld:
        """A world with these in it and room for loose bunches, compiled; nothing here changes."""
        slots = max(self._bunch_slot.values(), default=-1) + 1 + free_bunch.POOL_SIZE
        with self._compile_lock:
            spec = self._static_spec.copy()
            for robot in robots:
                robot.attach(spec)
            for person in people:
                person.attach(spec, sum(1 << robot.bit for robot in robots))
            for slot in range(slots):
                free_bunch.add_slot(spec, slot)
            world = recompile.compile_without_contacts(spec)
        # the solver's tolerance is relative to it: whoever joins would change when it stops for everybody else
        world.stat.meaninertia = 1.0
        for slot in range(slots):
            free_bunch.disable_collision(world, slot)
        return CompiledWorld(robots, people, slots, world)

    def _recompile(self) -> None:
        """Build the world anew for those who are here now."""
        self._replace_world(self._compile_world(tuple(self._robots.values()), tuple(self._humans.values())))

    def _replace_world(self, draft: CompiledWorld) -> None:
        """Go on in another world, every joint's and body's state carried over by its name."""
        before = (self.mj_model, self.mj_data, self.contact_force) if self.generation else None
        self.mj_model, self._pool_size = draft.mj_model, draft.bunch_slots
        world = self.mj_model
        for bunch, body in self._free_bunches.items():
            free_bunch.activate(world, self._bunch_slot[bunch], body, free_bunch.compile_alone(body))
        if before is None:
            self.mj_data, self.contact_force = mujoco.MjData(world), np.zeros(world.nv)
        else:
            parked = {
                free_bunch.slot_name(slot) for slot in set(range(self._pool_size)) - set(self._bunch_slot.values())
            }
            self.mj_data, self.contact_force = recompile.transfer_state(*before, world, parked)
        self._effective_mass = EffectiveMass(world)
        self._valid_qpos = self.mj_data.qpos.copy()
        self._kinematics_current = False
        for robot in self._robots.values():
            robot.locate(world)
        for person in self._humans.values():
            person.locate(world)
        for person in self._humans.values():
            for hand in person.hands:
                self._regrasp(person, hand)
        if before is None:
            self.static_geoms = collision_geoms.static_geoms(world)
        self._update_tables()

    def _regrasp(self, person: HumanBody, hand: HandBody) -> None:
        """In a world compiled anew: hold on to what was held, if it is still there."""
        if hand.held is None:
            return
        try:
            body = None if hand.on_plant else self._body_of_object(*hand.held)
        except (KeyError, ValueError):
            person.release(self.mj_model, self.mj_data, hand)
        else:
            person.grasp(self.mj_model, self.mj_data, hand, body)

    def _update_tables(self) -> None:
        """List anew what is here; whoever keeps views of it takes notice of the new ``generation``."""
        self.generation += 1
        self._visuals, self._visual_body = self._list_visuals()
        self._visual_row = np.zeros(self.mj_model.nbody, int)
        own = self._visual_body > 0
        self._visual_row[self._visual_body[own]] = np.flatnonzero(own)
        self.owners = self._list_owners()
        self.geoms = collision_geoms.movable_geoms(self.mj_model, self.owners)

    def _list_visuals(self) -> tuple[tuple[RigidVisual, ...], np.ndarray]:
        links, bodies = [], []
        for box, size in enumerate(self.model.box_size):
            links.append(
                RigidVisual(f"box/{box}", Organ.BOX, box, appearance.crate_shapes(tuple(map(float, size)), box))
            )
            bodies.append(self.mj_model.body(f"box/{box}").id)
        for name, robot in self._robots.items():
            for link, shapes in robot.shapes.items():
                if shapes:
                    links.append(RigidVisual(f"{name}/{link}", Organ.ROBOT, robot.spec.index, shapes))
                    bodies.append(robot.bodies[link])
        for name, person in self._humans.items():
            drawn = appearance.load_human_model(person.spec.height).parts
            mine = [(part, person.bodies[part]) for part in (*BODY_PARTS, *(hand.link for hand in person.hands))]
            for part, body in (
                *mine,
                *((limb, 0) for limb in VISUAL_PARTS),
            ):  # limbs have no body: link_q() places them
                links.append(RigidVisual(f"{name}/{part}", Organ.HUMAN, person.spec.index, drawn[part]))
                bodies.append(body)
        for bunch, body in self._free_bunches.items():
            links.append(RigidVisual(f"bunch/{bunch}", Organ.BUNCH, bunch, body.shapes))
            bodies.append(self._body_of_object(f"bunch/{bunch}", "bunch"))
        return tuple(links), np.array(bodies, int)

    def _list_owners(self) -> dict[int, tuple[str, str]]:
        """Actor and link of every MuJoCo body that can come, go or be moved."""
        m = self.mj_model
        owner = {m.body(f"box/{i}").id: (f"box/{i}", "box") for i in range(len(self.model.box_size))}
        for name, robot in self._robots.items():
            owner.update({body: (name, link) for link, body in robot.bodies.items()})
        for name, person in self._humans.items():
            owner.update({body: (name, link) for link, body in person.bodies.items()})
        owner.update(
            {m.body(free_bunch.slot_name(slot)).id: (f"bunch/{i}", "bunch") for i, slot in self._bunch_slot.items()}
        )
        return owner
