"""Fast motion: steps of second order for trees whose bodies turn fast.

The solve of a step is linear about the start of the step: gyroscopic and centrifugal terms and the directions of levers
are those of its start. The error of a body that turns at a rate w grows with dt w. Above ``fast_rate`` a drag and
backward Euler keep such steps stable; they remove energy, also at first order in dt.

All these errors are smooth in dt. So a fast tree takes the step with backward Euler as a whole and as two halves, with
the full damping of its joints and without the drag, and the two results are extrapolated to dt = 0:

    v = 2 v_halves - v_whole

and the same for rotations (Richardson's extrapolation; for backward Euler see Lawson and Morris, The extrapolation of
first order methods for parabolic partial differential equations, SIAM J. Numer. Anal. 15, 1978). The result is of
second order, also in the damping of joints and ties. Modes that the step does not resolve are damped as with backward
Euler. If the two results differ much, the step is divided into two and four, four and eight parts. If the last two
differ much, the finer one counts; if they differ by a quarter, none.

A tree takes such steps from the first step at whose start one of its bodies turns faster than :data:`FAST_SPIN` until
no body has done so for a second, and while :mod:`vinesim.kernels.plants.integration` demands backward Euler after fast
motion: a change of scheme twice in each swing would remove energy. It does not take them

* while contacts press on it, because their impulses were computed for the prediction of the whole step;
* where phi = 1 is requested, or geometric stiffness is switched off;
* with a cut-off part, whose momentum is corrected after the whole step;
* if its first mode is so fast that its step is divided into substeps;
* if a joint turns faster than half of ``max_rate``, or would turn faster than ``max_rate``, where rates are limited.
"""

import warp as wp

from vinesim.kernels.plants.integration import EULER_DURATION
from vinesim.kernels.plants.kinematics import max_joint_rate
from vinesim.kernels.plants.prediction import predict_tree
from vinesim.kernels.plants.spatial import exponential
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    FastScratch,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
    substep_parameters,
)

wp.set_module_options({"enable_backward": False})

FAST_SPIN = wp.constant(3.0)
"""[rad/s] A body that turns faster makes its tree fast. MEASURED: docs/decisions/integrator.md"""

MAX_SHARE = wp.constant(0.5)
"""Share of ``max_rate``. A tree with a faster joint takes no step of this module. TUNED"""

MAX_PARTS = wp.constant(8)
"""Largest number of parts of a step. TUNED"""

NO_DRAG = wp.constant(1.0e6)
"""[rad/s] Rate above which a drag slows the bodies of a fast tree: never."""

WILD_CHANGE = wp.constant(0.25)
"""Relative difference of the two finest results above which neither counts: the whole step is taken as by other trees
with phi = 1. TUNED: without it, one of 54 chains of very weak springs with half a kilogram never slows down."""

MAX_CHANGE = wp.constant(0.05)
"""Largest difference of joint rates between two results, as a share of the largest rate, at which they are
extrapolated. TUNED: with 0.1, canes lose up to 3 % of their energy in a fast second, with 0.05 up to 2 %."""


@wp.func
def is_fast(
    p: SolverParameters,
    model: ArticulationModel,
    body_wrench: wp.array(dtype=wp.spatial_vector),
    bodies: BodyState,
    joints: JointState,
    tree: int,
    euler_steps: int,
    fast_steps_out: wp.array(dtype=wp.int32),
):
    """Returns whether a tree takes a step of this module; see there. ``bodies``: motion at the start of the step."""
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    spin = float(0.0)
    for k in range(first, first + size * model.pitch, model.pitch):
        spin = wp.max(spin, wp.length_sq(wp.spatial_bottom(bodies.body_qd[k])))
    steps = wp.max(fast_steps_out[tree] - 1, 0)
    if spin > FAST_SPIN * FAST_SPIN:
        steps = int(EULER_DURATION / p.dt)
    fast_steps_out[tree] = steps
    if steps == 0 and euler_steps <= p.contact_steps:
        return False
    for k in range(first, first + size * model.pitch, model.pitch):
        wrench = body_wrench[k]
        if model.body_root[k] >= 0 or wp.dot(wrench, wrench) > 0.0:
            return False
    return max_joint_rate(joints.joint_qd, first, size, model.pitch) < MAX_SHARE * p.max_rate


@wp.func
def solve_part(
    p: SolverParameters,
    parts: int,
    plain: bool,
    elapsed: float,
    model: ArticulationModel,
    forces: AppliedForces,
    tree: int,
    part_model_out: ArticulationModel,
    part_forces_out: AppliedForces,
    joints_out: JointState,
    bodies_out: BodyState,
    factors_out: Factors,
    solve_out: Scratch,
    prediction_out: Prediction,
):
    """Move the joints of a tree over one of ``parts`` equal parts of the step, with backward Euler.

    plain: as other trees with phi = 1 do, with the drag, and with the damping that backward Euler adds subtracted.
    elapsed: [s] time between the start of the step and that of the part. part_model_out, part_forces_out: like
    ``model`` and ``forces``, but their dampings, anchors and root turns are scratch. Unless ``plain``, the dampings get
    on top what backward Euler itself adds, because a prediction subtracts it. Anchors and turns get their values at the
    start of the part.
    """
    divided = substep_parameters(p, parts)
    added = float(0.0)  # [s] damping that backward Euler adds
    if not plain:
        divided.fast_rate = NO_DRAG
        divided.euler_levers = 1.0
        added = divided.dt
    first = model.tree_first[tree]
    end = first + model.tree_moving[tree] * model.pitch
    part_forces_out.root_turn[tree] = forces.root_turn[tree] + elapsed * forces.root_turn_rate[tree]
    for k in range(first, end, model.pitch):
        part_model_out.joint_damping[k] = model.joint_damping[k] + added * model.joint_stiffness[k]
        ties = model.tie_span[k]
        for t in range(ties[0], ties[1]):
            part_model_out.tie_damping[t] = model.tie_damping[t] + added * model.tie_stiffness[t]
            part_forces_out.tie_anchor[t] = forces.tie_anchor[t] + elapsed * forces.tie_anchor_velocity[t]
    predict_tree(
        divided,
        part_model_out,
        part_forces_out,
        joints_out,
        tree,
        1.0,
        bodies_out,
        factors_out,
        solve_out,
        prediction_out,
    )
    for k in range(first, end, model.pitch):
        rate = prediction_out.joint_qd_free[k]
        joints_out.joint_qd[k] = rate
        joints_out.joint_q[k] = wp.normalize(exponential(divided.dt * rate) * joints_out.joint_q[k])


@wp.func
def rotation_vector(q: wp.quat):
    """Returns the rotation vector [rad] of a unit quaternion, the shorter way."""
    v = wp.vec3(q[0], q[1], q[2])
    sine = wp.length(v)
    angle = 2.0 * wp.atan2(sine, wp.abs(q[3]))
    scale = wp.where(sine > 1.0e-6, angle / wp.max(sine, 1.0e-6), 2.0)
    return wp.where(q[3] < 0.0, -scale, scale) * v


@wp.func
def relative_change(model: ArticulationModel, tree: int, fast: FastScratch, joints: JointState):
    """Returns the largest difference of joint rates between the coarser and the finer result of a step, as a share of
    the largest rate; NaN if a rate is NaN."""
    first = model.tree_first[tree]
    change = float(0.0)
    fastest = float(1.0e-20)
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        rate = joints.joint_qd[k]
        change = wp.max(change, wp.length_sq(rate - fast.coarse_joint_qd[k]))
        fastest = wp.max(fastest, wp.length_sq(rate))
    return wp.sqrt(change / fastest)


@wp.func
def extrapolate(model: ArticulationModel, tree: int, fast: FastScratch, joints_out: JointState):
    """Extrapolate the joints of a tree from two results, one with twice as many parts as the other, to dt = 0."""
    first = model.tree_first[tree]
    end = first + model.tree_moving[tree] * model.pitch
    for k in range(first, end, model.pitch):
        q = joints_out.joint_q[k]
        further = rotation_vector(q * wp.quat_inverse(fast.coarse_joint_q[k]))
        joints_out.joint_q[k] = wp.normalize(exponential(further) * q)
        joints_out.joint_qd[k] = 2.0 * joints_out.joint_qd[k] - fast.coarse_joint_qd[k]


@wp.kernel
def move_fast_trees(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_awake: wp.array(dtype=wp.bool),
    tree_phi: wp.array(dtype=float),
    tree_rate: wp.array(dtype=float),
    tree_euler_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    # out
    fast_out: FastScratch,
    part_model_out: ArticulationModel,
    part_forces_out: AppliedForces,
    tree_fast_steps_out: wp.array(dtype=wp.int32),
    tree_moved_out: wp.array(dtype=wp.bool),
    tree_phi_out: wp.array(dtype=float),
    joints_out: JointState,
    bodies_out: BodyState,
    factors_out: Factors,
    solve_out: Scratch,
    prediction_out: Prediction,
):
    """One thread per tree, before the integration of whole steps. Move the joints of fast trees to the end of the step.

    trees: [thread] index of the tree. tree_phi: [tree] requested phi (implicitness of the integrator, 0.5 trapezoidal
    to 1 backward Euler). tree_rate: [tree] rad/s, largest joint rate after the last step. tree_euler_steps: [tree]
    number of steps still to be taken with phi = 1. fast_out, part_model_out, part_forces_out, factors_out, solve_out:
    scratch; see :func:`solve_part`. tree_fast_steps_out: [tree] number of steps for which the tree still counts as
    fast. tree_moved_out: [tree] whether the tree was moved. tree_phi_out: [tree] 1 for a fast tree. joints_out: [body]
    of a tree that was moved, at the end of the step. bodies_out: motion at the start of the step; of a tree that was
    moved, at the start of its last part. prediction_out: accelerations over that part, joint rates at the end.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    tree_moved_out[tree] = False
    if not tree_awake[tree] or tree_phi[tree] == 1.0 or p.geometric_stiffness == 0.0:
        return
    euler_steps = tree_euler_steps[tree]
    size = model.tree_moving[tree]
    if (
        float(size) * tree_rate[tree] < FAST_SPIN  # no body can turn faster than all joints together
        and tree_fast_steps_out[tree] == 0
        and euler_steps <= p.contact_steps
    ):
        return
    if not is_fast(p, model, forces.body_wrench, bodies_out, joints_out, tree, euler_steps, tree_fast_steps_out):
        return
    first = model.tree_first[tree]
    end = first + size * model.pitch
    for k in range(first, end, model.pitch):
        fast_out.start_joint_q[k] = joints_out.joint_q[k]
        fast_out.start_joint_qd[k] = joints_out.joint_qd[k]
    parts = int(1)
    change = float(2.0)
    plain = bool(False)
    searching = bool(True)
    while searching:
        for k in range(first, end, model.pitch):
            fast_out.coarse_joint_q[k] = joints_out.joint_q[k]
            fast_out.coarse_joint_qd[k] = joints_out.joint_qd[k]
            joints_out.joint_q[k] = fast_out.start_joint_q[k]
            joints_out.joint_qd[k] = fast_out.start_joint_qd[k]
        for part in range(parts):
            solve_part(
                p,
                parts,
                plain,
                p.dt * float(part) / float(parts),
                model,
                forces,
                tree,
                part_model_out,
                part_forces_out,
                joints_out,
                bodies_out,
                factors_out,
                solve_out,
                prediction_out,
            )
        if plain:
            searching = False
        elif not max_joint_rate(joints_out.joint_qd, first, size, model.pitch) <= p.max_rate:
            plain = True
            parts = 1
        else:
            if parts > 1:
                change = relative_change(model, tree, fast_out, joints_out)
            searching = change > MAX_CHANGE
            parts = 2 * parts
            if searching and parts > MAX_PARTS:
                plain = change > WILD_CHANGE
                searching = plain
                parts = 1
    tree_phi_out[tree] = 1.0
    if plain:  # the integration of a whole step moves the tree, with the drag
        for k in range(first, end, model.pitch):
            joints_out.joint_q[k] = fast_out.start_joint_q[k]
            joints_out.joint_qd[k] = fast_out.start_joint_qd[k]
        return
    if change <= MAX_CHANGE:
        extrapolate(model, tree, fast_out, joints_out)
    for k in range(first, end, model.pitch):
        prediction_out.joint_qd_free[k] = joints_out.joint_qd[k]
    tree_moved_out[tree] = True
