"""Velocity changes of plants by impulses along the rows of contacts, computed on the CPU or GPU that holds the plants'
arrays."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import SharedArrays, struct_fields
from vinesim.kernels.contact import row_response
from vinesim.kernels.contact.structs import SideGroups
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.plants.structs import ArticulationModel, Factors
from vinesim.plants.articulation_solver import ArticulationSolver

NUMBERS_PER_CONTACT = 256
"""Initial capacity for response values, per contact. It grows when more are needed."""
ROWS_ON_A_GPU = 256
"""Number of GPU threads. Each thread computes the response to one group of contact sides at a time."""


class RowResponse:
    """Response of the plants to unit impulses along the rows of contacts, up to a fixed number of contacts.

    The contact kernels fill ``jacobian`` [row, 12], the lists ``body`` and ``tree_end`` [slot] of the plant bodies in
    contact (slot: index in these lists), ``body_slot`` and ``other_slot`` [contact], and ``groups`` of contact sides.
    The device that holds the plants can read all of these arrays.
    """

    def __init__(self, plants: ArticulationSolver, contacts: int, counters: np.ndarray) -> None:
        """``contacts``: largest number of contacts. ``counters`` [COUNTERS] holds the number of groups."""
        self.plants = plants
        buffers = plants.buffers
        self.jacobian = buffers.pinned(np.zeros((3 * contacts, 12)))
        self.body, self.tree_end = (buffers.pinned(np.zeros(2 * contacts + 1, np.int32)) for _ in range(2))
        self.body_slot, self.other_slot = (buffers.pinned(np.zeros(contacts, np.int32)) for _ in range(2))
        lists = {name: buffers.pinned(np.zeros(2 * contacts + 1, np.int32)) for name in struct_fields(SideGroups)}
        self.groups = SharedArrays(SideGroups, **lists)
        self._counters = counters
        self._there = SideGroups()
        for name, data in lists.items():
            setattr(self._there, name, buffers.reach(data, wp.int32, name))
        self.numbers = np.zeros(0, np.float32)
        """Values of the responses to all groups of contact sides; see
        :class:`vinesim.kernels.contact.structs.SideGroups`.
        """
        self.make_room(NUMBERS_PER_CONTACT * contacts)

    def make_room(self, numbers: int) -> bool:
        """Make room for ``numbers`` response values. Returns whether the array had to be allocated again."""
        if numbers <= len(self.numbers):
            return False
        self.numbers = self.plants.buffers.pinned(np.zeros(2 * numbers, np.float32))
        self._bind()
        return True

    def _bind(self) -> None:
        plants = self.plants
        buffers = self.plants.buffers
        device = buffers.device
        counters, *given = (
            buffers.reach(data, wp.int32, "list of responses")
            for data in (self._counters, self.body, self.tree_end, self.body_slot, self.other_slot)
        )
        size = buffers.max_tree_size
        threads = 1 if device.is_cpu else ROWS_ON_A_GPU
        scratch = row_response.ResponseScratch()
        scratch.is_on_path = wp.empty(threads * size, dtype=wp.bool, device=device)
        scratch.values = wp.empty(threads * size * row_response.BODY_NUMBERS, dtype=wp.float32, device=device)
        self.launch = KernelLaunch(
            row_response.respond_to_groups,
            [
                plants.launches.fill(ArticulationModel),
                size,
                threads,
                wp.array(buffers.slots, dtype=wp.int32, device=device),
                counters,
                *given,
                buffers.reach(self.jacobian, wp.float64, "jacobian"),
                self._there,
                plants.launches.fill(Factors),
            ],
            [scratch, buffers.reach(self.numbers, wp.float32, "response")],
            threads=threads,
        )
        """Launch that fills :attr:`numbers` for all groups. All bodies must be of trees that were in the last
        prediction."""
