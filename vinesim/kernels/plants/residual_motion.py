"""Residual motion: the speed of a tree that is coming to rest, and its distance from its equilibrium pose (rest pose).

The displacement to the rest pose is computed by one step of the articulated-body algorithm that starts at zero
velocity, has no damping, and is so long that inertia is negligible compared with springs. The step solves (M + (T/2)^2
K) a = u for the unbalanced generalised force u, and (T/2)^2 a is K^-1 u, the quasi-static displacement. K is the
tangent stiffness at the present pose, including loads and ties. For a tie to a wire, and a root's spring on an arm, K
contains the reduced stiffness that applies when all awake trees on the wire or arm move together. So the computed
distance from rest is not smaller than the actual distance. Where K is not positive definite, the pose is not a stable
equilibrium, and the distance is :data:`FAR`.
"""

import warp as wp

from vinesim.kernels.plants.forces import in_middle_axes, middle_axes_scale
from vinesim.kernels.plants.kinematics import body_kinematics, parent_kinematics
from vinesim.kernels.plants.prediction import accelerate_bodies, assemble_bodies, eliminate_joints
from vinesim.kernels.plants.spatial import half_rotation
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
)

wp.set_module_options({"enable_backward": False})

REST_STEP = 10.0
"""[s] Duration T of the long step that finds the rest pose. For a mode of frequency f the displacement is too small by
the share 1 / (1 + (pi f T)^2): 0.4 % at half a hertz. TUNED"""


FAR = wp.constant(1.0e30)
"""[m] Distance from rest that is reported for a tree at an unstable pose."""


@wp.func
def is_positive_definite(a: wp.mat33):
    """Returns whether the symmetric part of a matrix is positive definite, by its leading minors (Sylvester)."""
    trace = a[0, 0] + a[1, 1] + a[2, 2]
    positive = trace > 0.0
    if positive:
        s = (0.5 / trace) * (a + wp.transpose(a))
        positive = s[0, 0] > 0.0 and s[0, 0] * s[1, 1] > s[0, 1] * s[1, 0] and wp.determinant(s) > 0.0
    return positive


@wp.func
def largest_displacement(linear: wp.vec3, angular: wp.vec3, arm: wp.vec3, so_far: float):
    """Returns the largest of ``so_far`` [m] and the displacements [m] of both ends of a body; NaN if one is NaN."""
    most = wp.max(wp.length(linear), wp.length(linear + wp.cross(angular, arm)))
    if most <= so_far or so_far != so_far:
        most = so_far
    return most


@wp.func
def soften_tie(k: int, point: wp.vec3, axis: wp.vec3, mass: float, scratch_out: Scratch):
    """Subtract a point mass ``mass`` at ``point`` of body k, for motion across ``axis``, from the body's implicit
    inertia.

    A tie (spring to a wire) adds a mass to the implicit inertia. The subtraction makes the tie as soft as tie and
    deflecting wire in series.
    """
    across = mass * (wp.identity(n=3, dtype=float) - wp.outer(axis, axis))
    arm = wp.skew(point)
    scratch_out.J[k] = scratch_out.J[k] + arm * across * arm
    scratch_out.H[k] = scratch_out.H[k] - arm * across
    scratch_out.M[k] = scratch_out.M[k] - across


@wp.func
def soften_root(k: int, axes: wp.quat, q: wp.quat, softening: wp.vec3, mass: float, scratch_out: Scratch):
    """Subtract ``mass`` times the outer square of ``softening``, in joint axes, from the implicit inertia of root k,
    because its arm twists.

    The frame to which a root is attached has no acceleration, so this is equivalent to a smaller stiffness of the
    root's spring.
    """
    s, excess, v = middle_axes_scale(q)
    gradient = wp.quat_rotate(axes * half_rotation(q), in_middle_axes(s, excess, v, softening))
    scratch_out.J[k] = scratch_out.J[k] - mass * wp.outer(gradient, gradient)


@wp.kernel
def residual_motion(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    body_length: wp.array(dtype=float),
    tie_axis: wp.array(dtype=wp.vec3),
    # in
    tie_softening: wp.array(dtype=float),
    root_softening: wp.array(dtype=wp.vec3),
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    joints: JointState,
    joints_still: JointState,
    forces_static: AppliedForces,
    # out
    static_load_out: wp.array(dtype=wp.spatial_vector),
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
    speed_out: wp.array(dtype=float),
    distance_out: wp.array(dtype=float),
    is_free_out: wp.array(dtype=wp.bool),
):
    """One thread per tree. Find the largest speed of a body's end, and the largest distance of a body's end from its
    rest position.

    Contact forces of the last step are assumed to stay constant. The speed includes the motion of a floating component
    as a whole; the distance does not, because the component may rest anywhere.

    p: parameters with ``dt`` = :data:`REST_STEP`. model: model without joint damping. body_length: [body] m. tie_axis,
    tie_softening: [tie] see :class:`vinesim.plants.ties.TieTable`. root_softening: [tree] (N m/rad)^(1/2), see
    :class:`vinesim.plants.ties.RootRests`. trees: [thread] index of the tree. forces: forces with the contact wrenches
    of the last step. joints: joints at the end of the last step; joints_still: the same joints with zero rates.
    forces_static: forces with ``static_load_out`` as the load and no contact wrenches. prediction_out:
    ``joint_qd_free`` times T / 4 is the displacement [rad] of each joint.
    speed_out, distance_out: [tree] m/s, m.
    is_free_out: [tree] whether the tree has no contacts and no floating root, so that its displacement is complete. All
    other outputs are scratch.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    first = model.tree_first[tree]
    end = first + model.tree_moving[tree] * model.pitch
    speed = float(0.0)
    is_free = bool(True)
    for k in range(first, end, model.pitch):
        above, above_motion = parent_kinematics(k, tree, model, joints, bodies_out)
        _axes, _lever, pose, motion = body_kinematics(
            above, above_motion, model.body_offset[k], model.body_rest[k], joints.joint_q[k], joints.joint_qd[k]
        )
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = motion
        arm = wp.quat_rotate(wp.transform_get_rotation(pose), wp.vec3(body_length[k], 0.0, 0.0))
        speed = largest_displacement(wp.spatial_top(motion), wp.spatial_bottom(motion), arm, speed)
        contact = forces.body_wrench[k]
        static_load_out[k] = forces.body_load[k] + contact
        is_free = is_free and model.body_root[k] < 0 and wp.length_sq(contact) == 0.0
    is_free_out[tree] = is_free
    speed_out[tree] = speed

    assemble_bodies(p, model, forces_static, joints_still, tree, 0.5, bodies_out, factors_out, scratch_out)
    for k in range(first, end, model.pitch):
        ties = model.tie_span[k]
        for t in range(ties[0], ties[1]):
            if tie_softening[t] > 0.0:
                point = wp.quat_rotate(wp.transform_get_rotation(bodies_out.body_q[k]), model.tie_point[t])
                soften_tie(k, point, tie_axis[t], 0.25 * p.dt * p.dt * tie_softening[t], scratch_out)
        if model.body_parent[k] < 0:
            soften_root(
                k, factors_out.axes[k], joints.joint_q[k], root_softening[tree], 0.25 * p.dt * p.dt, scratch_out
            )
    eliminate_joints(p, model, joints_still, bodies_out, tree, 0.5, factors_out, scratch_out)
    accelerate_bodies(p.dt, model, joints_still, bodies_out, factors_out, scratch_out, tree, prediction_out)
    distance = float(0.0)
    is_stable = bool(True)
    for k in range(first, end, model.pitch):
        is_stable = is_stable and is_positive_definite(factors_out.D[k])  # the inverse of a pivot of the block matrix
        linear = wp.spatial_top(prediction_out.body_acceleration[k])
        angular = wp.spatial_bottom(prediction_out.body_acceleration[k])
        pose = bodies_out.body_q[k]
        root = model.body_root[k]
        if root >= 0:
            whole = wp.spatial_bottom(prediction_out.body_acceleration[root])
            away = wp.transform_get_translation(pose) - wp.transform_get_translation(bodies_out.body_q[root])
            linear = linear - wp.spatial_top(prediction_out.body_acceleration[root]) - wp.cross(whole, away)
            angular = angular - whole
        arm = wp.quat_rotate(wp.transform_get_rotation(pose), wp.vec3(body_length[k], 0.0, 0.0))
        distance = largest_displacement(linear, angular, arm, distance)
    # the bodies that support a tree in contact are not in K
    distance_out[tree] = wp.where(is_stable or not is_free, 0.25 * p.dt * p.dt * distance, FAR)
