"""How impulses along the rows of contacts move the plants in contact, computed on the device that holds the plants."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import SharedArrays
from vinesim.kernels.contact import row_response
from vinesim.kernels.contact.structs import SideGroups
from vinesim.kernels.launch import BoundLaunch, bound, join_partitions
from vinesim.kernels.plants.structs import ArticulationModel, Factors
from vinesim.plants.articulation_solver import ArticulationSolver

NUMBERS_PER_CONTACT = 256
"""Number of response values for each contact for which there is room at first. The room grows when more are needed."""
GROUPS_PER_CHUNK = 2
"""Number of groups of contact sides that a thread takes at a time: 4 us of work."""
ROWS_ON_A_GPU = 256
"""Number of groups that a GPU works on at once."""


class RowResponse:
    """Response of the plants to unit impulses along the rows of contacts, up to a fixed number of contacts.

    The contact kernels fill ``jacobian`` [row, 12], the lists ``body`` and ``tree_end`` [slot] of the plant bodies in
    contact, ``body_slot`` and ``other_slot`` [contact], and ``groups`` of sides. The device that holds the plants can
    read all of these.
    """

    def __init__(self, plants: ArticulationSolver, contacts: int) -> None:
        self.plants = plants
        buffers = plants.buffers
        self.jacobian = buffers.pinned(np.zeros((3 * contacts, 12)))
        self.body, self.tree_end = (buffers.pinned(np.zeros(2 * contacts + 1, np.int32)) for _ in range(2))
        self.body_slot, self.other_slot = (buffers.pinned(np.zeros(contacts, np.int32)) for _ in range(2))
        lists = {name: buffers.pinned(np.zeros(2 * contacts + 1, np.int32)) for name in SideGroups.vars}
        self.groups = SharedArrays(SideGroups, **lists)
        self._contacts = contacts
        self._there = SideGroups()
        for name, data in lists.items():
            setattr(self._there, name, buffers.reach(data, wp.int32, name))
        self.numbers = np.zeros(0, np.float32)
        """Response of each group; see :class:`vinesim.kernels.contact.structs.SideGroups`."""
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
        given = [
            buffers.reach(data, wp.int32, "list of responses")
            for data in (self.body, self.tree_end, self.body_slot, self.other_slot)
        ]
        items = wp.array(np.arange(2 * self._contacts), dtype=wp.int32, device=buffers.device)
        slots = wp.array(buffers.slots, dtype=wp.int32, device=buffers.device)
        size = buffers.max_tree_size
        jacobian = buffers.reach(self.jacobian, wp.float64, "jacobian")
        numbers = buffers.reach(self.numbers, wp.float32, "response")
        self._rows = 1 if buffers.device.is_cpu else ROWS_ON_A_GPU

        def bind() -> BoundLaunch:
            scratch = row_response.ResponseScratch()
            scratch.is_on_path = wp.empty(self._rows * size, dtype=wp.bool, device=buffers.device)
            scratch.values = wp.empty(
                self._rows * size * row_response.BODY_NUMBERS, dtype=wp.float32, device=buffers.device
            )
            return plants.launches.record(
                row_response.respond_to_groups,
                plants.launches.fill(ArticulationModel),
                size,
                self._rows,
                slots,
                items,
                *given,
                jacobian,
                self._there,
                plants.launches.fill(Factors),
                scratch,
                numbers,
                index_list="items",
            )

        pool = plants.launch_pool
        respond = pool.share([join_partitions([bind() for _ in range(pool.size)])], GROUPS_PER_CHUNK)

        def respond_in_parts(groups: int, first: int = 0, partition: int = 0) -> None:
            for start in range(first, first + groups, self._rows):
                respond(min(self._rows, first + groups - start), start)
            buffers.synchronize()

        self.launch = respond if buffers.device.is_cpu else bound(respond_in_parts)
        """Launch that fills :attr:`numbers` for groups. All groups must touch trees of the last prediction."""
