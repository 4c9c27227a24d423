"""Views of the contact arrays. A view contains exactly the entries of one tree.

Entry ``i`` of a tree is at ``i * trees + tree``; see :mod:`vinesim.kernels.contact.tree_islands`.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.structs import Contacts, Rows, WarmStart
from vinesim.kernels.contact.tree_solver import TreeSearch, TreeSystem

wp.set_module_options({"enable_backward": False})

VIEW = "a.data += tree; a.strides[0] = trees * (int)sizeof(*a.data); return a;"
VIEW_2D = """
a.data += tree;
a.strides[1] = trees * (int)sizeof(*a.data);
a.strides[0] = columns * a.strides[1];
return a;
"""


@wp.func_native(VIEW)
def view_int(a: wp.array(dtype=wp.int32), tree: int, trees: int) -> wp.array(dtype=wp.int32): ...


@wp.func_native(VIEW)
def view_double(a: wp.array(dtype=wp.float64), tree: int, trees: int) -> wp.array(dtype=wp.float64): ...


@wp.func_native(VIEW)
def view_surface(a: wp.array(dtype=Surface), tree: int, trees: int) -> wp.array(dtype=Surface): ...


@wp.func_native(VIEW)
def view_vec3d(a: wp.array(dtype=wp.vec3d), tree: int, trees: int) -> wp.array(dtype=wp.vec3d): ...


@wp.func_native(VIEW)
def view_mat33d(a: wp.array(dtype=wp.mat33d), tree: int, trees: int) -> wp.array(dtype=wp.mat33d): ...


@wp.func_native(VIEW_2D)
def view_table(a: wp.array2d(dtype=wp.float64), tree: int, trees: int, columns: int) -> wp.array2d(
    dtype=wp.float64
): ...


@wp.func_native(VIEW_2D)
def view_matrix(a: wp.array2d(dtype=float), tree: int, trees: int, columns: int) -> wp.array2d(dtype=float): ...


@wp.func_native("a.data += first; return a;")
def part_double(a: wp.array(dtype=wp.float64), first: int) -> wp.array(dtype=wp.float64): ...


@wp.func_native("a.data += first; return a;")
def part_surface(a: wp.array(dtype=Surface), first: int) -> wp.array(dtype=Surface): ...


@wp.func_native("a.data += first * a.shape.dims[1]; return a;")
def part_matrix(a: wp.array2d(dtype=float), first: int) -> wp.array2d(dtype=float): ...


@wp.func_native("a.data += first * a.shape.dims[1]; return a;")
def part_table(a: wp.array2d(dtype=wp.float64), first: int) -> wp.array2d(dtype=wp.float64): ...


GROUP = wp.constant(32)
"""Number of trees whose entries adjacent threads process: a GPU warp."""


@wp.func
def tree_and_entry(thread: int, entries: int):
    """Returns the tree that a thread processes, and the index of the thread's entry among the tree's ``entries``.

    All entries of 32 trees come before those of the next 32 trees, so that the threads of a GPU's block read the same
    bodies from a cache. The returned tree may be beyond the last tree.
    """
    return thread // (GROUP * entries) * GROUP + thread % GROUP, thread // GROUP % entries


@wp.func
def view_contacts(s: Contacts, tree: int, trees: int):
    """Returns views of the contacts of one tree. All are in one island and one block."""
    return Contacts(
        view_int(s.source, tree, trees),
        view_int(s.feature, tree, trees),
        view_int(s.other, tree, trees),
        view_int(s.body, tree, trees),
        s.body_slot,
        view_int(s.other_body, tree, trees),
        s.other_slot,
        view_double(s.gap, tree, trees),
        view_surface(s.surface, tree, trees),
        view_double(s.wire_stiffness, tree, trees),
        view_double(s.wire_shift, tree, trees),
        view_vec3d(s.point, tree, trees),
        view_mat33d(s.axes, tree, trees),
        s.island,
        s.block,
        s.place,
        view_vec3d(s.force, tree, trees),
    )


@wp.func
def view_rows(s: Rows, tree: int, trees: int):
    """Returns views of the rows of one tree's contacts."""
    return Rows(
        view_table(s.plant_jacobian, tree, trees, 12),
        s.rigid_jacobian,
        s.rigid_response,
        s.delassus,
        view_double(s.velocity_free, tree, trees),
        view_double(s.bias, tree, trees),
        view_double(s.impulse, tree, trees),
    )


@wp.func
def view_warm_start(s: WarmStart, tree: int, trees: int):
    """Returns views of the warm start of one tree's contacts."""
    return WarmStart(
        view_int(s.count, tree, trees),
        view_int(s.feature, tree, trees),
        view_int(s.other, tree, trees),
        view_double(s.normal_impulse, tree, trees),
        view_vec3d(s.friction_impulse, tree, trees),
        view_vec3d(s.anchor, tree, trees),
    )


@wp.func
def view_system(s: TreeSystem, tree: int, trees: int, width: int):
    """Returns views of the contact system of one tree; its matrix has ``width`` columns."""
    return TreeSystem(
        view_matrix(s.matrix, tree, trees, width),
        view_double(s.free, tree, trees),
        view_surface(s.surface, tree, trees),
        view_double(s.impulse, tree, trees),
        view_double(s.velocity, tree, trees),
    )


@wp.func
def view_search(s: TreeSearch, tree: int, trees: int, columns: int):
    """Returns views of the arrays that the search for one tree uses; its matrix has ``columns`` columns."""
    return TreeSearch(
        view_table(s.factor, tree, trees, columns),
        view_double(s.first, tree, trees),
        view_double(s.before, tree, trees),
        view_double(s.direction, tree, trees),
    )


@wp.func
def part_of_system(s: TreeSystem, first: int):
    """Returns views of the system from row ``first`` on, for arrays in which each tree's rows are contiguous."""
    return TreeSystem(
        part_matrix(s.matrix, first),
        part_double(s.free, first),
        part_surface(s.surface, first),
        part_double(s.impulse, first),
        part_double(s.velocity, first),
    )


@wp.func
def part_of_search(s: TreeSearch, first: int):
    """Returns views of the scratch of a search from row ``first`` on, for arrays in which each tree's rows are
    contiguous.
    """
    return TreeSearch(
        part_table(s.factor, first),
        part_double(s.first, first),
        part_double(s.before, first),
        part_double(s.direction, first),
    )
