"""Analytic primitives and their arrays.

Every primitive is four vectors ``a b c d`` whose meaning follows from its kind:

========== ======================= ======================= ============================ =====================
kind       a                       b                       c                            d
========== ======================= ======================= ============================ =====================
CONE       start, radius           end, radius             along, seed, sky at end, 1   -
SPHEROID   centre, radius          axis, length / width    seed, depth in bunch, -, -   occlusion vector, mean
LEAF       petiole end, size       midrib, outline number  upper normal, seed           curvatures a b c, age
BOX        centre, half x          quaternion              half y, half z, seed, -      -
ELLIPSOID  centre, half x          quaternion              half y, half z, seed, -      -
CYLINDER   centre of one end, r    centre of the other, -  distance along, seed, -, -   -
TRIANGLE   corner, normal          corner, normal          corner, normal               carrier's quaternion
========== ======================= ======================= ============================ =====================

A primitive that encloses the ray's origin is not hit, and triangles are seen from outside only (counter-clockwise):
a camera inside the housing of its robot looks out. Rays may have any length; ``t`` counts in lengths of ``d``.

Primitives lie in *clusters*: at most some dozens of one kind, close together, on one tree, bunch or link.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})

CONE = wp.constant(0)
SPHEROID = wp.constant(1)
LEAF = wp.constant(2)
BOX = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)
TRIANGLE = wp.constant(6)

FAR = wp.constant(1.0e30)
TINY = wp.constant(1.0e-20)
HIDDEN_HEIGHT = wp.constant(-1.0e6)
"""Height at which things that are gone lie for the ray caster [m]."""


@wp.struct
class Shapes:
    """All primitives, posed in the world."""

    a: wp.array(dtype=wp.vec4)
    b: wp.array(dtype=wp.vec4)
    c: wp.array(dtype=wp.vec4)
    d: wp.array(dtype=wp.vec4)
    kind: wp.array(dtype=wp.int32)
    outline: wp.array3d(dtype=wp.int8)
    """[outline, 256, 256] signed distance to the leaf's edge, positive inside, 1/400 leaf unit."""
    hull: wp.array2d(dtype=wp.vec2)
    """[outline, 8] corners of an octagon around each outline, leaf units."""


@wp.struct
class Clusters:
    """Runs of primitives of one kind."""

    first: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.int32)
    kind: wp.array(dtype=wp.int32)
    shown: wp.array(dtype=wp.int32)
    """0 for what is gone: a picked bunch."""


@wp.func
def xyz(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def with_w(v: wp.vec3, w: float) -> wp.vec4:
    return wp.vec4(v[0], v[1], v[2], w)


@wp.func
def as_quat(v: wp.vec4) -> wp.quat:
    return wp.quat(v[0], v[1], v[2], v[3])


@wp.func
def scale_along(v: wp.vec3, axis: wp.vec3, k: float) -> wp.vec3:
    """``v`` scaled by 1 + k along ``axis``: a spheroid becomes a sphere."""
    return v + axis * (k * wp.dot(v, axis))
