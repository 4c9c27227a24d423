"""Rows of primitives before they are laid out in clusters: one kind a batch, in the frames of what carries them."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.kernels.raster import primitives
from vinesim.sensors.raster.primitive_arrays import CONE


@dataclasses.dataclass
class Batch:
    """Primitives of one kind in the frames of their carriers; neither groups nor bunches ever mix in one cluster."""

    kind: int
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    material: np.ndarray
    tint: np.ndarray
    organ: np.ndarray
    label: np.ndarray
    carrier: np.ndarray
    group: np.ndarray
    bunch: np.ndarray
    """Which bunch a primitive belongs to while that hangs; -1 for none."""

    def __len__(self) -> int:
        return len(self.a)


def make_batch(kind: int, a, *, b=0.0, c=0.0, d=0.0, material, tint, organ, label, carrier, group, bunch=-1) -> Batch:
    """A batch with scalars and rows broadcast to the count of ``a`` [n, 4]."""
    a = np.atleast_2d(np.asarray(a, np.float32))
    n = len(a)
    wide = [np.broadcast_to(np.asarray(v, np.float32), (n, 4)) for v in (b, c, d)]
    flat = [np.broadcast_to(np.asarray(v, np.int32), n) for v in (organ, label, carrier, group, bunch)]
    tint = np.broadcast_to(np.clip(np.asarray(tint, np.float32), 0.004, 1.0), (n, 3))
    return Batch(kind, a, *wide, np.broadcast_to(np.asarray(material, np.int32), n), tint, *flat)


def stack_columns(*parts) -> np.ndarray:
    """Vectors [n, k] and scalars, one or [n], side by side."""
    columns = [np.asarray(p, float).reshape(-1, 1) if np.ndim(p) < 2 else np.asarray(p, float) for p in parts]
    n = max(len(c) for c in columns)
    return np.concatenate([np.broadcast_to(c, (n, c.shape[1])) for c in columns], 1)


def placeholder_batch(still: int) -> Batch:
    """A stand-in for a world without plants, far below the ground: no array is ever empty."""
    return make_batch(
        CONE,
        [[0.0, 0.0, float(primitives.HIDDEN_HEIGHT), 1e-6]],
        b=[[1e-3, 0.0, float(primitives.HIDDEN_HEIGHT), 1e-6]],
        material=0,
        tint=0.0,
        organ=0,
        label=0,
        carrier=still,
        group=0,
    )
