"""Grouping of primitives in clusters: runs of at most 24 primitives of one kind, group and bunch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from vinesim.sensors.primitives.primitive_batches import Batch

MAX_CLUSTER = 24
"""Largest number of primitives in one cluster."""


@dataclasses.dataclass(frozen=True, slots=True)
class ClusterLayout:
    """Primitives sorted by cluster, in the frames of their carriers (bodies that move them), and their clusters."""

    a: np.ndarray
    """[primitive, 4] float32; :mod:`vinesim.kernels.raster.primitives` defines the meaning of ``a`` to ``d``."""
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    material: np.ndarray
    """[primitive] int32, a number of :mod:`vinesim.kernels.shading.materials`."""
    tint: np.ndarray
    """[primitive, 3] linear RGB reflectance."""
    organ: np.ndarray
    """[primitive] int32, a number of :class:`vinesim.scene.ids.Organ`."""
    label: np.ndarray
    """[primitive] int32, label as defined by :func:`vinesim.scene.ids.label`."""
    carrier: np.ndarray
    """[primitive] int32, row in the array of poses of the body that moves the primitive."""
    first: np.ndarray
    """[cluster] int32, index of the cluster's first primitive."""
    size: np.ndarray
    """[cluster] int32, number of the cluster's primitives."""
    kind: np.ndarray
    """[cluster] int32, kind of the cluster's primitives."""
    owner: np.ndarray
    """[cluster] int32, tree that moves the cluster; -1 for clusters that no tree moves."""
    bunch: np.ndarray
    """[cluster] int32, bunch with which the cluster disappears when the bunch is picked; -1 for none."""
    is_rigid: np.ndarray
    """[cluster] bool, whether the cluster is part of a rigid body."""


def lay_out(fixed: Sequence[Batch], moving: Sequence[Batch], static_carrier: int) -> ClusterLayout:
    """Group primitives in clusters: first plants and the static scene (``fixed``), then rigid bodies (``moving``).

    A cluster contains one kind, group and bunch only. ``static_carrier``: carrier of primitives that never move.
    """
    whole: dict[str, list[np.ndarray]] = {
        name: [] for name in ("a", "b", "c", "d", "material", "tint", "organ", "label", "carrier")
    }
    clusters: dict[str, list[np.ndarray]] = {
        name: [] for name in ("first", "size", "kind", "owner", "bunch", "is_rigid")
    }
    total = 0
    for number, batch in enumerate([*fixed, *moving]):
        rigid = number >= len(fixed)
        order = np.lexsort((batch.bunch, batch.group))
        group = batch.group[order]
        bunch = batch.bunch[order]
        first, size = _runs(group, bunch)
        static = not rigid and bool((batch.carrier == static_carrier).all())
        clusters["first"].append(total + first)
        clusters["size"].append(size)
        clusters["kind"].append(np.full(len(first), batch.kind))
        clusters["owner"].append(np.full(len(first), -1) if static or rigid else group[first])
        clusters["bunch"].append(bunch[first])
        clusters["is_rigid"].append(np.full(len(first), rigid))
        for name, parts in whole.items():
            parts.append(getattr(batch, name)[order])
        total += len(batch)
    joined = {name: np.concatenate(parts) for name, parts in (whole | clusters).items()}
    for name in ("material", "organ", "label", "carrier", "first", "size", "kind", "owner", "bunch"):
        joined[name] = joined[name].astype(np.int32)
    return ClusterLayout(**joined)


def join_rigid(layouts: Sequence[ClusterLayout], carriers: Sequence[int], first_row: int) -> ClusterLayout:
    """Join the layouts of several rigid bodies into one, each body on its own carrier.

    ``carriers``: carrier of each layout; ``first_row``: index of the first primitive among all primitives of the scene.
    """
    joined = {
        field.name: np.concatenate([getattr(one, field.name) for one in layouts])
        for field in dataclasses.fields(ClusterLayout)
    }
    rows = [len(one.label) for one in layouts]
    starts = first_row + np.cumsum(rows) - rows
    joined["carrier"] = np.repeat(carriers, rows).astype(np.int32)
    joined["first"] += np.repeat(starts, [len(one.first) for one in layouts]).astype(np.int32)
    return ClusterLayout(**joined)


def _runs(group: np.ndarray, bunch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns first index and size [cluster] of runs of primitives with equal ``group`` and ``bunch`` [primitive], at
    most :data:`MAX_CLUSTER` long."""
    starts = np.flatnonzero(np.r_[True, (group[1:] != group[:-1]) | (bunch[1:] != bunch[:-1])])
    lengths = np.diff(np.r_[starts, len(group)])
    parts = (lengths + MAX_CLUSTER - 1) // MAX_CLUSTER
    inner = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    first = np.repeat(starts, parts) + inner * MAX_CLUSTER
    return first, np.minimum(MAX_CLUSTER, np.repeat(lengths, parts) - inner * MAX_CLUSTER)
