"""The physics of one vineyard and its step: an ordered list of named stages, see :meth:`Physics.step`.

The plant solver and the rigid solver each predict velocities without the contacts between plants and rigid bodies. One
contact solver then computes the forces of these contacts, and the two solvers integrate with these forces. Afterwards
the new state decides which bunches and pieces of wood detach, and which trees fall asleep.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.interaction.blades import Blade
from vinesim.interaction.detachment import DetachmentMonitor
from vinesim.interaction.dormant_bunches import DormantBunches
from vinesim.interaction.fruit_damage import FruitMonitor
from vinesim.interaction.hand_grasp import GraspManager
from vinesim.interaction.handwork import BoundTie, Handwork
from vinesim.interaction.stalk import is_on_stalk
from vinesim.interaction.support_tracking import SupportTracker
from vinesim.plants.articulation_solver import ROCKING_TIME, ArticulationSolver
from vinesim.plants.fault_guard import FaultGuard
from vinesim.plants.level_of_detail import LevelOfDetail
from vinesim.plants.sleep import SleepMonitor
from vinesim.plants.validation import warn_of_raised_damping
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.values import (
    BladeClosing,
    Contact,
    Detachment,
    GivenWood,
    HandSample,
    HumanPose,
    HumanSpec,
    RigidVisual,
    RobotSpec,
    Snapshot,
    WireBreak,
)
from vinesim.scene.wind import Wind
from vinesim.wind.plant_wind import WindOnPlants
from vinesim.wires.deflected_wires import DeflectedWires
from vinesim.wires.elastic_supports import ElasticSupports
from vinesim.wires.wire_segments import WireShapes


class Physics:
    """A vineyard that moves: plants, rigid bodies, and the contacts, grasps and detachments between them.

    Only the thread that steps a world may use its ``Physics``. Other threads read :class:`Snapshot` and other frozen
    values.
    """

    def __init__(
        self,
        model: Model,
        *,
        parameters: PhysicsParameters = PhysicsParameters(),
        device: str = "cpu",
        detachment: bool = True,
    ) -> None:
        """Args:
        model: constants of the vineyard.
        parameters: all numbers of the physics.
        device: ``"cpu"`` or ``"cuda"``, see :class:`ArticulationSolver`.
        detachment: whether bunches detach when they are pulled too hard, and wood and ties give.
        """
        p = parameters
        self.model = model
        self.parameters = p
        self.state = State.at_rest(model)
        self.plants = ArticulationSolver(model, self.state, p, device=device)
        warn_of_raised_damping(model, p.dt, p.phi)
        self.rigid = RigidWorld(model, parameters=p)
        self.elastic_supports = ElasticSupports(self.plants, p)
        self.wires = DeflectedWires(model, self.elastic_supports, self.state.tree_awake, p.dt)
        self.wire_shapes = WireShapes(model, self.elastic_supports, self.wires)
        wires = self.wires if self.wires.is_compliant.any() else None
        if wires is not None:
            self.rigid.use_compliant_wires(wires)
        self.contact_solver = ContactSolver(model, self.plants, self.rigid, wires)
        self.detachment_monitor = DetachmentMonitor(self.plants, self.rigid, self.contact_solver, p)
        self.handwork = Handwork(self.plants, self.contact_solver, self.detachment_monitor.report_work)
        """Ties that actors bind and open, and leaves that they take off."""
        self.grasp_manager = GraspManager(self.plants, self.rigid, self.contact_solver)
        self.fruit_monitor = FruitMonitor(self.plants, self.rigid, self.contact_solver)
        self.support_tracker = SupportTracker(self.rigid)
        self.dormant_bunches = DormantBunches(self.plants, self.rigid, self.contact_solver, self.support_tracker)
        self.level_of_detail = LevelOfDetail(self.plants, p)
        self.sleep_monitor = SleepMonitor(self.plants, p)
        self.fault_guard = FaultGuard(self.plants)
        self.wind: Wind | None = None
        """The wind; None for calm. It may be set between steps; the air then changes to the new wind within two
        seconds."""
        self.wind_time_offset = 0.0
        """[s] Time of the wind minus :attr:`time`. It differs from 0 in a shared world, where all clients have the same
        gusts at the same time."""
        self.wind_on_plants = WindOnPlants(self.plants, p)
        """Applies the wind to trees near robots and people."""
        self.detachments: tuple[Detachment, ...] = ()
        """Bunches and pieces of wood that left their plants in the last step, or by command before it; sorted by
        body."""
        self.remotely_posed = np.zeros(0, np.int32)
        """[k] Trees that :meth:`apply_remote_rest` has posed for the next snapshot. The client empties this array
        before it applies the messages of the next step."""
        self.tick = 0
        """Number of steps so far."""
        self._detachment = detachment
        self._visuals: tuple[tuple[RigidVisual, ...], tuple[RigidVisual, ...], tuple[RigidVisual, ...]] = ((), (), ())
        self._body_q: np.ndarray | None = None
        self._kinematics_current = True
        self.stages = self._ordered_stages()
        """Name and function of each stage of a step, in order. A name begins with the part of the physics that carries
        out the stage."""

    def _ordered_stages(self) -> tuple[tuple[str, Callable[[], object]], ...]:
        return (
            ("wind: set the air velocity at trees near actors", self._set_wind),
            ("grasps: close and open hands, pull held plants", self.grasp_manager.begin_step),
            ("blades: hold the wood between closing edges", self._hold_wood),
            ("handwork: pull canes to the wires to which actors tie them", self.handwork.update),
            ("rigid: predict velocities without plant contacts", self._predict_rigid),
            ("contacts: wake trees near moving geoms", self.contact_solver.wake_near_trees),
            ("detail: refine bunches near actors", self._refine_bunches),
            ("elastic supports: balance wires and arms with awake trees, wake others", self._update_elastic_supports),
            ("plants: predict velocities without contacts", self.plants.predict),
            ("contacts: wake trees that others touch, solve all together", self.contact_solver.solve),
            ("plants: integrate with contact wrenches", self._integrate_plants),
            ("rigid: integrate with contact forces", self._integrate_rigid),
            ("fruit: record what happens to bunches", self._record_fruit),
            ("wires: follow what presses on them", self._deflect_wires),
            ("faults: stop trees with invalid rates", self.fault_guard.stop_faulty_trees),
            ("detachment: detach what broke or was cut", self._detach),
            ("grasps: place hands on held plants, measure forces", self._end_grasps),
            ("sleep: put quiet trees to sleep", self._put_to_sleep),
        )

    def step(self) -> None:
        """Advance the world by :attr:`dt`. Commands given before the call take effect in this step."""
        for _, stage in self.stages:
            stage()
        self.tick += 1

    @property
    def faults(self) -> dict[str, int]:
        """Number of faults so far, by kind: trees and robots stopped, trees slowed, objects in heaps, contacts dropped,
        geoms skipped, grasps refused, cuts moved to a joint."""
        return {
            "trees_stopped": int(self.fault_guard.count.sum()),
            "trees_slowed": self.fault_guard.slowed,
            "robots_stopped": self.rigid.faults,
            "objects_in_heaps": self.rigid.heaped,
            "contacts_dropped": self.contact_solver.dropped_contacts,
            "geoms_skipped": self.contact_solver.skipped_geoms,
            "grasps_refused": self.grasp_manager.refused_grasps,
            "cuts_moved": self.plants.stumps.missing,
        }

    # ------------------------------------------------------------------ stages that pass values between parts

    def _set_wind(self) -> None:
        observers = None
        if self.wind is not None and (actors := self.rigid.actors):
            observers = np.array([self.rigid.actor_position(name) for name in actors]), self.parameters.wind_radius
        self.wind_on_plants.update(self.wind, self.time + self.wind_time_offset, observers)

    def _predict_rigid(self) -> None:
        if self.elastic_supports.count:  # the wires that robots press on follow from the poses of the shoots now
            self.update_kinematics()
        self.rigid.predict()

    def _refine_bunches(self) -> None:
        coarsened = self.level_of_detail.update(self.contact_solver.near_trees)
        if len(coarsened):  # the bounding boxes of sleeping trees must follow their new shapes
            self.contact_solver.update_tree_bounds(coarsened)

    def _update_elastic_supports(self) -> None:
        if self.elastic_supports.count:
            self.update_kinematics()
            self.elastic_supports.update()

    def _integrate_plants(self) -> None:
        self.plants.integrate(self.contact_solver.bodies, self.contact_solver.wrenches)
        if self.contact_solver.count and self.plants.state.body_cut.any():
            self.plants.slow_turning(self.contact_solver.lying_bodies, math.exp(-self.dt / ROCKING_TIME))
        if len(self.plants.awake):
            self._body_q = None
            self._kinematics_current = False

    def _hold_wood(self) -> None:
        self.detachment_monitor.grips.begin_step(self.detachment_monitor.blades)

    def _integrate_rigid(self) -> None:
        force = self.contact_solver.rigid_force
        held = self.detachment_monitor.grips.react()
        if held is not None:
            force = held if force is None else force + held
        self.rigid.integrate(force)

    def _record_fruit(self) -> None:
        self.fruit_monitor.update(self.grasp_manager.contacts)

    def _deflect_wires(self) -> None:
        self.contact_solver.report_wires()
        self.wires.end_step(self.rigid.mj_data.tree_asleep)
        if self._detachment:
            self.detachment_monitor.break_wires(self.elastic_supports)

    def _detach(self) -> None:
        self.detachments = self.detachment_monitor.update(check_load=self._detachment)
        if self.detachments:
            self._body_q = None

    def _end_grasps(self) -> None:
        self.grasp_manager.end_step(self.detachments)
        self.detachment_monitor.hand_contacts = self.grasp_manager.contacts

    def _put_to_sleep(self) -> None:
        if self.parameters.sleep and self.sleep_monitor.watch():
            keep_awake = self.contact_solver.remote_trees.copy()
            keep_awake[self.contact_solver.near_trees] = True
            keep_awake[self.model.body_tree[self.plants.held_bodies]] = True
            self.sleep_monitor.check(keep_awake, self.contact_solver.contact_pairs, self.elastic_supports.is_coupled)

    # ------------------------------------------------------------------ results of a step

    @property
    def dt(self) -> float:
        """[s] Duration of a step; fixed, see :class:`PhysicsParameters`."""
        return self.parameters.dt

    @property
    def time(self) -> float:
        """[s] Simulated time since the start."""
        return self.tick * self.dt

    @property
    def closings(self) -> tuple[BladeClosing, ...]:
        """Closings of blades that ended in the last step."""
        return self.detachment_monitor.closings

    @property
    def wire_breaks(self) -> tuple[WireBreak, ...]:
        """Pieces of wire that broke in the last step, sorted."""
        return self.detachment_monitor.wire_breaks

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts with plants in the last step, sorted by (tree, body, shape, geom), followed by one contact for each
        hand that held a plant, and for each piece of wood that a closing blade held."""
        return self.contact_solver.contacts + self.grasp_manager.contacts + self.detachment_monitor.grips.contacts

    @property
    def touched(self) -> tuple[tuple[int, str], ...]:
        """Pairs (tree, actor) for each tree that the actor pressed, held or tied in the last step, sorted."""
        contacts = self.grasp_manager.contacts + self.detachment_monitor.grips.contacts
        tied = self.handwork.touched
        if not contacts and not tied:
            return self.contact_solver.touched_trees
        held = ((int(self.model.body_tree[contact.body]), contact.actor) for contact in contacts)
        return tuple(sorted({*self.contact_solver.touched_trees, *held, *tied}))

    def update_kinematics(self) -> None:
        """Compute the body poses ``state.body_q`` at the end of the last step. Without this call, ``state.body_q``
        contains the poses at the start of the last step.
        """
        if not self._kinematics_current:
            self.plants.forward_kinematics()
            self._kinematics_current = True

    def wake(self, trees: np.ndarray) -> None:
        """Wake trees [k] and compute the poses of their bodies. Call it between steps, after writing joint rotations of
        these trees into :attr:`state`.

        Raises :class:`ValueError` if there is no such tree.
        """
        self.sleep_monitor.wake(trees)
        self.plants.forward_kinematics(trees)
        self._body_q = None

    def snapshot(self) -> Snapshot:
        """Returns the world after the last step as an immutable value. While no tree is awake, snapshots share one
        array of plant poses."""
        if self._body_q is None:
            self.update_kinematics()
            self._body_q = self.state.body_q.copy()
        return Snapshot(
            time=self.time,
            tick=self.tick,
            body_q=self._body_q,
            bunch_attached=self.state.bunch_attached.copy(),
            visuals=self.visuals(),
            visual_q=self.visual_q(),
            moved_trees=np.union1d(self.plants.awake, self.remotely_posed),
            wind=self.wind_on_plants.state,
            wires=self.wire_shapes.poses(),
            stumps=self.plants.stumps.table,
            leaf_off=self.state.leaf_off,
        )

    def visuals(self) -> tuple[RigidVisual, ...]:
        """Returns all rigid bodies and dormant bunches that have a visible shape. The same tuple is returned until a
        body or bunch is added or removed.
        """
        rigid = self.rigid.visuals()
        dormant = self.dormant_bunches.visuals()
        if self._visuals[0] is not rigid or self._visuals[1] is not dormant:
            self._visuals = rigid, dormant, rigid + dormant
        return self._visuals[2]

    def visual_q(self) -> np.ndarray:
        """Returns the world poses [visual, 7] of the bodies and bunches of :meth:`visuals`."""
        rigid = self.rigid.visual_q()
        return np.concatenate([rigid, self.dormant_bunches.visual_q()]) if len(self.dormant_bunches) else rigid

    # ------------------------------------------------------------------ actors

    def add_robot(self, spec: RobotSpec) -> None:
        """Add a robot to the vineyard; see :meth:`RigidWorld.add_robot`."""
        self.rigid.add_robot(spec)

    def remove_robot(self, name: str) -> None:
        """Remove a robot and its blades; see :meth:`RigidWorld.remove_robot`."""
        self.rigid.remove_robot(name)
        self._remove_blades_of(name)

    def add_human(self, spec: HumanSpec, *, is_remote: bool = False) -> None:
        """Add a person to the vineyard; see :meth:`RigidWorld.add_human`.

        ``is_remote``: another client controls the person. A remote person touches only trees whose state that client
        sends.
        """
        self.rigid.add_human(spec, is_remote=is_remote)
        if is_remote:
            self.contact_solver.remote_actors.add(spec.name)

    def remove_human(self, name: str) -> None:
        """Remove a person and the person's blades; see :meth:`RigidWorld.remove_human`. The hands release all objects
        and plants.
        """
        self.rigid.remove_human(name)
        self._remove_blades_of(name)
        self.grasp_manager.remove_ties_of(name)
        self.contact_solver.remote_actors.discard(name)

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Set the poses that a person's tracked points (head, hands, hips, feet) have at the end of the next step, and
        which hands are closed."""
        self.rigid.move_human(name, pose)

    def hand(self, name: str, side: str) -> HandSample:
        """Returns the state of a person's hand after the last step. ``side``: ``"left"`` or ``"right"``."""
        return self.rigid.hand_sample(name, side)

    # ------------------------------------------------------------------ detachment

    def pick(self, bunch: int) -> None:
        """Take a bunch off its vine, between steps; see :meth:`DetachmentMonitor.pick`."""
        self.detachment_monitor.pick(bunch)
        self._body_q = None

    def cut(self, body: int, at: float | None = None) -> None:
        """Cut a piece of wood off its vine, between steps; see :meth:`DetachmentMonitor.cut`. ``at``: place of the cut
        [m] from the body's origin."""
        self.detachment_monitor.cut(body, at=at)
        self._body_q = None

    def apply_remote_pick(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Pick a bunch that another client has picked; see :meth:`DetachmentMonitor.apply_remote_pick`."""
        self.detachment_monitor.apply_remote_pick(bunch, pose, velocity)
        self._body_q = None

    def apply_remote_stalk(self, bunch: int, segment: int, at: float) -> None:
        """Cut a bunch, now or when it leaves its vine, where another client has cut it: ``at`` [m] along ``segment``.

        Nothing happens if that place is not on its peduncle, or if the bunch has a stalk already.
        """
        if is_on_stalk(self.model, bunch, segment, at) and self.state.cut_segment[bunch] < 0:
            self.state.cut_segment[bunch] = segment
            self.state.cut_at[bunch] = at
            self.detachment_monitor.restore_stalk(bunch)
            self.dormant_bunches.restore_stalk(bunch)
            self._body_q = None

    def apply_remote_passing(self, bunch: int, passed: tuple[int, ...]) -> None:
        """Let a free bunch pass the trees that it passes on the client that moved it; see
        :meth:`ContactSolver.pass_through`."""
        self.contact_solver.pass_through(bunch, passed)

    def apply_remote_cut(self, body: int) -> None:
        """Cut off a piece of wood that another client has cut off; see :meth:`DetachmentMonitor.apply_remote_cut`."""
        self.detachment_monitor.apply_remote_cut(body)
        self._body_q = None

    def apply_remote_stump(self, stump: int, segment: int, at: float, *, floats: bool) -> None:
        """Leave the stump of a cut that another client has made; see :meth:`DetachmentMonitor.apply_remote_stump`."""
        self.detachment_monitor.apply_remote_stump(stump, segment, at, floats=floats)
        self._body_q = None

    def tie(self, body: int, along: float, to: np.ndarray, actor: str = "") -> BoundTie:
        """Tie a cane between steps; see :meth:`Handwork.bind`."""
        return self.handwork.bind(body, along, to, actor)

    def take_leaves(self, leaves: np.ndarray, actor: str = "") -> int:
        """Take leaves [k] off between steps; see :meth:`Handwork.take_leaves`."""
        self._body_q = None
        return self.handwork.take_leaves(leaves, actor)

    def given_wood(self, tree: int) -> GivenWood:
        """Returns how a tree has changed for good, besides cuts."""
        model = self.model
        state = self.state
        bodies = model.bodies_of(tree)
        joints = np.flatnonzero((state.joint_flow[bodies] > 0.0) & ~state.body_cut[bodies])
        ties = np.flatnonzero(model.body_tree[model.tie_body] == tree)
        gave = np.flatnonzero(state.tie_broken[ties] | (state.tie_flow[ties] > 0.0))
        notched = np.flatnonzero(state.notch_depth[bodies] > 0.0)
        bound = self.handwork.of_tree(tree)
        return GivenWood(
            joints,
            state.joint_set[bodies.start + joints],
            state.joint_flow[bodies.start + joints],
            gave,
            state.tie_slid[ties[gave]],
            state.tie_flow[ties[gave]],
            state.tie_broken[ties[gave]],
            notched,
            state.notch_at[bodies.start + notched],
            state.notch_depth[bodies.start + notched],
            np.array([tie.segment - bodies.start for tie in bound], int),
            np.array([tie.steps for tie in bound], int),
            np.array([tie.to for tie in bound], np.float32).reshape(-1, 3),
            np.array([tie.is_open for tie in bound], bool),
            np.flatnonzero(state.leaf_off[self._leaves_of(tree)]),
        )

    def _leaves_of(self, tree: int) -> np.ndarray:
        """Returns the leaves [k] of a tree, sorted."""
        return np.flatnonzero(self.model.body_tree[self.model.leaf_body] == tree)

    def apply_remote_wood(self, tree: int, given: GivenWood) -> None:
        """Change a tree as it has changed on other clients, for good and besides cuts. What has changed more here
        stays.

        Nothing happens if the tree has no such bodies, ties or leaves.
        """
        model = self.model
        state = self.state
        ties = np.flatnonzero(model.body_tree[model.tie_body] == tree)
        leaves = self._leaves_of(tree)
        core = np.concatenate([given.joints, given.notched, given.tied])
        if (
            core.max(initial=-1) >= model.tree_core[tree]
            or given.ties.max(initial=-1) >= len(ties)
            or given.bare.max(initial=-1) >= len(leaves)
        ):
            return
        first = int(model.tree_first[tree])
        bodies = first + given.joints
        further = (given.flows > state.joint_flow[bodies]) & ~state.body_cut[bodies]
        bodies = bodies[further]
        if len(bodies):
            self.plants.set_set(bodies, given.turns[further])
            state.joint_flow[bodies] = given.flows[further]
            self.detachment_monitor.wood.read_state(bodies)
        for tie, slid, way, broken in zip(
            ties[given.ties].tolist(), given.slid.tolist(), given.slid_in_all.tolist(), given.broken, strict=True
        ):
            if way > state.tie_flow[tie]:
                self.plants.slide_tie(tie, slid - float(state.tie_slid[tie]))
                state.tie_slid[tie] = slid
                state.tie_flow[tie] = way
            if broken and not state.tie_broken[tie]:
                self.plants.break_tie(tie)
        for segment, at, depth in zip(given.notched, given.notch_at, given.notch_depth, strict=True):
            self.detachment_monitor.notch(first + int(segment), float(at), float(depth))
        for segment, steps, to, is_open in zip(given.tied, given.tied_at, given.tied_to, given.opened, strict=True):
            self.handwork.learn_tie(first + int(segment), int(steps), to, is_open=bool(is_open))
        self.handwork.take_leaves(leaves[given.bare], is_remote=True)
        self._body_q = None

    def apply_remote_rest(self, trees: list[int], joint_q: list[np.ndarray]) -> None:
        """Put trees to sleep in the rest poses that the clients that own the trees have sent. No tree wakes.

        ``trees`` [k]: indices of the trees. ``joint_q`` [k]: joint rotations [body of the tree, 4] of each tree. If a
        tree is named several times, its last pose counts.
        """
        for tree, rotations in zip(trees, joint_q, strict=True):
            bodies = self.model.bodies_of(tree)
            turned = self.state.elastic_turn(bodies, np.asarray(rotations, np.float32))
            self.state.joint_q[bodies] = frames.normalize(np.asarray(turned, np.float32))
        resting = np.unique(trees).astype(np.int32)
        self.plants.put_to_sleep(resting)
        self.contact_solver.update_tree_bounds(resting)
        self.elastic_supports.place(resting)
        self.wires.release(resting)
        self.remotely_posed = np.union1d(self.remotely_posed, trees).astype(np.int32)
        self._body_q = None

    def set_detail_focus(self, points: np.ndarray, radius: float) -> None:
        """Refine the bunches within ``radius`` [m] of ``points`` [k, 3]; see :meth:`LevelOfDetail.set_focus`."""
        self.level_of_detail.set_focus(points, radius)

    def add_blade(
        self,
        actor: str,
        link: str,
        pose: np.ndarray,
        half: np.ndarray,
        *,
        force: float = np.inf,
        speed: float = np.inf,
        kind: str = "bypass",
    ) -> Blade:
        """Attach a cutter to a link of an actor. Its mouth is a box: ``pose`` [7] in the link's frame, half edges
        ``half`` [3] m.

        The box's x axis runs along the two blades, its y axis from one blade to the other. :meth:`Blade.close` cuts the
        wood that passes through the mouth. ``force`` [N]: largest closing force. ``speed`` [m/s]: speed with which the
        edges approach each other. ``kind``: see :data:`~vinesim.interaction.cutting_force.BLADE_FACTORS`.
        """
        self.rigid.link_pose(actor, link)  # raises an error if there is no such link
        blade = Blade(actor, link, np.asarray(pose, float), np.asarray(half, float), force, speed, kind)
        self.detachment_monitor.blades.append(blade)
        return blade

    def _remove_blades_of(self, actor: str) -> None:
        monitor = self.detachment_monitor
        for blade in monitor.blades:
            if blade.actor == actor:
                monitor.grips.release_all(blade)
        monitor.blades = [blade for blade in monitor.blades if blade.actor != actor]
