"""Response of plants to the rows of contacts: velocities of all bodies in contact by unit impulses along three rows.

The articulated-body algorithm with impulses only (Featherstone 2008, section 7.3): impulses travel inward along the path
to the root, the velocities that they cause travel outward. A contact of two plant bodies has two *sides*, number
2 * contact and 2 * contact + 1; of one with a rigid geom the second is empty.
"""

import warp as wp

from vinesim.kernels.articulation.structs import ArticulationModel, Factors
from vinesim.kernels.contact.jacobians import row_columns

wp.set_module_options({"enable_backward": False})


@wp.struct
class SideRows:
    """Unit impulses along the rows of each side of a contact [side], a column for each row, and what they cause."""

    force: wp.array(dtype=wp.mat33)
    """[1] at the origin of the body."""
    moment: wp.array(dtype=wp.mat33)
    """[m]"""
    linear: wp.array2d(dtype=wp.mat33)
    """[side, k] velocity [1/kg] of the k-th listed body of the tree, up to the side's own body."""
    angular: wp.array2d(dtype=wp.mat33)
    """[side, k] 1/(kg m)"""


@wp.struct
class ResponseScratch:
    """Velocities of all bodies of the tree [row * stride + body of the tree]; one row serves all sides in turn on a CPU,
    where it stays in the cache, and each side has its own on a GPU."""

    a: wp.array(dtype=wp.mat33)
    alpha: wp.array(dtype=wp.mat33)


@wp.func
def carry_inward(
    body: int, first: int, shift: int, force: wp.mat33, moment: wp.mat33, model: ArticulationModel, factors: Factors,
    scratch_out: ResponseScratch,
):  # fmt: skip
    """Carry impulses at a body along its path to the root; ``alpha``: what each joint takes of them, 0 beside the path.

    Returns the root, and how fast it moves if it floats.
    """
    path = int(body)
    root = int(body)
    a = wp.mat33()
    for i in range((body - first) / model.pitch + 1):
        k = body - i * model.pitch
        taken = wp.mat33()
        if k == path:
            taken = factors.D[k] * moment
            force = force - wp.transpose(factors.DH[k]) * moment
            moment = moment - wp.transpose(factors.DJ[k]) * moment + wp.skew(factors.lever[k]) * force
            path = model.body_parent[k]
            if path < 0:
                root = k
                a = factors.root_inverse_mass[k] * force
        scratch_out.alpha[shift + (k - first) / model.pitch] = taken
    return root, a


@wp.func
def carry_outward(
    body: int, first: int, shift: int, root: int, root_a: wp.mat33, model: ArticulationModel, factors: Factors,
    scratch_out: ResponseScratch,
):  # fmt: skip
    """From what joints take of impulses to the velocities of all bodies up to ``body``."""
    a = wp.mat33()
    alpha = wp.mat33()
    for i in range((body - first) / model.pitch + 1):
        k = first + i * model.pitch
        parent = model.body_parent[k]
        if parent < 0:
            a = wp.mat33()
            alpha = wp.mat33()
            if k == root:
                a = root_a
        else:
            if parent != k - model.pitch:
                a = scratch_out.a[shift + (parent - first) / model.pitch]
                alpha = scratch_out.alpha[shift + (parent - first) / model.pitch]
            a = a - wp.skew(factors.lever[k]) * alpha
        alpha = alpha + scratch_out.alpha[shift + i] - factors.DJ[k] * alpha - factors.DH[k] * a
        scratch_out.a[shift + i] = a
        scratch_out.alpha[shift + i] = alpha


@wp.kernel
def respond_to_sides(
    # model
    model: ArticulationModel,
    stride: int,
    scratch_rows: int,
    place: wp.array(dtype=wp.int32),
    # in
    items: wp.array(dtype=wp.int32),
    touched: wp.array(dtype=wp.int32),
    tree_start: wp.array(dtype=wp.int32),
    body_slot: wp.array(dtype=wp.int32),
    other_slot: wp.array(dtype=wp.int32),
    jacobian: wp.array2d(dtype=wp.float64),
    factors: Factors,
    # out
    scratch_out: ResponseScratch,
    sides_out: SideRows,
):
    """One thread per side of a contact: velocities of the listed bodies of its tree, up to its own.

    touched: [slot] bodies in contact, sorted; those after the side's own follow by symmetry. place: [body] where kernels
    find it. tree_start: [slot] first slot of the same tree. body_slot, other_slot: [contact] of its sides, -1 for none.
    jacobian: [row, 12] of both sides. stride: bodies of the largest tree; scratch_rows: rows of
    ``scratch_out``.
    """
    side = items[wp.tid()]
    c = side / 2
    slot = body_slot[c]
    if side % 2 == 1:
        slot = other_slot[c]
    if slot < 0:
        return
    body = place[touched[slot]]
    first = model.tree_first[model.body_tree[body]]
    shift = side % scratch_rows * stride
    force = row_columns(c, 6 * (side % 2), jacobian)
    moment = row_columns(c, 6 * (side % 2) + 3, jacobian)
    sides_out.force[side] = force
    sides_out.moment[side] = moment
    root, root_a = carry_inward(body, first, shift, force, moment, model, factors, scratch_out)
    carry_outward(body, first, shift, root, root_a, model, factors, scratch_out)
    start = tree_start[slot]
    for other in range(start, slot + 1):
        at = shift + (place[touched[other]] - first) / model.pitch
        sides_out.linear[side, other - start] = scratch_out.a[at]
        sides_out.angular[side, other - start] = scratch_out.alpha[at]
