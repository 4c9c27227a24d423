"""Interface between scene and rasterisers: kinds of primitives, their arrays, and the rasteriser protocol."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp

from vinesim.kernels.raster import primitives
from vinesim.kernels.raster.ground import Ground
from vinesim.kernels.raster.pinhole import Pinhole

CONE, SPHEROID, LEAF, BOX, ELLIPSOID, CYLINDER, TRIANGLE = (
    int(k)
    for k in (
        primitives.CONE,
        primitives.SPHEROID,
        primitives.LEAF,
        primitives.BOX,
        primitives.ELLIPSOID,
        primitives.CYLINDER,
        primitives.TRIANGLE,
    )
)
KINDS = {
    "cone": CONE,
    "spheroid": SPHEROID,
    "leaf": LEAF,
    "box": BOX,
    "ellipsoid": ELLIPSOID,
    "cylinder": CYLINDER,
    "triangle": TRIANGLE,
}
"""Numbers that stand for the kinds of primitives in kernels, by name."""


class PosedPrimitives(Protocol):
    """Interface of the primitives of a scene in world poses, for rasterisers. A cluster is a run of adjacent
    primitives. Implemented by :class:`vinesim.sensors.primitives.scene_primitives.Primitives`."""

    device: str
    shapes: primitives.Shapes
    clusters: primitives.Clusters
    ground: Ground
    """The uneven ground; without nodes the ground is the plane z = 0."""
    ball: wp.array
    """[cluster] vec4, bounding sphere: centre and radius [m]. The radius of a hidden cluster is negative."""
    labels: wp.array
    """[primitive] int32, label as defined by :func:`vinesim.scene.ids.label`."""
    cluster_first: np.ndarray
    """[cluster] int32, index of the cluster's first primitive."""
    cluster_size: np.ndarray
    """[cluster] int32, number of the cluster's primitives."""
    cluster_kind: np.ndarray
    """[cluster] int32, one of :data:`KINDS`."""
    pose_version: int
    """Number that changes when any pose changes."""

    @property
    def rasterizer(self) -> PrimitiveRasterizer | None:
        """The rasteriser for cameras of this scene; None: the CPU kernels of
        :mod:`vinesim.kernels.raster.camera_raster`."""
        ...


class PrimitiveRasterizer(Protocol):
    """Interface of a rasteriser, which computes a key for each pixel: depth [um] in the upper 32 bits, index of the
    primitive in the lower 32 bits."""

    def rasterize(
        self, primitives: PosedPrimitives, lens: Pinhole, clusters: np.ndarray | None, keys: wp.array
    ) -> None:
        """Write the key of the nearest primitive of every pixel to ``keys`` [pixel] int64.

        ``clusters``: [k] clusters (runs of adjacent primitives) to draw; None: all clusters.
        """
        ...
