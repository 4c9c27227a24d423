"""Energy budget: what only weight, springs and ties at rest act on does not gain energy.

The step is linear about its start. In modes that it does not resolve (w dt from 3 to 100: twist, high bending) its
error feeds energy; docs/decisions/integrator.md has the figures. So the energy of a tree, kinetic and potential, is
measured at the end of a step, and may not be above the least of the past by more than a band. If it is, the rates are
filtered at fixed pose,

    (M + c K) v' = M v,    c = 0.1 dt^2,

which takes 0.9 % of the rate of a mode with w dt = 0.3, half with w dt = 3, and all of those far beyond. Kinetic energy
can only fall. What is still too much is taken from all rates alike, and the next step is taken with phi = 1.

The budget begins anew with whatever does work from outside: contacts, loads, moving air, ties that are moved, and
changes of state or model between steps. Trees with a floating root have no budget, nor has a solver without geometric
stiffness, which is there to be compared with others.
"""

import warp as wp

from vinesim.kernels.articulation.body_dynamics import terms_left
from vinesim.kernels.articulation.contiguous import (
    contiguous_bodies,
    contiguous_factors,
    contiguous_forces,
    contiguous_joints,
    contiguous_model,
    contiguous_prediction,
    contiguous_scratch,
)
from vinesim.kernels.articulation.kinematics import body_kinematics, parent_kinematics
from vinesim.kernels.articulation.prediction import accelerate_bodies, add_terms
from vinesim.kernels.articulation.spatial import (
    half_rotation,
    inverse_symmetric,
    point_mass_inertia,
    rotated_diagonal,
    symmetric,
    world_inertia,
)
from vinesim.kernels.articulation.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    EnergyBudget,
    Factors,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
)

wp.set_module_options({"enable_backward": False})

BAND = wp.constant(0.01)
"""Share of the kinetic energy, the largest of the last seconds, by which energy may exceed its budget. Of motion that the
step resolves, it varies by less. TUNED"""

FADE = wp.constant(0.998)
"""What a check leaves of that largest kinetic energy. TUNED: 5 s at 100 checks a second"""

ROUNDING = wp.constant(1.0e-6)
"""[1] Rounding errors of an energy as a share of its terms: eight units in the last place of a float. DERIVED"""

FILTER = wp.constant(0.1)
"""c / dt^2. TUNED: 0.03 to 1 serve as well"""

CLOSE_STEPS = wp.constant(32)
"""Steps that are all checked after the budget began and after the energy was found to rise; else every
:data:`CHECK_PERIOD`-th is. TUNED"""

CHECK_PERIOD = wp.constant(8)
"""[step] TUNED: a check costs a sixth of a step"""

CHECK_RATE = wp.constant(2.0)
"""[rad/s] Every step of a tree with a faster joint is checked. TUNED"""

NO_LIMIT = wp.constant(1.0e30)
"""[J] Limit of a tree whose budget has not begun."""


@wp.func
def spring_energy(stiffness: wp.vec3, q: wp.quat):
    """theta^T K theta / 2 [J], with theta the rotation vector of q."""
    v = wp.vec3(q[0], q[1], q[2])
    square = wp.dot(v, v)
    s = 1.0 + square * (1.0 / 6.0 + square * (3.0 / 40.0 + square * (5.0 / 112.0)))  # asin(|v|) / |v|
    if square > 0.02:
        sine = wp.sqrt(square)
        s = wp.atan2(sine, wp.abs(q[3])) / sine
    return 2.0 * s * s * wp.dot(stiffness, wp.cw_mul(v, v))


@wp.func
def body_energy(
    k: int,
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joint_q: wp.quat,
    origin: wp.vec3,
    pose: wp.transform,
    motion: wp.spatial_vector,
):
    """Kinetic and potential energy of one body, the size of the terms that these are sums of [J], and a checksum of
    where its ties are held.

    Potential is its weight's, its joint's spring and its ties. pose: [m] against ``origin`` [m], world axes.
    """
    turn = wp.transform_get_rotation(pose)
    arm = wp.quat_rotate(turn, model.body_com[k])
    omega = wp.spatial_bottom(motion)
    velocity = wp.spatial_top(motion) + wp.cross(omega, arm)
    spin = wp.quat_rotate_inv(turn, omega)
    crossed = wp.vec3(spin[1] * spin[2], spin[2] * spin[0], spin[0] * spin[1])
    mass = model.body_mass[k]
    kinetic = 0.5 * (
        mass * wp.dot(velocity, velocity) + wp.dot(model.body_inertia[k], wp.cw_mul(spin, spin))
    ) + wp.dot(model.body_product[k], crossed)
    place = wp.transform_get_translation(pose)
    weight = mass * wp.dot(p.gravity, place + arm)
    elastic = spring_energy(model.joint_stiffness[k], joint_q)
    held = float(0.0)
    ties = model.tie_span[k]
    for t in range(ties[0], ties[1]):
        anchor = forces.tie_anchor[t]
        held += anchor[0] + 2.0 * anchor[1] + 4.0 * anchor[2]
        stretch = place + wp.quat_rotate(turn, model.tie_point[t]) - (anchor - origin)
        elastic += 0.5 * model.tie_stiffness[t] * wp.dot(stretch, stretch)
    return wp.vec4(kinetic, elastic - weight, kinetic + elastic + wp.abs(weight), held)


@wp.func
def tree_energy(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    tree: int,
    bodies_out: BodyState,
):
    """:func:`body_energy` of a whole tree, its bodies put where the joints say: against the tree's origin, so that far
    from the world's no digits are lost."""
    energy = wp.vec4()
    first = model.tree_first[tree]
    origin = wp.transform_get_translation(model.tree_pose[tree])
    standing = wp.transform(wp.vec3(), wp.transform_get_rotation(model.tree_pose[tree]))
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        parent = model.body_parent[k]
        above = standing
        above_motion = wp.spatial_vector()
        if parent >= 0:
            above = bodies_out.body_q[parent]
            above_motion = bodies_out.body_qd[parent]
        _axes, _lever, pose, motion = body_kinematics(
            above, above_motion, model.body_offset[k], model.body_rest[k], joints.joint_q[k], joints.joint_qd[k]
        )
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = motion
        energy += body_energy(k, p, model, forces, joints.joint_q[k], origin, pose, motion)
    return energy


@wp.func
def joint_mark(q: wp.quat, qd: wp.vec3):
    """Part of one joint in :func:`state_mark`; its weights are powers of two, so that contraction changes no bit."""
    return (q[0] + 2.0 * q[1] + 4.0 * q[2]) + (0.5 * qd[0] + qd[1] + 2.0 * qd[2])


@wp.func
def state_mark(model: ArticulationModel, joints: JointState, tree: int):
    """Fletcher's checksum of a tree's joints."""
    mark = float(0.0)
    weighted = float(0.0)
    first = model.tree_first[tree]
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        mark = mark + joint_mark(joints.joint_q[k], joints.joint_qd[k])
        weighted = weighted + mark
    return wp.vec2(mark, weighted)


@wp.func
def mark_and_push(model: ArticulationModel, forces: AppliedForces, joints: JointState, tree: int):
    """:func:`state_mark`, and whether contacts, loads or air do work on a tree in this step or a part of it floats."""
    push = wp.length_sq(forces.tree_air[tree])
    floating = int(0)
    mark = float(0.0)
    weighted = float(0.0)
    first = model.tree_first[tree]
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        mark = mark + joint_mark(joints.joint_q[k], joints.joint_qd[k])
        weighted = weighted + mark
        push = push + (wp.length_sq(forces.body_load[k]) + wp.length_sq(forces.body_wrench[k]))
        floating = wp.max(floating, model.body_root[k] + 1)
    return wp.vec2(mark, weighted), not push == 0.0 or floating > 0


@wp.kernel
def begin_budget(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    trees: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    joints: JointState,
    # out
    budget_out: EnergyBudget,
    bodies_out: BodyState,
):
    """Before an integration: one thread begins the budget of one tree, if work was done on it since the last step.

    trees: [thread] which tree. forces: of this step. joints: at its start. budget_out: the limit is :data:`NO_LIMIT`
    while outer forces act. bodies_out: scratch.
    """
    tree = trees[wp.tid()]
    dense = contiguous_model(model)
    state = contiguous_joints(joints)
    loads = contiguous_forces(forces)
    mark, pushed = mark_and_push(dense, loads, state, tree)
    if pushed or p.geometric_stiffness == 0.0:
        budget_out.limit[tree] = NO_LIMIT
        return
    known = budget_out.mark[tree]
    if budget_out.limit[tree] < NO_LIMIT and mark[0] == known[0] and mark[1] == known[1]:
        return
    energy = tree_energy(p, dense, loads, state, tree, contiguous_bodies(bodies_out))
    budget_out.limit[tree] = energy[0] + energy[1] + ROUNDING * energy[2]
    budget_out.last[tree] = energy[0] + energy[1]
    budget_out.scale[tree] = energy[0]
    budget_out.held[tree] = energy[3]
    budget_out.watch[tree] = CLOSE_STEPS


@wp.func
def filter_rates(
    p: SolverParameters,
    c: float,
    model: ArticulationModel,
    joints: JointState,
    tree: int,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """(M + c K)^-1 M v into ``joint_qd_free``, with v the joint rates [rad/s]; c in s^2.

    The articulated-body algorithm at rest: v' - v is the acceleration by the joint torques -c K v if c K is added to
    the inertia of the joints.
    """
    unloaded = SolverParameters(1.0, p.fast_rate, p.max_rate, p.fault_rate, p.contact_steps, 0.0, p.gravity)
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    for k in range(first, first + size * model.pitch, model.pitch):
        above, _above_motion = parent_kinematics(k, tree, model, joints, bodies_out)
        axes, lever, pose, _motion = body_kinematics(
            above, wp.spatial_vector(), model.body_offset[k], model.body_rest[k], joints.joint_q[k], wp.vec3()
        )
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = wp.spatial_vector()
        factors_out.axes[k] = axes
        factors_out.lever[k] = lever
        rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
        com = rotation * model.body_com[k]
        mass = model.body_mass[k]
        inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
        scratch_out.J[k] = inertia + point_mass_inertia(mass, com)
        scratch_out.H[k] = mass * wp.skew(com)
        scratch_out.M[k] = mass * wp.identity(n=3, dtype=float)
        scratch_out.bias[k] = wp.spatial_vector()
        scratch_out.tension[k] = wp.vec3()
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        axes = factors_out.axes[k]
        frame = wp.quat_to_matrix(axes * half_rotation(joints.joint_q[k]))
        metric = rotated_diagonal(frame, c * model.joint_stiffness[k])
        bias = scratch_out.bias[k]
        J = symmetric(scratch_out.J[k])
        H = scratch_out.H[k]
        M = symmetric(scratch_out.M[k])
        D = inverse_symmetric(J + metric)
        DJ = D * J
        DH = D * H
        Du = -(D * (metric * wp.quat_rotate(axes, joints.joint_qd[k]) + wp.spatial_bottom(bias)))
        factors_out.DJ[k] = DJ
        factors_out.DH[k] = DH
        scratch_out.Du[k] = Du
        parent = model.body_parent[k]
        if parent >= 0:
            J_left, H_left, M_left, bias_left = terms_left(
                unloaded, 1.0, wp.vec3(), metric, factors_out.lever[k], J, H, M, bias, wp.vec3(), DJ, DH, Du
            )
            add_terms(parent, J_left, H_left, M_left, bias_left, wp.vec3(), scratch_out)
    accelerate_bodies(1.0, model, joints, bodies_out, factors_out, scratch_out, tree, prediction_out)


@wp.func
def is_due(rate: float, tree: int, budget_out: EnergyBudget):
    """Whether this step of a tree is to be checked; counts it."""
    watch = budget_out.watch[tree] - 1
    due = watch >= 0 or rate > CHECK_RATE
    if watch <= -CHECK_PERIOD:
        watch = 0
        due = True
    budget_out.watch[tree] = watch
    return due


@wp.kernel
def keep_budget(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    trees: wp.array(dtype=wp.int32),
    tree_steps: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    forces: AppliedForces,
    # out
    budget_out: EnergyBudget,
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    joints_out: JointState,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """After an integration: one thread takes from one tree the energy that is beyond its budget.

    trees: [thread] which tree; nothing happens without a limit or with tree_rate [tree] above ``p.fault_rate``.
    tree_steps: [tree] substeps that the step is divided into; this is one of them. joints_out: rates at its end, less
    where energy was taken; tree_euler_steps_out: [tree] then at least 1. All that follows is scratch.
    """
    tree = trees[wp.tid()]
    limit = budget_out.limit[tree]
    rate = tree_rate[tree]
    if limit >= NO_LIMIT or not rate <= p.fault_rate:
        return
    dense = contiguous_model(model)
    state = contiguous_joints(joints_out)
    loads = contiguous_forces(forces)
    if is_due(rate, tree, budget_out):
        bodies = contiguous_bodies(bodies_out)
        energy = tree_energy(p, dense, loads, state, tree, bodies)
        if energy[3] != budget_out.held[tree]:
            budget_out.limit[tree] = NO_LIMIT
            return
        total = energy[0] + energy[1]
        rounding = ROUNDING * energy[2]
        band = BAND * wp.max(budget_out.scale[tree], energy[0]) + rounding
        gain = total - budget_out.last[tree]
        if total > limit + band and gain > rounding:
            goal = limit + 0.5 * band - gain  # less by what the next step may gain again
            dt = p.dt / float(tree_steps[tree])
            prediction = contiguous_prediction(prediction_out)
            filter_rates(
                p, FILTER * dt * dt, dense, state, tree, bodies, contiguous_factors(factors_out),
                contiguous_scratch(scratch_out), prediction,
            )  # fmt: skip
            first = dense.tree_first[tree]
            end = first + dense.tree_moving[tree] * dense.pitch
            for k in range(first, end, dense.pitch):
                state.joint_qd[k] = prediction.joint_qd_free[k]
            energy = tree_energy(p, dense, loads, state, tree, bodies)
            if energy[0] + energy[1] > goal:
                share = wp.sqrt(wp.clamp((goal - energy[1]) / energy[0], 0.0, 1.0))
                for k in range(first, end, dense.pitch):
                    state.joint_qd[k] = share * state.joint_qd[k]
                tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], 1)
                energy[0] = share * share * energy[0]
            budget_out.filtered[tree] = budget_out.filtered[tree] + 1
            budget_out.watch[tree] = CLOSE_STEPS
        else:
            budget_out.scale[tree] = wp.max(FADE * budget_out.scale[tree], energy[0])
            budget_out.limit[tree] = wp.min(limit, total + rounding)
            if total > limit + rounding and gain > rounding:
                budget_out.watch[tree] = CLOSE_STEPS
        budget_out.last[tree] = energy[0] + energy[1]
    budget_out.mark[tree] = state_mark(dense, state, tree)
