"""Kernels that transform primitives from their bodies' frames into the world, and bound primitives and clusters."""

import warp as wp

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
    leaf_heights,
    with_w,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class PosedPrimitive:
    """The four vectors ``a b c d`` of one primitive in the world, and the corners of its axis-aligned bounding box
    [m]."""

    a: wp.vec4
    b: wp.vec4
    c: wp.vec4
    d: wp.vec4
    lower: wp.vec3
    upper: wp.vec3


@wp.func
def pose_leaf(local: Shapes, i: int, pose: wp.transform) -> PosedPrimitive:
    """Returns leaf ``i`` transformed by ``pose`` from the frame of its body into the world, with its bounding box.

    An octagon in the leaf's plane contains the outline of the blade. The box contains two copies of this octagon,
    shifted along the leaf's normal to the lowest and to the highest point of the curved blade.
    """
    q = wp.transform_get_rotation(pose)
    s = PosedPrimitive()
    a = wp.transform_point(pose, xyz(local.a[i]))
    s.a = with_w(a, local.a[i][3])
    s.d = local.d[i]
    rib = wp.quat_rotate(q, xyz(local.b[i]))
    up = wp.quat_rotate(q, xyz(local.c[i]))
    side = wp.cross(rib, up)
    heights = leaf_heights(s.d)
    s.lower = a
    s.upper = a
    for k in range(8):
        corner = local.hull[int(local.b[i][3]), k]
        flat = a + (side * corner[0] + rib * corner[1]) * s.a[3]
        for m in range(2):
            p = flat + up * (heights[m] * s.a[3])
            s.lower = wp.min(s.lower, p)
            s.upper = wp.max(s.upper, p)
    s.b = with_w(rib, local.b[i][3])
    s.c = with_w(up, local.c[i][3])
    return s


@wp.func
def pose_solid(local: Shapes, i: int, kind: int, pose: wp.transform) -> PosedPrimitive:
    """Returns primitive ``i``, which is not a leaf, transformed from its body's frame by ``pose``, with its bounding
    box."""
    q = wp.transform_get_rotation(pose)
    s = PosedPrimitive()
    a = wp.transform_point(pose, xyz(local.a[i]))
    s.a = with_w(a, local.a[i][3])
    s.b = local.b[i]
    s.c = local.c[i]
    s.d = local.d[i]
    if kind == SPHEROID:
        s.b = with_w(wp.quat_rotate(q, xyz(s.b)), s.b[3])
        s.d = with_w(wp.quat_rotate(q, xyz(s.d)), s.d[3])
        r = s.a[3] * wp.max(1.0, s.b[3])
        s.lower = a - wp.vec3(r, r, r)
        s.upper = a + wp.vec3(r, r, r)
    elif kind == CONE or kind == CYLINDER:
        b = wp.transform_point(pose, xyz(s.b))
        r = wp.max(s.a[3], wp.where(kind == CONE, s.b[3], 0.0))
        s.lower = wp.min(a, b) - wp.vec3(r, r, r)
        s.upper = wp.max(a, b) + wp.vec3(r, r, r)
        s.b = with_w(b, s.b[3])
    elif kind == TRIANGLE:
        b = wp.transform_point(pose, xyz(s.b))
        c = wp.transform_point(pose, xyz(s.c))
        s.lower = wp.min(wp.min(a, b), c)
        s.upper = wp.max(wp.max(a, b), c)
        s.b = with_w(b, s.b[3])
        s.c = with_w(c, s.c[3])
        s.d = wp.vec4(q[0], q[1], q[2], q[3])
    else:
        turn = q * as_quat(s.b)
        r = wp.length(wp.vec3(s.a[3], s.c[0], s.c[1]))
        s.lower = a - wp.vec3(r, r, r)
        s.upper = a + wp.vec3(r, r, r)
        s.b = wp.vec4(turn[0], turn[1], turn[2], turn[3])
    return s


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
    """One thread transforms the primitives of one cluster of primitives from their bodies' frames into the world, and
    computes their bounds.

    local: [primitive] in the frame of its body; carrier: [primitive] row of the body in ``poses``; dirty: clusters
    whose bodies moved; lower, upper: [primitive] bounding box [m]; ball: [cluster] centre and radius of the bounding
    sphere [m], radius -1 for a hidden cluster.
    """
    cluster = dirty[wp.tid()]
    kind = clusters.kind[cluster]
    first = clusters.first[cluster]
    lowest = wp.vec3(FAR, FAR, FAR)
    highest = wp.vec3(-FAR, -FAR, -FAR)
    for i in range(first, first + clusters.size[cluster]):
        s = PosedPrimitive()
        if kind == LEAF:
            s = pose_leaf(local, i, poses[carrier[i]])
        else:
            s = pose_solid(local, i, kind, poses[carrier[i]])
        if clusters.shown[cluster] == 0:
            s.lower = wp.vec3(0.0, 0.0, HIDDEN_HEIGHT)
            s.upper = s.lower
        a_out[i] = s.a
        b_out[i] = s.b
        c_out[i] = s.c
        d_out[i] = s.d
        lower_out[i] = s.lower
        upper_out[i] = s.upper
        lowest = wp.min(lowest, s.lower)
        highest = wp.max(highest, s.upper)
    centre = (lowest + highest) * 0.5
    ball_out[cluster] = with_w(centre, wp.where(clusters.shown[cluster] == 0, -1.0, wp.length(highest - centre)))
