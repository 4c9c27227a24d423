"""Primitives carried from the frames of their bodies into the world, and bounds around them and their clusters."""

import warp as wp

from vinesim.kernels.raster.leaf_surface import leaf_heights
from vinesim.kernels.raster.primitives import (
    CONE,
    CYLINDER,
    FAR,
    HIDDEN_HEIGHT,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Clusters,
    Shapes,
    as_quat,
    with_w,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def pose_clusters(
    # model
    local: Shapes,
    clusters: Clusters,
    carrier: wp.array(dtype=wp.int32),
    # in
    dirty: wp.array(dtype=wp.int32),
    poses: wp.array(dtype=wp.transform),
    # out
    a_out: wp.array(dtype=wp.vec4),
    b_out: wp.array(dtype=wp.vec4),
    c_out: wp.array(dtype=wp.vec4),
    d_out: wp.array(dtype=wp.vec4),
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
    ball_out: wp.array(dtype=wp.vec4),
):
    """One thread carries one cluster from its bodies' frames into the world, and bounds it."""
    cluster = dirty[wp.tid()]
    kind = clusters.kind[cluster]
    first = clusters.first[cluster]
    lowest = wp.vec3(FAR, FAR, FAR)
    highest = wp.vec3(-FAR, -FAR, -FAR)
    for i in range(first, first + clusters.size[cluster]):
        pose = poses[carrier[i]]
        q = wp.transform_get_rotation(pose)
        a4 = local.a[i]
        b4 = local.b[i]
        c4 = local.c[i]
        d4 = local.d[i]
        a = wp.transform_point(pose, xyz(a4))
        a4 = with_w(a, a4[3])
        lo = a
        hi = a
        if kind == LEAF:
            rib = wp.quat_rotate(q, xyz(b4))
            up = wp.quat_rotate(q, xyz(c4))
            side = wp.cross(rib, up)
            heights = leaf_heights(d4)
            for k in range(8):
                corner = local.hull[int(b4[3]), k]
                flat = a + (side * corner[0] + rib * corner[1]) * a4[3]
                for m in range(2):
                    p = flat + up * (heights[m] * a4[3])
                    lo = wp.min(lo, p)
                    hi = wp.max(hi, p)
            b4 = with_w(rib, b4[3])
            c4 = with_w(up, c4[3])
        elif kind == SPHEROID:
            b4 = with_w(wp.quat_rotate(q, xyz(b4)), b4[3])
            d4 = with_w(wp.quat_rotate(q, xyz(d4)), d4[3])
            r = a4[3] * wp.max(1.0, b4[3])
            reach = wp.vec3(r, r, r)
            lo = a - reach
            hi = a + reach
        elif kind == CONE or kind == CYLINDER:
            b = wp.transform_point(pose, xyz(b4))
            r = wp.max(a4[3], wp.where(kind == CONE, b4[3], 0.0))
            reach = wp.vec3(r, r, r)
            lo = wp.min(a, b) - reach
            hi = wp.max(a, b) + reach
            b4 = with_w(b, b4[3])
        elif kind == TRIANGLE:
            b = wp.transform_point(pose, xyz(b4))
            c = wp.transform_point(pose, xyz(c4))
            lo = wp.min(wp.min(a, b), c)
            hi = wp.max(wp.max(a, b), c)
            b4 = with_w(b, b4[3])
            c4 = with_w(c, c4[3])
            d4 = wp.vec4(q[0], q[1], q[2], q[3])
        else:
            turn = q * as_quat(b4)
            r = wp.length(wp.vec3(a4[3], c4[0], c4[1]))
            reach = wp.vec3(r, r, r)
            lo = a - reach
            hi = a + reach
            b4 = wp.vec4(turn[0], turn[1], turn[2], turn[3])
        if clusters.shown[cluster] == 0:
            lo = wp.vec3(0.0, 0.0, HIDDEN_HEIGHT)
            hi = lo
        a_out[i] = a4
        b_out[i] = b4
        c_out[i] = c4
        d_out[i] = d4
        lower_out[i] = lo
        upper_out[i] = hi
        lowest = wp.min(lowest, lo)
        highest = wp.max(highest, hi)
    centre = (lowest + highest) * 0.5
    ball_out[cluster] = with_w(centre, wp.where(clusters.shown[cluster] == 0, -1.0, wp.length(highest - centre)))
