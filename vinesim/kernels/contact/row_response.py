"""Response of plants to contact impulses: velocities of the plant bodies in contact by unit impulses along the rows of
contacts.

The articulated-body algorithm with impulses only (Featherstone 2008, section 7.3): impulses travel inward along the
paths to the root, and the velocities that they cause travel outward. A contact of two plant bodies has two *sides*,
numbered 2 * contact and 2 * contact + 1; for a contact with a rigid geom the second side is empty. The impulses of
sides on one tree are propagated together, in groups of ten sides. Three rows for each side are thirty columns, and
eight columns are computed at once.
"""

import warp as wp

from vinesim.kernels.contact.islands import padded
from vinesim.kernels.contact.structs import GROUPS, SideGroups
from vinesim.kernels.plants.structs import ArticulationModel, Factors

wp.set_module_options({"enable_backward": False})

COLUMNS = wp.constant(32)
"""Number of columns in a body's working memory."""
BODY_NUMBERS = wp.constant(192)
"""Number of values in a body's working memory: force and moment, then linear and angular velocity, of all columns."""


EIGHT = """
#if defined(__CUDACC__)
    using Eight = wp::vec_t<8, float>;
#else
    typedef float Eight __attribute__((vector_size(32), aligned(4)));
#endif
"""
"""Native code: a vector type for eight columns."""


@wp.struct
class ResponseScratch:
    """Working memory of the impulse response [row of scratch, body of the tree]. Each row serves one group of contact
    sides at a time.
    """

    is_on_path: wp.array(dtype=wp.bool)
    """Whether the body or one of its descendants is in contact."""
    values: wp.array(dtype=float)
    """[body, component, column] Impulses, later velocities."""


@wp.func_native("""
    for (int i = 0; i < count; ++i) values.data[at + i] = 0.0f;
""")
def clear_numbers(values: wp.array(dtype=float), at: int, count: int):
    """Set ``count`` numbers to zero, from ``at`` on."""
    ...


@wp.func_native("""
    const int pitch = jacobian.strides[0] / (int)sizeof(double);
    for (int r = 0; r < 3; ++r) {
        const double* const row = jacobian.data + (3 * (side / 2) + r) * pitch + 6 * (side % 2);
        for (int k = 0; k < 6; ++k) values.data[at + 32 * k + 3 * number + r] += (float)row[k];
    }
""")
def add_side(side: int, number: int, jacobian: wp.array2d(dtype=wp.float64), values: wp.array(dtype=float), at: int):
    """Add unit impulses along the three rows of a contact side to the working memory of the side's body.

    ``number``: index of the side in its group, which selects the three columns. ``values``: working memory; the body's
    part begins at index ``at``.
    """
    ...


@wp.func_native(
    EIGHT
    + """
    float* const own = values.data + at;
    float* const parent = values.data + to;
    for (int c = 0; c < width; c += 8) {
        Eight f[3], m[3], left[3];
        for (int r = 0; r < 3; ++r) {
            f[r] = *(const Eight*)(own + 32 * r + c);
            m[r] = *(const Eight*)(own + 96 + 32 * r + c);
        }
        for (int r = 0; r < 3; ++r) {
            *(Eight*)(own + 96 + 32 * r + c) = D.data[r][0] * m[0] + D.data[r][1] * m[1] + D.data[r][2] * m[2];
            f[r] = f[r] - (DH.data[0][r] * m[0] + DH.data[1][r] * m[1] + DH.data[2][r] * m[2]);
        }
        for (int r = 0; r < 3; ++r) {
            const int s = (r + 1) % 3, t = (r + 2) % 3;
            left[r] = m[r] - (DJ.data[0][r] * m[0] + DJ.data[1][r] * m[1] + DJ.data[2][r] * m[2]);
            left[r] = left[r] + lever[s] * f[t] - lever[t] * f[s];
        }
        for (int r = 0; r < 3; ++r) {
            Eight* const force = (Eight*)(parent + 32 * r + c);
            Eight* const moment = (Eight*)(parent + 96 + 32 * r + c);
            if (to >= 0) *force = *force + f[r], *moment = *moment + left[r];
            else *(Eight*)(own + 32 * r + c) = root.data[r][0] * f[0] + root.data[r][1] * f[1] + root.data[r][2] * f[2];
        }
    }
"""
)
def carry_inward(
    values: wp.array(dtype=float),
    at: int,
    to: int,
    width: int,
    D: wp.mat33,
    DJ: wp.mat33,
    DH: wp.mat33,
    lever: wp.vec3,
    root: wp.mat33,
):
    """Propagate the impulses at a body through its joint to the body's parent. The part that turns the joint stays in
    the body's working memory.

    ``values``: working memory; the body's part begins at index ``at``, the parent's at ``to``. ``width``: number of
    columns. D, DJ, DH: factors of the joint (:mod:`vinesim.kernels.plants`); lever: [m] from parent to body. Without a
    parent (``to`` < 0) the impulses move the body; ``root`` is its inverse mass [1/kg].
    """
    ...


@wp.func_native(
    EIGHT
    + """
    float* const own = values.data + at;
    const float* const parent = values.data + from_parent;
    for (int c = 0; c < width; c += 8) {
        Eight a[3], alpha[3] = {};
        for (int r = 0; r < 3; ++r) {
            a[r] = *(const Eight*)((from_parent >= 0 ? parent : own) + 32 * r + c);
            if (from_parent >= 0) alpha[r] = *(const Eight*)(parent + 96 + 32 * r + c);
        }
        for (int r = 0; r < 3; ++r) {
            const int s = (r + 1) % 3, t = (r + 2) % 3;
            a[r] = a[r] - lever[s] * alpha[t] + lever[t] * alpha[s];
            *(Eight*)(own + 32 * r + c) = a[r];
        }
        for (int r = 0; r < 3; ++r) {
            Eight* const turned = (Eight*)(own + 96 + 32 * r + c);
            *turned = *turned + alpha[r]
                - (DJ.data[r][0] * alpha[0] + DJ.data[r][1] * alpha[1] + DJ.data[r][2] * alpha[2])
                - (DH.data[r][0] * a[0] + DH.data[r][1] * a[1] + DH.data[r][2] * a[2]);
        }
    }
"""
)
def carry_outward(
    values: wp.array(dtype=float), at: int, from_parent: int, width: int, DJ: wp.mat33, DH: wp.mat33, lever: wp.vec3
):
    """Compute the velocities of a body from the impulses that turn its joint and from the velocities of its parent.

    ``values``: working memory; the body's part begins at index ``at``, the parent's at ``from_parent`` (negative: no
    parent). ``width``: number of columns. DJ, DH: factors of the joint; lever: [m] from parent to body.
    """
    ...


@wp.func_native("""
    for (int k = 0; k < 6; ++k)
        for (int i = 0; i < width; ++i) response.data[to + width * k + i] = values.data[at + 32 * k + i];
""")
def keep_velocities(values: wp.array(dtype=float), at: int, width: int, response: wp.array(dtype=float), to: int):
    """Copy the velocities of a body from the working memory (index ``at``) to the response (index ``to``). ``width``:
    number of columns.
    """
    ...


@wp.func
def mark_paths(
    first: int,
    bodies: int,
    row: int,
    start: int,
    end: int,
    place: wp.array(dtype=wp.int32),
    touched: wp.array(dtype=wp.int32),
    model: ArticulationModel,
    scratch_out: ResponseScratch,
):
    """Mark the touched bodies of a tree, in slots ``start`` to ``end``, and all their ancestors. Set their working
    memory to zero.
    """
    for k in range(bodies):
        scratch_out.is_on_path[row + k] = False
    for slot in range(start, end):
        body = int(place[touched[slot]])
        while body >= 0:
            at = row + (body - first) / model.pitch
            known = bool(scratch_out.is_on_path[at])  # the value before it is overwritten
            if not known:
                scratch_out.is_on_path[at] = True
                clear_numbers(scratch_out.values, at * BODY_NUMBERS, BODY_NUMBERS)
            body = wp.where(known, -1, model.body_parent[body])


@wp.func
def memory_of(body: int, first: int, row: int, pitch: int):
    """Returns the index at which the working memory of a body begins; negative if ``body`` is negative."""
    at = int(-1)
    if body >= 0:
        at = (row + (body - first) / pitch) * BODY_NUMBERS
    return at


@wp.kernel
def respond_to_groups(
    # model
    model: ArticulationModel,
    stride: int,
    scratch_rows: int,
    place: wp.array(dtype=wp.int32),
    # in
    counters: wp.array(dtype=wp.int32),
    touched: wp.array(dtype=wp.int32),
    tree_end: wp.array(dtype=wp.int32),
    body_slot: wp.array(dtype=wp.int32),
    other_slot: wp.array(dtype=wp.int32),
    jacobian: wp.array2d(dtype=wp.float64),
    groups: SideGroups,
    factors: Factors,
    # out
    scratch_out: ResponseScratch,
    response_out: wp.array(dtype=float),
):
    """Compute, for each group of contact sides, the velocities of the touched bodies of the group's tree by unit
    impulses along the sides' rows.

    There are ``scratch_rows`` threads. Thread i takes the groups i, i + scratch_rows, i + 2 scratch_rows ...

    touched: [slot] bodies in contact, sorted. tree_end: [slot] slot after the last slot of the same tree. body_slot,
    other_slot: [contact] slots of the contact's sides. place: [body] index under which the kernels store the body.
    stride: number of bodies in the largest tree. ``scratch_out`` has memory for one tree for each thread.
    """
    row = wp.tid() * stride
    for group in range(wp.tid(), counters[GROUPS], scratch_rows):
        start = groups.tree[group]
        end = tree_end[start]
        last = place[touched[end - 1]]
        first = model.tree_first[model.body_tree[last]]
        bodies = (last - first) / model.pitch + 1
        sides = groups.start[group + 1] - groups.start[group]
        width = padded(3 * sides)
        mark_paths(first, bodies, row, start, end, place, touched, model, scratch_out)
        for number in range(sides):
            side = groups.side[groups.start[group] + number]
            slot = body_slot[side / 2]
            if side % 2 == 1:
                slot = other_slot[side / 2]
            add_side(
                side, number, jacobian, scratch_out.values, memory_of(place[touched[slot]], first, row, model.pitch)
            )
        for i in range(bodies):
            k = last - i * model.pitch
            if scratch_out.is_on_path[row + bodies - 1 - i]:
                carry_inward(
                    scratch_out.values,
                    memory_of(k, first, row, model.pitch),
                    memory_of(model.body_parent[k], first, row, model.pitch),
                    width,
                    factors.D[k],
                    factors.DJ[k],
                    factors.DH[k],
                    factors.lever[k],
                    factors.root_inverse_mass[k],
                )
        for i in range(bodies):
            k = first + i * model.pitch
            if scratch_out.is_on_path[row + i]:
                carry_outward(
                    scratch_out.values,
                    memory_of(k, first, row, model.pitch),
                    memory_of(model.body_parent[k], first, row, model.pitch),
                    width,
                    factors.DJ[k],
                    factors.DH[k],
                    factors.lever[k],
                )
        for slot in range(start, end):
            at = memory_of(place[touched[slot]], first, row, model.pitch)
            keep_velocities(
                scratch_out.values, at, width, response_out, groups.response[group] + (slot - start) * 6 * width
            )
