"""Stress in wood: how close the ends of peduncles and the joints of canes are to failure, for whole trees at once.

One pass from the tips to the root sums the wrenches in all joints of a tree, so it costs less than a step's prediction.
The laws are those of a round rod in tension, bending and twist. Stress sum and von Mises' criterion (Young and Budynas,
Roark's Formulas for Stress and Strain, 2002, sections 8.1, 10.1): the stress in the outermost fibre is N / A + M / W,
the shear stress there is T / (2 W), and together they count as sqrt(sigma^2 + 3 tau^2).
"""

import warp as wp

from vinesim.kernels.plants.forces import middle_axes_scale
from vinesim.kernels.plants.joint_wrench import own_wrench
from vinesim.kernels.plants.structs import AppliedForces, ArticulationModel, BodyState, JointState, SolverParameters
from vinesim.kernels.plants.tree_energy import is_pushed

wp.set_module_options({"enable_backward": False})

NO_WOOD = wp.constant(0)
"""Kind of a joint that is not watched."""
STALK_BASE = wp.constant(1)
"""Kind of the joint at the shoot's end of a peduncle."""
STALK_END = wp.constant(2)
"""Kind of the joint at the bunch's end of a peduncle."""
CANE = wp.constant(3)
"""Kind of the joint at the base of a segment of cane."""


CALM_RATE = wp.constant(1.0)
"""[rad/s] Rate of a tree's fastest joint below which its wood is not watched, unless something pushes or holds the tree.
Such a tree is watched for a while longer, because a swing is slow where its stress is largest. TUNED: a calm tree of 20
bodies takes 0.05 us instead of 4."""


@wp.struct
class WoodStrength:
    """Strength of the wood at each joint, at the body's place in the device's arrays."""

    kind: wp.array(dtype=wp.int32)  # NO_WOOD, STALK_BASE, STALK_END or CANE
    pull: wp.array(dtype=float)  # [N] tension at which the wood breaks
    bend: wp.array(dtype=float)  # [N m] bending moment at which a peduncle breaks; 1 for a cane
    tie_slip: wp.array(dtype=float)  # [tie] N, force along its wire at which a tie slips
    tie_strength: wp.array(dtype=float)  # [tie] N, force at which a tie breaks
    tie_axis: wp.array(dtype=wp.vec3)  # [tie] direction of the wire


@wp.func
def used_strength(tension: float, bending: float, twist: float, pull: float, bend: float):
    """Returns the share [1] of the strength of a round rod that tension N [N], bending M and twist T [N m] together
    use; the rod breaks at 1.

    With A pull strength P = sigma A and a bending strength B = sigma W this is von Mises' stress over sigma. P and B are
    given apart, because wood is weaker in one than in the other. Compression is not counted: a stalk that is pressed
    bends.
    """
    stretched = wp.max(tension, 0.0) / pull + bending / bend
    sheared = 0.5 * twist / bend
    return wp.sqrt(stretched * stretched + 3.0 * sheared * sheared)


@wp.func
def spring_moment(stiffness: wp.vec3, q: wp.quat, further: wp.vec3):
    """Returns the elastic moment [N m] in a cane's joint as the moment of pure bending that uses the same strength:
    sqrt(M^2 + 3/4 T^2).

    further: [rad] rotation that is added to q, in joint axes.
    """
    s, _excess, v = middle_axes_scale(q)
    torque = wp.cw_mul(stiffness, 2.0 * s * v + further)
    return wp.sqrt(torque[1] * torque[1] + torque[2] * torque[2] + 0.75 * torque[0] * torque[0])


@wp.func
def tie_stretch(pose: wp.transform, point: wp.vec3, anchor: wp.vec3):
    """Returns the vector [m] from the anchor of a tie to the point that it holds; ``point``: in the body's frame."""
    return anchor - wp.transform_point(pose, point)


@wp.kernel
def find_stress(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    wood: WoodStrength,
    capacity: wp.array(dtype=float),
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    bodies: BodyState,
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    joints: JointState,
    tree_rate: wp.array(dtype=float),
    is_held: wp.array(dtype=wp.bool),
    patience: int,
    # out
    watch_out: wp.array(dtype=wp.int32),
    carried_out: wp.array(dtype=wp.spatial_vector),
    stress_out: wp.array(dtype=wp.vec2),
    largest_out: wp.array(dtype=float),
):
    """One thread per tree. Find the stress of the last step in the wood of a tree.

    bodies: motion at the start of the step. joints: joints at its end. capacity: [body] N m, moment that a cane's joint
    bears now. tree_rate: [tree] rad/s. is_held: [tree] whether hands hold the tree. patience: number of steps for which
    a tree is watched after it was last pushed, held, blown or fast. watch_out: [tree] number of steps for which it will
    yet be watched; with 0 all other outputs of the tree keep their values. carried_out: [body] scratch: wrench in each joint, about the body's origin. stress_out: [body] for a
    peduncle the used share of its strength and 0; for a cane its elastic moment [N m] now and, if the joint keeps its
    rate under a contact, at the end of the next step; both are raised for the tension in the cane. It is also read: the
    moment before the step. largest_out: [3] largest used share
    [1] of a peduncle, largest moment of a cane over its capacity [1], and largest force of a tie over what it bears [1].
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    pushed = is_pushed(forces.body_load, forces.body_wrench, first, size, model.pitch)
    watch = watch_out[tree] - 1
    if pushed or is_held[tree] or not tree_rate[tree] < CALM_RATE or wp.length_sq(forces.tree_air[tree]) > 0.0:
        watch = patience
    watch_out[tree] = wp.max(watch, 0)
    if watch <= 0:
        return
    for k in range(first, first + size * model.pitch, model.pitch):
        carried_out[k] = own_wrench(k, tree, p, model, tree_phi, tree_steps, forces, bodies, body_acceleration)
    in_stalks = float(0.0)
    in_canes = float(0.0)
    in_ties = float(0.0)
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        parent = model.body_parent[k]
        pose = bodies.body_q[k]
        force = wp.spatial_top(carried_out[k])
        moment = wp.spatial_bottom(carried_out[k])
        if parent >= 0:
            lever = wp.transform_get_translation(pose) - wp.transform_get_translation(bodies.body_q[parent])
            carried_out[parent] = carried_out[parent] + wp.spatial_vector(force, moment + wp.cross(lever, force))
        ties = model.tie_span[k]
        for t in range(ties[0], ties[1]):
            pull = model.tie_stiffness[t] * tie_stretch(pose, model.tie_point[t], forces.tie_anchor[t])
            along = wp.abs(wp.dot(pull, wood.tie_axis[t]))
            in_ties = wp.max(in_ties, wp.max(wp.length(pull) / wood.tie_strength[t], along / wood.tie_slip[t]))
        kind = wood.kind[k]
        if kind != NO_WOOD and (parent >= 0 or model.body_root[k] < 0):
            turn = wp.transform_get_rotation(pose)
            if kind == STALK_END:
                turn = wp.transform_get_rotation(bodies.body_q[parent])
            axis = wp.quat_rotate(turn, wp.vec3(1.0, 0.0, 0.0))
            tension = -wp.dot(force, axis)
            if kind == CANE:
                rest = wp.max(1.0 - wp.max(tension, 0.0) / wood.pull[k], 1.0e-3)
                turned = wp.vec3()
                if parent < 0:
                    turned = -forces.root_turn[tree]
                step = p.dt * joints.joint_qd[k]
                now = spring_moment(model.joint_stiffness[k], joints.joint_q[k], turned) / rest
                ahead = now
                if pushed:
                    # a swing that the step hardly resolves would overshoot: it does not grow by more than it has grown
                    ahead = spring_moment(model.joint_stiffness[k], joints.joint_q[k], turned + step) / rest
                    ahead = wp.min(ahead, now + wp.max(now - stress_out[k][0], 0.0))
                stress_out[k] = wp.vec2(now, ahead)
                in_canes = wp.max(in_canes, wp.max(now, ahead) / capacity[k])
            else:
                twist = wp.dot(moment, axis)
                bending = wp.length(moment - twist * axis)
                used = used_strength(tension, bending, twist, wood.pull[k], wood.bend[k])
                stress_out[k] = wp.vec2(used, 0.0)
                in_stalks = wp.max(in_stalks, used)
    wp.atomic_max(largest_out, 0, in_stalks)
    wp.atomic_max(largest_out, 1, in_canes)
    wp.atomic_max(largest_out, 2, in_ties)
