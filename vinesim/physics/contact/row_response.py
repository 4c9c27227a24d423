"""How impulses along the rows of contacts move the plants in contact: computed where the plants are."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.articulation.structs import ArticulationModel, Factors
from vinesim.kernels.contact import row_response
from vinesim.kernels.launch import BoundLaunch, join_partitions
from vinesim.physics.contact.warp_arrays import share, zeros
from vinesim.physics.plants.articulation_solver import ArticulationSolver

SIDES_PER_CHUNK = 16
"""Sides of contacts that a thread takes at a time: work of 5 us."""


class RowResponse:
    """Response of the plants to unit impulses along the rows of up to so many contacts.

    The device of the plants reaches ``jacobian`` [row, 12], the lists ``body`` and ``tree_start`` [slot] of the plant
    bodies in contact, and ``body_slot`` and ``other_slot`` [contact], which the contact kernels fill.
    """

    def __init__(self, plants: ArticulationSolver, contacts: int) -> None:
        self.plants, buffers = plants, plants.buffers
        self.jacobian = buffers.pinned(np.zeros((3 * contacts, 12)))
        self.body, self.tree_start = (buffers.pinned(np.zeros(2 * contacts + 1, np.int32)) for _ in range(2))
        self.body_slot, self.other_slot = (buffers.pinned(np.zeros(contacts, np.int32)) for _ in range(2))
        self.sides = row_response.SideRows()
        """See :class:`vinesim.kernels.contact.row_response.SideRows`; for kernels on the CPU."""
        there = row_response.SideRows()
        size, matrix = buffers.max_tree_size, wp.mat33
        for name, shape in {"force": (), "moment": (), "linear": (size,), "angular": (size,)}.items():
            data = buffers.pinned(zeros(matrix, (2 * contacts, *shape)))
            setattr(self.sides, name, share(data, matrix))
            setattr(there, name, buffers.reach(data, matrix, name))
        lists = (self.body, self.tree_start, self.body_slot, self.other_slot)
        arrays = (
            wp.array(np.arange(2 * contacts), dtype=wp.int32, device=buffers.device),
            *(buffers.reach(data, wp.int32, "list of responses") for data in lists),
            buffers.reach(self.jacobian, wp.float64, "jacobian"),
            plants.launches.fill(Factors),
        )
        slots, pool = wp.array(buffers.slots, dtype=wp.int32, device=buffers.device), plants.launch_pool

        def bind(scratch_rows: int) -> BoundLaunch:
            scratch = row_response.ResponseScratch()
            for name in row_response.ResponseScratch.vars:
                setattr(scratch, name, wp.empty(scratch_rows * size, dtype=matrix, device=buffers.device))
            return plants.launches.record(
                row_response.respond_to_sides, plants.launches.fill(ArticulationModel), size, scratch_rows, slots,
                *arrays, scratch, there, index_list="items",
            )  # fmt: skip

        launches = [bind(1 if buffers.device.is_cpu else 2 * contacts) for _ in range(pool.size)]
        self._respond = pool.share([join_partitions(launches)], SIDES_PER_CHUNK)

    def compute(self, contacts: int) -> None:
        """Fill :attr:`sides` of the first ``contacts``; all touch trees of the last prediction, and belong to it."""
        self._respond(2 * contacts)
        self.plants.buffers.synchronize()
