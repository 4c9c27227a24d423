"""Poses of the wires' visible segments, deflected by shoots and contacts, for cameras and lidars."""

import warp as wp

from vinesim.kernels.wires.elastic_supports import SupportNodes, Wires
from vinesim.kernels.wires.wire_contacts import WireGeoms, WirePresses, deflection_between, interval_of

wp.set_module_options({"enable_backward": False})

LEAST_SHOWN = wp.constant(wp.float64(1.0e-4))
"""Displacement [m] of both ends below which a segment is drawn undeflected."""


@wp.struct
class SegmentShapes:
    """Visible segments of wires and their poses, ordered by wire. Arrays are [segment] unless stated otherwise."""

    first: wp.array(dtype=wp.int32)  # [piece + 1] first segment of each fixed piece
    start: wp.array(dtype=wp.float64)  # [1] start of the segment on its piece, as a share of the piece's length
    end: wp.array(dtype=wp.float64)
    rest_q: wp.array(dtype=wp.transformd)  # pose of the segment's middle, undeflected
    q: wp.array(dtype=wp.transformf)
    is_moved: wp.array(dtype=wp.bool)  # whether q is not rest_q


@wp.func
def deflection_at(
    piece: int,
    x: wp.float64,
    wires: Wires,
    nodes: SupportNodes,
    deflection: wp.array(dtype=wp.vec3d),
    presses: WirePresses,
):
    """Returns the displacement [m, world] of a wire's point ``x`` [m] from the wire's start, by ties and presses."""
    node, low, high = interval_of(piece, x, wires, nodes)
    at_low = wp.vec3d()
    at_high = wp.vec3d()
    support = wires.support[piece]
    if support >= 0:
        if node > nodes.first[support]:
            at_low = deflection[node - 1]
        if node < nodes.first[support + 1]:
            at_high = deflection[node]
    share = wp.clamp((x - low) / wp.max(high - low, wp.float64(1.0e-9)), wp.float64(0.0), wp.float64(1.0))
    straight = (wp.float64(1.0) - share) * at_low + share * at_high
    return straight + deflection_between(piece, x, wires, nodes, presses)


@wp.kernel
def pose_wire_segments(
    # model
    wires: Wires,
    nodes: SupportNodes,
    # in
    count: wp.array(dtype=wp.int32),
    pieces: wp.array(dtype=wp.int32),
    deflection: wp.array(dtype=wp.vec3d),
    presses: WirePresses,
    geoms: WireGeoms,
    # out
    segments_out: SegmentShapes,
):
    """One thread poses the segments of one wire.

    count: [1] number of wires to update; pieces: [thread] fixed piece of the wire; deflection: [node] m; segments: the
    poses are written here.
    """
    if wp.tid() >= count[0]:
        return
    piece = pieces[wp.tid()]
    length = wires.length[piece]
    axis = geoms.axis[piece]
    for s in range(segments_out.first[piece], segments_out.first[piece + 1]):
        begin = deflection_at(piece, segments_out.start[s] * length, wires, nodes, deflection, presses)
        end = deflection_at(piece, segments_out.end[s] * length, wires, nodes, deflection, presses)
        rest = segments_out.rest_q[s]
        is_moved = wp.max(wp.length(begin), wp.length(end)) > LEAST_SHOWN
        turn = wp.quatd(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
        middle = wp.transform_get_translation(rest)
        if is_moved:
            along = (segments_out.end[s] - segments_out.start[s]) * length
            way = wp.normalize(along * axis + end - begin)
            across = wp.cross(axis, way)
            turn = wp.normalize(wp.quatd(across[0], across[1], across[2], wp.float64(1.0) + wp.dot(axis, way)))
            middle = middle + wp.float64(0.5) * (begin + end)
        segments_out.q[s] = wp.transformf(
            wp.vec3f(wp.float32(middle[0]), wp.float32(middle[1]), wp.float32(middle[2])),
            wp.quatf(wp.float32(turn[0]), wp.float32(turn[1]), wp.float32(turn[2]), wp.float32(turn[3])),
        )
        segments_out.is_moved[s] = is_moved
