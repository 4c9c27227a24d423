"""Arguments of the articulation kernels, grouped: parameters, model, joints, bodies, forces, factors, scratch, prediction.

Arrays named ``tree_`` have one element for each tree, ``tie_`` for each tie, all others one for each body. The index of
a body is its place in the device's arrays (:mod:`vinesim.plants.device_buffers`): the bodies of a tree are ``pitch``
places apart, from ``tree_first`` on, parents before children. All vectors are in world axes unless said otherwise.
Blocks of a spatial inertia and of its factors are about the body's origin; see :mod:`vinesim.kernels.plants`.
"""

import warp as wp


@wp.struct
class SolverParameters:
    """Parameters that hold for all trees."""

    dt: float  # [s] duration of a step
    fast_rate: float  # [rad/s] a faster joint: phi = 1; a faster body: drag
    max_rate: float  # [rad/s] no joint is integrated faster
    fault_rate: float  # [rad/s] a tree with a faster joint is not integrated
    contact_steps: int  # a larger count of backward Euler steps was not set by a contact
    geometric_stiffness: float  # 1: the implicit solve includes geometric stiffness; 0: it does not
    euler_levers: float  # 1: levers of forces are those of backward Euler; 0: swings lose no energy at any phi
    gravity: wp.vec3  # [m/s^2]


@wp.func
def lever_time(p: SolverParameters, phi: float):
    """Returns the time [s] after the start of the step at which forces act on levers: (1 - phi) dt, or phi dt with
    ``p.euler_levers``; 0 without geometric stiffness."""
    return p.geometric_stiffness * (1.0 - phi + p.euler_levers * (2.0 * phi - 1.0)) * p.dt


@wp.func
def substep_parameters(p: SolverParameters, steps: int):
    """Returns the parameters for one substep of a step that is divided into ``steps`` substeps."""
    return SolverParameters(
        p.dt / float(steps),
        p.fast_rate,
        p.max_rate,
        p.fault_rate,
        p.contact_steps,
        p.geometric_stiffness,
        p.euler_levers,
        p.gravity,
    )


@wp.struct
class ArticulationModel:
    """Topology, inertia, springs and ties: values that no step changes."""

    pitch: int  # distance in memory from one body of a tree to the next
    tree_first: wp.array(dtype=wp.int32)  # index of the tree's first body
    tree_size: wp.array(dtype=wp.int32)  # number of bodies
    tree_moving: wp.array(dtype=wp.int32)  # number of bodies, without the berry clusters of a coarse tree
    tree_pose: wp.array(dtype=wp.transform)  # [m, xyzw] pose of the frame of bodies without a parent
    body_tree: wp.array(dtype=wp.int32)
    body_parent: wp.array(dtype=wp.int32)  # -1: none
    body_root: wp.array(dtype=wp.int32)  # floating root of the body's component; -1 for bodies on a fixed root
    body_falls: wp.array(dtype=wp.bool)  # whether the body is in a floating component that no tie holds
    body_offset: wp.array(dtype=wp.vec3)  # [m] body's origin in the parent's frame
    body_rest: wp.array(dtype=wp.quat)  # joint frame in the parent's frame
    body_mass: wp.array(dtype=float)  # [kg]
    body_com: wp.array(dtype=wp.vec3)  # [m] centre of mass in the body's frame
    body_inertia: wp.array(dtype=wp.vec3)  # [kg m^2] xx, yy, zz about the centre of mass, body axes
    body_product: wp.array(dtype=wp.vec3)  # [kg m^2] products of inertia yz, zx, xy, about the same point and axes
    body_drag: wp.array(dtype=float)  # [m^2] drag area Cd A
    joint_stiffness: wp.array(dtype=wp.vec3)  # [N m/rad] in joint axes
    joint_damping: wp.array(dtype=wp.vec3)  # [N m s/rad] in joint axes
    tie_span: wp.array(dtype=wp.vec2i)  # [body] first tie of a body, and the tie after its last
    tie_point: wp.array(dtype=wp.vec3)  # [m] in the body's frame
    tie_stiffness: wp.array(dtype=float)  # [N/m]
    tie_damping: wp.array(dtype=float)  # [N s/m]


@wp.struct
class JointState:
    """Generalized coordinates of ball joints, and of the free translation of floating roots."""

    joint_x: wp.array(dtype=wp.vec3)  # [m] origin of a floating root
    joint_xd: wp.array(dtype=wp.vec3)  # [m/s]
    joint_q: wp.array(dtype=wp.quat)  # rotation relative to the rest frame
    joint_qd: wp.array(dtype=wp.vec3)  # [rad/s] in joint axes


@wp.struct
class BodyState:
    """World poses and velocities at the start of the step."""

    body_q: wp.array(dtype=wp.transform)  # [m, xyzw]
    body_qd: wp.array(dtype=wp.spatial_vector)  # [m/s] of the origin, [rad/s]


@wp.struct
class AppliedForces:
    """External forces on bodies, and prescribed motions of air, arms and anchors."""

    tree_air: wp.array(dtype=wp.vec3)  # [m/s] velocity of the air
    root_turn: wp.array(dtype=wp.vec3)  # [tree] rad, rotation of the root spring's rest pose by the arm, joint axes
    root_turn_rate: wp.array(dtype=wp.vec3)  # [tree] rad/s
    tie_anchor: wp.array(dtype=wp.vec3)  # [m] fixed end of the tie in the world
    tie_anchor_velocity: wp.array(dtype=wp.vec3)  # [m/s] velocity of that point
    body_load: wp.array(dtype=wp.spatial_vector)  # [N, N m] lasting load, at the body's origin
    body_wrench: wp.array(dtype=wp.spatial_vector)  # [N, N m] wrench of contacts, at the body's origin


@wp.struct
class Factors:
    """The factored implicit inertia that :func:`predict` keeps for impulse responses (Featherstone 2008, section 7.3)."""

    axes: wp.array(dtype=wp.quat)  # joint frame in the world
    lever: wp.array(dtype=wp.vec3)  # [m] from the parent's origin to the body's
    D: wp.array(dtype=wp.mat33)  # [1/(kg m^2)] (J + metric)^-1
    DJ: wp.array(dtype=wp.mat33)  # [1]
    DH: wp.array(dtype=wp.mat33)  # [1/m]
    root_inverse_mass: wp.array(dtype=wp.mat33)  # [1/kg] acceleration of a floating root per force; 0 for other bodies


@wp.struct
class Scratch:
    """Articulated-body inertia and bias of each subtree while it is built from the tips to the root."""

    J: wp.array(dtype=wp.mat33)  # [kg m^2]
    H: wp.array(dtype=wp.mat33)  # [kg m]
    M: wp.array(dtype=wp.mat33)  # [kg]
    bias: wp.array(dtype=wp.spatial_vector)  # [N, N m]
    tension: wp.array(dtype=wp.vec3)  # [N] steady force of the subtree that pulls on the body's lever
    Du: wp.array(dtype=wp.vec3)  # [rad/s^2] D times the joint's driving torque


@wp.struct
class Prediction:
    """Motion of the bodies over the step without the contacts of this step."""

    body_acceleration: wp.array(dtype=wp.spatial_vector)  # [m/s^2, rad/s^2] mean over the step
    joint_xd_free: wp.array(dtype=wp.vec3)  # [m/s]
    joint_qd_free: wp.array(dtype=wp.vec3)  # [rad/s]
    body_qd_free: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s]


@wp.struct
class FastScratch:
    """Joints of fast trees at the start of the step, and after the step as a whole; see
    :mod:`vinesim.kernels.plants.fast_motion`."""

    start_joint_q: wp.array(dtype=wp.quat)  # [body]
    start_joint_qd: wp.array(dtype=wp.vec3)  # [body] rad/s
    coarse_joint_q: wp.array(dtype=wp.quat)  # [body]
    coarse_joint_qd: wp.array(dtype=wp.vec3)  # [body] rad/s


@wp.struct
class EnergyBudget:
    """Largest energy that each tree may have, and its bookkeeping. Arrays are [tree] unless said otherwise; see
    :mod:`vinesim.kernels.plants.energy_budget`."""

    limit: wp.array(dtype=float)  # [J] least energy since an external force last did work on the tree
    last: wp.array(dtype=float)  # [J] energy after the last check
    scale: wp.array(dtype=float)  # [J] largest kinetic energy of the last checks
    mark: wp.array(dtype=wp.int32)  # checksum of the state after the last step
    held: wp.array(dtype=float)  # checksum of the anchors of the tree's ties
    watch: wp.array(dtype=wp.int32)  # number of next steps to check; if negative, -(steps since the last check)
    filtered: wp.array(dtype=wp.int32)  # number of steps so far that removed energy
    start_q: wp.array(dtype=wp.quat)  # [body] rotations of joints at the start of the step, for trees watched closely


@wp.struct
class ResponseColumns:
    """Velocity changes of the bodies on a path by unit impulses [slot * stride + body]. Each matrix has one column for
    each of three unit impulses."""

    a_by_force: wp.array(dtype=wp.mat33)  # [1/kg]
    a_by_moment: wp.array(dtype=wp.mat33)  # [1/(kg m)]
    alpha_by_force: wp.array(dtype=wp.mat33)  # [1/(kg m)]
    alpha_by_moment: wp.array(dtype=wp.mat33)  # [1/(kg m^2)]


@wp.struct
class WrenchScratch:
    """Scratch of :func:`apply_wrenches`."""

    subtree_wrench: wp.array(dtype=wp.spatial_vector)  # [N, N m]
    added_acceleration: wp.array(dtype=wp.spatial_vector)  # [m/s^2, rad/s^2]


@wp.struct
class FloatingScratch:
    """Motion of the bodies of a floating component, relative to its root."""

    before: wp.array(dtype=wp.spatial_vector)  # [m, m/s] position and velocity at the start of the step
    after_q: wp.array(dtype=wp.transform)  # [m, xyzw] pose at the end of the step
    after_qd: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s] velocity at the end of the step
