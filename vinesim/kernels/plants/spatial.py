"""Rotations and inertias: exponential map, rotated tensors, point masses.

Functions that a prediction calls have no branches, so that LLVM can vectorise the loops of
:mod:`vinesim.kernels.plants.eight_trees`.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def exponential(v: wp.vec3):
    """Returns the quaternion of the rotation vector v [rad]."""
    square = wp.dot(v, v)
    half_sinc = 0.5 - square * (1.0 / 48.0 - square * (1.0 / 3840.0))
    cosine = 1.0 - square * (1.0 / 8.0 - square * (1.0 / 384.0))
    if square > 0.1:
        angle = wp.sqrt(square)
        half_sinc = wp.sin(0.5 * angle) / angle
        cosine = wp.cos(0.5 * angle)
    return wp.quat(half_sinc * v[0], half_sinc * v[1], half_sinc * v[2], cosine)


@wp.func
def half_rotation(q: wp.quat):
    """Returns the rotation by half the angle of the unit quaternion q, in the direction of the shorter way."""
    w = wp.abs(q[3])
    scale = 1.0 / wp.sqrt(2.0 * (1.0 + w))
    sine = scale
    if q[3] < 0.0:
        sine = -scale
    return wp.quat(sine * q[0], sine * q[1], sine * q[2], scale * (1.0 + w))


@wp.func
def rotated_diagonal(frame: wp.mat33, v: wp.vec3):
    """Returns the matrix that is diag(v) in the axes of frame (its columns): frame diag(v) frame^T."""
    x = wp.vec3(frame[0, 0], frame[1, 0], frame[2, 0])
    y = wp.vec3(frame[0, 1], frame[1, 1], frame[2, 1])
    return v[2] * wp.identity(n=3, dtype=float) + (v[0] - v[2]) * wp.outer(x, x) + (v[1] - v[2]) * wp.outer(y, y)


@wp.func
def cross_rows(A: wp.mat33, d: wp.vec3):
    """Returns A [d]x, with [d]x the cross-product matrix of d: every row of A crossed with d."""
    return wp.matrix_from_rows(wp.cross(A[0], d), wp.cross(A[1], d), wp.cross(A[2], d))


@wp.func
def point_mass_inertia(mass: float, lever: wp.vec3):
    """Returns the moment of inertia about the origin [kg m^2] of a point mass at a lever."""
    return mass * (wp.dot(lever, lever) * wp.identity(n=3, dtype=float) - wp.outer(lever, lever))


@wp.func
def world_inertia(rotation: wp.mat33, moments: wp.vec3, products: wp.vec3):
    """Returns the inertia in world axes from its diagonal and its entries yz, zx, xy in the body's axes."""
    inertia = wp.mat33(
        moments[0], products[2], products[1], products[2], moments[1], products[0], products[1], products[0], moments[2]
    )
    return rotation * inertia * wp.transpose(rotation)


@wp.func
def symmetric(m: wp.mat33):
    """Returns the symmetric matrix with the upper triangle of m. It removes asymmetry due to rounding."""
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[0, 1], m[1, 1], m[1, 2], m[0, 2], m[1, 2], m[2, 2])


@wp.func
def inverse_symmetric(m: wp.mat33):
    """Returns the inverse of a symmetric matrix, of which only the upper triangle is read, from its cofactors; 0 if it
    is singular."""
    xx = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    xy = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    xz = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    yy = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    yz = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    zz = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    determinant = m[0, 0] * xx + m[0, 1] * xy + m[0, 2] * xz
    is_singular = determinant == 0.0
    scale = wp.where(is_singular, 0.0, 1.0) / wp.where(is_singular, 1.0, determinant)
    return scale * wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)
