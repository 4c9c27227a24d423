"""Energy budget: a tree does not gain energy while only weight, springs and fixed ties act on it.

The step is linear about its start. In modes that it does not resolve (w dt from 3 to 100: twist, high bending) its
error adds energy; docs/decisions/integrator.md has the figures. So the kinetic plus potential energy of a tree is
measured at the end of a step. It may not exceed the tree's limit by more than :data:`BAND`. The limit is the least
energy that was measured since the budget of the tree *began*. If the energy exceeds the limit by more, the joint rates
are filtered at fixed pose,

    (M + c K) v' = M v,    c = 0.1 dt^2,

which removes 0.9 % of the rate of a mode with w dt = 0.3, half with w dt = 3, and nearly all of modes far beyond. The
filter can only reduce kinetic energy. Any excess that remains is removed from all rates alike, and the next step is
taken with backward Euler (phi = 1). If the potential energy alone is too large, the tree is moved back towards its pose
at the start of the step.

A budget begins in :func:`begin_budget`: the present energy becomes the limit. It begins again after every external
influence that does work on the tree: contacts, loads, moving air, moved ties, and changes of state or model between
steps. Trees with a floating root or on wires have no budget. Without geometric stiffness, which is an option for
comparisons with other solvers, no tree has a budget.

Trees that can gain much energy within one step are *watched closely*: their energy is checked often, the energy of
other trees seldom; see :func:`choose_budget`.
"""

import warp as wp

from vinesim.kernels.compiler_flags import INLINE_ALL
from vinesim.kernels.plants.body_dynamics import terms_left
from vinesim.kernels.plants.first_mode import place_relaxed
from vinesim.kernels.plants.kinematics import body_kinematics, parent_kinematics
from vinesim.kernels.plants.prediction import accelerate_bodies, add_terms
from vinesim.kernels.plants.spatial import (
    half_rotation,
    inverse_symmetric,
    point_mass_inertia,
    rotated_diagonal,
    symmetric,
    world_inertia,
)
from vinesim.kernels.plants.structs import (
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
from vinesim.kernels.plants.tree_energy import is_pushed, state_mark, tree_energy

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINE_ALL})

BAND = wp.constant(0.01)
"""Share of the largest kinetic energy in the last seconds by which the energy of a tree may exceed its budget.

The energy of modes that the step resolves varies by less. TUNED
"""

FADE = wp.constant(0.998)
"""Factor by which each check reduces the stored largest kinetic energy. TUNED: 5 s at 100 checks a second"""

ROUNDING = wp.constant(1.0e-6)
"""[1] Rounding errors of an energy as a share of its terms: eight units in the last place of a float. DERIVED"""

FILTER = wp.constant(0.1)
"""c / dt^2 of the filter. TUNED: 0.03 to 1 serve as well"""

CLOSE_STEPS = wp.constant(32)
"""Number of consecutive steps in which the energy of a tree is checked after its budget began (its present energy
became the limit that it may not exceed), and after a check found that the energy has risen.

In other steps, one in :data:`CHECK_PERIOD` is checked. TUNED
"""

NO_BUDGET = 0
CLOSELY = 1
NOW_AND_THEN = 2
"""Value of ``tree_budget``: the tree's energy is checked once in :data:`CHECK_PERIOD` launches. When its energy has
risen, every step is checked until :data:`CLOSE_STEPS` steps have passed without a rise.

With ``NO_BUDGET`` the energy is never checked. With ``CLOSELY`` the tree is watched closely: every step is checked in
which a joint is faster than :data:`CHECK_RATE`, and changes of the state between steps are noticed at once.
"""

CHECK_PERIOD = wp.constant(8)
"""[launch] Period in which the energy of a tree is checked while nothing demands more checks, such as a rise of energy.
On a CPU there is one launch in eight steps while no tree is watched closely (:data:`CLOSELY`).
TUNED: a check costs as much as a third of a step"""

CHECK_RATE = wp.constant(2.0)
"""[rad/s] Joint rate above which the energy of a closely watched tree (:data:`CLOSELY`) is checked in every step.
TUNED"""

MIN_DAMPING = wp.constant(0.5)
"""Ratio of damping to stiffness [steps] of a joint below which the energy of the joint's tree is watched closely
(:data:`CLOSELY`). MEASURED, like :data:`MAX_SAG`: docs/decisions/integrator.md"""

MAX_SAG = wp.constant(4.0)
"""[rad] Sag of a tree above which its energy is watched closely (:data:`CLOSELY`). Sag is the largest sum of joint
angles along a path from root to tip, under the weight of the tree in its relaxed shape, held level, with linear
springs."""

MIN_PHI = wp.constant(0.549)
"""Value of phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler) below which the energy of a tree
is watched closely (:data:`CLOSELY`), because the scheme does not damp modes that the step cannot resolve."""

BACKTRACKS = wp.constant(8)
"""Largest number of times that the joint rotations of a step are halved. DERIVED: 0.4 % of them then remain."""

NO_LIMIT = wp.constant(1.0e30)
"""[J] Limit of a tree whose energy budget has not begun: no present energy has been stored as its limit yet."""


@wp.kernel
def choose_budget(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    # out
    scratch_out: Scratch,
    tree_budget_out: wp.array(dtype=wp.int32),
):
    """One thread per tree. Choose how often the tree's energy is checked: it is watched closely if the tree's springs
    are weak or hardly damped.

    trees: [thread] index of the tree. tree_budget_out: [tree] :data:`CLOSELY` or :data:`NOW_AND_THEN`, or
    :data:`NO_BUDGET` with a floating root or without geometric stiffness. scratch_out: scratch; later kernels do not
    need it.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    budget = wp.int32(NOW_AND_THEN)
    floats = bool(False)
    for k in range(first, first + size * model.pitch, model.pitch):
        place_relaxed(model, k, scratch_out)
        mass = model.body_mass[k]
        scratch_out.bias[k] = wp.spatial_vector(mass * (scratch_out.J[k] * model.body_com[k]), wp.vec3(mass, 0.0, 0.0))
        floats = floats or model.body_root[k] >= 0
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        subtree = scratch_out.bias[k]
        moment = wp.spatial_top(subtree)
        mass = subtree[3]
        stiffness = model.joint_stiffness[k]
        damping = model.joint_damping[k]
        softest = float(NO_LIMIT)
        for axis in range(3):
            if stiffness[axis] > 0.0:
                softest = wp.min(softest, stiffness[axis])
                if damping[axis] < MIN_DAMPING * p.dt * stiffness[axis]:
                    budget = CLOSELY
        scratch_out.Du[k] = wp.vec3(wp.length(p.gravity) * wp.length(moment) / softest, 0.0, 0.0)
        parent = model.body_parent[k]
        if parent >= 0:
            moment = moment + mass * scratch_out.tension[k]
            scratch_out.bias[parent] = scratch_out.bias[parent] + wp.spatial_vector(moment, wp.vec3(mass, 0.0, 0.0))
    for k in range(first, first + size * model.pitch, model.pitch):
        parent = model.body_parent[k]
        if parent >= 0:
            scratch_out.Du[k] = scratch_out.Du[k] + scratch_out.Du[parent]
        if scratch_out.Du[k][0] > MAX_SAG:
            budget = CLOSELY
    if floats or p.geometric_stiffness == 0.0:
        budget = NO_BUDGET
    tree_budget_out[tree] = budget


@wp.func
def is_close(budget: int, phi: float):
    """Returns whether the energy of a tree is watched closely: because of its ``budget``, or because its ``phi``
    (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler) is below :data:`MIN_PHI`."""
    return budget == CLOSELY or phi < MIN_PHI


@wp.func
def is_watched(budget: int, phi: float, tree: int, budgets: EnergyBudget):
    """Returns whether the state of a tree is recorded in this step for its energy budget: the tree is watched closely
    (:func:`is_close`), its budget has not begun, or its next steps are to be checked."""
    return is_close(budget, phi) or budgets.limit[tree] >= NO_LIMIT or budgets.watch[tree] > 0


@wp.kernel
def begin_budget(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_budget: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    forces: AppliedForces,
    joints: JointState,
    # out
    budget_out: EnergyBudget,
    bodies_out: BodyState,
):
    """One thread per tree, before an integration. Begin the tree's energy budget if an external influence did work on
    the tree since the last step: store the present energy as the limit that it may not exceed.

    trees: [thread] index of the tree; nothing happens with a tree_budget [tree] of :data:`NO_BUDGET`. tree_phi: [tree]
    requested phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler). forces: forces of this step.
    joints: joints at the start of this step. budget_out: the limit is :data:`NO_LIMIT` while external forces act.
    bodies_out: scratch.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    kind = tree_budget[tree]
    if kind == NO_BUDGET or not is_watched(kind, tree_phi[tree], tree, budget_out):
        return
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    if wp.length_sq(forces.tree_air[tree]) != 0.0 or is_pushed(
        forces.body_load, forces.body_wrench, first, size, model.pitch
    ):
        budget_out.limit[tree] = NO_LIMIT
        return
    for k in range(first, first + size * model.pitch, model.pitch):
        budget_out.start_q[k] = joints.joint_q[k]
    mark = state_mark(joints.joint_q, joints.joint_qd, first, size, model.pitch)
    if budget_out.limit[tree] < NO_LIMIT and mark == budget_out.mark[tree]:
        return
    energy = tree_energy(
        p,
        model,
        forces,
        joints,
        tree,
        bodies_out,
    )
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
    """Write (M + c K)^-1 M v into ``joint_qd_free``, with v the joint rates [rad/s]; c in s^2.

    This is the articulated-body algorithm at rest: v' - v is the acceleration by the joint torques -c K v if c K is
    added to the inertia of the joints.
    """
    unloaded = SolverParameters(1.0, p.fast_rate, p.max_rate, p.fault_rate, p.contact_steps, 0.0, 0.0, p.gravity)
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
def is_due(rate: float, close: bool, tree: int, budget_out: EnergyBudget):
    """Returns whether this step of a tree is to be checked, and counts the step.

    ``rate`` [rad/s]: largest joint rate of the tree. ``close``: whether the tree is watched closely (:func:`is_close`).
    """
    watch = budget_out.watch[tree] - 1
    due = watch >= 0 or (close and rate > CHECK_RATE)
    if watch <= -CHECK_PERIOD:
        watch = 0
        due = True
    budget_out.watch[tree] = watch
    return due


@wp.func
def lead_back(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    start_q: wp.array(dtype=wp.quat),
    goal: float,
    tree: int,
    joints_out: JointState,
    bodies_out: BodyState,
):
    """Set the joint rates of a tree to 0, and move its joints back towards their rotations at the start of the step
    (``start_q``), half of the remaining way at a time, until the potential energy is at most ``goal`` [J].

    Returns the result of :func:`tree_energy` in the new pose.
    """
    first = model.tree_first[tree]
    energy = wp.vec4(0.0, wp.float32(NO_LIMIT), 0.0, 0.0)
    halved = wp.int32(0)
    while energy[1] > goal and halved < BACKTRACKS:
        for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
            joints_out.joint_q[k] = wp.normalize(start_q[k] + joints_out.joint_q[k])
            joints_out.joint_qd[k] = wp.vec3()
        energy = tree_energy(p, model, forces, joints_out, tree, bodies_out)
        halved += 1
    return energy


@wp.func
def take_energy(
    p: SolverParameters,
    dt: float,
    goal: float,
    pose_goal: float,
    model: ArticulationModel,
    forces: AppliedForces,
    tree: int,
    budget_out: EnergyBudget,
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    joints_out: JointState,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """Remove a tree's energy above ``goal`` [J], or above ``pose_goal`` [J] if its potential energy exceeds
    ``pose_goal``.

    Returns the tree's remaining kinetic and potential energy [J].
    """
    filter_rates(p, FILTER * dt * dt, model, joints_out, tree, bodies_out, factors_out, scratch_out, prediction_out)
    first = model.tree_first[tree]
    end = first + model.tree_moving[tree] * model.pitch
    for k in range(first, end, model.pitch):
        joints_out.joint_qd[k] = prediction_out.joint_qd_free[k]
    energy = tree_energy(p, model, forces, joints_out, tree, bodies_out)
    if energy[0] + energy[1] > goal:
        share = wp.sqrt(wp.clamp((goal - energy[1]) / energy[0], 0.0, 1.0))
        for k in range(first, end, model.pitch):
            joints_out.joint_qd[k] = share * joints_out.joint_qd[k]
        tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], 1)
        energy[0] = share * share * energy[0]
        if energy[1] > pose_goal:
            energy = lead_back(p, model, forces, budget_out.start_q, pose_goal, tree, joints_out, bodies_out)
    budget_out.filtered[tree] = budget_out.filtered[tree] + 1
    budget_out.watch[tree] = CLOSE_STEPS
    return energy[0] + energy[1]


@wp.kernel
def keep_budget(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_budget: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
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
    """One thread per tree, after an integration. Remove the tree's energy in excess of its budget.

    trees: [thread] index of the tree. Nothing happens if the tree's budget has no limit or its tree_rate [tree] is
    above ``p.fault_rate``.
    tree_budget: [tree] how its energy is watched, such as :data:`CLOSELY`. tree_phi: [tree] requested phi
    (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler). tree_steps: [tree] number of substeps of the
    step; this launch handles one substep. joints_out: joints at the end of the step, slower where energy was removed.
    tree_euler_steps_out: [tree] number of next steps with phi = 1; raised to at least 1 where energy was removed. All
    later arguments are scratch.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    kind = tree_budget[tree]
    if kind == NO_BUDGET:
        return
    limit = budget_out.limit[tree]
    rate = tree_rate[tree]
    if limit >= NO_LIMIT or not rate <= p.fault_rate:
        return
    close = is_close(kind, tree_phi[tree])
    watched = is_watched(kind, tree_phi[tree], tree, budget_out)
    if is_due(rate, close, tree, budget_out):
        energy = tree_energy(p, model, forces, joints_out, tree, bodies_out)
        if energy[3] != budget_out.held[tree]:
            budget_out.limit[tree] = NO_LIMIT
            return
        total = energy[0] + energy[1]
        rounding = ROUNDING * energy[2]
        band = BAND * wp.max(budget_out.scale[tree], energy[0]) + rounding
        gain = total - budget_out.last[tree]
        if total > limit + band and not watched:
            budget_out.watch[tree] = CLOSE_STEPS
            budget_out.limit[tree] = NO_LIMIT  # the tree may have been pushed since
            return
        if total > limit + band and gain > rounding:
            goal = limit + 0.5 * band - gain  # minus the energy that the next step may gain again
            total = take_energy(
                p,
                p.dt / float(tree_steps[tree]),
                goal,
                limit + BAND * budget_out.scale[tree] + rounding,
                model,
                forces,
                tree,
                budget_out,
                tree_euler_steps_out,
                joints_out,
                bodies_out,
                factors_out,
                scratch_out,
                prediction_out,
            )
        else:
            budget_out.scale[tree] = wp.max(FADE * budget_out.scale[tree], energy[0])
            budget_out.limit[tree] = wp.min(limit, total + rounding)
            if total > limit + rounding and gain > rounding:
                budget_out.watch[tree] = CLOSE_STEPS
        budget_out.last[tree] = total
    if close or budget_out.watch[tree] > 0:
        budget_out.mark[tree] = state_mark(
            joints_out.joint_q, joints_out.joint_qd, model.tree_first[tree], model.tree_moving[tree], model.pitch
        )
