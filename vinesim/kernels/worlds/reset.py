"""Faults of single worlds of a batch, and their return to their first states."""

import warp as wp

from vinesim.kernels.contact.structs import RigidBodies, WarmStart
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})


MOTION = wp.constant(1)
"""Fault: a number of the state is not finite, or a rate is too high."""
ROOM = wp.constant(2)
"""Fault: contacts were left out because there was no room for them."""
BUNCHES = wp.constant(4)
"""Fault: a bunch that was cut off hangs on, because no body of the pool was free."""
STUMPS = wp.constant(8)
"""Fault: a cane that was cut hangs on, because its tree has no spare body left for a stump."""
NO_ROOM = wp.constant(15)
"""mujoco_warp's overflow flags NEFC, NJMAX_NNZ, BROADPHASE and NARROWPHASE."""


@wp.kernel
def find_faults(
    # model
    max_rate: float,
    fault_rate: float,
    # in
    worlds: int,
    tree_rate: wp.array(dtype=float),
    qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float),
    overflow: wp.array(dtype=wp.int32),
    world_contacts: WorldContacts,
    # out
    dropped_before_out: wp.array(dtype=wp.int32),
    faults_out: wp.array(dtype=wp.int32),
    fault_count_out: wp.array(dtype=wp.int32),
):
    """One thread per world. Add the faults of the last step to the world's faults.

    max_rate: largest rate of rigid bodies [m/s, rad/s]. fault_rate: largest rate of trees [rad/s]. overflow: [world]
    mujoco_warp's flags. dropped_before: [world] number of dropped contacts that is known. faults: [world] sum of
    :data:`MOTION`, :data:`ROOM`, :data:`BUNCHES` and :data:`STUMPS`. fault_count: [world] number of times that a world without faults got one.
    """
    world = wp.tid()
    moves_wrongly = bool(False)
    for tree in range(world, tree_rate.shape[0], worlds):
        moves_wrongly = moves_wrongly or not tree_rate[tree] <= fault_rate
    for k in range(qpos.shape[1]):
        moves_wrongly = moves_wrongly or not wp.isfinite(qpos[world, k])
    for k in range(qvel.shape[1]):
        moves_wrongly = moves_wrongly or not wp.abs(qvel[world, k]) <= max_rate
    dropped = world_contacts.dropped[world]
    lacks_room = dropped > dropped_before_out[world] or (overflow[world] & NO_ROOM) != 0
    dropped_before_out[world] = dropped
    before = faults_out[world]
    faults = before
    if moves_wrongly:
        faults = faults | MOTION
    if lacks_room:
        faults = faults | ROOM
    faults_out[world] = faults
    if before == 0 and faults != 0:
        fault_count_out[world] = fault_count_out[world] + 1


@wp.kernel
def restore_rows(
    # in
    worlds: int,
    resets: wp.array(dtype=wp.bool),
    tree: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=float),
    # out
    rows_out: wp.array2d(dtype=float),
):
    """One thread per number of an array with a row for each body or tree. Copy the number from ``start`` if the row's
    world is reset. resets: [world]. tree: [row] tree that the row belongs to."""
    k, column = wp.tid()
    if resets[tree[k] % worlds]:
        rows_out[k, column] = start[k, column]


@wp.kernel
def restore_flags(
    # in
    worlds: int,
    resets: wp.array(dtype=wp.bool),
    tree: wp.array(dtype=wp.int32),
    start: wp.array(dtype=wp.bool),
    # out
    flags_out: wp.array(dtype=wp.bool),
):
    """One thread per flag of an array with a flag for each body. Copy it from ``start`` if its world is reset. resets:
    [world]. tree: [flag] tree that it belongs to."""
    k = wp.tid()
    if resets[tree[k] % worlds]:
        flags_out[k] = start[k]


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
    worlds: int,
    dofs: int,
    resets: wp.array(dtype=wp.bool),
    # out
    world_contacts_out: WorldContacts,
    warm_start_out: WarmStart,
    was_in_contact_out: wp.array(dtype=wp.bool),
    rigid_out: RigidBodies,
):
    """One thread per world. Let the next step of a world that is reset begin without contacts of the last step.

    dofs: number of degrees of freedom of a world's rigid bodies. was_in_contact: [tree].
    """
    world = wp.tid()
    if resets[world]:
        world_contacts_out.count[world] = 0
        warm_start_out.count[world] = 0
        for tree in range(world, was_in_contact_out.shape[0], worlds):
            was_in_contact_out[tree] = False
        for dof in range(world * dofs, (world + 1) * dofs):
            rigid_out.velocity_free[dof] = wp.float64(0.0)
            rigid_out.correction[dof] = wp.float64(0.0)
            rigid_out.correction_before[dof] = wp.float64(0.0)


@wp.kernel
def forget_faults(
    # in
    resets: wp.array(dtype=wp.bool),
    # out
    overflow_out: wp.array(dtype=wp.int32),
    faults_out: wp.array(dtype=wp.int32),
):
    """One thread per world. Clear the faults of a world that is reset."""
    world = wp.tid()
    if resets[world]:
        overflow_out[world] = 0
        faults_out[world] = 0
