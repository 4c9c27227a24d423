"""Peduncles that break under their load in a batch of worlds."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.interaction.breaking import PATIENCE, wood_kinds
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.plants import structs, wood_stress
from vinesim.kernels.worlds.cutting import Cuts, Wood
from vinesim.kernels.worlds.overload import count_loads
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.segment_parts import SHORTEST
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.strength import stalk_ends


class Overload:
    """Finds the peduncles of all worlds that break under their load, as
    :class:`vinesim.interaction.breaking.WoodMonitor` does in a client. Canes do not break.

    Args:
        plants: trees of all worlds.
        worlds: number of worlds.
        parameters: numbers of the physics.
        wood: shapes of the plants' bodies.
    """

    def __init__(self, plants: ArticulationSolver, worlds: int, parameters: PhysicsParameters, wood: Wood) -> None:
        self._plants = plants
        self._worlds = worlds
        self._parameters = parameters
        self._wood = wood
        model = plants.model
        self._ends = stalk_ends(model)
        bunches = len(model.bunch_body)
        slots = plants.buffers.slot_count
        self._watch = self._zeros(wp.int32, len(model.tree_first))
        self._stress = self._zeros(wp.vec2, slots)
        self._load_time = self._zeros(float, bunches)
        self._used = self._zeros(float, bunches)

    def _zeros(self, dtype: type, count: int) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self._plants.buffers.device)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._plants.buffers.device)

    def find(self, cuts: Cuts, is_free: wp.array) -> list[KernelLaunch]:
        """Returns the launches that write the peduncles that break to ``cuts``, after an integration. ``is_free``
        [bunch]: 1 if a bunch has left its vine."""
        launches = self._plants.launches
        fill = launches.fill_resident
        arrays = launches.resident_arrays
        model = self._plants.model
        trees = len(model.tree_first)
        every = [self._array(np.array([trees]), wp.int32), self._array(np.arange(trees), wp.int32)]
        held = self._zeros(wp.bool, trees)
        capacity = wp.full(self._plants.buffers.slot_count, np.inf, dtype=float, device=self._plants.buffers.device)
        given = [launches.parameters, fill(structs.ArticulationModel), self._strengths(), capacity, *every]
        given += [arrays["phi_used"], arrays["tree_steps"], fill(structs.AppliedForces), fill(structs.BodyState)]
        given += [arrays["body_acceleration"], fill(structs.JointState), arrays["tree_rate"], held]
        given += [max(1, round(PATIENCE / self._plants.dt))]
        written = [self._watch, arrays["subtree_wrench"], self._stress, self._zeros(float, 3)]
        stress = KernelLaunch(wood_stress.find_stress, given, written, threads=trees)
        ends = self._array(self._plants.buffers.slots[self._ends], wp.vec2i)
        duration = self._parameters.detachment_duration
        given = [self._plants.dt, duration, self._worlds, trees, self._wood, ends, SHORTEST, is_free]
        given += [self._watch, self._stress]
        written = [self._load_time, self._used, cuts]
        return [stress, KernelLaunch(count_loads, given, written, threads=self._worlds)]

    def _strengths(self) -> wood_stress.WoodStrength:
        model = self._plants.model
        buffers = self._plants.buffers
        kind = wood_kinds(model, self._ends)
        kind[kind == int(wood_stress.CANE)] = int(wood_stress.NO_WOOD)
        pull, bend = np.ones((2, len(kind)), np.float32)
        for end in self._ends.T:
            pull[end] = model.bunch_pull
            bend[end] = model.bunch_bend
        wood = wood_stress.WoodStrength()
        for name, values in (("kind", kind), ("pull", pull), ("bend", bend)):
            there = np.zeros(buffers.slot_count, values.dtype)
            there[buffers.slots] = values
            setattr(wood, name, self._array(there, wp.dtype_from_numpy(values.dtype)))
        for name in ("tie_slip", "tie_strength", "tie_axis"):
            setattr(wood, name, buffers.arrays[name])
        return wood

    def of_trees(self) -> list[tuple[wp.array, wp.array]]:
        """Returns the arrays that change with a row for each tree or bunch, and for each row the number of its
        tree."""
        model = self._plants.model
        of_bunch = self._array(model.body_tree[model.bunch_body], wp.int32)
        of_tree = self._array(np.arange(len(model.tree_first)), wp.int32)
        return [(self._watch, of_tree), (self._load_time, of_bunch), (self._used, of_bunch)]
