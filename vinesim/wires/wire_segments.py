"""Wires that give, cut into short straight segments: what moves of them in pictures, scans and pages."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.model import Model
from vinesim.scene.values import SegmentPoses

MAX_LENGTH = 0.25
"""Longest segment [m]: a force F on a wire of tension T is drawn with an error of F / T times a quarter of it at most,
1.4 mm for 20 N."""


@dataclasses.dataclass(frozen=True)
class WireSegments:
    """Segments of the wires of a model, along each wire from its start to its end."""

    piece: np.ndarray
    """[segment] int32, an index of ``Model.fixed_start``."""
    start: np.ndarray
    """[segment] 1, where it begins on its piece, from 0 to 1."""
    end: np.ndarray
    """[segment] 1"""
    rest_q: np.ndarray
    """[segment, 7] m, 1: its middle as drawn, axes of the world."""

    def __len__(self) -> int:
        return len(self.piece)

    def poses(self, which: np.ndarray, away: SegmentPoses) -> np.ndarray:
        """Poses [k, 7] float32 m, 1 of some segments [k], ascending, of which all but those ``away`` are as drawn."""
        q = self.rest_q[which].astype(np.float32)
        _, here, there = np.intersect1d(which, away.segment, assume_unique=True, return_indices=True)
        q[here] = away.q[there]
        return q


def wire_segments(model: Model) -> WireSegments:
    """The segments of all pieces of wire under tension; the others never move."""
    gives = np.flatnonzero(model.fixed_tension > 0.0)
    way = (model.fixed_end - model.fixed_start)[gives].astype(float)
    whole, start, end = cut(np.linalg.norm(way, axis=1), MAX_LENGTH)
    piece = gives[whole]
    middle = model.fixed_start[piece].astype(float) + 0.5 * (start + end)[:, None] * way[whole]
    rest_q = frames.pose(middle) if len(piece) else np.zeros((0, 7))
    return WireSegments(piece.astype(np.int32), start, end, rest_q)


def cut(length: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines of ``length`` [k] m in equal parts of at most ``longest`` [m]: the line of each part [part], and where on
    it the part begins and ends [part], from 0 to 1."""
    parts = np.maximum(np.ceil(length / longest), 1.0).astype(int)
    whole = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(len(whole)) - np.repeat(np.cumsum(parts) - parts, parts)
    return whole, number / parts[whole], (number + 1.0) / parts[whole]
