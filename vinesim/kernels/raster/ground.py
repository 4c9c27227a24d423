"""Uneven ground for rays: the first point at which a ray meets its triangles, and its slope, by the law of
:class:`vinesim.scene.terrain.Terrain`.

A ray is straight in coordinates that follow the inclined plane, too. There the ground is a thin layer, so a ray visits
few cells: only those where it is inside the layer.
"""

import warp as wp

from vinesim.kernels.raster.primitives import FAR

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class Ground:
    """Uneven ground; without nodes the ground is the plane z = 0."""

    residual: wp.array2d(dtype=wp.float32)
    """[row, column] m, height of the nodes above the inclined plane; empty if the ground is the plane z = 0."""
    x: float
    """[m] Position of the first node."""
    y: float
    cell: float
    """[m] Distance between nodes."""
    slope_x: float
    """[1] Rise of the inclined plane along x."""
    slope_y: float
    low: float
    """[m] Lowest residual."""
    high: float


@wp.func
def is_uneven(ground: Ground) -> bool:
    """Returns whether the ground is not the plane z = 0."""
    return ground.residual.shape[0] > 0


@wp.func
def ground_triangles(ground: Ground, i: int, j: int) -> wp.vec4:
    """Returns the residual at node (column ``i``, row ``j``), and its changes to the nodes right of it, above it, and
    both; beyond the grid those of the nearest edge."""
    last_column = ground.residual.shape[1] - 1
    last_row = ground.residual.shape[0] - 1
    a = wp.clamp(i, 0, last_column)
    b = wp.clamp(i + 1, 0, last_column)
    c = wp.clamp(j, 0, last_row)
    d = wp.clamp(j + 1, 0, last_row)
    low = ground.residual[c, a]
    return wp.vec4(low, ground.residual[c, b] - low, ground.residual[d, a] - low, ground.residual[d, b] - low)


@wp.func
def ground_residual(ground: Ground, x: float, y: float) -> float:
    """Returns the height [m] of the ground above its inclined plane."""
    u = (x - ground.x) / ground.cell
    v = (y - ground.y) / ground.cell
    i = int(wp.floor(u))
    j = int(wp.floor(v))
    r = ground_triangles(ground, i, j)
    fx = u - float(i)
    fy = v - float(j)
    # r[3] is the change to the opposite corner
    return wp.where(fx >= fy, r[0] + fx * r[1] + fy * (r[3] - r[1]), r[0] + fx * (r[3] - r[2]) + fy * r[2])


@wp.func
def ground_gradient(ground: Ground, x: float, y: float) -> wp.vec2:
    """Returns the rise [1] along x and y of the ground's triangle at (x, y) [m]."""
    u = (x - ground.x) / ground.cell
    v = (y - ground.y) / ground.cell
    i = int(wp.floor(u))
    j = int(wp.floor(v))
    r = ground_triangles(ground, i, j)
    below = u - float(i) >= v - float(j)
    along = wp.where(below, r[1], r[3] - r[2]) / ground.cell
    across = wp.where(below, r[3] - r[1], r[2]) / ground.cell
    return wp.vec2(ground.slope_x + along, ground.slope_y + across)


@wp.func
def ground_relief(ground: Ground, x: float, y: float) -> wp.vec2:
    """Returns the rise [1] along x and y of the ground over two cells around (x, y) [m], for shading without facets."""
    step = ground.cell
    along = ground_residual(ground, x + step, y) - ground_residual(ground, x - step, y)
    across = ground_residual(ground, x, y + step) - ground_residual(ground, x, y - step)
    return wp.vec2(ground.slope_x + 0.5 * along / step, ground.slope_y + 0.5 * across / step)


@wp.func
def ground_hit(ground: Ground, o: wp.vec3, d: wp.vec3, reach: float) -> float:
    """Returns where the ray from ``o`` [m] along ``d`` first meets uneven ground from above, in lengths of ``d``; FAR
    if it does not before ``reach``."""
    height = o[2] - ground.slope_x * o[0] - ground.slope_y * o[1]
    climb = d[2] - ground.slope_x * d[0] - ground.slope_y * d[1]
    if height <= ground_residual(ground, o[0], o[1]):
        return FAR
    start = float(0.0)
    end = reach
    if climb < -1.0e-9:
        start = wp.max((ground.high - height) / climb, 0.0)
        end = wp.min((ground.low - height) / climb + 1.0e-4, reach)
    elif climb > 1.0e-9:
        end = wp.min((ground.high - height) / climb, reach)
    elif height > ground.high:
        end = -1.0
    if start >= end:
        return FAR
    u = (o[0] - ground.x) / ground.cell
    v = (o[1] - ground.y) / ground.cell
    du = d[0] / ground.cell
    dv = d[1] / ground.cell
    columns = ground.residual.shape[1]
    rows = ground.residual.shape[0]
    # cells -1 and columns - 1 are the strips beyond the grid
    i = wp.clamp(int(wp.floor(u + start * du)), -1, columns - 1)
    j = wp.clamp(int(wp.floor(v + start * dv)), -1, rows - 1)
    t = start
    found = float(FAR)
    for visit in range(2 * (columns + rows)):
        next_u = end
        next_v = end
        if du > 0.0 and i < columns - 1:
            next_u = (float(i + 1) - u) / du
        elif du < 0.0 and i >= 0:
            next_u = (float(i) - u) / du
        if dv > 0.0 and j < rows - 1:
            next_v = (float(j + 1) - v) / dv
        elif dv < 0.0 and j >= 0:
            next_v = (float(j) - v) / dv
        leave = wp.min(wp.min(next_u, next_v), end)
        leave = wp.max(leave, t)
        r = ground_triangles(ground, i, j)
        fx = u - float(i)
        fy = v - float(j)
        # the gap above the lower triangle (fx >= fy) and the upper one are linear along the ray
        lower = wp.vec2(height - r[0] - fx * r[1] - fy * (r[3] - r[1]), climb - du * r[1] - dv * (r[3] - r[1]))
        upper = wp.vec2(height - r[0] - fx * (r[3] - r[2]) - fy * r[2], climb - du * (r[3] - r[2]) - dv * r[2])
        side = fx - fy
        turn = du - dv
        middle = leave
        if turn * (side + t * turn) < 0.0:
            middle = wp.clamp(-side / turn, t, leave)
        begin = t
        for part in range(2):
            stop = wp.where(part == 0, middle, leave)
            centre = 0.5 * (begin + stop)
            gap = wp.where(side + centre * turn >= 0.0, lower, upper)
            below = gap[0] + stop * gap[1]
            if found >= FAR and below <= 0.0:
                above = gap[0] + begin * gap[1]
                found = begin
                if above > 0.0:
                    found = begin + (stop - begin) * above / (above - below)
            begin = stop
        t = leave
        if found < FAR or t >= end:
            break
        if next_u <= next_v:
            i += wp.where(du > 0.0, 1, -1)
        else:
            j += wp.where(dv > 0.0, 1, -1)
    return wp.where(found < reach, found, FAR)
