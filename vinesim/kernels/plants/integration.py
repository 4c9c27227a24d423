"""Integration: computes the state of joints at the end of the step. Faulty trees keep their state from the start of the
step.
"""

import warp as wp

from vinesim.kernels.plants.kinematics import max_rate_and_speed
from vinesim.kernels.plants.spatial import exponential
from vinesim.kernels.plants.structs import ArticulationModel, JointState, Prediction, SolverParameters

wp.set_module_options({"enable_backward": False})

EULER_ON = wp.constant(0.1)
"""Share of ``max_rate``. A tree with a joint faster than this share is integrated with backward Euler (phi = 1, the
implicitness of the integrator) until all its joints are slower than ``EULER_OFF``.

With a smaller phi, a chain of weak springs that swings a heavy load would gain energy and never come to rest. TUNED
"""

EULER_OFF = wp.constant(0.06)
"""Share of ``max_rate`` below which all joints of a tree must stay for ``EULER_DURATION`` before its phi (implicitness
of the integrator, 0.5 trapezoidal to 1 backward Euler) may fall below 1 again. TUNED"""

EULER_DURATION = wp.constant(1.0)
"""[s] Time for which all joints must be slower than ``EULER_OFF``. TUNED"""


@wp.kernel
def integrate(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_awake: wp.array(dtype=wp.bool),
    tree_phi: wp.array(dtype=float),
    tree_steps: wp.array(dtype=wp.int32),
    tree_moved: wp.array(dtype=wp.bool),
    joints: JointState,
    prediction: Prediction,
    # out
    tree_rate_out: wp.array(dtype=float),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    joints_out: JointState,
):
    """One thread per tree. Move its joints to the end of the step. A faulty tree keeps its state from the start of the
    step.

    trees: [thread] index of the tree; nothing happens unless tree_awake [tree]. tree_phi: [tree] phi (implicitness of
    the integrator, 0.5 trapezoidal to 1 backward Euler) that :func:`predict` used. tree_steps: [tree] number of
    substeps of the step; a tree that is stopped in one substep takes no further substeps. tree_moved: [tree] whether
    the joint rotations are those of the end of a whole step already (:mod:`vinesim.kernels.plants.fast_motion`).
    tree_rate_out: [tree]
    sqrt(a^2 + b^2) of the fastest joint rate a [rad/s] and the fastest speed b [m/s] of a floating root; NaN or above
    ``p.fault_rate`` if the tree was stopped. tree_euler_steps_out: [tree] number of steps and substeps still to be
    taken with phi = 1; this kernel counts it down. joints_out: [body] rotations by the exponential map of the mean
    rate; may be ``joints``.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    substeps = tree_steps[tree]
    if not tree_awake[tree] or (substeps > 1 and not tree_rate_out[tree] <= p.fault_rate):
        return
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    pitch = model.pitch
    dt = p.dt / float(substeps)
    is_moved = tree_moved[tree] and substeps == 1
    turning, falling = max_rate_and_speed(
        prediction.joint_qd_free,
        joints.joint_x,
        prediction.joint_xd_free,
        model.body_parent,
        model.body_root,
        first,
        size,
        pitch,
    )
    most = wp.length(wp.vec2(turning, falling))
    tree_rate_out[tree] = most
    steps = wp.max(tree_euler_steps_out[tree] - 1, 0)
    phi = tree_phi[tree]
    if (phi == 1.0 and turning > EULER_ON * p.max_rate) or (
        steps > p.contact_steps and turning > EULER_OFF * p.max_rate
    ):
        steps = wp.max(steps, int(EULER_DURATION / dt))
    tree_euler_steps_out[tree] = steps
    sound = most <= p.fault_rate
    # all joints of a tree beyond max_rate are slowed together, to well below max_rate: slowing single joints would add
    # energy to other joints, and a loaded cane would swing at the limit for ever
    slower = float(1.0)
    if turning > p.max_rate:
        slower = 0.5 * p.max_rate / turning
    for k in range(first, first + size * pitch, pitch):
        # all values of a body are read before the first branch, so that a GPU waits for memory once
        parent = model.body_parent[k]
        root = model.body_root[k]
        free = prediction.joint_qd_free[k]
        rate_before = joints.joint_qd[k]
        q = joints.joint_q[k]
        floats = parent < 0 and root >= 0
        if sound:
            rate = slower * free
            share = phi
            if floats:
                if model.body_falls[k]:  # no spring turns the root: phi above 1/2 would only add error
                    share = 0.5
                joints_out.joint_x[k] = joints.joint_x[k] + dt * (
                    (1.0 - share) * joints.joint_xd[k] + share * prediction.joint_xd_free[k]
                )
                joints_out.joint_xd[k] = prediction.joint_xd_free[k]
            mean = (1.0 - share) * rate_before + share * rate
            joints_out.joint_qd[k] = rate
            if not is_moved:
                q = wp.normalize(exponential(dt * mean) * q)
            joints_out.joint_q[k] = q
        else:
            joints_out.joint_qd[k] = wp.vec3()
            joints_out.joint_q[k] = q
            if floats:
                joints_out.joint_xd[k] = wp.vec3()
                joints_out.joint_x[k] = joints.joint_x[k]
