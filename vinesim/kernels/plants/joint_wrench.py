"""Wrench that the parent exerts on a body through the body's joint, computed from the motion of the subtree beyond the
joint.
"""

import warp as wp

from vinesim.kernels.plants.forces import tie_and_drag_wrench
from vinesim.kernels.plants.spatial import world_inertia
from vinesim.kernels.plants.structs import AppliedForces, ArticulationModel, BodyState, SolverParameters

wp.set_module_options({"enable_backward": False})


@wp.func
def own_wrench(
    k: int,
    tree: int,
    p: SolverParameters,
    model: ArticulationModel,
    tree_phi: wp.array(dtype=float),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    bodies: BodyState,
    body_acceleration: wp.array(dtype=wp.spatial_vector),
):
    """Returns the wrench that the joints of body k exerted on it together in the last step: force [N], and moment about
    the body's origin [N m], world axes.

    It is the wrench with which the body moves as it did: Newton-Euler (Featherstone 2008, section 5.3), without weight,
    loads, contacts, ties and drag.
    """
    pose = bodies.body_q[k]
    rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
    com = rotation * model.body_com[k]
    omega = wp.spatial_bottom(bodies.body_qd[k])
    alpha = wp.spatial_bottom(body_acceleration[k])
    a = wp.spatial_top(body_acceleration[k]) + wp.cross(alpha, com) + wp.cross(omega, wp.cross(omega, com))
    own = model.body_mass[k] * (a - p.gravity)
    given = forces.body_load[k] + forces.body_wrench[k]
    given += tie_and_drag_wrench(
        k,
        p.dt / float(tree_steps[tree]),
        tree_phi[tree],
        forces.tree_air[tree],
        model,
        forces,
        pose,
        bodies.body_qd[k],
        body_acceleration[k],
    )
    moment = wp.cross(com, own) + inertia * alpha + wp.cross(omega, inertia * omega)
    return wp.spatial_vector(own, moment) - given


@wp.kernel
def joint_wrench(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    joint_bodies: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    bodies: BodyState,
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    # out
    wrench_out: wp.array(dtype=wp.spatial_vector),
):
    """One thread per joint. Compute the wrench that the parent exerted on a body through the joint in the last step.

    It is the sum of :func:`own_wrench` over the subtree beyond the joint. joint_bodies: [thread] body beyond the joint. bodies: motion at the start of the step.
    body_acceleration: [body] m/s^2, rad/s^2 over the step. If the step was divided into tree_steps [tree] substeps,
    both describe the last substep. wrench_out: [thread] force on the body [N], and moment on the body about the body's
    origin [N m], world axes; zero for bodies that have been cut off.
    """
    slot = wp.tid()
    if slot >= count[0]:
        return
    body = joint_bodies[slot]
    tree = model.body_tree[body]
    pivot = wp.transform_get_translation(bodies.body_q[body])
    force = wp.vec3()
    moment = wp.vec3()
    last = model.tree_first[tree] + model.tree_moving[tree] * model.pitch
    if model.body_parent[body] < 0 and model.body_root[body] >= 0:
        last = body  # no joint holds a cut-off body
    for k in range(body, last, model.pitch):
        up = int(k)
        while up > body:
            up = model.body_parent[up]
        if up == body:
            given = own_wrench(k, tree, p, model, tree_phi, tree_steps, forces, bodies, body_acceleration)
            arm = wp.transform_get_translation(bodies.body_q[k]) - pivot
            force += wp.spatial_top(given)
            moment += wp.spatial_bottom(given) + wp.cross(arm, wp.spatial_top(given))
    wrench_out[slot] = wp.spatial_vector(force, moment)
