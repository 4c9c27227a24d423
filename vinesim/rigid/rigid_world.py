"""All rigid bodies in one MuJoCo world: ground, trellis, old wood, crates, robots, people, free bunches.

A step is split in two halves, with the contact solve of :mod:`vinesim.contact.contact_solver` between them:
:meth:`RigidWorld.predict` computes the velocity at the end of the step without contacts with plants,
:meth:`RigidWorld.impulse_response` how an impulse changes that prediction, and :meth:`RigidWorld.integrate` integrates
with the contact forces known.

MuJoCo's integrator ``discrete`` is implicit in joint damping and in the servos: the effective mass of a step is
M^ = M + dt D + dt^2 K, not M. With plain M a gripper closes with 6.6 N where its servos give 40 N.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid import free_bunch, recompile, static_world
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.human_body import HumanBody, HumanError, hand_wrenches
from vinesim.rigid.human_posture import BODY_PARTS, PALM_TO_FINGERTIP
from vinesim.rigid.mujoco_contacts import SoftWires
from vinesim.rigid.mujoco_world import CompiledWorld, MujocoWorld
from vinesim.rigid.recompile import wake_body
from vinesim.rigid.robot_body import RobotBody, build_error
from vinesim.rigid.static_world import FIRST_FIXED_GEOM, FIXED
from vinesim.rigid.urdf import RobotError
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import HandSample, HumanPose, HumanSpec, RigidBox, RobotSpec
from vinesim.scene.values.signals import Color
from vinesim.wires.deflected_wires import DeflectedWires

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
_GROUND_KINDS = int(mujoco.mjtGeom.mjGEOM_HFIELD)
"""Greatest of MuJoCo's types of geoms that are the ground: plane and height field."""
_HIPS = BODY_PARTS.index("hips")

MAX_CONTACTS = 3000
"""Number of contacts of rigid bodies above which objects that are in each other pass through everything. GUESSED:
MuJoCo's memory suffices for twice as many, and a crate of bunches has some hundred."""

MAX_CONTACTS_OF_OBJECT = 100
"""Number of contacts above which an object passes, if there are more than :data:`MAX_CONTACTS` in all. GUESSED."""

MAX_RATE = 1e4
"""Rate [m/s, rad/s] of a degree of freedom above which the simulation counts as unstable."""


class RigidWorld(MujocoWorld):
    """Robots, people, crates, free bunches and static geoms in one MuJoCo world, and their step."""

    def __init__(self, model: Model, *, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        super().__init__(model, parameters=parameters)
        self.heaped = 0
        """Number of times that a free object passed through everything for a step, because it was in a heap of objects
        that overlap."""
        self.faults = 0
        """Number of times a kinematic tree was stopped because of a non-finite number or a rate above
        :data:`MAX_RATE`."""
        self.last_fault = ""
        """Time and names of the kinematic trees that were stopped last; empty if none was stopped."""

    # ------------------------------------------------------------------ actors

    def add_robot(self, spec: RobotSpec) -> None:
        """Add a robot at ``spec.pose`` and ``spec.home``; the states of all other bodies do not change.

        Raises :class:`RobotError` if the URDF does not compile; then the world does not change.
        """
        while not self.adopt(self.compile_with(spec)):
            pass

    def add_human(self, spec: HumanSpec, *, is_remote: bool = False) -> None:
        """Add a person at ``spec.pose``; the states of all other bodies do not change. Raises :class:`HumanError`.

        ``is_remote``: another client moves the person. The hands of the copy hold nothing and do not touch robots.
        """
        while not self.adopt(self.compile_with(spec, is_remote=is_remote)):
            pass

    def remove_robot(self, name: str) -> None:
        """Remove a robot; the states of all other bodies do not change."""
        self.robot(name)
        del self._robots[name]
        self._recompile()

    def remove_human(self, name: str) -> None:
        """Remove a person and release everything that the hands held."""
        self.human(name)
        del self._humans[name]
        self._recompile()

    def compile_with(
        self,
        *specs: RobotSpec | HumanSpec,
        is_remote: bool = False,
        replaces: bool = False,
        without: Collection[str] = (),
    ) -> CompiledWorld:
        """Compile a world with additional actors ``specs``, for :meth:`adopt`; its pool for free bunches has all
        bodies.

        Any thread may call this while another thread steps the world. Raises :class:`RobotError` if a URDF does not
        compile; with several robots, the error does not name the robot.

        Args:
            specs: actors to add.
            is_remote: see :meth:`add_human`.
            replaces: the robots in ``specs`` exist already and keep their states; only their shapes change.
            without: names of actors to remove.
        """
        robots = list(self._robots.values())
        humans = list(self._humans.values())
        removed = tuple(actor for actor in (*robots, *humans) if actor.spec.name in without)
        robots = [robot for robot in robots if robot not in removed]
        humans = [human for human in humans if human not in removed]
        for spec in specs:
            if isinstance(spec, HumanSpec):
                code = _free_code(spec.name, "human", static_world.HUMAN_CODES, humans, robots, HumanError)
                humans.append(HumanBody(spec, code, self.parameters, is_remote=is_remote))
            elif replaces:
                old = self.robot(spec.name)
                resumed = dataclasses.replace(spec, pose=old.spec.pose)
                new = RobotBody(resumed, old.code, self.parameters, self.model.terrain)
                robots = [new if robot is old else robot for robot in robots]
            else:
                code = _free_code(spec.name, "robot", static_world.ROBOT_CODES, robots, humans, RobotError)
                robots.append(RobotBody(spec, code, self.parameters, self.model.terrain))
        try:
            return dataclasses.replace(self._compile_world(tuple(robots), tuple(humans)), removed=removed)
        except ValueError as error:
            added = [spec for spec in specs if isinstance(spec, RobotSpec)]
            if not added:
                raise
            raise build_error(added[-1], error) from error

    def adopt(self, compiled: CompiledWorld) -> bool:
        """Use a world from :meth:`compile_with`; call this between steps.

        Returns False and changes nothing if actors or boxes were added or removed since the compilation; then the
        caller must compile again.
        """
        present = tuple(
            actor for actor in (*self._robots.values(), *self._humans.values()) if actor not in compiled.removed
        )
        planned = (*compiled.robots, *compiled.humans)
        added = [actor for actor in planned if actor not in present]
        replaced = {
            actor: self._robots[actor.spec.name]
            for actor in added
            if isinstance(actor, RobotBody) and self._robots.get(actor.spec.name) in present
        }
        kept: list[RobotBody | HumanBody] = [
            replaced[actor] if isinstance(actor, RobotBody) and actor in replaced else actor
            for actor in planned
            if actor in replaced or actor not in added
        ]
        stays = tuple(kept) == present and compiled.boxes == self.boxes
        if not stays or compiled.bunch_slots <= max(self._bunch_slot.values(), default=-1):
            return False
        for new, old in replaced.items():
            new.take_over(old)
            recompile.keep_touching_awake(self.mj_model, self.mj_data, self.mj_model.body(new.spec.name).id)
        self._robots = {robot.spec.name: robot for robot in compiled.robots}
        self._humans = {human.spec.name: human for human in compiled.humans}
        self._replace_world(compiled)
        for actor in added:
            if isinstance(actor, RobotBody) and actor not in replaced:
                self.place_robot(actor.spec.name, actor.start_pose, actor.spec.home)
        return True

    def actor_position(self, name: str) -> np.ndarray:
        """Returns the position [3] m of a robot's base or of a person's hips."""
        return self.human(name).part_poses[_HIPS, :3] if name in self._humans else self.base_state(name)[0][:3]

    def penetrations(self) -> list[tuple[str, str, float]]:
        """Returns the pairs of actors or objects that overlapped at the start of the last step, each with the depth of
        the overlap [m].
        """
        m = self.mj_model
        d = self.mj_data
        found = []
        for contact in d.contact:
            if contact.dist > 0.0:
                continue
            bodies = [m.geom_bodyid[geom] for geom in contact.geom]
            pairs = zip(bodies, contact.geom, strict=True)
            names = [self.owners[body][0] if body in self.owners else m.geom(geom).name for body, geom in pairs]
            found.append((names[0], names[1], -float(contact.dist)))
        return found

    def use_compliant_wires(self, wires: DeflectedWires) -> None:
        """Make contacts with wires compliant; without this call wires are rigid."""
        self._soft_wires = SoftWires(wires)
        self._soft_wires.use_world(self.mj_model)

    # ------------------------------------------------------------------ the step, in two halves

    def predict(self) -> None:
        """First half of a step: compute poses, contacts of rigid bodies, and the velocity at the end of the step
        without contacts with plants."""
        m = self.mj_model
        d = self.mj_data
        self.apply_controls()
        for human in self._humans.values():
            human.apply_controls(m, d, self.dt)
        self._valid_qpos[:] = d.qpos
        if self._passing_bunches:
            self._set_passing(self._passing_bunches, True)
        has_margins = self._speculative_contacts.set_margins(m, d)
        if self._soft_wires is not None:
            self._soft_wires.place_geoms(m, d)
        # qfrc_applied still holds the forces of the last step, so a force on a sleeping box wakes it now
        mujoco.mj_step1(m, d)
        if d.ncon > MAX_CONTACTS:
            self._pass_through_heaps()
        if self._ground_contacts is not None:
            self._ground_contacts.apply(m, d)
        if self._passing_bunches:
            self._end_passing()
        self._pair_friction.apply(m, d)
        if has_margins:
            self._speculative_contacts.limit_closing(m, d)
        if self._soft_wires is not None:
            self._soft_wires.soften(m, d)
        for robot in self._robots.values():
            if robot.free_base is not None:
                robot.free_base.load(m, d)
        d.qfrc_applied.fill(0.0)
        # the whole forward pass after the velocity stage, because calls of its parts omit dt K v
        mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 1)

    def _pass_through_heaps(self) -> None:
        """Let free objects with more than :data:`MAX_CONTACTS_OF_OBJECT` contacts pass through everything in this step.

        So many contacts arise only if another client puts objects into each other. MuJoCo's memory would not suffice
        for them.
        """
        m = self.mj_model
        d = self.mj_data
        contacts = np.bincount(m.geom_bodyid[d.contact.geom].ravel(), minlength=m.nbody)
        objects = np.array([body for body, (_, kind) in self.owners.items() if kind in ("box", "bunch")], int)
        crowded = objects[contacts[objects] > MAX_CONTACTS_OF_OBJECT]
        geoms = np.isin(m.geom_bodyid, crowded)
        kept = m.geom_contype[geoms].copy(), m.geom_conaffinity[geoms].copy()
        bodies = m.body_contype[crowded].copy(), m.body_conaffinity[crowded].copy()
        m.geom_contype[geoms] = m.geom_conaffinity[geoms] = 0
        m.body_contype[crowded] = m.body_conaffinity[crowded] = 0
        mujoco.mj_step1(m, d)
        m.geom_contype[geoms], m.geom_conaffinity[geoms] = kept
        m.body_contype[crowded], m.body_conaffinity[crowded] = bodies
        self.heaped += len(crowded)

    def apply_controls(self) -> None:
        """Compute MuJoCo's controls from the targets of all robots."""
        for robot in self._robots.values():
            robot.apply_controls(self.mj_data, self.dt)

    @property
    def velocity_free(self) -> np.ndarray:
        """Velocity [dof] at the end of the step as :meth:`predict` computes it; zero for sleeping trees, whose ``qacc``
        MuJoCo does not update."""
        m = self.mj_model
        d = self.mj_data
        velocity = d.qvel + self.dt * d.qacc
        if d.nv_awake < m.nv:
            velocity[d.tree_asleep[m.dof_treeid] >= 0] = 0.0
        return velocity

    @property
    def dof_names(self) -> list[tuple[str, int]]:
        """Returns for each degree of freedom the name of its joint (or free bunch) and the index within that joint.

        Names and indices stay valid after a recompilation.
        """
        m = self.mj_model
        bunch_in = {free_bunch.slot_name(slot): f"bunch/{bunch}" for bunch, slot in self._bunch_slot.items()}
        of = [bunch_in.get(name, name) for name in self._names.joints]
        return [(of[i], int(v - m.jnt_dofadr[i])) for v, i in enumerate(m.dof_jntid.tolist())]

    @property
    def islands(self) -> np.ndarray:
        """Returns a label of the island of each kinematic tree, see :meth:`EffectiveMass.island_labels`."""
        return self._effective_mass.island_labels(self.mj_data)

    def is_constrained(self, bodies: np.ndarray) -> bool:
        """Returns whether active constraints act on the MuJoCo ``bodies`` [k], see
        :meth:`EffectiveMass.is_constrained`."""
        return self._effective_mass.is_constrained(self.mj_data, bodies)

    def impulse_response(self, J: np.ndarray) -> np.ndarray:
        """Returns the change of velocity [dof, k] by unit impulses along the rows of ``J`` [k, dof]; see
        :class:`EffectiveMass`."""
        return self._effective_mass.impulse_response(self.mj_data, J)

    def predict_with(self, force: np.ndarray) -> None:
        """Repeat :meth:`predict` with the generalised contact forces of plants, ``force`` [dof] N or N m.

        With these forces, other constraints of MuJoCo may hold, slide or open.
        """
        np.add(force, 0.0, out=self.mj_data.qfrc_applied)  # turns -0 into +0, because -0 would keep boxes awake
        mujoco.mj_forwardSkip(self.mj_model, self.mj_data, mujoco.mjtStage.mjSTAGE_VEL, 1)

    def integrate(self, force: np.ndarray | None = None) -> None:
        """Second half of a step: integrate with the generalised contact forces of plants, ``force`` [dof] N or N m."""
        m = self.mj_model
        d = self.mj_data
        if force is not None:
            np.add(force, 0.0, out=d.qfrc_applied)  # see predict_with()
        mujoco.mj_step2(m, d)
        if self._soft_wires is not None:
            self._soft_wires.report(d, self.dt)
        self._link_sensors.measure(m, d)
        if self._is_faulty():
            self._stop_faulty_trees()
            force = None
        self.contact_force[:] = 0.0 if force is None else force
        if d.ncon:
            rigid_contacts = np.where(d.efc_type >= _CONTACT, d.efc_force, 0.0)
            out = np.zeros(m.nv)
            mujoco.mj_mulJacTVec(m, d, out, rigid_contacts)
            self.contact_force += out
        for robot in self._robots.values():
            if robot.remote_wrenches:
                self.contact_force += robot.remote_effort(m, d)
        for human in self._humans.values():
            human.measure(d)
        self._kinematics_current = False

    def rebind(self, mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
        """Use another MuJoCo model and data, in which the joints and bodies have equal names."""
        self.mj_model = mj_model
        self.mj_data = mj_data
        self.contact_force = np.zeros(mj_model.nv)
        self._names = recompile.WorldNames.of(mj_model)
        self._kinematics_current = False
        for robot in self._robots.values():
            robot.find_indices(mj_model, self._names)
        self._link_sensors.find_indices(mj_model, self._robots)
        self._pair_friction.find_materials(mj_model)
        self._speculative_contacts.find_crates(mj_model, self._boxes)

    def _is_faulty(self) -> bool:
        """Returns whether a number of the state is not finite, or a rate exceeds :data:`MAX_RATE`."""
        rate = self.mj_data.qvel
        position = self.mj_data.qpos
        if rate.dot(rate) < MAX_RATE**2 and position.dot(position) < np.inf:  # a cheap sufficient test
            return False
        return not (rate.min() > -MAX_RATE and rate.max() < MAX_RATE and np.isfinite(position).all())

    def _stop_faulty_trees(self) -> None:
        """Stop kinematic trees with a non-finite number or a rate above :data:`MAX_RATE` at their poses before the
        step.

        All other trees keep their states.
        """
        m = self.mj_model
        d = self.mj_data
        joint_tree = m.dof_treeid[m.jnt_dofadr]
        width = np.where(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE, 7, 1)
        tree = np.repeat(joint_tree, width)  # tree of each entry of qpos
        faulty = np.zeros(m.ntree, bool)
        faulty[m.dof_treeid[~(np.abs(d.qvel) < MAX_RATE)]] = True
        faulty[tree[~np.isfinite(d.qpos)]] = True
        valid = np.where(np.isfinite(self._valid_qpos), self._valid_qpos, m.qpos0)
        d.qpos[faulty[tree]] = valid[faulty[tree]]
        dofs = faulty[m.dof_treeid]
        for name in recompile.DOF_ARRAYS:
            getattr(d, name)[dofs] = 0.0
        for name, robot in self._robots.items():
            if faulty[m.body_treeid[robot.bodies[robot.spec.base]]]:
                self.place_robot(name, self.base_state(name)[0], d.qpos[robot.q].copy())
                robot.feedforward[:] = 0.0
        stopped = [m.body(m.tree_bodyadr[tree]).name for tree in np.flatnonzero(faulty)]
        self.faults += len(stopped)
        names = ", ".join(stopped)
        self.last_fault = f"t = {d.time:.2f} s: {names} moved by a number that is not finite or too fast; stopped"

    # ------------------------------------------------------------------ robots, by name
    # Every method raises ``ValueError`` if no robot or link has the given name, and :class:`RobotError` for commands
    # that are not finite or have the wrong shape.

    def place_robot(self, name: str, pose: np.ndarray, position: np.ndarray) -> None:
        """Put a robot at base ``pose`` [7] and joint ``position`` [joint], at rest, and make these its targets."""
        self._check_joints(name, position=position)
        _check_finite(name, "pose", pose, 7)
        self.robot(name).place(self.mj_model, self.mj_data, np.asarray(pose, float), position)
        self._kinematics_current = False

    def _check_joints(self, name: str, **commands: object) -> None:
        """Raise :class:`RobotError` unless each given command has one finite number for each drive."""
        count = len(self.robot(name).spec.drives)
        for what, given in commands.items():
            if given is not None:
                _check_finite(name, f"joint {what}", given, count)

    # commands

    def command(self, name: str, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Set the targets of the servos: ``position`` [joint] and ``velocity`` [joint] (zero unless given)."""
        self._check_joints(name, position=position, velocity=velocity)
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
        """Set the gains of the servos and a feedforward ``effort`` (all [joint]); they last until the next call.

        Args:
            name: name of the robot.
            stiffness: N m/rad or N/m; with zero gains a joint is driven by ``effort`` alone.
            damping: N m s/rad or N s/m.
            effort: N m or N, added within ``limit``.
            limit: N m or N, effort limit of the servos; by default the limit of the drive, which it cannot exceed.
            exact: bool, joints that are damped by exactly ``damping``. MuJoCo damps other joints as if ``damping`` were
                larger by dt times stiffness, which suits stiff servos.
        """
        self._check_joints(name, stiffness=stiffness, damping=damping, effort=effort)
        self.robot(name).set_gains(self.mj_model, self.mj_data, (stiffness, damping, effort), limit, exact)

    def command_base(self, name: str, velocity: tuple[float, float, float]) -> None:
        """Drive the base with (vx, vy, wz) [m/s, m/s, rad/s] in its own axes; zero holds it in place. Raises
        :class:`RobotError` for a free base."""
        robot = self.robot(name)
        if robot.free_base is not None:
            raise RobotError(f"robot {name!r} stands on its legs: nothing drives its base; command its joints")
        _check_finite(name, "base velocity", velocity, 3)
        robot.base_velocity[:] = velocity
        robot.base_slip = self.parameters.base_slip

    def follow_remote(
        self, name: str, base_q: np.ndarray, base_qd: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """Let the servos pull the copy of a remote robot to the state that its client has sent. The copy stays dynamic,
        so that a vine can hold it back.

        ``base_q``: [7] pose of the base; ``base_qd``: [6] velocity of the base, world axes; ``position``, ``velocity``:
        [joint] rad or m, rad/s or m/s.
        """
        self._check_joints(name, position=position, velocity=velocity)
        _check_finite(name, "base pose", base_q, 7)
        _check_finite(name, "base velocity", base_qd, 6)
        self.robot(name).follow_remote(
            self.mj_model, self.mj_data, np.asarray(base_q, float), np.asarray(base_qd, float), position, velocity
        )

    def apply_wrench(self, name: str, link: str, force: np.ndarray, moment: np.ndarray = np.zeros(3)) -> None:
        """Apply a force [3] N and a moment [3] N m at a link's centre of mass, world axes, until the next call."""
        wrench = self.mj_data.xfrc_applied[self._link_body(name, link)]
        _check_finite(name, "force", force, 3)
        _check_finite(name, "moment", moment, 3)
        wrench[:3], wrench[3:] = force, moment

    def set_remote_wrenches(self, name: str, wrenches: dict[str, np.ndarray]) -> None:
        """Set the wrenches that remote people exert on a robot. They act until the next call.

        ``wrenches``: wrench [6] by name of the link: a force [N] and a moment [N m] about the link's centre of mass,
        world axes. The contact efforts of :meth:`joint_measurements` include them. Raises :class:`RobotError` if a link
        does not exist or a number is not finite.
        """
        robot = self.robot(name)
        for link, wrench in wrenches.items():
            _check_finite(name, f"wrench on {link!r}", wrench, 6)
        if wrenches or robot.remote_wrenches:
            robot.set_remote_wrenches(self.mj_data, wrenches)

    def set_indicator_color(self, name: str, color: Color | None) -> None:
        """Set the colour of a robot's indicator lights, black for unlit; None: the colour of the URDF."""
        robot = self.robot(name)
        robot.indicator_color = color
        self._show_lamps(robot)

    # joints and base

    def joint_measurements(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns position, velocity, effort and contact effort of the drives, each [joint] in the order of
        ``spec.drives``.

        The effort is that of servo and gravity compensation in the last step. The contact effort is J^T f of the
        contacts with plants and rigid bodies. At rest, effort and contact effort together balance the robot's weight.
        """
        robot = self.robot(name)
        d = self.mj_data
        return d.qpos[robot.q], d.qvel[robot.v], robot.transmitted_effort(d), self.contact_force[robot.v]

    def joint_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns position [rad or m] and velocity of the drives [joint], in the order of ``spec.drives``."""
        robot = self.robot(name)
        return self.mj_data.qpos[robot.q], self.mj_data.qvel[robot.v]

    def gravity_effort(self, name: str) -> np.ndarray:
        """Returns the effort [joint] N m or N of the drives that balances the robot's own weight."""
        return self.mj_data.qfrc_gravcomp[self.robot(name).v]

    def joint_inertia(self, name: str) -> np.ndarray:
        """Returns the inertia [joint] kg m^2 or kg that each drive moves in the present pose while all other joints are
        fixed.

        It includes the armature.
        """
        return self.mj_data.M[self.robot(name).inertia_index]

    def base_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose [7] and the velocity [6] (world axes) of the base link."""
        return self.robot(name).base_state(self.mj_data)

    # links

    def link_centre(self, name: str, link: str) -> np.ndarray:
        """Returns the centre of mass [3] m of a link at the start of the last step; ``ValueError`` for an unknown
        name."""
        return self.mj_data.xipos[self._link_body(name, link)].copy()

    def jacobian(self, name: str, link: str, point: np.ndarray) -> np.ndarray:
        """Returns the Jacobian [6, joint] of a link: rows 0 to 2 for the velocity of its point at ``point`` [3] m
        (world), rows 3 to 5 for its angular velocity."""
        robot = self.robot(name)
        body = self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((6, self.mj_model.nv))
        mujoco.mj_jac(self.mj_model, self.mj_data, jacobian[:3], jacobian[3:], np.asarray(point, float), body)
        return jacobian[:, robot.v]

    def generalised_force(self, name: str, link: str, force: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Returns the generalised force [dof] of a force [3] N that acts at ``point`` [3] m (world) of a link of a
        robot or person."""
        body = self._body_of_object(name, link)
        result = np.zeros(self.mj_model.nv)
        mujoco.mj_applyFT(
            self.mj_model, self.mj_data, np.asarray(force, float), np.zeros(3), np.asarray(point, float), body, result
        )
        return result

    def add_link_sensor(self, name: str, link: str) -> None:
        """Add a sensor to a link, so that :meth:`link_wrench` and :meth:`link_acceleration` are measured from the next
        step on."""
        self._link_body(name, link)
        if link not in self.robot(name).sensor_links:
            self.robot(name).sensor_links.append(link)
            self._link_sensors.find_indices(self.mj_model, self._robots)

    def link_wrench(self, name: str, link: str) -> np.ndarray:
        """Returns the wrench [6] that a link and all links beyond it exert on the link's parent: force [N], moment [N
        m].

        The wrench is the mean over the last step, about the link's origin and in the link's axes. It includes weight,
        inertia, pushes and contacts with rigid bodies, but not contacts with plants, which are in ``Physics.contacts``.
        """
        return self._link_sensors.wrench(name, link)

    def link_acceleration(self, name: str, link: str) -> np.ndarray:
        """Returns angular acceleration [rad/s^2] and proper acceleration [m/s^2] of a link's origin [6], in the link's
        axes. The proper acceleration of a link at rest is 9.81 m/s^2 upwards."""
        return self._link_sensors.acceleration(name, link)

    def link_angular_velocity(self, name: str, link: str) -> np.ndarray:
        """Returns the angular velocity [3] rad/s of a link, in its axes."""
        body = self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((3, self.mj_model.nv))
        mujoco.mj_jacBody(self.mj_model, self.mj_data, None, jacobian, body)
        return jacobian @ self.mj_data.qvel @ self.mj_data.xmat[body].reshape(3, 3)

    # ------------------------------------------------------------------ people, by name
    # Every method raises :class:`HumanError` if no person or hand has the given name.

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Set the tracked points that a person reaches at the end of the next step, and the state of hands and
        shears."""
        human = self.human(name)
        busy = [hand.busy for hand in human.hands]
        shears = human.shears_parts
        human.set_pose(pose)
        if shears != human.shears_parts:
            self._list_visuals()
        if busy != [hand.busy for hand in human.hands]:
            human.update_hand_collisions(self.mj_model)
            self._update_geoms()

    def hand_sample(self, name: str, side: str) -> HandSample:
        """Returns the state of a person's ``"left"`` or ``"right"`` hand after the last step."""
        human = self.human(name)
        return human.hand_sample(human.hand(side), self.mj_data)

    def hand_wrenches(self, name: str) -> tuple[dict[str, dict[str, np.ndarray]], tuple[bool, bool]]:
        """Returns the wrenches of a person's hands on robots in the last step; see :mod:`vinesim.rigid.human_body`."""
        robots = self._robots.items()
        links = {body: (robot, link) for robot, found in robots for link, body in found.bodies.items()}
        return hand_wrenches(self.mj_model, self.mj_data, self.human(name), links)

    # grasps

    def grasp(self, name: str, side: str, actor: str, link: str) -> None:
        """Weld a person's hand to an object at the object's present pose.

        The object is a ``link`` of an ``actor``, a box or a bunch; names are as in ``RigidGeoms``.
        """
        hand = self.human(name).hand(side)
        body = self._body_of_object(actor, link)
        self.update_kinematics()
        pose = np.concatenate([self.mj_data.xpos[[body, hand.body]], self.mj_data.xquat[[body, hand.body]]], -1)
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        hand.grasp_pose = frames.compose(frames.inverse(pose[0]), pose[1])
        hand.held = (actor, link)
        hand.weld_to(self.mj_model, self.mj_data, body)
        self._update_geoms()

    def grasp_plant(self, name: str, side: str, body: int) -> None:
        """Let a hand hold a plant's ``body``. The hand then collides with nothing; :meth:`place_hand` moves it."""
        hand = self.human(name).hand(side)
        hand.held = ("plants", f"body/{body}")
        hand.weld_to(self.mj_model, self.mj_data, None)
        self._update_geoms()

    def place_hand(self, name: str, side: str, pose: np.ndarray) -> None:
        """Put a person's hand at ``pose`` [7], at rest."""
        self.human(name).hand(side).place(self.mj_data, pose)
        self._kinematics_current = False

    def release(self, name: str, side: str) -> None:
        """Open a person's hand, so that it releases the object that it holds."""
        self.human(name).hand(side).release(self.mj_model, self.mj_data)
        self._update_geoms()

    def nearest_to_hand(self, name: str, side: str, reach: float) -> tuple[float, str, str] | None:
        """Returns gap [m], actor and link of the rigid body nearest to a hand; None if no body is nearer than ``reach``
        [m].

        The ground and the person's own body are ignored.
        """
        hand = self.human(name).hand(side)
        self.update_kinematics()
        m = self.mj_model
        d = self.mj_data
        of_hand = range(m.body_geomadr[hand.body], m.body_geomadr[hand.body] + m.body_geomnum[hand.body])
        best: tuple[float, str, str] | None = None
        for geoms in (self.geoms, self.static_geoms):
            distance = np.linalg.norm(d.geom_xpos[geoms.id] - d.xpos[hand.body], axis=1)
            for i in np.flatnonzero(distance - geoms.radius < reach + PALM_TO_FINGERTIP):
                if geoms.kind[i] > _GROUND_KINDS and geoms.actor[i] != name:
                    gap = min(mujoco.mj_geomDistance(m, d, geom, int(geoms.id[i]), reach, None) for geom in of_hand)
                    if gap < reach and (best is None or gap < best[0]):
                        best = (gap, geoms.actor[i], geoms.link[i])
        return best

    # ------------------------------------------------------------------ free bunches, by number

    @property
    def bunch_room(self) -> int:
        """Number of free bunches that can still be added without a recompilation."""
        return self._pool_size - 1 - max(self._bunch_slot.values(), default=-1)

    def add_bunch(self, bunch: int, body: FreeBunch, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Add a free bunch at ``pose`` [7] with ``velocity`` [6]: linear of its origin, then angular, in world axes."""
        self.add_bunches({bunch: (body, pose, velocity)})

    def add_bunches(self, bunches: dict[int, tuple[FreeBunch, np.ndarray, np.ndarray]]) -> None:
        """Add several bunches, each with its pose [7] and velocity [6]; ``ValueError`` if one exists already."""
        if known := sorted(bunches.keys() & self._free_bunches.keys()):
            raise ValueError(f"bunch {known[0]} is already a free bunch")
        derived = {bunch: self._derive(body) for bunch, (body, _, _) in bunches.items()}
        unused = iter(sorted(set(range(self._pool_size + len(bunches))) - set(self._bunch_slot.values())))
        for bunch, (body, _, _) in bunches.items():
            self._free_bunches[bunch] = body
            self._bunch_slot[bunch] = next(unused)
        if max(self._bunch_slot[bunch] for bunch in bunches) >= self._pool_size:
            self._recompile()
        else:
            for bunch, (body, _, _) in bunches.items():
                free_bunch.activate(self.mj_model, self._bunch_slot[bunch], body, derived[bunch])
            self._update_tables()
        for bunch, (_, pose, velocity) in bunches.items():
            self.place_bunch(bunch, pose, velocity)

    def free_bunch(self, bunch: int) -> FreeBunch:
        """Returns mass and shapes of a free bunch."""
        return self._free_bunches[bunch]

    def replace_bunch(self, bunch: int, body: FreeBunch) -> None:
        """Give a free bunch other mass and shapes. It keeps its pose and velocity."""
        self._free_bunches[bunch] = body
        free_bunch.activate(self.mj_model, self._bunch_slot[bunch], body, self._derive(body))
        self._update_tables()

    def place_bunch(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put a free bunch at ``pose`` [7] with ``velocity`` [6] in world axes, and wake it."""
        joint = self._bunch_joint(bunch)
        pose = np.asarray(pose, float)
        rotation = frames.normalize(pose[3:])
        joint.qpos[:] = np.concatenate([pose[:3], frames.to_wxyz(rotation)])
        joint.qvel[:3] = velocity[:3]
        joint.qvel[3:] = frames.rotate(frames.conjugate(rotation), np.asarray(velocity[3:], float))
        wake_body(self.mj_model, self.mj_data, self._body_of_object(f"bunch/{bunch}", "bunch"))
        self._kinematics_current = False

    def remove_bunch(self, bunch: int) -> None:
        """Remove a free bunch. This recompiles the world."""
        del self._free_bunches[bunch], self._bunch_slot[bunch]
        self._passing_bunches.discard(bunch)
        self._recompile()

    def ignore_overlaps(self, bunch: int) -> None:
        """Let a bunch that was just picked pass through fixed pieces (wood, wires, poles) while it overlaps one.

        While the bunch hung on its vine, such an overlap was not a contact.
        """
        self.update_kinematics()
        self._passing_bunches.add(bunch)
        self._end_passing()

    def passes_fixed_pieces(self, bunch: int) -> bool:
        """Returns whether a free bunch passes through fixed pieces since it was picked."""
        return bunch in self._passing_bunches

    def pass_fixed_pieces(self, bunch: int, *, passing: bool) -> None:
        """Let a free bunch pass through fixed pieces while it overlaps one, or collide with them."""
        if passing:
            self._passing_bunches.add(bunch)
        else:
            self._passing_bunches.discard(bunch)
            self._set_passing({bunch}, False)

    def _end_passing(self) -> None:
        """Enable collisions with fixed pieces for the bunches that passed through a fixed piece since they were picked
        and no longer overlap any.

        MuJoCo's poses must be current.
        """
        clear = {bunch for bunch in self._passing_bunches if not self._overlaps_fixed_piece(bunch)}
        self._passing_bunches -= clear
        self._set_passing(clear, False)

    def _set_passing(self, bunches: set[int], passing: bool) -> None:
        """Set whether free ``bunches`` pass through fixed pieces (wood, wires, poles) or collide with them."""
        m = self.mj_model
        bits = free_bunch.CONAFFINITY & ~FIXED if passing else free_bunch.CONAFFINITY
        for bunch in bunches:
            m.body_conaffinity[self._body_of_object(f"bunch/{bunch}", "bunch")] = bits
            m.geom_conaffinity[self._geoms_of_bunch(bunch)] = bits

    def _overlaps_fixed_piece(self, bunch: int) -> bool:
        m = self.mj_model
        d = self.mj_data
        geoms = self._geoms_of_bunch(bunch)
        low = (d.geom_xpos[geoms] - m.geom_rbound[geoms, None]).min(0)
        high = (d.geom_xpos[geoms] + m.geom_rbound[geoms, None]).max(0)
        start = self.model.fixed_start
        end = self.model.fixed_end
        radius = self.model.fixed_radius.mean(1)[:, None]
        near = (np.minimum(start, end) - radius < high) & (low < np.maximum(start, end) + radius)
        pieces = np.flatnonzero(near.all(1)) + FIRST_FIXED_GEOM
        pairs = itertools.product(geoms, pieces.tolist())
        return any(mujoco.mj_geomDistance(m, d, geom, piece, 0.0, None) < 0.0 for geom, piece in pairs)

    def _geoms_of_bunch(self, bunch: int) -> range:
        """Returns the indices of MuJoCo's geoms of a free bunch."""
        first = int(self.mj_model.body_geomadr[self._body_of_object(f"bunch/{bunch}", "bunch")])
        return range(first, first + len(self._free_bunches[bunch].radius))

    def bunch_pose(self, bunch: int) -> np.ndarray:
        """Returns the world pose [7] of a free bunch."""
        qpos = self._bunch_joint(bunch).qpos
        return np.concatenate([qpos[:3], frames.from_wxyz(qpos[3:])])

    def bunch_rates(self, bunch: int) -> np.ndarray:
        """Returns the velocity [6] of a free bunch as MuJoCo has it: linear of its origin [m/s] in world axes, then
        angular [rad/s] in its own axes."""
        return self._bunch_joint(bunch).qvel

    def _bunch_joint(self, bunch: int) -> Any:  # MuJoCo's view of a joint has no public type
        return self.mj_data.joint(free_bunch.slot_name(self._bunch_slot[bunch]))

    # ------------------------------------------------------------------ boxes, by number
    # Boxes of the scene have the numbers of its model.

    def add_box(self, number: int, box: RigidBox) -> None:
        """Add a box at rest; all other states do not change. ``ValueError`` if a box has this number already."""
        if number in self._boxes:
            raise ValueError(f"a box with number {number} exists already; give another number")
        self._use_boxes(self._boxes | {number: box})

    def remove_box(self, number: int) -> None:
        """Remove a box; objects in it or on it fall. ``ValueError`` if no box has this number."""
        if number not in self._boxes:
            raise ValueError(f"no box has the number {number}")
        self._use_boxes({other: box for other, box in self._boxes.items() if other != number})

    def _use_boxes(self, boxes: dict[int, RigidBox]) -> None:
        static = static_world.build_static_world(self.model, self.parameters, boxes)
        with self._compile_lock:
            self._boxes = boxes
            self._static_spec = static
        self._recompile()


def _check_finite(name: str, what: str, given: object, size: int) -> None:
    """Raise :class:`RobotError` unless a command consists of ``size`` finite numbers."""
    values = np.asarray(given, float)
    if values.shape != (size,):
        raise RobotError(f"robot {name!r}: {what} has the shape {values.shape}; give {size} numbers")
    if not math.isfinite(values.dot(values)) and not np.isfinite(values).all():  # a cheap test first
        raise RobotError(f"robot {name!r}: {what} is {values.tolist()}; give finite numbers")


def _free_code(
    name: str,
    kind: str,
    codes: tuple[int, ...],
    actors: Sequence[RobotBody | HumanBody],
    others: Sequence[RobotBody | HumanBody],
    error: type[ValueError],
) -> int:
    """Returns a collision code that no actor of this ``kind`` has; raises ``error`` if no code is free or ``name`` is
    taken."""
    if any(name == actor.spec.name for actor in (*actors, *others)):
        raise error(f"{kind} {name!r} is already here; give the newcomer another name")
    if "/" in name or not name:
        raise error(f"{kind} name {name!r} must not be empty nor contain '/', which separates actor and link")
    used = {actor.code for actor in actors}
    free = next((code for code in codes if code not in used), None)
    if free is None:
        raise error(f"{kind} {name!r} is one too many: {len(used)} of that kind share this world, remove one")
    return free
