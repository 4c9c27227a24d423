"""Canes that blades cut in a batch of worlds, and canes that break.

What is beyond a cut falls as a floating component of its tree, and the stump stays, as in a client. A cut takes one of
the tree's spare bodies (:mod:`vinesim.scene.spare_bodies`), so a tree can be cut as often as it has such bodies.
Everything happens on the device. The state on the host does not learn of the cuts, but ``Worlds.download`` copies the
changed rows of the trees (:data:`CHANGED_ROWS`) to the host.

What this leaves out: canes with leaves, and canes of trees that are tied, stop a blade. Of each tree a closing cuts one
cane. A short stump takes whole steps, however fast its first mode is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core import frames
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.plants import structs
from vinesim.kernels.worlds import cane_cuts as kernels
from vinesim.kernels.worlds.cutting import Canes, Cuts
from vinesim.kernels.worlds.free_bunches import PlantMasses
from vinesim.kernels.worlds.reset import restore_flags
from vinesim.plants.articulation_solver import ROCKING_TIME, ArticulationSolver
from vinesim.plants.segment_parts import CLAMPED, SHORTEST, own_share, rod_of
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.worlds.batch_contacts import BatchContacts

CHANGED_ROWS = ("body_parent", "body_root", "body_offset", "body_rest", "joint_stiffness", "joint_damping")
"""Arrays with a row for each body of the trees that cuts of canes change, beside masses."""
BREAKS = 2
"""Number of times that each tree can break under its load, at least. GUESSED"""


class CaneCuts:
    """The parts of the canes of all worlds.

    Args:
        plants: trees of all worlds.
        worlds: number of worlds.
        contacts: contacts of the trees.
        spares: number of spare bodies of each tree for stumps that blades leave; 0: no cane is cut.
        breaks: whether canes break under their load.
    """

    def __init__(
        self, plants: ArticulationSolver, worlds: int, contacts: BatchContacts, spares: int, *, breaks: bool
    ) -> None:
        self._plants = plants
        self._worlds = worlds
        self._contacts = contacts
        self._is_cut = contacts.is_cut
        self._spares = spares
        model = plants.model
        self.cuts = max(spares, BREAKS if breaks else 0)
        """Number of cuts and breaks that each tree can have."""
        self._canes = self._take_parts(model)
        if self.cuts:
            plants.let_kernels_cut(self.cuts)
            self.topology = self._take_topology()
            """What cuts change, for kernels."""

    @property
    def parts(self) -> tuple[Canes, wp.array]:
        """The parts of canes, and whether each body [body] has been cut off, for kernels."""
        return self._canes, self._is_cut

    def cut(self, cuts: Cuts, masses: PlantMasses, faults: wp.array, fault_count: wp.array) -> list[KernelLaunch]:
        """Returns the launches that make the cuts of canes in ``cuts``, at the end of a step. ``masses``: those of the
        trees. ``faults``, ``fault_count``: see :class:`~vinesim.worlds.bunch_pool.BunchPool`."""
        if not self._spares:
            return []
        given = [self._numbers(), self._whole_wood(), cuts]
        written = [self._canes, faults, fault_count, masses, self._contacts.capsules, self.topology, *self._state()]
        return [KernelLaunch(kernels.cut_canes, given, written, threads=self._worlds)]

    def part(self, breaks: wp.array, faults: wp.array, fault_count: wp.array) -> list[KernelLaunch]:
        """Returns the launches that part canes at the joints ``breaks`` bool [body], at the end of a step; see
        :meth:`cut`."""
        if not self.cuts:
            return []
        written = [faults, fault_count, self.topology, *self._state()]
        return [KernelLaunch(kernels.part_canes, [self._numbers(), breaks], written, threads=self._worlds)]

    def slow_lying_parts(self) -> list[KernelLaunch]:
        """Returns the launches that damp the rocking of cut pieces that lie on something, as a client does, after
        the integration of each step."""
        if not self.cuts:
            return []
        arrays = self._plants.launches.resident_arrays
        share = math.exp(-self._plants.dt / ROCKING_TIME)
        given = [share, self.cuts, self._worlds, self._contacts.geoms, arrays["body_root"], self.topology]
        given += self._contacts.lists()
        trees = len(self._plants.model.tree_first)
        return [KernelLaunch(kernels.slow_lying_parts, given, [arrays["joint_qd"]], threads=trees)]

    def _numbers(self) -> kernels.CaneNumbers:
        numbers = kernels.CaneNumbers()
        numbers.worlds = self._worlds
        numbers.trees = len(self._plants.model.tree_first)
        numbers.cuts = self.cuts
        numbers.spares = self._spares
        numbers.shortest = SHORTEST
        numbers.place_step = PLACE_STEP
        numbers.clamped = CLAMPED
        return numbers

    def _state(self) -> list[Any]:
        fill = self._plants.launches.fill_resident
        return [fill(structs.ArticulationModel), fill(structs.BodyState), fill(structs.JointState)]

    # ------------------------------------------------------------------ state, for resets

    def of_trees(self) -> list[tuple[wp.array, wp.array]]:
        """Returns the arrays that cuts of canes change with a row for each tree or body, and for each row the number of
        its tree; without flags."""
        if not self.cuts:
            return []
        arrays = self._plants.launches.resident_arrays
        trees = np.arange(len(self._plants.model.tree_first))
        rows = [arrays[name] for name in CHANGED_ROWS] + [
            getattr(self._canes, name) for name in ("segment", "start", "end")
        ]
        rows += [self.topology.grown, self.topology.kept]
        of_root = self._array(np.repeat(trees, self.cuts), wp.int32)
        return [
            *((row, arrays["body_tree"]) for row in rows),
            (self.topology.moving, self._array(trees, wp.int32)),
            (self.topology.budget, self._array(trees, wp.int32)),
            (self.topology.roots, of_root),
        ]

    def restore_flags(self, resets: wp.array) -> list[KernelLaunch]:
        """Returns the launches that give the flags of bodies their present values in the worlds ``resets`` bool
        [world]."""
        if not self.cuts:
            return []
        arrays = self._plants.launches.resident_arrays
        flags = (arrays["body_falls"], self.topology.branches, self.topology.is_cut)
        given = [self._worlds, resets, arrays["body_tree"]]
        return [
            KernelLaunch(restore_flags, [*given, wp.clone(flag)], [flag], threads=flag.shape[0], block=128)
            for flag in flags
        ]

    # ------------------------------------------------------------------ arrays

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._plants.buffers.device)

    def _by_place(self, values: np.ndarray, dtype: type, missing: float = 0) -> wp.array:
        """Returns an array with a row for each body in the order of the kernels' arrays."""
        buffers = self._plants.buffers
        there = np.full((buffers.slot_count, *values.shape[1:]), missing, values.dtype)
        there[buffers.slots] = values
        return self._array(there, dtype)

    def _can_be_cut(self, model: Model) -> np.ndarray:
        """Returns whether each body [body] is a piece of cane that can be cut."""
        is_cane = model.body_organ == int(Organ.CANE)
        is_cane[model.leaf_body] = False
        is_tied = np.zeros(len(model.tree_first), bool)
        is_tied[model.body_tree[model.tie_body]] = True
        return is_cane & ~is_tied[model.body_tree] & (self._spares > 0)

    def _take_parts(self, model: Model) -> Canes:
        slots = self._plants.buffers.slots.astype(np.int32)
        is_spare = model.is_spare()
        canes = Canes()
        canes.can_cut = self._by_place(self._can_be_cut(model).astype(np.int32), wp.int32)
        canes.length = self._by_place(model.body_length.astype(np.float32), float, 1)
        canes.segment = self._by_place(np.where(is_spare, np.int32(-1), slots), wp.int32, -1)
        canes.start = self._by_place(np.zeros(len(slots), np.float32), float)
        canes.end = self._by_place(np.where(is_spare, 0.0, model.body_length).astype(np.float32), float)
        return canes

    def _take_topology(self) -> kernels.Topology:
        arrays = self._plants.launches.resident_arrays
        topology = kernels.Topology()
        topology.moving = arrays["tree_moving"]
        topology.budget = arrays["tree_budget"]
        topology.roots = arrays["floating"][: self.cuts * len(self._plants.model.tree_first)]
        topology.branches = arrays["body_branches"]
        topology.is_cut = self._is_cut
        topology.grown = wp.clone(arrays["body_rest"])
        identity = np.tile(frames.IDENTITY, (len(topology.grown), 1)).astype(np.float32)
        topology.kept = self._array(identity, wp.quat)
        return topology

    def _whole_wood(self) -> kernels.WholeWood:
        model = self._plants.model
        arrays = self._plants.launches.resident_arrays
        slots = self._plants.buffers.slots
        count = len(model.body_mass)
        rod, end_mass, end, rest = np.zeros((4, count))
        second = np.zeros((count, 2))
        known: dict[bytes, tuple[float, float, float, float, np.ndarray]] = {}
        mass = np.column_stack([model.body_mass, model.body_com, model.body_inertia, model.body_length])
        for body in np.flatnonzero(self._can_be_cut(model)).tolist():
            key = mass[body].tobytes()
            if key not in known:
                found = rod_of(model, body)
                known[key] = found.mass, found.points[-1], found.places[-1], found.rest, found.second[1:]
            rod[body], end_mass[body], end[body], rest[body], second[body] = known[key]
        growth = np.full(count, np.inf, np.float32)
        grown = np.flatnonzero(model.body_parent >= 0)
        np.minimum.at(growth, model.body_parent[grown], model.body_offset[grown, 0])
        shapes = plant_capsules(model)
        of_wood = np.flatnonzero(shapes.bunch < 0)
        body = shapes.body[of_wood]
        capsule = np.full(count, -1, np.int32)
        capsule[body] = (of_wood - shapes.tree_start[model.body_tree[body]]) * len(model.tree_first)
        capsule[body] += model.body_tree[body]
        wood = kernels.WholeWood()
        wood.rod = self._by_place(rod, wp.float64)
        wood.end_mass = self._by_place(end_mass, wp.float64)
        wood.end = self._by_place(end, wp.float64)
        wood.rest = self._by_place(rest, wp.float64)
        wood.second = self._by_place(second, wp.vec2d)
        wood.com = self._by_place(model.body_com, wp.vec3)
        wood.drag = self._by_place(model.body_drag, float)
        wood.growth = self._by_place(growth, float)
        wood.share = self._by_place(own_share(model, np.arange(count)), wp.float64)
        wood.settled = self._by_place(frames.log(model.joint_settled.astype(float)), wp.vec3d)
        wood.offset = wp.clone(arrays["body_offset"])
        wood.rest_turn = wp.clone(arrays["body_rest"])
        wood.stiffness = wp.clone(arrays["joint_stiffness"])
        wood.damping = wp.clone(arrays["joint_damping"])
        wood.capsule = self._by_place(capsule, wp.int32, -1)
        wood.spare = self._array(slots[model.tree_first + model.tree_core - model.tree_spares], wp.int32)
        return wood
