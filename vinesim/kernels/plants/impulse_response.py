"""Impulse response: velocity changes of bodies by unit impulses, and the effect of given wrenches on a prediction.

Both reuse the factors of :mod:`vinesim.kernels.plants.prediction`: an impulse travels inward along the path to the
root, the velocities it causes travel outward (Featherstone 2008, section 7.3, with forces only at the touched
bodies).
"""

import warp as wp

from vinesim.kernels.plants.structs import (
    ArticulationModel,
    BodyState,
    Factors,
    Prediction,
    ResponseColumns,
    Scratch,
    WrenchScratch,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def propagate_impulses_inward(
    body: int,
    first: int,
    last: int,
    shift: int,
    model: ArticulationModel,
    factors: Factors,
    columns_out: ResponseColumns,
):
    """Propagate three unit forces and three unit moments at a body along the path from the body to the root. Entries of
    bodies off this path are 0."""
    zero = wp.mat33()
    force_f = wp.identity(n=3, dtype=float)
    force_m = wp.mat33()
    moment_f = wp.mat33()
    moment_m = wp.identity(n=3, dtype=float)
    path = int(body)
    for i in range((last - first) / model.pitch + 1):
        k = last - i * model.pitch
        columns_out.alpha_by_force[shift + k] = zero
        columns_out.alpha_by_moment[shift + k] = zero
        columns_out.a_by_force[shift + k] = zero
        columns_out.a_by_moment[shift + k] = zero
        if k == path:
            columns_out.alpha_by_force[shift + k] = factors.D[k] * moment_f
            columns_out.alpha_by_moment[shift + k] = factors.D[k] * moment_m
            DJt = wp.transpose(factors.DJ[k])
            DHt = wp.transpose(factors.DH[k])
            arm = wp.skew(factors.lever[k])
            force_f = force_f - DHt * moment_f
            force_m = force_m - DHt * moment_m
            moment_f = moment_f - DJt * moment_f + arm * force_f
            moment_m = moment_m - DJt * moment_m + arm * force_m
            path = model.body_parent[k]
            if path < 0:
                columns_out.a_by_force[shift + k] = factors.root_inverse_mass[k] * force_f
                columns_out.a_by_moment[shift + k] = factors.root_inverse_mass[k] * force_m


@wp.func
def propagate_velocities_outward(
    first: int, last: int, shift: int, model: ArticulationModel, factors: Factors, columns_out: ResponseColumns
):
    """Compute the velocities of all bodies, from the root to ``last``, from the impulses that each joint transmits."""
    for k in range(first, last + 1, model.pitch):
        parent = model.body_parent[k]
        a_f = columns_out.a_by_force[shift + k]
        a_m = columns_out.a_by_moment[shift + k]
        alpha_f = wp.mat33()
        alpha_m = wp.mat33()
        if parent >= 0:
            arm = wp.skew(factors.lever[k])
            alpha_f = columns_out.alpha_by_force[shift + parent]
            alpha_m = columns_out.alpha_by_moment[shift + parent]
            a_f = columns_out.a_by_force[shift + parent] - arm * alpha_f
            a_m = columns_out.a_by_moment[shift + parent] - arm * alpha_m
        columns_out.a_by_force[shift + k] = a_f
        columns_out.a_by_moment[shift + k] = a_m
        columns_out.alpha_by_force[shift + k] = (
            alpha_f + columns_out.alpha_by_force[shift + k] - factors.DJ[k] * alpha_f - factors.DH[k] * a_f
        )
        columns_out.alpha_by_moment[shift + k] = (
            alpha_m + columns_out.alpha_by_moment[shift + k] - factors.DJ[k] * alpha_m - factors.DH[k] * a_m
        )


@wp.kernel
def impulse_response(
    # model
    model: ArticulationModel,
    stride: int,
    # in
    count: wp.array(dtype=wp.int32),
    bodies: wp.array(dtype=wp.int32),
    factors: Factors,
    # out
    columns_out: ResponseColumns,
    response_out: wp.array4d(dtype=float),
):
    """One thread per listed body. Apply six unit impulses to the body, and write the velocities of the listed bodies of
    its tree up to itself.

    bodies: [thread] index of the body; bodies of one tree are adjacent in the list. response_out: [u, 6, t, 6] velocity
    of body u of the list by a unit impulse wrench on the t-th listed body of its tree, linear before angular, in 1/kg,
    1/(kg m), 1/(kg m^2). Each thread writes its columns and, because the matrix is symmetric, their transposes.
    columns_out: [thread * stride + body of the tree] scratch; ``stride`` is the extent of the largest tree.
    """
    slot = wp.tid()
    if slot >= count[0]:
        return
    body = bodies[slot]
    tree = model.body_tree[body]
    first = model.tree_first[tree]
    shift = slot * stride - first  # scratch of this thread: one entry for each body of the tree
    start = int(slot)  # the first slot of the tree
    last = int(body)
    while start > 0 and model.body_tree[bodies[wp.max(start - 1, 0)]] == tree:
        start = start - 1
        last = wp.max(last, bodies[start])
    propagate_impulses_inward(body, first, last, shift, model, factors, columns_out)
    propagate_velocities_outward(first, last, shift, model, factors, columns_out)
    column = slot - start
    for other in range(start, slot + 1):
        place = shift + bodies[other]
        a_f = columns_out.a_by_force[place]
        a_m = columns_out.a_by_moment[place]
        alpha_f = columns_out.alpha_by_force[place]
        alpha_m = columns_out.alpha_by_moment[place]
        if other == slot:  # symmetric except for rounding errors
            a_f = 0.5 * (a_f + wp.transpose(a_f))
            alpha_m = 0.5 * (alpha_m + wp.transpose(alpha_m))
            a_m = 0.5 * (a_m + wp.transpose(alpha_f))
            alpha_f = wp.transpose(a_m)
        for r in range(3):
            for c in range(3):
                response_out[other, r, column, c] = a_f[r, c]
                response_out[other, r, column, 3 + c] = a_m[r, c]
                response_out[other, 3 + r, column, c] = alpha_f[r, c]
                response_out[other, 3 + r, column, 3 + c] = alpha_m[r, c]
                response_out[slot, c, other - start, r] = a_f[r, c]
                response_out[slot, 3 + c, other - start, r] = a_m[r, c]
                response_out[slot, c, other - start, 3 + r] = alpha_f[r, c]
                response_out[slot, 3 + c, other - start, 3 + r] = alpha_m[r, c]


@wp.func
def apply_tree_wrenches(
    tree: int,
    dt: float,
    model: ArticulationModel,
    body_wrench: wp.array(dtype=wp.spatial_vector),
    factors: Factors,
    work_out: WrenchScratch,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """Add the effect over a step of the wrenches on a tree's bodies to its prediction; see :func:`apply_wrenches`."""
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    for k in range(first, first + size * model.pitch, model.pitch):
        work_out.subtree_wrench[k] = body_wrench[k]
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        parent = model.body_parent[k]
        wrench = work_out.subtree_wrench[k]
        moment = wp.spatial_bottom(wrench)
        scratch_out.Du[k] = factors.D[k] * moment
        if parent >= 0:
            force = wp.spatial_top(wrench) - wp.transpose(factors.DH[k]) * moment
            moment = moment - wp.transpose(factors.DJ[k]) * moment + wp.cross(factors.lever[k], force)
            work_out.subtree_wrench[parent] = work_out.subtree_wrench[parent] + wp.spatial_vector(force, moment)
    for k in range(first, first + size * model.pitch, model.pitch):
        parent = model.body_parent[k]
        above = wp.spatial_vector()
        if parent >= 0:
            above = work_out.added_acceleration[parent]
        elif model.body_root[k] >= 0:
            wrench = work_out.subtree_wrench[k]
            force = wp.spatial_top(wrench) - wp.transpose(factors.DH[k]) * wp.spatial_bottom(wrench)
            above = wp.spatial_vector(factors.root_inverse_mass[k] * force, wp.vec3())
            prediction_out.joint_xd_free[k] = prediction_out.joint_xd_free[k] + dt * (
                factors.root_inverse_mass[k] * force
            )
        alpha = wp.spatial_bottom(above)
        a = wp.spatial_top(above) + wp.cross(alpha, factors.lever[k])
        relative = scratch_out.Du[k] - factors.DJ[k] * alpha - factors.DH[k] * a
        work_out.added_acceleration[k] = wp.spatial_vector(a, alpha + relative)
        prediction_out.body_acceleration[k] = prediction_out.body_acceleration[k] + work_out.added_acceleration[k]
        prediction_out.joint_qd_free[k] = prediction_out.joint_qd_free[k] + dt * wp.quat_rotate_inv(
            factors.axes[k], relative
        )


@wp.kernel
def apply_wrenches(
    # model
    dt: float,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    factors: Factors,
    # out
    work_out: WrenchScratch,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread per tree. Add the effect over a step of the wrenches on its bodies to its prediction.

    trees: [thread] index of the tree. body_wrench: [body] N, N m at the origin, world axes; with dt = 1 it is an
    impulse, N s, N m s. prediction_out: accelerations and joint rates are increased; ``body_qd_free`` is not. work_out,
    scratch_out.Du: scratch.
    """
    if wp.tid() >= count[0]:
        return
    apply_tree_wrenches(trees[wp.tid()], dt, model, body_wrench, factors, work_out, scratch_out, prediction_out)


@wp.kernel
def respond_to_blows(
    # model
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    blow_bodies: wp.array(dtype=wp.int32),
    blow_points: wp.array(dtype=wp.vec3),
    blow_axes: wp.array(dtype=wp.vec3),
    bodies: BodyState,
    factors: Factors,
    # out
    work_out: WrenchScratch,
    scratch_out: Scratch,
    response_out: wp.array2d(dtype=float),
):
    """One thread in all. Apply a unit impulse to a point of a body along an axis, blow by blow, and write the velocities
    of all these points along their axes.

    count: [1] number of blows. blow_bodies: [blow] body. blow_points: [blow] m, in the world. blow_axes: [blow] unit
    vector. response_out: [blow, struck] 1/kg, velocity at ``blow`` by an impulse at ``struck``; 0 between trees.
    work_out, scratch_out.Du: scratch.
    """
    for struck in range(count[0]):
        body = blow_bodies[struck]
        tree = model.body_tree[body]
        first = model.tree_first[tree]
        last = int(body)
        for blow in range(count[0]):
            if model.body_tree[blow_bodies[blow]] == tree:
                last = wp.max(last, blow_bodies[blow])
        for k in range(first, last + 1, model.pitch):
            scratch_out.Du[k] = wp.vec3()
            work_out.subtree_wrench[k] = wp.spatial_vector()
        force = wp.vec3(blow_axes[struck])
        moment = wp.cross(blow_points[struck] - wp.transform_get_translation(bodies.body_q[body]), force)
        path = int(body)
        while path >= 0:
            scratch_out.Du[path] = factors.D[path] * moment
            force = force - wp.transpose(factors.DH[path]) * moment
            moment = moment - wp.transpose(factors.DJ[path]) * moment + wp.cross(factors.lever[path], force)
            work_out.subtree_wrench[path] = wp.spatial_vector(force, moment)
            path = model.body_parent[path]
        for k in range(first, last + 1, model.pitch):
            parent = model.body_parent[k]
            above = wp.spatial_vector()
            if parent >= 0:
                above = work_out.added_acceleration[parent]
            elif model.body_root[k] >= 0:
                pushed = wp.spatial_top(work_out.subtree_wrench[k])
                above = wp.spatial_vector(factors.root_inverse_mass[k] * pushed, wp.vec3())
            alpha = wp.spatial_bottom(above)
            a = wp.spatial_top(above) + wp.cross(alpha, factors.lever[k])
            relative = scratch_out.Du[k] - factors.DJ[k] * alpha - factors.DH[k] * a
            work_out.added_acceleration[k] = wp.spatial_vector(a, alpha + relative)
        for blow in range(count[0]):
            k = blow_bodies[blow]
            response_out[blow, struck] = 0.0
            if model.body_tree[k] == tree:
                arm = blow_points[blow] - wp.transform_get_translation(bodies.body_q[k])
                moved = work_out.added_acceleration[k]
                velocity = wp.spatial_top(moved) + wp.cross(wp.spatial_bottom(moved), arm)
                response_out[blow, struck] = wp.dot(blow_axes[blow], velocity)
