"""Wires under tension, cut into short straight segments: the moving parts of wires in pictures, scans and the web
page."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.wires import wire_shapes as kernels
from vinesim.plants.articulation_solver import spans
from vinesim.scene.model import Model
from vinesim.scene.values import SegmentPoses
from vinesim.wires.deflected_wires import DeflectedWires
from vinesim.wires.elastic_supports import ElasticSupports

MAX_LENGTH = 0.25
"""Largest length of a segment [m]. With a force F on a wire of tension T the drawn position errs by at most F / T times
a quarter of this length: 1.4 mm for 20 N."""


@dataclasses.dataclass(frozen=True)
class WireSegments:
    """Segments of the wires of a model, along each wire from its start to its end."""

    piece: np.ndarray
    """[segment] int32, fixed piece that the segment is a part of: an index of ``Model.fixed_start``."""
    start: np.ndarray
    """[segment] Start of the segment as a share of the piece's length, from 0 to 1."""
    end: np.ndarray
    """[segment] End of the segment as a share of the piece's length, from 0 to 1."""
    rest_q: np.ndarray
    """[segment, 7] m, xyzw: world pose of the segment's middle on the undeflected wire."""

    def __len__(self) -> int:
        return len(self.piece)

    def poses(self, which: np.ndarray, away: SegmentPoses) -> np.ndarray:
        """Returns the world poses [k, 7] float32 of the segments ``which`` [k], in ascending order. Segments that are
        not in ``away`` have their rest pose."""
        q = self.rest_q[which].astype(np.float32)
        _, here, there = np.intersect1d(which, away.segment, assume_unique=True, return_indices=True)
        q[here] = away.q[there]
        return q


def wire_segments(model: Model) -> WireSegments:
    """Returns the segments of all pieces of wire under tension. Other pieces never move."""
    gives = np.flatnonzero(model.fixed_tension > 0.0)
    way = (model.fixed_end - model.fixed_start)[gives].astype(float)
    whole, start, end = cut(np.linalg.norm(way, axis=1), MAX_LENGTH)
    piece = gives[whole]
    middle = model.fixed_start[piece].astype(float) + 0.5 * (start + end)[:, None] * way[whole]
    rest_q = frames.pose(middle) if len(piece) else np.zeros((0, 7))
    return WireSegments(piece.astype(np.int32), start, end, rest_q)


def cut(length: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut lines of ``length`` [k] m into equal parts of at most ``longest`` [m]. Returns three arrays [part]: index of
    the line, and start and end of the part as shares of the line's length."""
    parts = np.maximum(np.ceil(length / longest), 1.0).astype(int)
    whole = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(len(whole)) - np.repeat(np.cumsum(parts) - parts, parts)
    return whole, number / parts[whole], (number + 1.0) / parts[whole]


# Poses of the segments of wires, for snapshots: stored for all pieces, computed for pieces that may have moved.


class WireShapes:
    """Poses of the segments of all wires of one model."""

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
        self._count = np.zeros(1, np.int32)
        self._listed = np.zeros(pieces, np.int32)
        self._poses = SegmentPoses()
        structs = supports.wire_structs
        pose = KernelLaunch(
            kernels.pose_wire_segments,
            [
                *structs[:2],
                share(self._count, wp.int32),
                share(self._listed, wp.int32),
                share(supports.deflection, wp.vec3d),
                wires.presses.struct,
                wires.geoms,
            ],
            [self._shapes.struct],
        )
        self._pose = KernelGraph(pose)

    def poses(self) -> SegmentPoses:
        """Returns the segments of deflected wires, with their poses."""
        marked = self._may_have_moved
        presses = self._wires.presses
        marked[self._supports.moved_pieces()] = True
        marked[presses.piece[: presses.count[0]]] = True
        pieces = np.flatnonzero(marked)
        if len(pieces) == 0:
            return self._poses
        self._listed[: len(pieces)] = pieces
        self._count[0] = len(pieces)
        self._pose(len(pieces))
        segment = spans(self._first[pieces], self._first[pieces + 1] - self._first[pieces])
        segment = segment[self._shapes.is_moved[segment]]
        marked[pieces] = False
        marked[self._piece[segment]] = True
        self._poses = SegmentPoses(segment, self._shapes.q[segment])
        return self._poses
