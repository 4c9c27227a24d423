"""Interface between scene and rasterisers: kinds of primitives, their arrays, and the rasteriser protocol."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp

from vinesim.kernels.raster import primitives
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
"""Number of each kind of primitive, by name."""


class PosedPrimitives(Protocol):
    """Primitives posed in the world (:class:`vinesim.sensors.primitives.scene_primitives.Primitives`)."""

    device: str
    shapes: primitives.Shapes
    clusters: primitives.Clusters
    ball: wp.array
    """[cluster] vec4, bounding sphere: centre and radius [m]. The radius is negative if the cluster is hidden."""
    labels: wp.array
    """[primitive] int32, as of :func:`vinesim.scene.ids.label`."""
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
        """The rasteriser that fills the keys of cameras; None for the kernels of
        :mod:`vinesim.kernels.raster.camera_raster`."""
        ...


class PrimitiveRasterizer(Protocol):
    """Fills keys: depth [um] in the upper 32 bits, number of the primitive in the lower 32 bits."""

    def rasterize(
        self, primitives: PosedPrimitives, lens: Pinhole, clusters: np.ndarray | None, keys: wp.array
    ) -> None:
        """Write the nearest primitive of every pixel to ``keys`` [pixel] int64.

        ``clusters`` [k]: only these are drawn; all unless given.
        """
        ...
