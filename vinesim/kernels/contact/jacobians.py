"""Contact Jacobians, velocities along the rows without contacts, bias velocities, and initial guesses of the impulses.

A contact has three rows: normal n (from the other side to the plant) and two tangents. In each direction an implicit
spring and damper act. The stretch of the tangential spring is called *anchor*; it is the displacement since the contact
began to stick.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, velocity_at
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.structs import (
    CONTACTS,
    Candidates,
    Capsules,
    Contacts,
    Geoms,
    Parameters,
    PlantBodies,
    RigidBodies,
    RigidFactors,
    Rows,
    WarmStart,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def first_tangent(n: wp.vec3d):
    """Returns a unit vector perpendicular to n. It depends on n only."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    other = wp.vec3d(zero, one, zero)
    if wp.abs(n[0]) < wp.float64(0.7):
        other = wp.vec3d(one, zero, zero)
    return wp.normalize(wp.cross(n, other))


@wp.func
def write_plant_row(
    row: int, column: int, sign: wp.float64, axis: wp.vec3d, lever: wp.vec3d, jacobian_out: wp.array2d(dtype=wp.float64)
):
    """Write the six entries of one plant body in row ``row`` of the contact Jacobian, from column ``column`` on.

    ``axis``: unit vector along the row; ``lever`` [m]: from the body's origin to the contact point; ``sign``: 1 for the
    contact's first body, -1 for the other plant body.
    """
    moment = wp.cross(lever, axis)
    for k in range(3):
        jacobian_out[row, column + k] = sign * axis[k]
        jacobian_out[row, column + 3 + k] = sign * moment[k]


@wp.func
def write_rigid_rows(
    c: int, last_dof: int, axes: wp.mat33d, arm: wp.vec3d, rigid: RigidBodies, jacobian_out: wp.array2d(dtype=wp.vec3d)
):
    """Write the rigid Jacobian of a contact: velocities along the contact's axes of a point of the rigid body whose
    last degree of freedom is ``last_dof``.

    arm: [m] vector from the centre of mass of the body's kinematic tree to the point. Returns the point's free
    velocities along the axes.
    """
    velocity = wp.vec3d()
    dof = int(last_dof)
    while dof >= 0:
        angular = wp.vec3d(rigid.cdof[dof, 0], rigid.cdof[dof, 1], rigid.cdof[dof, 2])
        linear = wp.vec3d(rigid.cdof[dof, 3], rigid.cdof[dof, 4], rigid.cdof[dof, 5])
        entry = axes * (linear + wp.cross(angular, arm))
        jacobian_out[c, dof] = entry
        velocity = velocity + entry * rigid.velocity_free[dof]
        dof = rigid.dof_parent[dof]
    return velocity


@wp.func
def with_wire(surface: Surface, wire_stiffness: wp.float64, parameters: Parameters):
    """Returns the surface of a contact, with a wire's spring [N/m] in series with the contact's spring."""
    one = wp.float64(1.0)
    surface.stiffness = one / (one / surface.stiffness + one / wire_stiffness)
    surface.damping = parameters.wire_damping_time * surface.stiffness
    surface.compliance = one / (parameters.dt * (surface.stiffness * parameters.dt + surface.damping))
    return surface


@wp.func
def with_petiole(surface: Surface, petiole_stiffness: wp.float64, dt: wp.float64):
    """Returns the surface of a contact with a leaf, which gives way by its petiole [N/m]. The time constant of the
    contact's damping stays."""
    surface.damping = surface.damping * petiole_stiffness / surface.stiffness
    surface.stiffness = petiole_stiffness
    surface.compliance = wp.float64(1.0) / (dt * (surface.stiffness * dt + surface.damping))
    return surface


@wp.func
def write_bias(
    c: int,
    parameters: Parameters,
    end_gap: wp.float64,
    is_limited: bool,
    contacts: Contacts,
    warm_start: WarmStart,
    rows_out: Rows,
):
    """Write the bias velocities and the initial guess of the impulses of one contact.

    The spring of an open contact exerts no force before the gap is closed within the step. The limit on the speed of
    separation (``is_limited``) does not apply to the springs of wires and petioles.
    """
    feature = contacts.feature[c]
    other = contacts.other[c]
    axes = contacts.axes[c]
    stiffness = contacts.surface[c].stiffness
    share = stiffness * parameters.dt + contacts.surface[c].damping
    if end_gap > wp.float64(0.0):
        rows_out.bias[3 * c] = end_gap / parameters.dt
    else:
        rows_out.bias[3 * c] = end_gap * stiffness / share
        if is_limited:
            rows_out.bias[3 * c] = wp.max(rows_out.bias[3 * c], -parameters.max_separation_speed)
    t1 = wp.vec3d(axes[1, 0], axes[1, 1], axes[1, 2])
    t2 = wp.vec3d(axes[2, 0], axes[2, 1], axes[2, 2])
    count = warm_start.count[0]
    middle = wp.min(c, count - 1)
    looked = int(0)
    while looked < 2 * count:  # a contact of the last step has a similar place in the list
        step = (looked + 1) // 2
        k = middle + wp.where(looked % 2 == 1, step, -step)
        looked = looked + 1
        if k >= 0 and k < count and warm_start.feature[k] == feature and warm_start.other[k] == other:
            looked = 2 * count
            rows_out.impulse[3 * c] = warm_start.normal_impulse[k]
            rows_out.impulse[3 * c + 1] = wp.dot(t1, warm_start.friction_impulse[k])
            rows_out.impulse[3 * c + 2] = wp.dot(t2, warm_start.friction_impulse[k])
            rows_out.bias[3 * c + 1] = wp.dot(t1, warm_start.anchor[k]) * stiffness / share
            rows_out.bias[3 * c + 2] = wp.dot(t2, warm_start.anchor[k]) * stiffness / share


@wp.func
def write_rows(
    c: int,
    tree_row: int,
    slot: int,
    parameters: Parameters,
    pairs: wp.array2d(dtype=Surface),
    capsules: Capsules,
    geoms: Geoms,
    bodies: PlantBodies,
    rigid: RigidBodies,
    candidates: Candidates,
    warm_start: WarmStart,
    contacts_out: Contacts,
    rows_out: Rows,
):
    """Write the three rows of contact ``c``. ``tree_row``, ``slot``: index of the contact's candidate in the table of
    candidates [awake tree, slot].
    """
    g = contacts_out.other[c]
    n = candidates.normal[tree_row, slot]
    x = candidates.point[tree_row, slot]
    t1 = first_tangent(n)
    t2 = wp.cross(n, t1)
    contacts_out.gap[c] = candidates.gap[tree_row, slot]
    contacts_out.point[c] = x
    contacts_out.axes[c] = wp.matrix_from_rows(n, t1, t2)
    body = contacts_out.body[c]
    lever = x - to_double(wp.transform_get_translation(bodies.q[body]))
    velocity = velocity_at(bodies.q[body], bodies.qd_free[body], x)
    capsule = contacts_out.feature[c] // 2
    material = capsules.material[capsule]
    petiole = capsules.stiffness[capsule]
    other = contacts_out.other_body[c]
    other_lever = lever
    last_dof = int(-1)
    arm = lever
    if g >= 0:
        surface = pairs[material, geoms.material[g]]
        if geoms.friction[g] > wp.float64(0.0):
            surface.friction = geoms.friction[g]
        if contacts_out.wire_stiffness[c] > wp.float64(0.0):
            surface = with_wire(surface, contacts_out.wire_stiffness[c], parameters)
        if petiole > wp.float64(0.0):
            surface = with_petiole(surface, petiole, parameters.dt)
        contacts_out.surface[c] = surface
        last_dof = geoms.dof[g]
        arm = x - rigid.subtree_com[geoms.root[g]]
    else:
        contacts_out.surface[c] = pairs[material, capsules.material[-1 - g]]
        other_lever = x - to_double(wp.transform_get_translation(bodies.q[other]))
        velocity = velocity - velocity_at(bodies.q[other], bodies.qd_free[other], x)

    rigid_velocity = write_rigid_rows(c, last_dof, contacts_out.axes[c], arm, rigid, rows_out.rigid_jacobian)
    for r in range(3):
        axis = n
        if r == 1:
            axis = t1
        if r == 2:
            axis = t2
        row = 3 * c + r
        write_plant_row(row, 0, wp.float64(1.0), axis, lever, rows_out.plant_jacobian)
        if g < 0:
            write_plant_row(row, 6, wp.float64(-1.0), axis, other_lever, rows_out.plant_jacobian)
        rows_out.velocity_free[row] = wp.dot(axis, velocity) - rigid_velocity[r]
        rows_out.bias[row] = wp.float64(0.0)
        rows_out.impulse[row] = wp.float64(0.0)
    end_gap = candidates.end_gap[tree_row, slot] + contacts_out.wire_shift[c]
    is_limited = contacts_out.wire_stiffness[c] == wp.float64(0.0) and petiole == wp.float64(0.0)
    write_bias(c, parameters, end_gap, is_limited, contacts_out, warm_start, rows_out)


@wp.func
def write_rows_of_contact(
    c: int,
    parameters: Parameters,
    pairs: wp.array2d(dtype=Surface),
    capsules: Capsules,
    geoms: Geoms,
    bodies: PlantBodies,
    rigid: RigidBodies,
    factors: RigidFactors,
    candidates: Candidates,
    warm_start: WarmStart,
    spans_out: wp.array(dtype=wp.vec2i),
    contacts_out: Contacts,
    rows_out: Rows,
):
    """Write the three rows of contact ``c``, and set to zero the entries of its rigid rows that the last step wrote."""
    slots = candidates.feature.shape[1]
    span = spans_out[c]
    for dof in range(span[0], span[1]):
        rows_out.rigid_jacobian[c, dof] = wp.vec3d()
        rows_out.rigid_response[c, dof] = wp.vec3d()
    spans_out[c] = wp.vec2i(0, 0)
    g = contacts_out.other[c]
    if g >= 0:
        last_dof = geoms.dof[g]
        if last_dof >= 0:
            tree = rigid.dof_tree[last_dof]
            spans_out[c] = wp.vec2i(factors.tree_dof[tree], factors.tree_dof[tree] + factors.tree_dof_count[tree])
    write_rows(
        c,
        contacts_out.source[c] // slots,
        contacts_out.source[c] % slots,
        parameters,
        pairs,
        capsules,
        geoms,
        bodies,
        rigid,
        candidates,
        warm_start,
        contacts_out,
        rows_out,
    )


@wp.kernel
def write_contact_rows(
    # model
    threads: int,
    parameters: Parameters,
    pairs: wp.array2d(dtype=Surface),
    capsules: Capsules,
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    bodies: PlantBodies,
    rigid: RigidBodies,
    factors: RigidFactors,
    candidates: Candidates,
    warm_start: WarmStart,
    # out
    spans_out: wp.array(dtype=wp.vec2i),
    contacts_out: Contacts,
    rows_out: Rows,
):
    """Write the three rows of each contact. Thread i takes the contacts i, i + threads, i + 2 threads ...

    spans_out: [contact] range of degrees of freedom in which its rows of the rigid Jacobian and of the rigid response
    are not 0. Entries outside of it are not written.
    """
    for c in range(wp.tid(), counters[CONTACTS], threads):
        write_rows_of_contact(
            c,
            parameters,
            pairs,
            capsules,
            geoms,
            bodies,
            rigid,
            factors,
            candidates,
            warm_start,
            spans_out,
            contacts_out,
            rows_out,
        )


@wp.func
def row_vector(row: int, column: int, jacobian: wp.array2d(dtype=wp.float64)):
    """Returns the entries ``column`` to ``column`` + 2 of a row of the Jacobian, in single precision."""
    return wp.vec3(
        wp.float32(jacobian[row, column]), wp.float32(jacobian[row, column + 1]), wp.float32(jacobian[row, column + 2])
    )


@wp.func
def row_columns(c: int, column: int, jacobian: wp.array2d(dtype=wp.float64)):
    """Returns a matrix with three entries, from ``column`` on, of each of the three rows of a contact. Each row becomes
    a column of the matrix."""
    return wp.matrix_from_cols(
        row_vector(3 * c, column, jacobian),
        row_vector(3 * c + 1, column, jacobian),
        row_vector(3 * c + 2, column, jacobian),
    )
