"""Wood that gives under its load in a batch of worlds: peduncles that break, canes that keep a set and break."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.interaction.breaking import PATIENCE, cane_law, strengths, wood_kinds
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.plants import structs, wood_stress
from vinesim.kernels.worlds import overload as kernels
from vinesim.kernels.worlds.cane_cuts import Topology
from vinesim.kernels.worlds.cutting import Cuts, Wood
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.segment_parts import SHORTEST
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.strength import stalk_ends


class Overload:
    """Lets canes of all worlds keep a set, and finds peduncles and canes that break under their load, as
    :class:`vinesim.interaction.breaking.WoodMonitor` does in a client.

    Args:
        plants: trees of all worlds.
        worlds: number of worlds.
        parameters: numbers of the physics.
        wood: shapes of the plants' bodies.
        topology: what cuts of canes change.
    """

    def __init__(
        self,
        plants: ArticulationSolver,
        worlds: int,
        parameters: PhysicsParameters,
        wood: Wood,
        topology: Topology,
    ) -> None:
        self._plants = plants
        self._worlds = worlds
        self._parameters = parameters
        self._wood = wood
        model = plants.model
        self._ends = stalk_ends(model)
        bunches = len(model.bunch_body)
        slots = plants.buffers.slot_count
        self._watch = self._zeros(wp.int32, len(model.tree_first))
        self._topology = topology
        self._law = self._take_law()
        self._given = kernels.GivenWood()
        self._given.flow = self._zeros(float, slots)
        self._given.capacity = self._array(np.maximum(self._law.yields.numpy(), 1e-6).astype(np.float32), float)
        self._given.stress = self._zeros(wp.vec2, slots)
        self._given.breaks = self.breaks = self._zeros(wp.bool, slots)
        """[body] Whether the joint of a cane has broken in this step."""
        self._load_time = self._zeros(float, bunches)
        self._used = self._zeros(float, bunches)

    def _zeros(self, dtype: type, count: int) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self._plants.buffers.device)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._plants.buffers.device)

    def find(self, cuts: Cuts, is_free: wp.array) -> list[KernelLaunch]:
        """Returns the launches that let canes give, and write peduncles that break to ``cuts``, after an integration.
        ``is_free`` [bunch]: 1 if a bunch has left its vine."""
        launches = self._plants.launches
        fill = launches.fill_resident
        arrays = launches.resident_arrays
        model = self._plants.model
        trees = len(model.tree_first)
        every = [self._array(np.array([trees]), wp.int32), self._array(np.arange(trees), wp.int32)]
        held = self._zeros(wp.bool, trees)
        given = [launches.parameters, fill(structs.ArticulationModel), self._strengths(), self._given.capacity, *every]
        given += [arrays["phi_used"], arrays["tree_steps"], fill(structs.AppliedForces), fill(structs.BodyState)]
        given += [arrays["body_acceleration"], fill(structs.JointState), arrays["tree_rate"], held]
        given += [max(1, round(PATIENCE / self._plants.dt))]
        written = [self._watch, arrays["subtree_wrench"], self._given.stress, self._zeros(float, 3)]
        stress = KernelLaunch(wood_stress.find_stress, given, written, threads=trees)
        ends = self._array(self._plants.buffers.slots[self._ends], wp.vec2i)
        duration = self._parameters.detachment_duration
        given = [self._plants.dt, duration, self._worlds, trees, self._wood, ends, SHORTEST, is_free]
        given += [self._watch, self._given.stress]
        written = [self._load_time, self._used, cuts]
        count = KernelLaunch(kernels.count_loads, given, written, threads=self._worlds)
        given = [self._law, self._watch, arrays["phi_used"]]
        state = [fill(structs.ArticulationModel), fill(structs.JointState)]
        bend = KernelLaunch(kernels.bend_canes, given, [self._given, self._topology, *state], threads=trees)
        return [stress, count, bend]

    def _by_place(self, values: np.ndarray) -> wp.array:
        """Returns an array with a number for each body in the order of the kernels' arrays."""
        buffers = self._plants.buffers
        there = np.zeros(buffers.slot_count, values.dtype)
        there[buffers.slots] = values
        return self._array(there, wp.dtype_from_numpy(values.dtype))

    def _take_law(self) -> kernels.CaneLaw:
        model = self._plants.model
        found = kernels.CaneLaw()
        found.kind = self._by_place(wood_kinds(model, self._ends))
        bending = cane_law(model)
        for name in ("yields", "breaks", "hardening", "cracking"):
            setattr(found, name, self._by_place(np.asarray(getattr(bending, name), float)))
        return found

    def _strengths(self) -> wood_stress.WoodStrength:
        pull, bend = strengths(self._plants.model, self._ends)
        wood = wood_stress.WoodStrength()
        wood.kind = self._law.kind
        wood.pull = self._by_place(pull)
        wood.bend = self._by_place(bend)
        for name in ("tie_slip", "tie_strength", "tie_axis"):
            setattr(wood, name, self._plants.buffers.arrays[name])
        return wood

    def of_trees(self) -> list[tuple[wp.array, wp.array]]:
        """Returns the arrays that change with a row for each tree, body or bunch, and for each row the number of its
        tree."""
        model = self._plants.model
        of_bunch = self._array(model.body_tree[model.bunch_body], wp.int32)
        of_tree = self._array(np.arange(len(model.tree_first)), wp.int32)
        of_body = self._plants.launches.resident_arrays["body_tree"]
        given = [(row, of_body) for row in (self._given.flow, self._given.capacity, self._given.stress)]
        return [(self._watch, of_tree), (self._load_time, of_bunch), (self._used, of_bunch), *given]
