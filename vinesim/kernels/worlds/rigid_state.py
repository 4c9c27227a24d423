"""Numbers that the contacts of a batch take from mujoco_warp: poses, motion axes, predicted velocities, and the inverse
of the effective mass of each world.

mujoco_warp's arrays have a row for each world and single precision. The contact kernels need double precision.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double
from vinesim.kernels.contact.structs import RigidBodies
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.kernels.worlds.views import view_table

wp.set_module_options({"enable_backward": False})

QUADRATIC = wp.constant(1)
"""State of a constraint that resists like a spring: MuJoCo's mjCNSTRSTATE_QUADRATIC."""


@wp.struct
class WarpState:
    """Arrays of mujoco_warp under their names there, with a row for each world."""

    geom_xpos: wp.array2d(dtype=wp.vec3)
    geom_xmat: wp.array2d(dtype=wp.mat33)
    cvel: wp.array2d(dtype=wp.spatial_vector)
    """[world, body] Velocity: angular, linear."""
    cdof: wp.array2d(dtype=wp.spatial_vector)
    """[world, dof] Motion axis: angular, linear."""
    subtree_com: wp.array2d(dtype=wp.vec3)
    qvel: wp.array2d(dtype=float)
    qacc: wp.array2d(dtype=float)


@wp.struct
class EffectiveMass:
    """Arrays of mujoco_warp from which the effective mass of a step follows."""

    qH: wp.array2d(dtype=float)
    """[world, entry] Sparse mass matrix with implicit damping and servos."""
    row_start: wp.array(dtype=wp.int32)
    """[dof] Index of the first entry of the row: MuJoCo's M_rowadr."""
    row_count: wp.array(dtype=wp.int32)
    """[dof] Number of entries of the row: MuJoCo's M_rownnz."""
    column: wp.array(dtype=wp.int32)
    """[entry] Column of the entry: MuJoCo's M_colind."""
    nefc: wp.array(dtype=wp.int32)
    """[world] Number of rows of active constraints."""
    J_rownnz: wp.array2d(dtype=wp.int32)
    """[world, row] Number of entries of a row of the constraints' Jacobian."""
    J_rowadr: wp.array2d(dtype=wp.int32)
    """[world, row] Index of the first entry of the row."""
    J_colind: wp.array3d(dtype=wp.int32)
    """[world, 0, entry] Degree of freedom of the entry."""
    J: wp.array3d(dtype=float)
    """[world, 0, entry] Jacobian of the constraints, sparse."""
    D: wp.array2d(dtype=float)
    """[world, row] Stiffness of the constraints."""
    state: wp.array2d(dtype=wp.int32)
    """[world, row] State of the constraints: MuJoCo's mjtConstraintState."""


@wp.func
def write_spatial(row: int, value: wp.spatial_vector, rows_out: wp.array2d(dtype=wp.float64)):
    """Write six numbers into a row of a table."""
    for k in range(6):
        rows_out[row, k] = wp.float64(value[k])


@wp.kernel
def take_rigid_state(
    # model
    dt: wp.float64,
    # in
    worlds: int,
    geom: wp.array(dtype=wp.int32),
    first_pose: int,
    source: WarpState,
    # out
    rigid_out: RigidBodies,
):
    """One thread per item of a world: its moving geoms, then its bodies, then its degrees of freedom.

    geom: [m] MuJoCo index of moving geom m. first_pose: index of the first pose of a moving geom in ``rigid_out``.
    """
    world = wp.tid() % worlds
    item = wp.tid() / worlds
    moving = geom.shape[0]
    bodies = source.cvel.shape[1]
    if item < moving:
        pose = first_pose + item * worlds + world
        rigid_out.xpos[pose] = to_double(source.geom_xpos[world, geom[item]])
        turned = source.geom_xmat[world, geom[item]]
        rotation = wp.mat33d()
        for i in range(3):
            for k in range(3):
                rotation[i, k] = wp.float64(turned[i, k])
        rigid_out.xmat[pose] = rotation
        return
    item = item - moving
    if item < bodies:
        write_spatial(world * bodies + item, source.cvel[world, item], rigid_out.cvel)
        rigid_out.subtree_com[world * bodies + item] = to_double(source.subtree_com[world, item])
        return
    item = item - bodies
    dofs = source.qvel.shape[1]
    dof = world * dofs + item
    write_spatial(dof, source.cdof[world, item], rigid_out.cdof)
    velocity = wp.float64(source.qvel[world, item])
    rigid_out.correction_before[dof] = rigid_out.correction[dof]
    rigid_out.correction[dof] = velocity - rigid_out.velocity_free[dof]
    rigid_out.velocity_free[dof] = velocity + dt * wp.float64(source.qacc[world, item])


@wp.kernel
def invert_effective_mass(
    # model
    mass: EffectiveMass,
    # in
    worlds: int,
    dofs: int,
    world_contacts: WorldContacts,
    # out
    inverse_out: wp.array2d(dtype=wp.float64),
):
    """One thread per world. Compute the inverse of the effective mass of its rigid bodies, if the world has contacts
    with plants: M^ + J^T D J of the constraints that resist like springs.

    M^ is the mass matrix with implicit damping and servos. A contact between rigid bodies that slides does not resist
    (in :class:`vinesim.rigid.effective_mass.EffectiveMass` it resists along its normal). The matrix is symmetric and
    positive definite, so Gauss-Jordan elimination in place needs no pivots.
    """
    world = wp.tid()
    if world_contacts.count[world] == 0:
        return
    H = view_table(inverse_out, world, worlds, dofs)
    for i in range(dofs):
        for k in range(dofs):
            H[i, k] = wp.float64(0.0)
    for i in range(dofs):
        for at in range(mass.row_start[i], mass.row_start[i] + mass.row_count[i]):
            k = mass.column[at]
            H[i, k] = wp.float64(mass.qH[world, at])
            H[k, i] = H[i, k]
    for row in range(mass.nefc[world]):
        if mass.state[world, row] == QUADRATIC:
            stiffness = wp.float64(mass.D[world, row])
            begin = mass.J_rowadr[world, row]
            end = begin + mass.J_rownnz[world, row]
            for at in range(begin, end):
                i = mass.J_colind[world, 0, at]
                along = stiffness * wp.float64(mass.J[world, 0, at])
                for other in range(begin, end):
                    k = mass.J_colind[world, 0, other]
                    H[i, k] = H[i, k] + along * wp.float64(mass.J[world, 0, other])
    one = wp.float64(1.0)
    for pivot in range(dofs):
        scale = one / H[pivot, pivot]
        H[pivot, pivot] = one
        for k in range(dofs):
            H[pivot, k] = H[pivot, k] * scale
        for i in range(dofs):
            if i != pivot:
                factor = H[i, pivot]
                if factor != wp.float64(0.0):
                    H[i, pivot] = wp.float64(0.0)
                    for k in range(dofs):
                        H[i, k] = H[i, k] - factor * H[pivot, k]
