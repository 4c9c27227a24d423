"""Energy of trees: kinetic energy, and potential energy of weight, springs and ties (springs to wires or hands).

Also checksums by which changes of state and of forces are detected.
"""

import warp as wp

from vinesim.kernels.plants.kinematics import body_kinematics
from vinesim.kernels.plants.structs import AppliedForces, ArticulationModel, BodyState, JointState, SolverParameters

wp.set_module_options({"enable_backward": False})


@wp.func
def spring_energy(stiffness: wp.vec3, q: wp.quat):
    """Returns theta^T K theta / 2 [J], with theta the rotation vector of q and K the diagonal matrix of
    ``stiffness``."""
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
    """Returns kinetic and potential energy of one body, the sum of the absolute values of their terms [J], and a
    checksum.

    The potential energy is the sum of the energies of the body's weight, its joint's spring and its ties (springs to
    wires or hands). The checksum is computed from the anchors of the ties. pose: [m] relative to ``origin`` [m], world
    axes.
    """
    com = model.body_com[k]
    mass = model.body_mass[k]
    inertia = model.body_inertia[k]
    product = model.body_product[k]
    stiffness = model.joint_stiffness[k]
    ties = model.tie_span[k]
    turn = wp.transform_get_rotation(pose)
    arm = wp.quat_rotate(turn, com)
    omega = wp.spatial_bottom(motion)
    velocity = wp.spatial_top(motion) + wp.cross(omega, arm)
    spin = wp.quat_rotate_inv(turn, omega)
    crossed = wp.vec3(spin[1] * spin[2], spin[2] * spin[0], spin[0] * spin[1])
    kinetic = 0.5 * (mass * wp.dot(velocity, velocity) + wp.dot(inertia, wp.cw_mul(spin, spin))) + wp.dot(
        product, crossed
    )
    place = wp.transform_get_translation(pose)
    weight = mass * wp.dot(p.gravity, place + arm)
    elastic = spring_energy(stiffness, joint_q)
    held = float(0.0)
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
    """Returns the sums of :func:`body_energy` over the bodies of a tree, in the pose of ``joints``.

    Positions are relative to the tree's origin, so that no digits are lost far from the world's origin.
    """
    energy = wp.vec4()
    first = model.tree_first[tree]
    origin = wp.transform_get_translation(model.tree_pose[tree])
    standing = wp.transform(wp.vec3(), wp.transform_get_rotation(model.tree_pose[tree]))
    pose = wp.transform()
    motion = wp.spatial_vector()
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        parent = model.body_parent[k]
        offset = model.body_offset[k]
        rest = model.body_rest[k]
        q = joints.joint_q[k]
        qd = joints.joint_qd[k]
        if parent < 0:
            pose = standing
            motion = wp.spatial_vector()
        elif parent != k - model.pitch:  # otherwise the last body is the parent
            pose = bodies_out.body_q[parent]
            motion = bodies_out.body_qd[parent]
        _axes, _lever, pose, motion = body_kinematics(pose, motion, offset, rest, q, qd)
        energy += body_energy(k, p, model, forces, q, origin, pose, motion)
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = motion
    return energy


@wp.func_native("""
unsigned long long sum = 0, weight = 1;
for (int row = 0; row < (pitch == 1 ? 1 : count); ++row) {
    const int length = pitch == 1 ? count : 1;
    const char* turns = (const char*)(q.data + first + row * pitch);
    const char* rates = (const char*)(qd.data + first + row * pitch);
    unsigned long long word;
    unsigned last = 0;
    for (int i = 0; i < 2 * length; ++i, weight += 2) {
        memcpy(&word, turns + 8 * i, 8);
        sum += weight * word;
    }
    for (int i = 0; i < 3 * length / 2; ++i, weight += 2) {
        memcpy(&word, rates + 8 * i, 8);
        sum += weight * word;
    }
    if (length % 2) memcpy(&last, rates + 12 * length - 4, 4);
    sum += weight * last;
}
return (int)(sum >> 32) ^ (int)sum;
""")
def state_mark(q: wp.array(dtype=wp.quat), qd: wp.array(dtype=wp.vec3), first: int, count: int, pitch: int) -> int:
    """Returns a checksum of the bits of ``count`` joints, ``pitch`` apart."""
    ...


@wp.func_native("""
if (pitch == 1) {
    unsigned any = 0;
    const unsigned* a = (const unsigned*)(load.data + first);
    const unsigned* b = (const unsigned*)(wrench.data + first);
    for (int i = 0; i < 6 * count; ++i) any |= a[i] | b[i];
    return any << 1 != 0;
}
unsigned long long any = 0;
for (int start = 0; start < count && !any; start += 4) {  // four at a time: a GPU fetches them at once
    #pragma unroll
    for (int i = 0; i < 4; ++i) {
        const int row = start + i < count ? start + i : start;
        const unsigned long long* a = (const unsigned long long*)(load.data + first + row * pitch);
        const unsigned long long* b = (const unsigned long long*)(wrench.data + first + row * pitch);
        any |= (a[0] | a[1] | a[2] | b[0] | b[1] | b[2]) & 0x7fffffff7fffffff;
    }
}
return any != 0;
""")
def is_pushed(
    load: wp.array(dtype=wp.spatial_vector),
    wrench: wp.array(dtype=wp.spatial_vector),
    first: int,
    count: int,
    pitch: int,
) -> bool:
    """Returns whether a load or a contact acts on one of ``count`` bodies: whether a component is not zero."""
    ...
