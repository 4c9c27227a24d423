"""Views of the arrays of a batch of worlds. A view contains exactly the entries of one world.

Entry ``i`` of a world is at ``i * worlds + world`` (interleaved; see :mod:`vinesim.kernels.worlds.contact_step`), except
in the arrays of rigid bodies, where the entries of a world are contiguous.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.structs import Contacts, RigidBodies, Rows, WarmStart
from vinesim.kernels.worlds.dense_solver import WorldSearch, WorldSystem

wp.set_module_options({"enable_backward": False})

VIEW = "a.data += world; a.strides[0] = worlds * (int)sizeof(*a.data); return a;"
VIEW_2D = """
a.data += world;
a.strides[1] = worlds * (int)sizeof(*a.data);
a.strides[0] = columns * a.strides[1];
return a;
"""


@wp.func_native(VIEW)
def view_int(a: wp.array(dtype=wp.int32), world: int, worlds: int) -> wp.array(dtype=wp.int32): ...


@wp.func_native("a.data += first * worlds + world; a.strides[0] = worlds * (int)sizeof(*a.data); return a;")
def view_int_from(a: wp.array(dtype=wp.int32), first: int, world: int, worlds: int) -> wp.array(dtype=wp.int32):
    """Returns a view of one world's entries from its entry ``first`` on."""
    ...


@wp.func_native(VIEW)
def view_double(a: wp.array(dtype=wp.float64), world: int, worlds: int) -> wp.array(dtype=wp.float64): ...


@wp.func_native(VIEW)
def view_surface(a: wp.array(dtype=Surface), world: int, worlds: int) -> wp.array(dtype=Surface): ...


@wp.func_native(VIEW)
def view_vec3d(a: wp.array(dtype=wp.vec3d), world: int, worlds: int) -> wp.array(dtype=wp.vec3d): ...


@wp.func_native(VIEW)
def view_mat33d(a: wp.array(dtype=wp.mat33d), world: int, worlds: int) -> wp.array(dtype=wp.mat33d): ...


@wp.func_native(VIEW_2D)
def view_table(a: wp.array2d(dtype=wp.float64), world: int, worlds: int, columns: int) -> wp.array2d(
    dtype=wp.float64
): ...


@wp.func_native(VIEW_2D)
def view_matrix(a: wp.array2d(dtype=float), world: int, worlds: int, columns: int) -> wp.array2d(dtype=float): ...


@wp.func_native(VIEW_2D)
def view_vec3d_table(a: wp.array2d(dtype=wp.vec3d), world: int, worlds: int, columns: int) -> wp.array2d(
    dtype=wp.vec3d
): ...


@wp.func_native("a.data += first; return a;")
def part_vec3d(a: wp.array(dtype=wp.vec3d), first: int) -> wp.array(dtype=wp.vec3d): ...


@wp.func_native("a.data += first; return a;")
def part_double(a: wp.array(dtype=wp.float64), first: int) -> wp.array(dtype=wp.float64): ...


@wp.func_native("a.data += first; return a;")
def part_surface(a: wp.array(dtype=Surface), first: int) -> wp.array(dtype=Surface): ...


@wp.func_native("a.data += first * a.shape.dims[1]; return a;")
def part_matrix(a: wp.array2d(dtype=float), first: int) -> wp.array2d(dtype=float): ...


@wp.func_native("a.data += first * a.shape.dims[1]; return a;")
def part_table(a: wp.array2d(dtype=wp.float64), first: int) -> wp.array2d(dtype=wp.float64): ...


GROUP = wp.constant(32)
"""Number of worlds whose entries adjacent threads process: a GPU warp."""


@wp.func
def world_and_entry(thread: int, entries: int):
    """Returns the world that a thread processes, and the index of the thread's entry among the world's ``entries``.

    All entries of 32 worlds come before those of the next 32 worlds, so that the threads of a GPU's block read the same
    bodies from a cache. The returned world may be beyond the last world.
    """
    return thread // (GROUP * entries) * GROUP + thread % GROUP, thread // GROUP % entries


@wp.func
def view_contacts(s: Contacts, world: int, worlds: int):
    """Returns views of the contacts of one world. All are in one island and one block."""
    return Contacts(
        view_int(s.source, world, worlds),
        view_int(s.feature, world, worlds),
        view_int(s.other, world, worlds),
        view_int(s.body, world, worlds),
        s.body_slot,
        view_int(s.other_body, world, worlds),
        s.other_slot,
        view_double(s.gap, world, worlds),
        view_surface(s.surface, world, worlds),
        view_double(s.wire_stiffness, world, worlds),
        view_double(s.wire_shift, world, worlds),
        view_vec3d(s.point, world, worlds),
        view_mat33d(s.axes, world, worlds),
        s.island,
        s.block,
        s.place,
        view_vec3d(s.force, world, worlds),
    )


@wp.func
def view_rows(s: Rows, world: int, worlds: int, dofs: int):
    """Returns views of the rows of one world's contacts. ``dofs``: number of degrees of freedom of its rigid bodies."""
    return Rows(
        view_table(s.plant_jacobian, world, worlds, 12),
        view_vec3d_table(s.rigid_jacobian, world, worlds, dofs),
        view_vec3d_table(s.rigid_response, world, worlds, dofs),
        s.delassus,
        view_double(s.velocity_free, world, worlds),
        view_double(s.bias, world, worlds),
        view_double(s.impulse, world, worlds),
    )


@wp.func
def view_warm_start(s: WarmStart, world: int, worlds: int):
    """Returns views of the warm start of one world's contacts."""
    return WarmStart(
        view_int(s.count, world, worlds),
        view_int(s.feature, world, worlds),
        view_int(s.other, world, worlds),
        view_double(s.normal_impulse, world, worlds),
        view_vec3d(s.friction_impulse, world, worlds),
        view_vec3d(s.anchor, world, worlds),
    )


@wp.func
def view_system(s: WorldSystem, world: int, worlds: int, width: int):
    """Returns views of the contact system of one world; its matrix has ``width`` columns."""
    return WorldSystem(
        view_matrix(s.matrix, world, worlds, width),
        view_double(s.free, world, worlds),
        view_surface(s.surface, world, worlds),
        view_double(s.impulse, world, worlds),
        view_double(s.velocity, world, worlds),
    )


@wp.func
def view_search(s: WorldSearch, world: int, worlds: int, columns: int):
    """Returns views of the arrays that the search for one world uses; its matrix has ``columns`` columns."""
    return WorldSearch(
        view_table(s.factor, world, worlds, columns),
        view_double(s.first, world, worlds),
        view_double(s.before, world, worlds),
        view_double(s.direction, world, worlds),
    )


@wp.func
def part_of_system(s: WorldSystem, first: int):
    """Returns views of the system from row ``first`` on, for arrays in which each world's rows are contiguous."""
    return WorldSystem(
        part_matrix(s.matrix, first),
        part_double(s.free, first),
        part_surface(s.surface, first),
        part_double(s.impulse, first),
        part_double(s.velocity, first),
    )


@wp.func
def part_of_search(s: WorldSearch, first: int):
    """Returns views of the scratch of a search from row ``first`` on, for arrays in which each world's rows are
    contiguous.
    """
    return WorldSearch(
        part_table(s.factor, first),
        part_double(s.first, first),
        part_double(s.before, first),
        part_double(s.direction, first),
    )


@wp.func
def part_of_rigid(s: RigidBodies, world: int, bodies: int, dofs: int):
    """Returns views of the rigid bodies of one world, which has ``bodies`` bodies and ``dofs`` degrees of freedom. Geoms
    keep their indices in the whole batch.
    """
    return RigidBodies(
        s.xpos,
        s.xmat,
        part_table(s.cvel, world * bodies),
        part_table(s.cdof, world * dofs),
        part_vec3d(s.subtree_com, world * bodies),
        s.dof_parent,
        s.dof_tree,
        s.tree_asleep,
        part_double(s.velocity_free, world * dofs),
        part_double(s.correction, world * dofs),
        part_double(s.correction_before, world * dofs),
        s.tree_island,
    )
