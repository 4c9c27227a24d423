"""The box around a primitive, in the frame of whatever sees it: bounds that stay narrow beside the eye."""

import warp as wp

from vinesim.kernels.raster.leaf_surface import leaf_extent, leaf_heights
from vinesim.kernels.raster.primitives import CYLINDER, LEAF, Shapes, as_quat, xyz

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class OrientedBox:
    """A centre and three half axes [m]."""

    centre: wp.vec3
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3


@wp.func
def oriented_box(shapes: Shapes, i: int, kind: int, eye: wp.vec3, rotation: wp.mat33) -> OrientedBox:
    """The box around box, ellipsoid, cylinder or leaf ``i``, seen from ``eye`` [m]; rows of ``rotation``: the axes of the
    frame in the world."""
    a4 = shapes.a[i]
    b4 = shapes.b[i]
    c4 = shapes.c[i]
    o = OrientedBox()
    o.centre = rotation * (xyz(a4) - eye)
    if kind == CYLINDER:
        o.z = 0.5 * (rotation * (xyz(b4) - xyz(a4)))
        o.centre += o.z
        axis = o.z / wp.max(wp.length(o.z), 1.0e-9)
        other = wp.where(wp.abs(axis[2]) < 0.7, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
        o.x = wp.normalize(wp.cross(axis, other)) * a4[3]
        o.y = wp.cross(axis, o.x)
    elif kind == LEAF:
        rib = rotation * xyz(b4)
        up = rotation * xyz(c4)
        heights = leaf_heights(shapes.d[i])
        extent = leaf_extent(shapes.hull, int(b4[3]))
        o.centre += (rib * (extent[1] + extent[2]) + up * (heights[0] + heights[1])) * (0.5 * a4[3])
        o.x = wp.cross(rib, up) * (extent[0] * a4[3])
        o.y = rib * (0.5 * (extent[2] - extent[1]) * a4[3])
        o.z = up * (0.5 * (heights[1] - heights[0]) * a4[3])
    else:
        q = as_quat(b4)
        o.x = rotation * wp.quat_rotate(q, wp.vec3(a4[3], 0.0, 0.0))
        o.y = rotation * wp.quat_rotate(q, wp.vec3(0.0, c4[0], 0.0))
        o.z = rotation * wp.quat_rotate(q, wp.vec3(0.0, 0.0, c4[1]))
    return o
