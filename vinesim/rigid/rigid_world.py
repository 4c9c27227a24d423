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
from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from vinesim.rigid import free_bunch, mujoco_sleep, recompile, static_world
from vinesim.rigid.human_body import HumanBody, HumanError
from vinesim.rigid.human_shapes import BODY_PARTS
from vinesim.rigid.mujoco_world import CompiledWorld
from vinesim.rigid.rigid_world_boxes import BoxAccess
from vinesim.rigid.rigid_world_bunches import BunchAccess
from vinesim.rigid.rigid_world_humans import HumanAccess
from vinesim.rigid.rigid_world_robots import RobotAccess
from vinesim.rigid.robot_body import RobotBody, build_error
from vinesim.rigid.urdf import RobotError
from vinesim.rigid.wire_contacts import SoftWires
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import HumanSpec, RobotSpec
from vinesim.wires.deflected_wires import DeflectedWires

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
_HIPS = BODY_PARTS.index("hips")

MAX_RATE = 1e4
"""[m/s, rad/s] No body moves as fast, unless the simulation has become unstable."""


class RigidWorld(RobotAccess, HumanAccess, BunchAccess, BoxAccess):
    """Robots, people, crates, free bunches and static geoms in one MuJoCo world, and their step."""

    def __init__(self, model: Model, *, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        super().__init__(model, parameters=parameters)
        self.faults = 0
        """Number of kinematic trees that were stopped: one of their numbers was not finite, or a rate too high."""
        self.last_fault = ""
        """Time and names of the last ones; empty if there was none."""

    # ------------------------------------------------------------------ actors

    def add_robot(self, spec: RobotSpec) -> None:
        """Add a robot at ``spec.pose`` and ``spec.home``; the state of all others is unchanged to the bit.

        Raises :class:`RobotError` and leaves the world as it was if the URDF does not compile.
        """
        while not self.adopt(self.compile_with(spec)):
            pass

    def add_human(self, spec: HumanSpec, *, is_remote: bool = False) -> None:
        """Add a person at ``spec.pose``; the state of all others is unchanged to the bit. Raises :class:`HumanError`.

        ``is_remote``: another client moves the person; here the hands neither hold anything nor touch robots.
        """
        while not self.adopt(self.compile_with(spec, is_remote=is_remote)):
            pass

    def remove_robot(self, name: str) -> None:
        """Remove a robot; the state of all others is unchanged to the bit."""
        self.robot(name)
        del self._robots[name]
        self._recompile()

    def remove_human(self, name: str) -> None:
        """Remove a person; what the hands held is released."""
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
        """Compile the world with more actors, ``without`` those of some names, and with a full pool of spare bodies for
        free bunches, for :meth:`adopt`.

        Any thread may call this while steps go on. Raises :class:`RobotError` if a URDF does not compile, of several
        robots without saying which. ``is_remote``: see :meth:`add_human`. ``replaces``: the robots
        are here and keep their states; only their shapes are others.
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
                new = RobotBody(dataclasses.replace(spec, pose=old.spec.pose), old.code, self.parameters)
                robots = [new if robot is old else robot for robot in robots]
            else:
                code = _free_code(spec.name, "robot", static_world.ROBOT_CODES, robots, humans, RobotError)
                robots.append(RobotBody(spec, code, self.parameters))
        try:
            return dataclasses.replace(self._compile_world(tuple(robots), tuple(humans)), removed=removed)
        except ValueError as error:
            added = [spec for spec in specs if isinstance(spec, RobotSpec)]
            if not added:
                raise
            raise build_error(added[-1], error) from error

    def adopt(self, compiled: CompiledWorld) -> bool:
        """Use a world that was compiled with more or fewer actors, with other shapes of robots, or with more room for
        free bunches; between steps.

        False, and nothing is changed, if other actors or boxes came or went meanwhile: compile it anew.
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
            mujoco_sleep.keep_touching_awake(self.mj_model, self.mj_data, self.mj_model.body(new.spec.name).id)
        self._robots = {robot.spec.name: robot for robot in compiled.robots}
        self._humans = {human.spec.name: human for human in compiled.humans}
        self._replace_world(compiled)
        for actor in added:
            if isinstance(actor, RobotBody) and actor not in replaced:
                self.place_robot(actor.spec.name, actor.spec.pose, actor.spec.home)
        return True

    def actor_position(self, name: str) -> np.ndarray:
        """[3] m Position of a robot's base or of a person's hips."""
        return self.human(name).part_poses[_HIPS, :3] if name in self._humans else self.base_state(name)[0][:3]

    def penetrations(self) -> list[tuple[str, str, float]]:
        """Pairs of actors or objects that overlapped when the step began, as :meth:`predict` found them, and depth
        [m]."""
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

    def let_wires_give(self, wires: DeflectedWires) -> None:
        """From now on what presses on a wire deflects it; before, wires are rigid."""
        self._soft_wires = SoftWires(wires)
        self._soft_wires.use_world(self.mj_model)

    # ------------------------------------------------------------------ the step, in two halves

    def predict(self) -> None:
        """First half: poses, contacts of rigid bodies, and the velocity at the end of the step without plants."""
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
        # qfrc_applied is still that of the last step: what pushed a sleeping box wakes it now
        mujoco.mj_step1(m, d)
        if self._passing_bunches:
            self._end_passing()
        self._pair_friction.apply(m, d)
        if has_margins:
            self._speculative_contacts.limit_closing(m, d)
        if self._soft_wires is not None:
            self._soft_wires.soften(m, d)
        d.qfrc_applied.fill(0.0)
        # the whole forward pass after the velocity stage: single calls of its parts leave out dt K v
        mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 1)

    def apply_controls(self) -> None:
        """Turn the targets of all robots into MuJoCo's controls."""
        for robot in self._robots.values():
            robot.apply_controls(self.mj_data, self.dt)

    @property
    def velocity_free(self) -> np.ndarray:
        """[dof] the prediction of :meth:`predict`; zero for sleeping trees, whose ``qacc`` MuJoCo does not update."""
        m = self.mj_model
        d = self.mj_data
        velocity = d.qvel + self.dt * d.qacc
        if d.nv_awake < m.nv:
            velocity[d.tree_asleep[m.dof_treeid] >= 0] = 0.0
        return velocity

    @property
    def dof_names(self) -> list[tuple[str, int]]:
        """[dof] joint (or free bunch) and number in it, which are the same after the world is compiled anew."""
        m = self.mj_model
        bunch_in = {free_bunch.slot_name(slot): f"bunch/{bunch}" for bunch, slot in self._bunch_slot.items()}
        of = [bunch_in.get(name, name) for name in self._names.joints]
        return [(of[i], int(v - m.jnt_dofadr[i])) for v, i in enumerate(m.dof_jntid.tolist())]

    @property
    def islands(self) -> np.ndarray:
        """See :meth:`EffectiveMass.island_labels`."""
        return self._effective_mass.island_labels(self.mj_data)

    def is_constrained(self, bodies: np.ndarray) -> bool:
        """See :meth:`EffectiveMass.is_constrained`."""
        return self._effective_mass.is_constrained(self.mj_data, bodies)

    def impulse_response(self, J: np.ndarray) -> np.ndarray:
        """Change of velocity [dof, k] for unit impulses along the rows of ``J`` [k, dof]; see
        :class:`EffectiveMass`."""
        return self._effective_mass.impulse_response(self.mj_data, J)

    def predict_with(self, force: np.ndarray) -> None:
        """Predict again with generalised contact forces of plants, ``force`` [dof] N or N m: which constraints of
        MuJoCo hold, slide or open under them."""
        np.add(force, 0.0, out=self.mj_data.qfrc_applied)  # turns -0 into +0: -0 would keep sleeping boxes awake
        mujoco.mj_forwardSkip(self.mj_model, self.mj_data, mujoco.mjtStage.mjSTAGE_VEL, 1)

    def integrate(self, force: np.ndarray | None = None) -> None:
        """Second half: integrate with generalised contact forces of plants, ``force`` [dof] N or N m."""
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
        """Use another MuJoCo world in which the robots' joints and bodies have the same names."""
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
        """Whether a number is not finite, or a rate beyond :data:`MAX_RATE`."""
        rate = self.mj_data.qvel
        position = self.mj_data.qpos
        if rate.dot(rate) < MAX_RATE**2 and position.dot(position) < np.inf:  # enough, and the cheapest
            return False
        return not (rate.min() > -MAX_RATE and rate.max() < MAX_RATE and np.isfinite(position).all())

    def _stop_faulty_trees(self) -> None:
        """Stop the kinematic trees with a number that is not finite, or a rate beyond :data:`MAX_RATE`, where the step
        began; the others go on."""
        m = self.mj_model
        d = self.mj_data
        joint_tree = m.dof_treeid[m.jnt_dofadr]
        width = np.where(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE, 7, 1)
        tree = np.repeat(joint_tree, width)  # of each entry of qpos
        faulty = np.zeros(m.ntree, bool)
        faulty[m.dof_treeid[~(np.abs(d.qvel) < MAX_RATE)]] = True
        faulty[tree[~np.isfinite(d.qpos)]] = True
        valid = np.where(np.isfinite(self._valid_qpos), self._valid_qpos, m.qpos0)
        d.qpos[faulty[tree]] = valid[faulty[tree]]
        dofs = faulty[m.dof_treeid]
        for name in recompile.DOF_ARRAYS:
            getattr(d, name)[dofs] = 0.0
        for name, robot in self._robots.items():
            if faulty[m.dof_treeid[robot.base_v[0]]]:
                self.place_robot(name, self.base_state(name)[0], d.qpos[robot.q].copy())
                robot.feedforward[:] = 0.0
        stopped = [m.body(m.tree_bodyadr[tree]).name for tree in np.flatnonzero(faulty)]
        self.faults += len(stopped)
        names = ", ".join(stopped)
        self.last_fault = f"t = {d.time:.2f} s: {names} moved by a number that is not finite or too fast; stopped"


def _free_code(
    name: str,
    kind: str,
    codes: tuple[int, ...],
    actors: Sequence[RobotBody | HumanBody],
    others: Sequence[RobotBody | HumanBody],
    error: type[ValueError],
) -> int:
    """A collision code that none of ``actors`` of its kind has; ``error`` if there is none or the name is taken."""
    if any(name == actor.spec.name for actor in (*actors, *others)):
        raise error(f"{kind} {name!r} is already here; give the newcomer another name")
    if "/" in name or not name:
        raise error(f"{kind} name {name!r} must not be empty nor contain '/', which parts actor and link")
    used = {actor.code for actor in actors}
    free = next((code for code in codes if code not in used), None)
    if free is None:
        raise error(f"{kind} {name!r} is one too many: {len(used)} of that kind share this world, remove one")
    return free
