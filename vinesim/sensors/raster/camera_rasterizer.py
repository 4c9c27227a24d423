"""Camera rasteriser: primitive, depth and label of every pixel, by CPU kernels or by the scene's CUDA rasteriser."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.thread_pool import ThreadPool
from vinesim.core.warp_arrays import struct_fields
from vinesim.kernels.raster import camera_raster, camera_raster_plants
from vinesim.kernels.raster import primitives as shapes
from vinesim.kernels.raster.pinhole import EMPTY_KEY, NEAR_DEPTH, Pinhole
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraInfo
from vinesim.sensors.raster.primitive_arrays import (
    BOX,
    CONE,
    CYLINDER,
    ELLIPSOID,
    LEAF,
    SPHEROID,
    TRIANGLE,
    PosedPrimitives,
)

MAX_DEPTH = 500.0
"""Depth [m] beyond which primitives are not drawn."""
BANDS_PER_THREAD = 2
"""Average number of bands of rows of a picture for each thread. A thread that has finished a band takes the next one.
"""
_KERNELS = (
    (camera_raster_plants.raster_cones, (CONE,)),
    (camera_raster_plants.raster_spheroids, (SPHEROID,)),
    (camera_raster.raster_triangles, (TRIANGLE,)),
    (camera_raster.raster_solids, (BOX, ELLIPSOID, CYLINDER)),
    (camera_raster_plants.raster_leaves, (LEAF,)),  # last, because leaves cost most, and most are then already hidden
)
_KERNEL_OF_KIND = np.array(
    [next(i for i, (_, kinds) in enumerate(_KERNELS) if kind in kinds) for kind in range(TRIANGLE + 1)]
)
"""[kind] Index of the entry of ``_KERNELS`` that draws each kind."""


def pinhole(info: CameraInfo, pose: np.ndarray) -> Pinhole:
    """Returns the kernel struct of a camera with intrinsics ``info`` whose optical frame has the ``pose`` [7]."""
    if not (info.fx > 0.0 and info.fy > 0.0 and info.width > 0 and info.height > 0):
        raise ValueError(
            f"camera {info.frame_id!r} has fx {info.fx}, fy {info.fy}, {info.width} x {info.height}; give positive ones"
        )
    if info.distortion:
        raise ValueError(f"camera {info.frame_id!r} has distortion; draw lens_map(info).pinhole")
    pose = np.asarray(pose, float)
    if not np.isfinite(pose).all():
        raise ValueError(f"camera {info.frame_id!r} has the pose {pose.tolist()}; give finite numbers")
    lens = Pinhole()
    lens.eye = wp.vec3(*map(float, pose[:3]))
    lens.rotation = wp.mat33(*map(float, frames.to_matrix(frames.normalize(pose[3:])).T.ravel()))
    lens.fx = float(info.fx)
    lens.fy = float(info.fy)
    lens.cx = float(info.cx)
    lens.cy = float(info.cy)
    lens.width = int(info.width)
    lens.height = int(info.height)
    lens.max_depth = MAX_DEPTH
    lens.first_row = 0
    lens.end_row = lens.height
    wide = max(info.cx, info.width - info.cx) / info.fx
    high = max(info.cy, info.height - info.cy) / info.fy
    lens.near_radius = float(NEAR_DEPTH) * float(np.sqrt(1.0 + wide * wide + high * high))
    return lens


def row_bands(lens: Pinhole, count: int) -> list[Pinhole]:
    """Returns up to ``count`` copies of ``lens``, each for a band of an even number of rows, that together cover its
    rows."""
    rows = [2 * round(0.5 * lens.height * i / count) for i in range(count)] + [lens.height]
    bands = []
    for first, end in itertools.pairwise(rows):
        if first < end:
            band = Pinhole()
            for name in struct_fields(Pinhole):
                setattr(band, name, getattr(lens, name))
            band.first_row = first
            band.end_row = end
            bands.append(band)
    return bands


def supersampled(info: CameraInfo, samples: int) -> CameraInfo:
    """Returns the intrinsics of a picture with ``samples`` times as many pixels along each side and an equal view."""
    return dataclasses.replace(
        info,
        width=info.width * samples,
        height=info.height * samples,
        fx=info.fx * samples,
        fy=info.fy * samples,
        cx=samples * (info.cx + 0.5) - 0.5,
        cy=samples * (info.cy + 0.5) - 0.5,
    )


class CameraRasterizer:
    """Finds the nearest primitive in every pixel of one camera, and holds the buffers of its picture."""

    def __init__(self, width: int, height: int, device: str = "cpu", workers: ThreadPool | None = None) -> None:
        """``width``, ``height``: of the picture [px]; ``workers``: threads that draw bands of rows in parallel, without
        effect on the result."""
        count = width * height
        self.workers = workers or ThreadPool(1)
        self.width = width
        self.height = height
        self.device = device
        self.keys = wp.empty(count, dtype=wp.int64, device=device)
        self._keys = self.keys.numpy() if device == "cpu" else None
        self.primitive = wp.empty(count, dtype=wp.int32, device=device)
        self.depth = wp.empty(count, dtype=float, device=device)
        self.labels = wp.empty(count, dtype=wp.int32, device=device)

    def draw(
        self,
        primitives: PosedPrimitives,
        lens: Pinhole,
        nearest: float = 0.0,
        farthest: float = MAX_DEPTH,
        beside: Sequence[Callable[[], None]] = (),
    ) -> None:
        """Compute primitive (-1 the sky, -2 the ground), depth [m] and label of every pixel.

        ``nearest``, ``farthest``: range of depth [m]; depths beyond it become -inf and inf. ``beside``: other functions
        for the same threads, which have returned when this method returns.
        """
        if primitives.rasterizer is not None:
            primitives.rasterizer.rasterize(primitives, lens, None, self.keys)
            self._resolve(primitives, lens, nearest, farthest)
            self.workers.share(beside)
            return

        def draw_band(band: Pinhole) -> None:
            distance = self.cluster_distances(primitives, band)
            seen = np.flatnonzero(distance < float(shapes.FAR))
            self._rasterize(primitives, band, seen[np.argsort(distance[seen], kind="stable")])
            self._resolve(primitives, band, nearest, farthest)

        self.workers.share([*beside, *(functools.partial(draw_band, band) for band in self.bands(lens))])

    def bands(self, lens: Pinhole) -> list[Pinhole]:
        """Returns the bands of rows of ``lens`` into which the work of a picture is divided for :attr:`workers`."""
        return row_bands(lens, BANDS_PER_THREAD * self.workers.size if self.workers.size > 1 else 1)

    def _resolve(self, primitives: PosedPrimitives, lens: Pinhole, nearest: float, farthest: float) -> None:
        """Convert the keys (depth and primitive of each pixel as one integer) in the rows of ``lens`` to primitive,
        depth and label."""
        run = self.width if self.device == "cpu" else 1  # on a CPU one thread takes a row, to pass structs less often
        wp.launch(
            camera_raster.resolve_keys,
            self.width * (lens.end_row - lens.first_row) // run,
            inputs=[
                primitives.labels,
                primitives.ground,
                lens,
                label(Organ.GROUND, 0),
                float(nearest),
                float(farthest),
                -float("inf"),
                float("inf"),
                run,
            ],
            outputs=[self.keys, self.primitive, self.depth, self.labels],
            device=self.device,
        )

    def cluster_distances(self, primitives: PosedPrimitives, lens: Pinhole) -> np.ndarray:
        """Returns the least distance [cluster] m of each cluster (run of primitives) from the camera, or FAR for
        clusters out of view."""
        distance = wp.empty(len(primitives.cluster_first), dtype=float, device=self.device)
        wp.launch(
            camera_raster.cull_clusters,
            len(distance),
            inputs=[primitives.ball, lens],
            outputs=[distance],
            device=self.device,
        )
        return distance.numpy()

    def coverage(self, primitives: PosedPrimitives, lens: Pinhole, clusters: np.ndarray) -> np.ndarray:
        """Returns which pixels [height, width] would show the ``clusters`` [k] (runs of primitives) if the scene
        contained no other clusters.

        This overwrites the keys (depth and primitive of each pixel as one integer), but neither depth nor labels.
        """
        if primitives.rasterizer is None:
            self._rasterize(primitives, lens, clusters)
        else:
            primitives.rasterizer.rasterize(primitives, lens, clusters, self.keys)
        return self.keys.numpy().reshape(self.height, self.width) < int(EMPTY_KEY)

    def _rasterize(self, primitives: PosedPrimitives, lens: Pinhole, seen: np.ndarray) -> None:
        """Compute the keys (depth and primitive of each pixel as one integer) in the rows of ``lens``.

        ``seen`` [k]: clusters (runs of primitives) to draw, sorted from near to far for speed.
        """
        assert self._keys is not None, "these kernels draw on a CPU only"
        rows = slice(lens.first_row * self.width, lens.end_row * self.width)
        self._keys[rows].fill(int(EMPTY_KEY))  # numpy fills this memory five times as fast as Warp
        seen = np.asarray(seen, np.int32)
        kind = primitives.cluster_kind[seen]
        stage = _KERNEL_OF_KIND[kind]
        for number, (kernel, _) in enumerate(_KERNELS):
            mine = seen[stage == number]
            if len(mine):
                wp.launch(
                    kernel,
                    (len(mine), 1),
                    inputs=[primitives.shapes, primitives.clusters, wp.array(mine, device=self.device), lens, 1],
                    outputs=[self.keys],
                    device=self.device,
                )
