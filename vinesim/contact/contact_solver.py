"""Contacts of plants with rigid bodies and with each other: one solve a step, shared by plants and rigid bodies.

The solvers of plants and of rigid bodies each predict velocities without contacts, and the velocity changes by
impulses. One solve then finds the contact impulses for plants and rigid bodies together, so both get equal and opposite
forces in the same step. Solving plants and rigid bodies in turn with penalty springs (a *staggered* scheme) is unstable
from 1e4 N/m on.

Stages: :meth:`ContactSolver.wake_near_trees` (``detection``: broadphase), the prediction of the plants,
:meth:`ContactSolver.solve` (``detection``: narrowphase; ``impulse_solver``: islands and impulses).
"""

from __future__ import annotations

import numpy as np

from vinesim.contact.collision_arrays import PlantArrays, RigidArrays, kernel_parameters
from vinesim.contact.detection import ContactDetection
from vinesim.contact.impulse_solver import ImpulseSolver
from vinesim.contact.plant_capsules import HIDDEN, nearest_body, pass_leaves, plant_capsules, with_leaves
from vinesim.kernels.contact import structs
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import FIXED_PIECES, Organ
from vinesim.scene.model import Model
from vinesim.scene.values import Contact
from vinesim.wires.deflected_wires import DeflectedWires


class ContactSolver:
    """Contacts between the plants and the rigid world in one step.

    ``wake_near_trees()`` (before ``plants.predict()``) wakes the trees that an actor is near to. ``solve()`` (after
    ``plants.predict()``) writes ``bodies`` and ``wrenches`` for ``plants.integrate()`` and ``rigid_force`` for
    ``rigid.integrate()``.

    Robots, people, boxes and free bunches wake the trees that they are near to. Awake trees wake the trees that they
    touch. Static geoms (ground, trellis, wood) wake no tree; they only stop bodies that already move. Shapes that
    overlap in the generated scene are in contact only if they overlap more than there. All numbers come from
    ``rigid.parameters``. If there are more contacts than ``contact_capacity``, the deepest are kept, and
    ``dropped_contacts`` and ``overflow_message`` report the contacts left out.
    """

    def __init__(
        self, model: Model, plants: ArticulationSolver, rigid: RigidWorld, wires: DeflectedWires | None = None
    ) -> None:
        """``wires``: the trellis wires that deflect under contact forces. If None, all wires are rigid."""
        self.model = model
        self.plants = plants
        self.rigid = rigid
        self.parameters = rigid.parameters
        self.capsules = plant_capsules(model)
        if self.parameters.leaves == "touch" and len(model.leaf_body):
            self.capsules = with_leaves(self.capsules, model, self.parameters)
        self.plant_plant_contacts = True
        """Whether bunches and branches of awake trees touch each other too."""
        self.count = 0
        """Number of contacts in the last step, including contacts without force."""
        self.dropped_contacts = 0
        """Number of contacts left out since the start because the contact arrays were full."""
        self.overflow_message = ""
        """Message with the number of contacts that were last left out, and how to avoid it. Empty if no contact was
        ever left out."""
        self.skipped_geoms = 0
        """Number of static geoms left out since the start because too many of them were near one tree."""
        self.near_trees = np.zeros(0, np.int32)
        """[k] Trees whose bounding box overlaps the bounding box of a robot, a person or a moving object. These trees
        must not fall asleep.
        """
        self.remote_actors: set[str] = set()
        """Robots and people that another client controls. That client computes their contacts. In this world they touch
        only remote trees, so that each contact is solved by one client only.
        """
        self.remote_trees = np.zeros(len(model.tree_first), np.bool_)
        """[tree] Whether another client owns the tree's state. The client writes this array."""
        self._awake = np.zeros(0, np.int32)
        self._reported: tuple[Contact, ...] | None = ()
        self._touched: tuple[tuple[int, str], ...] | None = ()
        self._generation = 0
        self._pressed = self._pressed_before = np.zeros(0, np.int64)
        self._kernel_parameters = numbers = kernel_parameters(self.parameters)
        self._arrays = PlantArrays(model, plants, self.capsules)
        self._rigid_arrays: RigidArrays | None = None
        self.detection = ContactDetection(plants, self._arrays, self.parameters, numbers)
        self.impulses = ImpulseSolver(plants, rigid, self.detection, self.parameters, numbers, wires)
        self._wires = wires
        self._deflected = np.zeros(0, int)
        self._update_rigid_world()
        self.update_tree_bounds(np.arange(len(model.tree_first), dtype=np.int32))

    # ------------------------------------------------------------------ stages of a step

    def wake_near_trees(self) -> None:
        """Wake the trees that a robot, a person or a moving object is near to. Each other tree takes one comparison."""
        if self._generation != self.rigid.generation:
            self._update_rigid_world()
        if self._awake is not self.plants.awake:
            fallen_asleep = self._awake[~self.plants.state.tree_awake[self._awake]]
            if len(fallen_asleep):
                self.update_tree_bounds(fallen_asleep)
        if self._wires is not None and (len(self._deflected) or len(self._wires.deflected)):
            self.detection.move_wires(np.union1d(self._deflected, self._wires.deflected), self._wires)
            self._deflected = self._wires.deflected.copy()
        self.near_trees = self.detection.find_near_trees()
        if self.detection.counters[structs.NEAR_ASLEEP]:
            self.plants.wake(self.near_trees)

    def solve(self) -> None:
        """Find the contacts of all awake trees, and of the sleeping trees that they wake, and the contact forces."""
        self.count = 0
        self._reported = ()
        self._touched = ()
        self._awake = self.plants.awake
        if len(self._awake):
            self._awake = awake = self._wake_reached_trees()
            self._find_contacts(awake)
        if self.count:
            self.impulses.solve(self.count)
            self._reported = self._touched = None
        else:
            self.impulses.clear()
        self._pressed_before = self._pressed
        self._pressed = self.impulses.pressed_keys(self.count)

    def _wake_reached_trees(self) -> np.ndarray:
        """Wake the sleeping trees that awake trees touch, then the sleeping trees that these touch, and so on.

        Returns all awake trees [k].
        """
        plants = self.plants
        detection = self.detection
        candidates = self.detection.candidates
        while len(reached := detection.find_reached_trees(plants.awake, self.plant_plant_contacts)):
            plants.wake(reached)
            plants.predict(reached)
        if detection.candidates is not candidates:
            self.impulses.make_graphs()
        return plants.awake

    def _find_contacts(self, awake: np.ndarray) -> None:
        """List the contacts of the awake trees. If there are too many, keep the deepest."""
        detection = self.detection
        impulses = self.impulses
        capacity = self.impulses.capacity
        impulses.find_contacts(len(awake))
        counters = detection.counters.tolist()
        count = counters[structs.CONTACTS]
        overflow = counters[structs.OVERFLOW]
        self.skipped_geoms += counters[structs.SKIPPED_GEOMS]
        if count > capacity:
            overflow += count - capacity
            impulses.contacts.source[:] = detection.deepest(len(awake), capacity)
            detection.counters[structs.CONTACTS] = count = capacity
            impulses.build_islands()
        if overflow:
            self.dropped_contacts += overflow
            self.overflow_message = (
                f"{overflow} of {count + overflow} contacts of one step were left out, the shallowest; there is room "
                f"for {capacity}, and for {len(detection.slots)} at one tree: raise contact_capacity or "
                "max_contacts_per_tree of PhysicsParameters, or touch less at once"
            )
        if counters[structs.IMPACTED_TREES]:
            self._predict_impacted(awake)
        self.count = count

    def _predict_impacted(self, awake: np.ndarray) -> None:
        """Integrate trees that are about to suffer an impact with backward Euler (phi = 1) from this step on.

        The trapezoidal rule (phi = 0.5) moves a body by the mean of its velocities before and after the step. A body
        hit from rest would therefore move only half the required distance, overlap with the other body, and be thrown
        out.
        """
        impacted = awake[self.detection.candidates.is_impact[: len(awake)]]
        changed = impacted[self.plants.phi_used[impacted] < 1.0]
        if len(changed):
            self.plants.use_backward_euler(impacted)
            self.plants.predict(changed)

    def report_wires(self) -> None:
        """Pass the contact forces of plants on wires in the last step to :class:`DeflectedWires`."""
        if self.count:
            self.impulses.report_wires()

    # ------------------------------------------------------------------ results

    @property
    def bodies(self) -> np.ndarray:
        """[n] Indices of the plant bodies in contact, sorted."""
        return self.impulses.bodies

    @property
    def wrenches(self) -> np.ndarray:
        """[n, 6] Force (N) and torque (N m) of the contacts on each of ``bodies``, at the body's origin, world axes."""
        return self.impulses.wrenches

    @property
    def rigid_force(self) -> np.ndarray | None:
        """[dof] Generalised force (N or N m) of the contacts with plants on the rigid world. None without contact."""
        return self.impulses.rigid_force

    @property
    def trees_touched_by_copies(self) -> np.ndarray:
        """[tree] Whether local copies of remote actors touch the tree. The client writes this array."""
        return self._arrays.trees.is_remote

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The contacts of the last step that carry a force, sorted by (tree, body, capsule, other).

        Static geoms have the actor ``world`` (links ``ground``, ``fixed/7``), other plants the actor ``plants`` (links
        ``body/42``).
        """
        if self._reported is None:
            n = self.count
            contacts = self.impulses.contacts
            force = contacts.force[:n]
            pressure = self.impulses.rows.impulse[0 : 3 * n : 3]
            peak = self.impulses.peaks(n, self._pressed_before)
            self._reported = tuple(
                Contact(
                    *self._actor_and_link(other),
                    int(contacts.body[c]),
                    contacts.point[c].copy(),
                    -force[c],
                    float(contacts.gap[c]),
                    float(peak[c]),
                )
                for c, other in enumerate(contacts.other[:n].tolist())
                if pressure[c] > 0.0
            )
        return self._reported

    @property
    def contact_pairs(self) -> np.ndarray:
        """[k, 2] Pairs of awake trees that were in contact in the last step."""
        contacts = self.impulses.contacts
        of_plants = np.flatnonzero(contacts.other_body[: self.count] >= 0)
        return self.model.body_tree[np.stack([contacts.body[of_plants], contacts.other_body[of_plants]], -1)]

    @property
    def touched_trees(self) -> tuple[tuple[int, str], ...]:
        """Pairs (tree, actor) for each tree that the actor pressed on in the last step, sorted."""
        if self._touched is None:
            self._touched = tuple(sorted({(int(self.model.body_tree[c.body]), c.actor) for c in self.contacts}))
        return self._touched

    def _actor_and_link(self, other: int) -> tuple[str, str]:
        """Returns the actor and the link of a contact's second geom, ``other`` (negative: a capsule of a plant)."""
        if other < 0:
            return "plants", f"body/{self.capsules.body[-1 - other]}"
        assert self._rigid_arrays is not None
        return self._rigid_arrays.listed.actor[other], self._rigid_arrays.listed.link[other]

    @property
    def lying_bodies(self) -> np.ndarray:
        """Plant bodies [k] that pressed on the ground, a post, a wire or other static geoms in the last step; a body
        may be listed several times."""
        contacts = self.impulses.contacts
        other = contacts.other[: self.count]
        if self._rigid_arrays is None:
            return contacts.body[:0]
        presses = (other >= self._rigid_arrays.movable) & contacts.force[: self.count].any(1)
        return contacts.body[: self.count][presses]

    @property
    def geom_bodies(self) -> np.ndarray:
        """[geom] MuJoCo bodies of the geoms by which contacts of the last step refer to their other side."""
        return np.zeros(0, int) if self._rigid_arrays is None else self._rigid_arrays.listed.body

    # ------------------------------------------------------------------ queries and updates between steps

    def nearest_body(self, points: np.ndarray, max_distance: float) -> tuple[float, int] | None:
        """Returns the distance (m) from ``points`` [k, 3] m to the nearest plant body, and that body's index.

        None if no body is within ``max_distance`` (m). Searches all trees near the points; see
        :func:`vinesim.contact.plant_capsules.nearest_body`.
        """
        low = points.min(0) - max_distance
        high = points.max(0) + max_distance
        boxes = self.detection.tree_boxes
        trees = np.flatnonzero(((boxes.low <= high) & (low <= boxes.high)).all(1))
        if len(trees) == 0:
            return None
        self.plants.forward_kinematics(trees)
        return nearest_body(self.capsules, self.model, self.plants.state, trees, points, max_distance)

    def update_tree_bounds(self, trees: np.ndarray) -> None:
        """Compute the bounding boxes of the sleeping trees ``trees`` [k] again, after their bodies were moved."""
        self.detection.update_tree_bounds(trees)

    def leave_stump(self, segment: int, length: float) -> None:
        """Shorten the wood of a peduncle's segment to ``length`` [m]. It and the segments between it and the vine
        collide on, although their bunch has left."""
        shapes = self.capsules
        model = self.plants.model
        body = segment
        while body >= 0 and model.body_organ[body] == int(Organ.PEDUNCLE):
            shapes.bunch[shapes.body == body] = -1
            body = int(model.body_parent[body])
        self.detection.shorten(int(np.flatnonzero(shapes.body == segment)[0]), length)

    def divide_wood(self, segment: int) -> None:
        """Give each part of a segment that cuts have divided its own shape; see :class:`Stumps`."""
        plants = self.plants
        shapes = self.capsules
        parts = plants.stumps.parts_of(segment)
        pass_leaves(shapes, self.model, parts)
        of_wood = shapes.body[: shapes.tree_start[-1]]
        first = np.searchsorted(of_wood, [body for body, _, _ in parts]).tolist()
        last = first[-1]
        for (body, _, _), capsule in zip(parts[:-1], first[:-1], strict=True):
            if shapes.level[capsule] == HIDDEN:
                tied = bool(plants.ties.are_tied(np.array([body]))[0])
                self.detection.pass_ties(last, capsule, body, tied=tied)
        self.detection.divide(
            last, [(capsule, start, end) for capsule, (_, start, end) in zip(first, parts, strict=True)]
        )

    def hide_wood(self, spare: int) -> None:
        """Remove the shape of a body that is no stump any more."""
        self.capsules.level[self.capsules.body == spare] = HIDDEN
        self.detection.forget_clearances()

    def hide_leaves(self, capsules: np.ndarray) -> None:
        """Remove the shapes ``capsules`` [k] of leaves that were taken off; -1 for a leaf without one."""
        self.detection.remove_leaves(capsules[capsules >= 0])

    def ignore_overlaps(self, bunch: int, low: np.ndarray, high: np.ndarray) -> None:
        """Disable contacts of a picked bunch with the trees and fixed pieces that it overlaps; see
        :meth:`ContactDetection.ignore_overlaps` and :meth:`RigidWorld.ignore_overlaps`."""
        self.rigid.ignore_overlaps(bunch)
        self.detection.ignore_overlaps(bunch, low, high)

    def passed_by(self, bunch: int) -> tuple[int, ...]:
        """Returns the trees through which a free bunch passes since it was picked, sorted, and before them
        :data:`FIXED_PIECES` if it passes through fixed pieces."""
        fixed = (FIXED_PIECES,) if self.rigid.passes_fixed_pieces(bunch) else ()
        return *fixed, *self.detection.passed_by(bunch).tolist()

    def pass_through(self, bunch: int, passed: tuple[int, ...]) -> None:
        """Let a free bunch pass through the trees and fixed pieces ``passed``, as :meth:`passed_by` returned them on
        another client, while it overlaps them, and touch all others."""
        self.rigid.pass_fixed_pieces(bunch, passing=FIXED_PIECES in passed)
        self.detection.pass_through(bunch, np.array([tree for tree in passed if tree != FIXED_PIECES], int))

    def _update_rigid_world(self) -> None:
        """Read the rigid world again after an actor came or left, a hand opened or closed, or a bunch got a body."""
        previous = self._rigid_arrays
        if previous is not None and previous.world is self.rigid.mj_model:
            self._generation = self.rigid.generation
            self.impulses.renumber_geoms(previous.update(self.rigid, self.remote_actors))
            self.detection.update_rigid_geoms()
            return
        self._rigid_arrays = arrays = RigidArrays(self.rigid, self.remote_actors, self._kernel_parameters, previous)
        self._generation = self.rigid.generation
        self.detection.set_rigid_world(arrays)
        self.impulses.set_rigid_world(arrays, previous)
