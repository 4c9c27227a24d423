"""Return single worlds of a batch to their first states."""

import warp as wp

from vinesim.kernels.contact.structs import WarmStart
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})


@wp.kernel
def restore_bodies(
    # in
    worlds: int,
    resets: wp.array(dtype=wp.bool),
    body_tree: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=float),
    # out
    rows_out: wp.array2d(dtype=float),
):
    """One thread per number of an array with a row for each body. Copy the number from ``start`` if the body's world is
    reset. resets: [world]."""
    k, column = wp.tid()
    if resets[body_tree[k] % worlds]:
        rows_out[k, column] = start[k, column]


@wp.kernel
def restore_worlds(
    # in
    resets: wp.array(dtype=wp.bool),
    start: wp.array2d(dtype=float),
    # out
    rows_out: wp.array2d(dtype=float),
):
    """One thread per number of an array with a row for each world. Copy the number from ``start`` if the world is
    reset."""
    world, column = wp.tid()
    if resets[world]:
        rows_out[world, column] = start[world, column]


@wp.kernel
def forget_contacts(
    # in
    resets: wp.array(dtype=wp.bool),
    # out
    world_contacts_out: WorldContacts,
    warm_start_out: WarmStart,
):
    """One thread per world. Let the next step of a world that is reset begin without contacts of the last step."""
    world = wp.tid()
    if resets[world]:
        world_contacts_out.count[world] = 0
        warm_start_out.count[world] = 0
