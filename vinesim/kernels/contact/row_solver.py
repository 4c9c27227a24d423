"""The solver of :mod:`vinesim.kernels.contact.tree_solver` on a GPU: a thread for each row, which stays in its registers.

The matrices of trees are small, and their solve is a chain of steps that wait for each other: through memory, even shared
memory, each of them takes many times what it takes through registers and shuffles. The steps, their order and their
conditions are those of ``tree_solver``; a Newton step keeps the rows of contacts that do not press as those of an identity.
"""

import warp as wp

from vinesim.kernels.contact.newton import SLIDING_SHARE
from vinesim.kernels.contact.projected_gauss_seidel import MIN_IMPULSE_SCALE

wp.set_module_options({"enable_backward": False})

_SOLVER = """
#if defined(__CUDA_ARCH__)
constexpr int ROWS = %(rows)d, LANES = %(lanes)d;
constexpr unsigned ALL = 0xffffffffu;
const int lane = threadIdx.x %% LANES, c = lane / 3, part = lane %% 3;
const int size = 3 * count <= ROWS ? 3 * count : 0;
const int most = __reduce_max_sync(ALL, size);  // all trees of a warp go through the same steps
if (most == 0) return count > 0 ? -1 : 0;
const bool is_row = lane < size;

auto from = [&](double value, int source) { return __shfl_sync(ALL, value, source, LANES); };
auto of_group = [&](bool value) {  // a bit for each lane of the tree
    return __ballot_sync(ALL, value) >> (threadIdx.x %% 32 - lane) & (0xffffffffu >> (32 - LANES));
};
auto entry = [](auto& a, int i) -> double& { return *(double*)((char*)a.data + (size_t)i * a.strides[0]); };
auto coupling = [&](int i, int j) {
    return *(float*)((char*)matrix.data + (size_t)i * matrix.strides[0] + (size_t)j * matrix.strides[1]);
};
float a[ROWS];
const char* column = (const char*)matrix.data + (is_row ? lane * (size_t)matrix.strides[1] : 0);
#pragma unroll
for (int j = 0; j < ROWS; ++j, column += matrix.strides[0]) a[j] = is_row && j < size ? *(const float*)column : 0.0f;
double x = 0.0, outside = 0.0, mu = 0.0, soft = 0.0, by_normal = 0.0, by_tangent = 0.0, nu = 0.0, nv = 0.0;
if (is_row) {
    x = entry(impulse, lane);
    outside = entry(free, lane);
    mu = entry(friction, c);
    soft = entry(compliance, c);
    const double uu = coupling(3 * c + 1, 3 * c + 1), vv = coupling(3 * c + 2, 3 * c + 2);
    const double uv = coupling(3 * c + 1, 3 * c + 2), spread = 0.5 * (uu - vv);
    by_normal = 1.0 / (coupling(3 * c, 3 * c) + soft);
    by_tangent = 1.0 / (0.5 * (uu + vv) + soft + sqrt(spread * spread + uv * uv));
    nu = coupling(3 * c, 3 * c + 1);
    nv = coupling(3 * c, 3 * c + 2);
}
auto velocities = [&]() {
    double sum = outside;
    #pragma unroll
    for (int j = 0; j < ROWS; ++j) {
        if (j %% 3 == 0 && j >= most) break;
        sum += (double)a[j] * from(x, j);
    }
    return sum;
};
double v = velocities(), first = 0.0, before = 0.0, direction = 0.0, gradient_before = 0.0;
bool busy = size > 0;
int done = 0;
for (int sweeps = 0; sweeps < max_sweeps && __any_sync(ALL, busy); ++sweeps) {
    const bool restarts = busy && newton_end > 0 && sweeps == newton_end + 1;
    const bool follows = busy && !restarts && sweeps > newton_end;
    const bool steps = busy && sweeps > 0 && sweeps <= newton_end;
    if (sweeps == first_sweeps) first = x;
    bool moved = restarts;
    if (restarts) x = first;
    if (__any_sync(ALL, follows)) {  // the conjugate direction
        const double change = x - before;
        double gradient = change * change;
        #pragma unroll
        for (int other = LANES / 2; other > 0; other /= 2) gradient += __shfl_xor_sync(ALL, gradient, other, LANES);
        if (follows) {
            const double share = gradient_before > 0.0 && gradient <= gradient_before ? gradient / gradient_before : 0.0;
            const double further = share > 0.0 ? share * direction : 0.0;
            direction = further + change;
            gradient_before = gradient;
            x += further;
            moved = share > 0.0;
        }
    }
    if (__any_sync(ALL, steps)) {  // a Newton step
        const double xn = from(x, 3 * c), xu = from(x, 3 * c + 1), xv = from(x, 3 * c + 2);
        const double vu = from(v, 3 * c + 1), vv = from(v, 3 * c + 2);
        const int partner = 3 * c + (part == 1 ? 2 : 1);
        const double outside_partner = from(outside, partner);
        const bool presses = is_row && xn > 0.0;
        const unsigned pressing = of_group(presses);
        double own = presses ? 1.0 : 0.0, others = 0.0, right = presses ? -outside : 0.0;
        double to_normal = 0.0, to_u = 0.0, to_v = 0.0;
        const double limit = mu * xn * %(sliding)r;
        if (presses && part > 0 && xu * xu + xv * xv >= limit * limit) {
            const double softer = 1.0 - soft * by_tangent;
            const double fu = softer * xu - by_tangent * vu, fv = softer * xv - by_tangent * vv;
            const double scale = rsqrt(fmax(fu * fu + fv * fv, 1e-30)), share = fmin(mu * xn * scale, 1.0);
            const double along_u = part == 1 ? 1.0 : 0.0, along_v = 1.0 - along_u;
            const double mine = (part == 1 ? fu : fv) * scale;
            const double cu = share * (along_u - mine * fu * scale), cv = share * (along_v - mine * fv * scale);
            own = by_tangent * (part == 1 ? cu : cv);
            others = by_tangent * (part == 1 ? cv : cu);
            right = -(own * outside + others * outside_partner);
            to_normal = -mu * mine;
            to_u = along_u - softer * cu;
            to_v = along_v - softer * cv;
        } else {
            const double diagonal = presses ? soft : 1.0;
            if (part == 0) to_normal = diagonal;
            if (part == 1) to_u = diagonal;
            if (part == 2) to_v = diagonal;
        }
        double row[ROWS];
        #pragma unroll
        for (int j = 0; j < ROWS; ++j) {
            const float theirs = __shfl_sync(ALL, a[j], partner, LANES);
            row[j] = (float)(pressing >> j & 1) * (own * a[j] + others * theirs);
            if (j / 3 == c) row[j] += j %% 3 == 0 ? to_normal : j %% 3 == 1 ? to_u : to_v;
        }
        double by_pivot = 0.0;
        #pragma unroll
        for (int k = 0; k < ROWS; ++k) {  // Gauss-Jordan, without pivoting: see solve_newton_system
            if (k %% 3 == 0 && k >= most) break;
            const double reciprocal = 1.0 / from(row[k], k);
            const double factor = lane == k ? 0.0 : row[k] * reciprocal;
            if (lane == k) by_pivot = reciprocal;
            #pragma unroll
            for (int j = k + 1; j < ROWS; ++j) {
                if (j %% 3 == 0 && j >= most) break;
                row[j] -= factor * from(row[j], k);
            }
            right -= factor * from(right, k);
        }
        const double found = presses ? right * by_pivot : x;
        const double normal = fmax(from(found, 3 * c), 0.0), u = from(found, 3 * c + 1), w = from(found, 3 * c + 2);
        const double tangential = sqrt(u * u + w * w);
        const double share = tangential > mu * normal ? mu * normal / tangential : 1.0;
        if (steps) {
            x = part == 0 ? normal : share * found;
            moved = true;
        }
    }
    if (__any_sync(ALL, moved)) {
        const double anew = velocities();
        if (moved) v = anew;
    }
    before = x;
    double change = 0.0, largest = %(scale)r;
    #pragma unroll
    for (int k = 0; k < ROWS / 3; ++k) {  // a sweep: each lane computes for its own contact, when that one's turn comes
        if (3 * k >= most) break;
        const double xn = from(x, 3 * c), xu = from(x, 3 * c + 1), xv = from(x, 3 * c + 2);
        const double vn = from(v, 3 * c), vu = from(v, 3 * c + 1), vv = from(v, 3 * c + 2);
        const double normal = fmax(0.0, xn - (vn + soft * xn) * by_normal), by_n = normal - xn;
        double fu = xu - (vu + soft * xu + by_n * nu) * by_tangent;
        double fv = xv - (vv + soft * xv + by_n * nv) * by_tangent;
        const double square = fu * fu + fv * fv, limit = mu * normal;
        if (square > limit * limit) {
            const double share = limit * rsqrt(square);
            fu *= share;
            fv *= share;
        }
        const bool turn = busy && is_row && c == k;
        const double dn = from(turn ? by_n : 0.0, 3 * k), du = from(turn ? fu - xu : 0.0, 3 * k);
        const double dv = from(turn ? fv - xv : 0.0, 3 * k);
        if (turn) {
            x = part == 0 ? normal : part == 1 ? fu : fv;
            change = fmax(fabs(dn), fabs(du) + fabs(dv));
            largest = fmax(largest, normal);
        }
        v += (double)a[3 * k] * dn + (double)a[3 * k + 1] * du + (double)a[3 * k + 2] * dv;
    }
    #pragma unroll
    for (int other = LANES / 2; other > 0; other /= 2) {
        largest = fmax(largest, __shfl_xor_sync(ALL, largest, other, LANES));
    }
    const bool goes_on = of_group(change > tolerance * largest) != 0;
    if (busy) done = sweeps + 1;
    busy = busy && goes_on;
}
if (is_row) {
    entry(impulse, lane) = x;
    entry(velocity, lane) = v;
}
return size > 0 || count == 0 ? done : -1;
#else
return -1;
#endif
"""


def _snippet(rows: int, lanes: int) -> str:
    numbers = {"sliding": float(SLIDING_SHARE), "scale": float(MIN_IMPULSE_SCALE)}
    return _SOLVER % ({"rows": rows, "lanes": lanes} | numbers)


FEW_ROWS = wp.constant(15)
"""Rows of a tree that :func:`solve_few_rows` solves."""
MANY_ROWS = wp.constant(30)
"""Rows of a tree that :func:`solve_many_rows` solves."""


@wp.func_native(_snippet(int(FEW_ROWS), 16))
def solve_few_rows(
    count: int,
    max_sweeps: int,
    first_sweeps: int,
    newton_end: int,
    tolerance: wp.float64,
    matrix: wp.array2d(dtype=float),
    free: wp.array(dtype=wp.float64),
    friction: wp.array(dtype=wp.float64),
    compliance: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.float64),
) -> int:
    """Solve for the impulses of ``count`` contacts of a tree with 16 threads of a GPU; returns the number of sweeps, or -1 on
    a CPU and where there are more than :data:`FEW_ROWS` rows: then nothing has happened.

    The fields of :class:`vinesim.kernels.contact.tree_solver.TreeSystem`. All threads of a warp must call it.
    """
    ...


@wp.func_native(_snippet(int(MANY_ROWS), 32))
def solve_many_rows(
    count: int,
    max_sweeps: int,
    first_sweeps: int,
    newton_end: int,
    tolerance: wp.float64,
    matrix: wp.array2d(dtype=float),
    free: wp.array(dtype=wp.float64),
    friction: wp.array(dtype=wp.float64),
    compliance: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.float64),
) -> int:
    """The same with the 32 threads of a warp for a tree, and up to :data:`MANY_ROWS` rows."""
    ...
