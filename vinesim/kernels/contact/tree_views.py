"""Views of the arrays of contacts: with an offset and a pitch they show one tree all of its own entries, and nothing else.

Entry ``i`` of a tree lies at ``i * trees + tree``: see :mod:`vinesim.kernels.contact.tree_islands`.
"""

import warp as wp

from vinesim.kernels.contact.structs import Candidates, Contacts, Islands, Rows, SolverScratch, WarmStart

wp.set_module_options({"enable_backward": False})

VIEW = "a.data += tree; a.strides[0] = trees * (int)sizeof(*a.data); return a;"
VIEW_COLUMNS = "a.data += first * (a.strides[1] / (int)sizeof(*a.data)); a.shape.dims[1] = count; return a;"
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
def view_vec3d(a: wp.array(dtype=wp.vec3d), tree: int, trees: int) -> wp.array(dtype=wp.vec3d): ...


@wp.func_native(VIEW)
def view_mat33d(a: wp.array(dtype=wp.mat33d), tree: int, trees: int) -> wp.array(dtype=wp.mat33d): ...


@wp.func_native(VIEW_2D)
def view_table(a: wp.array2d(dtype=wp.float64), tree: int, trees: int, columns: int) -> wp.array2d(
    dtype=wp.float64
): ...


@wp.func_native(VIEW_COLUMNS)
def columns_int(a: wp.array2d(dtype=wp.int32), first: int, count: int) -> wp.array2d(dtype=wp.int32): ...


@wp.func_native(VIEW_COLUMNS)
def columns_double(a: wp.array2d(dtype=wp.float64), first: int, count: int) -> wp.array2d(dtype=wp.float64): ...


@wp.func_native(VIEW_COLUMNS)
def columns_vec3d(a: wp.array2d(dtype=wp.vec3d), first: int, count: int) -> wp.array2d(dtype=wp.vec3d): ...


@wp.func
def view_candidates(s: Candidates, first: int, count: int):
    """Candidates with the slots from ``first`` on."""
    return Candidates(
        s.count,
        s.is_impact,
        s.near_geoms,
        s.skipped_geoms,
        columns_int(s.feature, first, count),
        columns_int(s.other, first, count),
        columns_double(s.gap, first, count),
        columns_double(s.end_gap, first, count),
        columns_vec3d(s.normal, first, count),
        columns_vec3d(s.point, first, count),
    )


@wp.func
def view_contacts(s: Contacts, tree: int, trees: int):
    """The contacts of one tree. Islands, blocks and places are the same for all: one island, one block, in order."""
    return Contacts(
        view_int(s.source, tree, trees),
        view_int(s.feature, tree, trees),
        view_int(s.other, tree, trees),
        view_int(s.body, tree, trees),
        s.body_slot,
        view_int(s.other_body, tree, trees),
        s.other_slot,
        view_double(s.gap, tree, trees),
        view_double(s.friction, tree, trees),
        view_double(s.stiffness, tree, trees),
        view_double(s.damping, tree, trees),
        view_double(s.compliance, tree, trees),
        view_vec3d(s.point, tree, trees),
        view_mat33d(s.axes, tree, trees),
        s.island,
        s.block,
        s.place,
        view_vec3d(s.force, tree, trees),
    )


@wp.func
def view_rows(s: Rows, tree: int, trees: int):
    """The rows of one tree's contacts, and its Delassus matrix."""
    return Rows(
        view_table(s.plant_jacobian, tree, trees, 12),
        s.rigid_jacobian,
        s.plant_response,
        s.other_response,
        s.rigid_response,
        view_double(s.delassus, tree, trees),
        view_double(s.velocity_free, tree, trees),
        view_double(s.bias, tree, trees),
        view_double(s.impulse, tree, trees),
        s.rigid_velocity,
    )


@wp.func
def view_scratch(s: SolverScratch, tree: int, trees: int):
    """What the solve of one tree works with."""
    return SolverScratch(
        view_double(s.matrix, tree, trees),
        view_table(s.columns, tree, trees, 1),
        s.rigid_system,
        view_double(s.impulse_first, tree, trees),
        view_double(s.impulse_before, tree, trees),
        view_double(s.direction, tree, trees),
    )


@wp.func
def view_warm_start(s: WarmStart, tree: int, trees: int):
    """What one tree's contacts start from."""
    return WarmStart(
        view_int(s.count, tree, trees),
        view_int(s.feature, tree, trees),
        view_int(s.other, tree, trees),
        view_double(s.normal_impulse, tree, trees),
        view_vec3d(s.friction_impulse, tree, trees),
        view_vec3d(s.anchor, tree, trees),
    )


@wp.func
def view_islands(s: Islands, tree: int, trees: int):
    """One island of one block: its first contact is 0, its end the number of the tree's contacts."""
    return Islands(
        view_int(s.start, tree, trees),
        s.first_block,
        view_int(s.start, tree, trees),
        s.matrix_start,
        s.contact,
        s.label,
        s.block_label,
        s.first_dof,
        s.dof,
        s.rigid_last_contact,
        view_int(s.sweeps, tree, trees),
    )
