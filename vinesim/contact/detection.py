"""Collision detection of plants: bounding boxes, the trees near actors, and candidate contacts.

The stages of a step: :meth:`ContactDetection.find_near_trees` (broadphase of actors and all trees), then, with the
prediction of the plants known, :meth:`ContactDetection.find_reached_trees` (sleeping trees that awake trees touch) and
:attr:`ContactDetection.narrowphase` (contacts of the awake trees). Each stage is a graph of kernels
(:mod:`vinesim.kernels.graph`), made again when an array is allocated again.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.contact.collision_arrays import PlantArrays, RigidArrays
from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.contact import (
    broadphase,
    leaves,
    narrowphase_plants,
    narrowphase_rigid,
    sleeping_trees,
    structs,
    sweep_order,
)
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.collision_geoms import PLANE_HALF_SIZE
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.wires.deflected_wires import DeflectedWires

AABB_BLOCK = int(structs.AABB_BLOCK)
MAX_PASSING_BUNCHES = 4
"""Number of picked bunches that can pass through one tree at the same time. Further bunches collide with the tree at
once."""
PAIRS_AT_ONCE = 64
"""Number of capsule-geom pairs of one tree that the narrowphase handles in one pass."""
MIN_TREE_ROOM = 64
"""Smallest capacity [awake trees] of the candidate arrays. The arrays grow when more trees are awake."""
_NO_TREES = np.zeros(0, np.intp)

_NOWHERE = np.array([0.0, 0.0, 1e6], np.float32)
"""[3] m, place in a body's frame that nothing touches."""


class ContactDetection:
    """Finds the trees near actors, and the contacts of awake trees with rigid geoms, with each other and with
    themselves."""

    def __init__(
        self,
        plants: ArticulationSolver,
        arrays: PlantArrays,
        parameters: PhysicsParameters,
        kernel_parameters: structs.Parameters,
    ) -> None:
        self.plants = plants
        self.arrays = arrays
        self.parameters = parameters
        self._kernel_parameters = kernel_parameters
        trees = len(arrays.trees.is_fine)
        self._sorted_rows = np.zeros((2, trees), np.int32)
        self._is_near = np.zeros(trees, np.bool_)
        self._is_reached = np.zeros(trees, np.bool_)
        self._clearances = SharedArrays.zeros(structs.Clearances, len(arrays.capsules.body))
        self._passing = np.full((trees, MAX_PASSING_BUNCHES), -1, np.int32)
        self.counters = plants.buffers.pinned(np.zeros(structs.COUNTERS, np.int32))
        """[COUNTERS] Counts that the kernels write. :mod:`vinesim.kernels.contact.structs` names the entries."""
        self.tree_boxes = SharedArrays.zeros(structs.Aabbs, trees)
        self._wood_boxes = SharedArrays.zeros(structs.Aabbs, trees)
        blocks = -(-trees // AABB_BLOCK)
        self._blocks = np.zeros(blocks, np.int32)
        self._block_boxes = SharedArrays.zeros(structs.Aabbs, blocks)
        self._listed: np.ndarray | None = None
        """[k] Trees in the kernels' lists of awake trees. None after other trees were written to these lists."""
        self.slots = np.arange(parameters.max_contacts_per_tree)
        self._room = 0

    def set_rigid_world(self, rigid_arrays: RigidArrays) -> None:
        """Use the geoms of a rigid world that was recompiled."""
        self.rigid_arrays = rigid_arrays
        self._static_bounded = False
        self._static_blocks = SharedArrays.zeros(structs.Aabbs, -(-rigid_arrays.static // AABB_BLOCK))
        self._actor_boxes = SharedArrays.zeros(structs.Aabbs, len(rigid_arrays.actors.is_remote))
        self._passing_bunches = SharedArrays(
            structs.PassingBunches, by_tree=self._passing, of_geom=rigid_arrays.bunch_of_geom
        )
        self._allocate_candidates(max(self._room, MIN_TREE_ROOM))

    def update_rigid_geoms(self) -> None:
        """Compute the boxes of static geoms again, because the rigid world has renumbered its geoms."""
        self._static_bounded = False

    def _allocate_candidates(self, trees: int) -> None:
        """Allocate the candidate arrays for ``trees`` awake trees, and make the graphs of the kernels on them."""
        self._room, slots = trees, len(self.slots)
        static = min(self.rigid_arrays.static, self.parameters.max_static_geoms_per_tree)
        near = self.rigid_arrays.capacity - self.rigid_arrays.static + static
        self.candidates = SharedArrays.zeros(
            structs.Candidates,
            trees,
            slots,
            count=np.zeros(trees, np.int32),
            is_impact=np.zeros(trees, np.bool_),
            near_geoms=np.zeros((trees, near), np.int32),
            skipped_geoms=np.zeros(trees, np.int32),
            near_pairs=np.zeros((trees * PAIRS_AT_ONCE, 2), np.int32),
        )
        self._make_graphs()

    # ------------------------------------------------------------------ broadphase

    def update_tree_bounds(self, trees: np.ndarray) -> None:
        """Compute the bounding boxes of ``trees`` [k], and of the blocks of trees that contain them, from the present
        poses of the bodies.
        """
        self._list(trees)
        self._listed = None
        self.counters[structs.SEARCHING_TREES] = 0
        self._find_reached_trees(len(trees))
        self.forget_clearances()

    def _list(self, trees: np.ndarray) -> None:
        """Write ``trees`` [k], and the blocks of trees that contain them, into the lists that the kernels read."""
        blocks = np.unique(trees // AABB_BLOCK)
        self.arrays.trees.awake[: len(trees)], self._blocks[: len(blocks)] = trees, blocks
        self.counters[structs.AWAKE_TREES] = len(trees)
        self.counters[structs.CHANGED_BLOCKS] = len(blocks)

    def forget_clearances(self) -> None:
        """Make the next step compare all capsules of awake trees with those of sleeping trees.

        Otherwise, a capsule is skipped until it has moved by its clearance, the distance that it could move without
        touching a sleeping tree when it was last compared.
        """
        self._clearances.distance[:] = -1.0

    def find_near_trees(self) -> np.ndarray:
        """Returns the trees [k] whose bounding box a geom of an actor overlaps within the step."""
        if not self._static_bounded:
            self._bound_static_geoms()
        self.counters[structs.NEAR_ASLEEP] = 0
        self._find_near_trees()
        return self._is_near.nonzero()[0]

    def move_wires(self, pieces: np.ndarray, wires: DeflectedWires) -> None:
        """Move the geoms of the wire pieces ``pieces`` [k] to the deflected positions of these pieces."""
        if not self._static_bounded:
            self._bound_static_geoms()
        arrays = self.rigid_arrays
        states = self.rigid_arrays.geom_states
        boxes = self._static_blocks
        geoms = arrays.geom_of_wire[pieces]
        ends = np.stack([wires.start[pieces], wires.end[pieces]], 1) + wires.offset[pieces]
        states.offset[geoms] = wires.offset[pieces].mean(1)
        states.center[geoms] = ends.mean(1)
        # the wire may return to its undeflected position within the step
        states.speed[geoms] = np.sqrt((wires.offset[pieces] ** 2).sum(2).max(1)) / self.parameters.dt
        grown = (arrays.geoms.size[geoms, 0] + self.parameters.contact_margin)[:, None]
        states.low[geoms] = ends.min(1) - grown
        states.high[geoms] = ends.max(1) + grown
        block = (geoms - arrays.movable) // AABB_BLOCK
        np.minimum.at(boxes.low, block, states.low[geoms])
        np.maximum.at(boxes.high, block, states.high[geoms])

    def _bound_static_geoms(self) -> None:
        """Compute the bounding boxes of the blocks of static geoms. The ground's box has no lower end."""
        self._bound_all_geoms()
        first = self.rigid_arrays.movable
        states = self.rigid_arrays.geom_states
        boxes = self._static_blocks
        states.offset[:] = 0.0  # move_wires() follows
        ground = np.flatnonzero(self.rigid_arrays.geoms.kind[first:] == 0) + first
        states.low[ground, 2] = -PLANE_HALF_SIZE
        for block in range(len(boxes.low)):
            of = slice(first + AABB_BLOCK * block, first + AABB_BLOCK * (block + 1))
            boxes.low[block] = states.low[of].min(0)
            boxes.high[block] = states.high[of].max(0)
        self._static_bounded = True

    # ------------------------------------------------------------------ narrowphase

    def shorten(self, capsule: int, length: float) -> None:
        """Move the end of a capsule along its axis, so that it lies ``length`` [m] from its body's origin."""
        shapes = self.arrays.capsules
        share = length / float(shapes.local_end[capsule, 0])
        shapes.rest_end[capsule] = shapes.rest_start[capsule] + share * (
            shapes.rest_end[capsule] - shapes.rest_start[capsule]
        )
        shapes.local_end[capsule] *= share
        shapes.extent[capsule] = length + shapes.radius[capsule]
        self.forget_clearances()

    def remove_leaves(self, capsules: np.ndarray) -> None:
        """Move the capsules [k] of leaves out of everybody's reach."""
        shapes = self.arrays.capsules
        shapes.local_start[capsules] = shapes.local_end[capsules] = _NOWHERE

    def divide(self, capsule: int, parts: list[tuple[int, float, float]]) -> None:
        """Divide the capsule of a piece of wood: each of ``parts`` is a capsule, which may be hidden, and the distances
        [m] of its ends from the origin of the body, on the axis of ``capsule``."""
        shapes = self.arrays.capsules
        axis = shapes.local_end[capsule] - shapes.local_start[capsule]
        length = float(axis[0])
        way = (shapes.rest_end[capsule] - shapes.rest_start[capsule]) / length
        rest = shapes.rest_start[capsule] - way * float(shapes.local_start[capsule, 0])
        for part, start, end in parts:
            shapes.local_start[part] = (start / length) * axis
            shapes.local_end[part] = (end / length) * axis
            shapes.rest_start[part] = rest + start * way
            shapes.rest_end[part] = rest + end * way
            shapes.radius[part] = shapes.radius[capsule]
            shapes.material[part] = shapes.material[capsule]
            shapes.extent[part] = end + shapes.radius[part]
            shapes.level[part] = shapes.level[capsule]
        self.forget_clearances()

    def pass_ties(self, capsule: int, stump: int, joint: int, *, tied: bool) -> None:
        """Let a stump pass the wires that the piece of wood passed to which it belonged.

        Args:
            capsule: capsule of the piece.
            stump: capsule of the stump.
            joint: body of the stump, which has the piece's joint now.
            tied: whether the piece's own ties hold the stump now.
        """
        shapes = self.arrays.capsules
        geom = shapes.tied_geom
        at = shapes.tied_joint
        body = int(shapes.body[capsule])
        own = at[capsule] < 0
        above = at[capsule] == body
        geom[stump] = np.where(above | (own & tied), geom[capsule], -1)
        at[stump] = np.where(above, joint, -1)
        geom[capsule, own & tied] = -1

    def ignore_overlaps(self, bunch: int, low: np.ndarray, high: np.ndarray) -> None:
        """Disable the contacts of a picked bunch with the trees that it overlaps, until it no longer overlaps them.

        The bunch was picked within the box ``low`` [3] to ``high`` [3] m. While it hung there, its overlap with these
        trees was no contact.
        """
        self.pass_through(bunch, np.flatnonzero(((self.tree_boxes.low <= high) & (low <= self.tree_boxes.high)).all(1)))

    def pass_through(self, bunch: int, trees: np.ndarray) -> None:
        """Disable the contacts of a picked bunch with ``trees`` [k] until it no longer overlaps them, and enable its
        contacts with all others."""
        self._passing[self._passing == bunch] = -1
        room = self._passing[trees] < 0
        trees = trees[room.any(1)]
        room = room[room.any(1)]
        self._passing[trees, room.argmax(1)] = bunch

    def passed_by(self, bunch: int) -> np.ndarray:
        """Returns the trees [k] through which a picked bunch passes, sorted."""
        return np.flatnonzero((self._passing == bunch).any(1))

    def find_reached_trees(self, awake: np.ndarray, among_plants: bool) -> np.ndarray:
        """Compute the boxes of the awake trees [k] over their predicted motion, and find the sleeping trees that the
        awake trees touch.

        Returns the sleeping trees [j] that the awake trees touch now or will touch before the step ends; no trees
        unless plants can touch each other (``among_plants``).
        """
        if awake is not self._listed:
            self._list(awake)
            self._listed = awake
            if len(awake) > self._room:
                self._allocate_candidates(2 * len(awake))
        count = len(awake)
        sleep = among_plants and len(awake) < len(self._is_reached)
        self.counters[structs.PAIRED_TREES] = count if among_plants else 0
        # a tree that falls asleep calls forget_clearances()
        self.counters[structs.SEARCHING_TREES] = count if sleep else 0
        self._find_reached_trees(count)
        if not sleep:
            return _NO_TREES
        reached = self._is_reached.nonzero()[0]
        self._is_reached[reached] = False
        return reached

    def deepest(self, trees: int, count: int) -> np.ndarray:
        """Returns the ``count`` candidates with the smallest gap, as indices row * slots + slot in ascending order."""
        found = np.flatnonzero(self.slots < self.candidates.count[:trees, None])
        return np.sort(found[np.argsort(self.candidates.gap.ravel()[found], kind="stable")[:count]])

    # ------------------------------------------------------------------ graphs

    def _make_graphs(self) -> None:
        """Make the graphs of all stages, bound to the present arrays."""
        parameters = self._kernel_parameters
        plants = self.arrays
        rigid = self.rigid_arrays
        trees = plants.trees.struct
        bodies = plants.bodies.struct
        capsules = plants.capsules.struct
        capsule_states = plants.capsule_states.struct
        geoms = rigid.geoms.struct
        geom_states = rigid.geom_states.struct
        actors = rigid.actors.struct
        tree_boxes = self.tree_boxes.struct
        wood_boxes = self._wood_boxes.struct
        actor_boxes = self._actor_boxes.struct
        block_boxes = self._block_boxes.struct
        candidates = self.candidates.struct
        counters = share(self.counters, wp.int32)
        movable, listed = (geoms.count[k : k + 1] for k in range(2))
        most_movable = rigid.capacity - rigid.static

        def bound_geoms(count: wp.array, most: int) -> KernelLaunch:
            given = [parameters, geoms, count, rigid.bodies.struct]
            return KernelLaunch(broadphase.geom_aabbs, given, [geom_states], threads=most)

        mark_near_leaves: tuple[KernelLaunch, ...] = ()
        find_leaf_contacts: tuple[KernelLaunch, ...] = ()
        if plants.leaves is not None:
            mark_near_leaves = (
                KernelLaunch(
                    leaves.mark_trees_with_near_leaves,
                    [
                        parameters,
                        actors,
                        capsules,
                        plants.leaves,
                        trees,
                        bodies,
                        block_boxes,
                        tree_boxes,
                        actor_boxes,
                        geom_states,
                    ],
                    [share(self._is_near, wp.bool), counters],
                    threads=len(self._blocks),
                ),
            )
            find_leaf_contacts = (
                KernelLaunch(
                    leaves.find_leaf_contacts,
                    [
                        1,
                        parameters,
                        capsules,
                        plants.leaves,
                        geoms,
                        counters,
                        trees,
                        tree_boxes,
                        bodies,
                        rigid.bodies.struct,
                        rigid.hulls.struct,
                        geom_states,
                    ],
                    [capsule_states, candidates],
                    threads=1,
                ),
            )
        self._bound_all_geoms = KernelGraph(bound_geoms(listed, rigid.capacity))
        self._find_near_trees = KernelGraph(
            rigid.take_free_velocities,
            bound_geoms(movable, most_movable),
            KernelLaunch(
                broadphase.actor_aabbs,
                [actors, geoms, rigid.bodies.struct, geom_states],
                [actor_boxes],
                threads=most_movable,
            ),
            KernelLaunch(
                broadphase.mark_near_trees,
                [actors, capsules, trees, capsule_states, block_boxes, tree_boxes, actor_boxes, geom_states],
                [share(self._is_near, wp.bool), counters],
                threads=len(self._blocks),
            ),
            *mark_near_leaves,
        )
        # without the boxes of blocks, actors near a tree that was dragged out of its block would be missed
        self._find_reached_trees = KernelGraph(
            KernelLaunch(
                broadphase.tree_aabbs,
                [parameters, capsules, counters, trees, bodies],
                [capsule_states, wood_boxes, tree_boxes],
            ),
            KernelLaunch(broadphase.block_aabbs, [counters, share(self._blocks, wp.int32), tree_boxes], [block_boxes]),
            KernelLaunch(
                sleeping_trees.find_reached_trees,
                [parameters, capsules, counters, trees, block_boxes, tree_boxes, bodies, capsule_states],
                [self._clearances.struct, share(self._is_reached, wp.bool)],
            ),
        )
        sorted_rows, scratch = (share(rows, wp.int32) for rows in self._sorted_rows)
        self.narrowphase = (
            KernelLaunch(
                narrowphase_rigid.find_rigid_contacts,
                [
                    1,
                    parameters,
                    self.parameters.max_static_geoms_per_tree,
                    capsules,
                    geoms,
                    counters,
                    trees,
                    tree_boxes,
                    bodies,
                    capsule_states,
                    rigid.bodies.struct,
                    rigid.hulls.struct,
                    geom_states,
                    self._static_blocks.struct,
                ],
                [self._passing_bunches.struct, candidates],
                threads=1,
            ),
            KernelLaunch(
                sweep_order.sort_awake_trees, [trees, tree_boxes], [counters, sorted_rows, scratch], threads=1
            ),
            KernelLaunch(
                narrowphase_plants.find_plant_contacts,
                [
                    parameters,
                    capsules,
                    sorted_rows,
                    counters,
                    trees,
                    tree_boxes,
                    wood_boxes,
                    bodies,
                    capsule_states,
                ],
                [candidates],
            ),
            *find_leaf_contacts,
        )
        """Launches that fill ``candidates`` for the listed awake trees."""
