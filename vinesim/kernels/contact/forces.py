"""Results of the contact solve: contact forces, wrenches on plant bodies, and the warm start of the next step."""

import warp as wp

from vinesim.kernels.contact.island_system import IslandSystem, contact_velocity, three
from vinesim.kernels.contact.structs import (
    BODIES,
    CONTACTS,
    ISLANDS,
    UNFINISHED,
    Contacts,
    Islands,
    Parameters,
    Rows,
    WarmStart,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def store_contact(
    c: int,
    slip_u: wp.float64,
    slip_v: wp.float64,
    parameters: Parameters,
    impulses: wp.array(dtype=wp.float64),
    contacts_out: Contacts,
    warm_start_out: WarmStart,
):
    """Write the impulse of contact ``c`` as a force on the plant, and the warm start of the next step.

    slip_u, slip_v: [m/s] velocities along the contact's tangents with all impulses.
    """
    n = 3 * c
    axes = contacts_out.axes[c]
    t1 = wp.vec3d(axes[1, 0], axes[1, 1], axes[1, 2])
    t2 = wp.vec3d(axes[2, 0], axes[2, 1], axes[2, 2])
    impulse = wp.vec3d(impulses[n], impulses[n + 1], impulses[n + 2])
    contacts_out.force[c] = wp.transpose(axes) * impulse / parameters.dt
    # the stretch at which spring and damper exert exactly this friction: a sliding contact drags its anchor along
    surface = contacts_out.surface[c]
    force_u = impulse[1] / parameters.dt + surface.damping * slip_u
    force_v = impulse[2] / parameters.dt + surface.damping * slip_v
    anchor = -force_u / surface.stiffness * t1
    anchor = anchor - force_v / surface.stiffness * t2
    friction = impulse[1] * t1 + impulse[2] * t2
    if impulse[0] <= wp.float64(0.0):  # an open contact starts from zero, but the next step looks for it
        anchor = wp.vec3d()
        friction = wp.vec3d()
    warm_start_out.feature[c] = contacts_out.feature[c]
    warm_start_out.other[c] = contacts_out.other[c]
    warm_start_out.normal_impulse[c] = wp.max(impulse[0], wp.float64(0.0))
    warm_start_out.friction_impulse[c] = friction
    warm_start_out.anchor[c] = anchor


@wp.kernel
def store_warm_start(
    # model
    parameters: Parameters,
    # in
    counters: wp.array(dtype=wp.int32),
    islands: Islands,
    system: IslandSystem,
    rows: Rows,
    # out
    contacts_out: Contacts,
    warm_start_out: WarmStart,
):
    """One thread per contact. Write its impulse as a force on the plant, and the warm start of the next step."""
    c = wp.tid()
    if c >= counters[CONTACTS]:
        return
    velocity = three(3 * c, rows.velocity_free) + contact_velocity(
        contacts_out.place[c], contacts_out.block[c], contacts_out.island[c], islands, rows.delassus, system
    )
    store_contact(c, velocity[1], velocity[2], parameters, rows.impulse, contacts_out, warm_start_out)


@wp.kernel
def count_unfinished(
    # model
    most_sweeps: int,
    # in
    islands: Islands,
    # out
    counters_out: wp.array(dtype=wp.int32),
):
    """One thread in all. Count the islands of contacts whose solve took ``most_sweeps`` sweeps, so that their impulses
    may be outside the tolerance.
    """
    unfinished = int(0)
    for island in range(counters_out[ISLANDS]):
        if islands.sweeps[island] >= most_sweeps:
            unfinished = unfinished + 1
    counters_out[UNFINISHED] = unfinished


@wp.kernel
def accumulate_wrenches(
    # model
    parameters: Parameters,
    # in
    counters: wp.array(dtype=wp.int32),
    contacts: Contacts,
    rows: Rows,
    # out
    wrench_out: wp.array2d(dtype=wp.float64),
):
    """One thread in all. Sum the wrenches [N, N m] of all contacts on each plant body in contact."""
    for body in range(counters[BODIES]):
        for k in range(6):
            wrench_out[body, k] = wp.float64(0.0)
    for row in range(3 * counters[CONTACTS]):
        c = row // 3
        force = rows.impulse[row] / parameters.dt
        body = contacts.body_slot[c]
        for k in range(6):
            wrench_out[body, k] = wrench_out[body, k] + force * rows.plant_jacobian[row, k]
        if contacts.other[c] < 0:
            other = contacts.other_slot[c]
            for k in range(6):
                wrench_out[other, k] = wrench_out[other, k] + force * rows.plant_jacobian[row, 6 + k]
