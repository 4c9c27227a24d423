"""Arguments of the articulation kernels, grouped: parameters, model, joints, bodies, forces, factors, scratch, prediction.

Arrays named ``tree_`` have one element for each tree, ``tie_`` for each tie, all others one for each body. Bodies are
numbered as :mod:`vinesim.plants.device_buffers` places them: those of a tree ``pitch`` apart, from
``tree_first`` on, parents before children. All vectors are in world axes unless said otherwise. Blocks of a spatial
inertia and of its factors are about the body's origin; see :mod:`vinesim.kernels.plants`.
"""

from typing import Any

import warp as wp


def fields(struct: Any) -> dict[str, Any]:
    """Names of a struct's fields, and Warp's variables with their types."""
    return struct.vars


@wp.struct
class SolverParameters:
    """Numbers that hold for all trees."""

    dt: float  # [s] duration of a step
    fast_rate: float  # [rad/s] faster joints: phi = 1; faster bodies feel drag
    max_rate: float  # [rad/s] no joint is integrated faster
    fault_rate: float  # [rad/s] a tree with a faster joint is not integrated
    contact_steps: int  # a count of backward Euler steps above this is not from a contact
    geometric_stiffness: float  # 1: the stiffness that loads lend to levers is in the implicit solve; 0: it is not
    gravity: wp.vec3  # [m/s^2]


@wp.func
def substep_parameters(p: SolverParameters, steps: int):
    """The same numbers for one of so many substeps."""
    return SolverParameters(
        p.dt / float(steps),
        p.fast_rate,
        p.max_rate,
        p.fault_rate,
        p.contact_steps,
        p.geometric_stiffness,
        p.gravity,
    )


@wp.struct
class ArticulationModel:
    """Topology, inertia, springs and ties: what no step changes."""

    pitch: int  # from one body of a tree to the next
    tree_first: wp.array(dtype=wp.int32)  # the first body
    tree_size: wp.array(dtype=wp.int32)  # bodies
    tree_moving: wp.array(dtype=wp.int32)  # bodies that move: without the berry clusters of a coarse tree
    tree_pose: wp.array(dtype=wp.transform)  # [m, xyzw] on which bodies without a parent stand
    body_tree: wp.array(dtype=wp.int32)
    body_parent: wp.array(dtype=wp.int32)  # -1: none
    body_root: wp.array(dtype=wp.int32)  # the floating root that a body moves with, -1 for what stands
    body_falls: wp.array(dtype=wp.bool)  # whether it moves with a floating root and no tie holds what does
    body_offset: wp.array(dtype=wp.vec3)  # [m] of the origin in the parent
    body_rest: wp.array(dtype=wp.quat)  # joint frame in the parent
    body_mass: wp.array(dtype=float)  # [kg]
    body_com: wp.array(dtype=wp.vec3)  # [m] in the body
    body_inertia: wp.array(dtype=wp.vec3)  # [kg m^2] xx, yy, zz about the centre of mass, body axes
    body_product: wp.array(dtype=wp.vec3)  # [kg m^2] yz, zx, xy of the same
    body_drag: wp.array(dtype=float)  # [m^2] drag area Cd A
    joint_stiffness: wp.array(dtype=wp.vec3)  # [N m/rad] in joint axes
    joint_damping: wp.array(dtype=wp.vec3)  # [N m s/rad] in joint axes
    tie_span: wp.array(dtype=wp.vec2i)  # [body] first tie of a body, and the one after its last
    tie_point: wp.array(dtype=wp.vec3)  # [m] in the body
    tie_stiffness: wp.array(dtype=float)  # [N/m]
    tie_damping: wp.array(dtype=float)  # [N s/m]


@wp.struct
class JointState:
    """Generalized coordinates: ball joints, and the free translation of floating roots."""

    joint_x: wp.array(dtype=wp.vec3)  # [m] origin of a floating root
    joint_xd: wp.array(dtype=wp.vec3)  # [m/s]
    joint_q: wp.array(dtype=wp.quat)  # rotation against the rest frame
    joint_qd: wp.array(dtype=wp.vec3)  # [rad/s] in joint axes


@wp.struct
class BodyState:
    """World poses and velocities at the start of the step."""

    body_q: wp.array(dtype=wp.transform)  # [m, xyzw]
    body_qd: wp.array(dtype=wp.spatial_vector)  # [m/s] of the origin, [rad/s]


@wp.struct
class AppliedForces:
    """What acts on bodies from outside."""

    tree_air: wp.array(dtype=wp.vec3)  # [m/s] velocity of the air
    root_turn: wp.array(dtype=wp.vec3)  # [tree] rad by which the arm turns the rest of the root's spring, joint axes
    root_turn_rate: wp.array(dtype=wp.vec3)  # [tree] rad/s
    tie_anchor: wp.array(dtype=wp.vec3)  # [m] where ties are held
    tie_anchor_velocity: wp.array(dtype=wp.vec3)  # [m/s] how fast that place moves
    body_load: wp.array(dtype=wp.spatial_vector)  # [N, N m] lasting, at the origin
    body_wrench: wp.array(dtype=wp.spatial_vector)  # [N, N m] of contacts, at the origin


@wp.struct
class Factors:
    """What :func:`predict` leaves for impulse responses: the factored implicit inertia (Featherstone 2008, section 7.3)."""

    axes: wp.array(dtype=wp.quat)  # joint frame in the world
    lever: wp.array(dtype=wp.vec3)  # [m] from the parent's origin to the body's
    D: wp.array(dtype=wp.mat33)  # [1/(kg m^2)] (J + metric)^-1
    DJ: wp.array(dtype=wp.mat33)  # [1]
    DH: wp.array(dtype=wp.mat33)  # [1/m]
    root_inverse_mass: wp.array(dtype=wp.mat33)  # [1/kg] acceleration of a floating root by force; 0 for what stands


@wp.struct
class Scratch:
    """Articulated-body inertia and bias of each subtree while it is built from the tips to the root."""

    J: wp.array(dtype=wp.mat33)  # [kg m^2]
    H: wp.array(dtype=wp.mat33)  # [kg m]
    M: wp.array(dtype=wp.mat33)  # [kg]
    bias: wp.array(dtype=wp.spatial_vector)  # [N, N m]
    tension: wp.array(dtype=wp.vec3)  # [N] steady force of the subtree on its lever
    Du: wp.array(dtype=wp.vec3)  # [rad/s^2] D times what drives the joint


@wp.struct
class Prediction:
    """The end of the step if nothing more touches the tree."""

    body_acceleration: wp.array(dtype=wp.spatial_vector)  # [m/s^2, rad/s^2] over the step
    joint_xd_free: wp.array(dtype=wp.vec3)  # [m/s]
    joint_qd_free: wp.array(dtype=wp.vec3)  # [rad/s]
    body_qd_free: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s]


@wp.struct
class EnergyBudget:
    """What energy each tree may have [tree] unless said otherwise; see :mod:`vinesim.kernels.plants.energy_budget`."""

    limit: wp.array(dtype=float)  # [J] least energy since something did work on the tree from outside
    last: wp.array(dtype=float)  # [J] energy that the last check left
    scale: wp.array(dtype=float)  # [J] largest kinetic energy of the last checks
    mark: wp.array(dtype=wp.int32)  # checksum of the state that the last step left
    held: wp.array(dtype=float)  # checksum of where its ties are held
    watch: wp.array(dtype=wp.int32)  # steps that are all checked, or minus the steps since the last check
    filtered: wp.array(dtype=wp.int32)  # steps so far at whose end energy was taken
    start_q: wp.array(dtype=wp.quat)  # [body] rotations of joints at the start of the step, of trees watched closely


@wp.struct
class ResponseColumns:
    """Velocities of the bodies on a path by unit impulses [slot * stride + body]; a matrix holds three impulses."""

    a_by_force: wp.array(dtype=wp.mat33)  # [1/kg]
    a_by_moment: wp.array(dtype=wp.mat33)  # [1/(kg m)]
    alpha_by_force: wp.array(dtype=wp.mat33)  # [1/(kg m)]
    alpha_by_moment: wp.array(dtype=wp.mat33)  # [1/(kg m^2)]


@wp.struct
class WrenchScratch:
    """What :func:`apply_wrenches` works with."""

    subtree_wrench: wp.array(dtype=wp.spatial_vector)  # [N, N m]
    added_acceleration: wp.array(dtype=wp.spatial_vector)  # [m/s^2, rad/s^2]


@wp.struct
class FloatingScratch:
    """Bodies of a floating component, seen from its root."""

    before: wp.array(dtype=wp.spatial_vector)  # [m, m/s] place and velocity at the start of the step
    after_q: wp.array(dtype=wp.transform)  # [m, xyzw] at its end
    after_qd: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s]
