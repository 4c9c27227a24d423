"""Sway of trees in the wind: the drawn pose of trees on which wind is not simulated, computed from their rest poses.

Each joint turns by its angle in the steady wind, plus a linear response to the pressure of the gusts. Gusts reach the
tree through the transfer function of an oscillator, as a sum over the plane waves of the wind.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

JOINT_GAP = wp.constant(0.005)
"""[m] Distance of a body from its joint above which the body was cut off, and does not sway."""


@wp.func
def steady_share(pressure: wp.vec3, mean: wp.vec3):
    """Returns the share of the mean wind's deflection for a pressure v |v| [m^2/s^2]: its component along the mean
    pressure, relative to the mean pressure."""
    square = wp.dot(mean, mean)
    share = float(0.0)
    if square > 0.0:
        share = wp.clamp(wp.dot(pressure, mean) / square, 0.0, 1.0)
    return share


@wp.func
def small_turn(turn: wp.vec3):
    """Returns the quaternion of a small rotation vector [rad], exact to fifth order in its angle."""
    square = wp.dot(turn, turn)
    half = 0.5 - square / 48.0 + square * square / 3840.0
    w = 1.0 - square / 8.0 + square * square / 384.0
    return wp.normalize(wp.quat(turn[0] * half, turn[1] * half, turn[2] * half, w))


@wp.kernel
def sway_trees(
    # model
    tree_first: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    body_offset: wp.array(dtype=wp.vec3),
    body_steady: wp.array(dtype=wp.vec3),
    body_gain: wp.array(dtype=wp.mat33),
    tree_steady: wp.array(dtype=wp.vec3),
    tree_gust: wp.array(dtype=wp.vec3, ndim=2),
    # in
    trees: wp.array(dtype=wp.int32),
    waves: wp.array(dtype=float),
    strength: float,
    tree_air: wp.array(dtype=wp.vec3),
    tree_drawn: wp.array(dtype=float),
    body_q: wp.array(dtype=wp.transform),
    # out
    turned_out: wp.array(dtype=wp.quat),
    body_q_out: wp.array(dtype=wp.transform),
):
    """One thread per tree. Compute the drawn poses of the tree's bodies.

    body_steady: [body] rad, world axes, rotation of the body's joint in the mean wind. body_gain: [body] rad per
    m^2/s^2, change of this rotation per change of the pressure v |v|. tree_steady: [tree] m/s, mean wind at the tree.
    tree_gust: [tree, term] m/s, filtered gusts as factors of ``waves`` [term], which are the cosines and then the sines
    of the waves at this instant. trees: [thread] index of the tree. strength: [1] factor of the wind speed. tree_air:
    [tree] m/s, air velocity for which ``body_q`` is the simulated pose. tree_drawn: [tree] share of the sway that is
    drawn, 0 to 1. turned_out: [body] scratch, rotation of each body. body_q_out: [body] drawn poses.
    """
    tree = trees[wp.tid()]
    first = tree_first[tree]
    drawn = tree_drawn[tree]
    air = tree_steady[tree]
    mean = wp.length(air) * air
    if drawn > 0.0:
        for i in range(waves.shape[0]):
            air += waves[i] * tree_gust[tree, i]
    air = strength * air
    felt = tree_air[tree]
    pressure = wp.length(air) * air
    rest = wp.length(felt) * felt
    steady = steady_share(pressure, mean)
    steady_at_rest = steady_share(rest, mean)
    change = drawn * (pressure - rest - (steady - steady_at_rest) * mean)
    share = drawn * (steady - steady_at_rest)
    for k in range(first, first + tree_size[tree]):
        pose = body_q[k]
        place = wp.transform_get_translation(pose)
        turned = wp.quat_identity(dtype=float)
        if drawn > 0.0:
            parent = body_parent[k]
            joined = bool(True)
            moved = place
            if parent >= 0:
                lever = place - wp.transform_get_translation(body_q[parent])
                joined = wp.abs(wp.length(lever) - wp.length(body_offset[k])) < JOINT_GAP
                turned = turned_out[parent]
                moved = wp.transform_get_translation(body_q_out[parent]) + wp.quat_rotate(turned, lever)
            if joined:
                turned = turned * small_turn(share * body_steady[k] + body_gain[k] * change)
                place = moved
            else:
                turned = wp.quat_identity(dtype=float)
        turned_out[k] = turned
        body_q_out[k] = wp.transform(place, turned * wp.transform_get_rotation(pose))
