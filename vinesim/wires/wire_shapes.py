"""Where the segments of wires are, for snapshots: kept for all pieces, computed for those that may have moved."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.launch import bind_launch
from vinesim.kernels.wires import wire_shapes as kernels
from vinesim.plants.articulation_solver import spans
from vinesim.scene.model import Model
from vinesim.scene.values import SegmentPoses
from vinesim.wires.deflected_wires import DeflectedWires
from vinesim.wires.elastic_supports import ElasticSupports
from vinesim.wires.wire_segments import wire_segments


class WireShapes:
    """The shapes of all wires of one model."""

    def __init__(self, model: Model, supports: ElasticSupports, wires: DeflectedWires) -> None:
        self._supports = supports
        self._wires = wires
        segments = wire_segments(model)
        pieces = len(model.fixed_start)
        count = len(segments)
        first = np.searchsorted(segments.piece, np.arange(pieces + 1)).astype(np.int32)
        self._shapes = SharedArrays.zeros(
            kernels.SegmentShapes,
            count,
            first=first,
            start=segments.start,
            end=segments.end,
            rest_q=segments.rest_q,
            q=segments.rest_q.astype(np.float32),
            is_moved=np.zeros(count, np.bool_),
        )
        self._first = first
        self._piece = segments.piece
        self._may_have_moved = np.zeros(pieces, np.bool_)
        self._listed = np.zeros(pieces, np.int32)
        self._poses = SegmentPoses()
        structs = supports.wire_structs
        self._pose = bind_launch(
            kernels.pose_wire_segments,
            [
                *structs[:2],
                share(self._listed, wp.int32),
                share(supports.deflection, wp.vec3d),
                wires.presses.struct,
                wires.geoms,
            ],
            [self._shapes.struct],
        )

    def poses(self) -> SegmentPoses:
        """The segments that are away from where they were drawn."""
        marked = self._may_have_moved
        presses = self._wires.presses
        marked[self._supports.moved_pieces()] = True
        marked[presses.piece[: presses.count[0]]] = True
        pieces = np.flatnonzero(marked)
        if len(pieces) == 0:
            return self._poses
        self._listed[: len(pieces)] = pieces
        self._pose(len(pieces))
        segment = spans(self._first[pieces], self._first[pieces + 1] - self._first[pieces])
        segment = segment[self._shapes.is_moved[segment]]
        marked[pieces] = False
        marked[self._piece[segment]] = True
        self._poses = SegmentPoses(segment, self._shapes.q[segment])
        return self._poses
