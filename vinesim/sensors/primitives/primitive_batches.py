"""Batches of primitives of one kind, in the frames of their carriers, before they are grouped in clusters."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from vinesim.kernels.raster import primitives
from vinesim.sensors.raster.primitive_arrays import CONE


@dataclasses.dataclass
class Batch:
    """Primitives [n] of one kind, in the frames of their carriers (bodies that move them)."""

    kind: int
    """Kind of the primitives, a number of :data:`vinesim.sensors.raster.primitive_arrays.KINDS`."""
    a: np.ndarray
    """[n, 4] float32; :mod:`vinesim.kernels.raster.primitives` defines the meaning of ``a`` to ``d`` for each kind."""
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    material: np.ndarray
    """[n] int32, a number of :mod:`vinesim.kernels.shading.materials`."""
    tint: np.ndarray
    """[n, 3] linear RGB reflectance, 0.004 to 1."""
    organ: np.ndarray
    """[n] int32, a number of :class:`vinesim.scene.ids.Organ`."""
    label: np.ndarray
    """[n] int32, label as defined by :func:`vinesim.scene.ids.label`."""
    carrier: np.ndarray
    """[n] int32, row in the array of poses of the body that moves the primitive."""
    group: np.ndarray
    """[n] int32, group; a cluster contains primitives of one group only."""
    bunch: np.ndarray
    """[n] int32, bunch with which the primitive disappears when the bunch is picked; -1 for none."""

    def __len__(self) -> int:
        return len(self.a)


def make_batch(
    kind: int,
    a: ArrayLike,
    *,
    b: ArrayLike = 0.0,
    c: ArrayLike = 0.0,
    d: ArrayLike = 0.0,
    material: ArrayLike,
    tint: ArrayLike,
    organ: ArrayLike,
    label: ArrayLike,
    carrier: ArrayLike,
    group: ArrayLike,
    bunch: ArrayLike = -1,
) -> Batch:
    """Returns a batch of primitives of one ``kind``; scalars and single rows are broadcast to the length of ``a`` [n,
    4]."""
    a = np.atleast_2d(np.asarray(a, np.float32))
    n = len(a)

    def rows(values: ArrayLike) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.float32), (n, 4))

    def integers(values: ArrayLike) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.int32), n)

    return Batch(
        kind=kind,
        a=a,
        b=rows(b),
        c=rows(c),
        d=rows(d),
        material=integers(material),
        tint=np.broadcast_to(np.clip(np.asarray(tint, np.float32), 0.004, 1.0), (n, 3)),
        organ=integers(organ),
        label=integers(label),
        carrier=integers(carrier),
        group=integers(group),
        bunch=integers(bunch),
    )


def stack_columns(*parts: ArrayLike) -> np.ndarray:
    """Returns an array [n, ...] whose columns are those of ``parts`` side by side: vectors [n, k], and scalars, single
    or [n]."""
    columns = [np.asarray(p, float).reshape(-1, 1) if np.ndim(p) < 2 else np.asarray(p, float) for p in parts]
    n = max(len(c) for c in columns)
    return np.concatenate([np.broadcast_to(c, (n, c.shape[1])) for c in columns], 1)


def placeholder_batch(static_carrier: int) -> Batch:
    """Returns a batch with one primitive far below the ground, for a world without plants, so that no array is
    empty."""
    return make_batch(
        CONE,
        [[0.0, 0.0, float(primitives.HIDDEN_HEIGHT), 1e-6]],
        b=[[1e-3, 0.0, float(primitives.HIDDEN_HEIGHT), 1e-6]],
        material=0,
        tint=0.0,
        organ=0,
        label=0,
        carrier=static_carrier,
        group=0,
    )
