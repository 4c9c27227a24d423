"""Rasteriser of a spinning lidar: finds the nearest primitive along each ray of a grid of azimuths and elevations.

A row contains the rays of one elevation; columns are equal steps of azimuth. Each row has its own first azimuth,
because lasers fire one after another and a beam consists of several rays. Tests compare the results with
:class:`~vinesim.sensors.primitives.ray_caster.RayCaster`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import struct_fields
from vinesim.kernels.lidar import lidar_raster
from vinesim.kernels.lidar.lidar_raster import ELEVATION_SLOTS, LidarHead
from vinesim.kernels.raster import primitives as shapes
from vinesim.kernels.raster.pinhole import EMPTY_KEY
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import MAX_DEPTH


def _as_floats(vectors: wp.array) -> wp.array:
    """Returns a view of an array of vectors as scalars [n, 3]."""
    return wp.array(ptr=vectors.ptr, shape=(len(vectors), 3), dtype=float, device=vectors.device, copy=False)


class LidarRasterizer:
    """The rays of one revolution of a lidar, and the last computed hit of each ray."""

    def __init__(
        self, elevation: np.ndarray, azimuth: np.ndarray, step: float, columns: int, device: str = "cpu"
    ) -> None:
        """The ray of column k and row r has ``elevation[r]`` and azimuth ``azimuth[r] + k * step`` [rad] in the head's
        frame: x forward, z up, azimuth counter-clockwise seen from above.
        """
        wp.load_module(lidar_raster, device=device)  # here, because only one thread may load a module at a time
        elevation = np.asarray(elevation, float)
        azimuth = np.asarray(azimuth, float)
        self.rows = len(elevation)
        self.columns = columns
        self.step = float(step)
        self.device = device
        e = np.tile(elevation, columns)
        a = (azimuth + step * np.arange(columns)[:, None]).ravel()
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1).astype(np.float32)
        self.direction = wp.array(rays, dtype=wp.vec3, device=device)
        """[column * row] Unit vectors of the rays in the head's frame: column by column, in the order of firing."""
        self.distance = wp.zeros(columns * self.rows, dtype=float, device=device)
        """[column * row] Distance to the nearest hit [m]; 1e30 without a hit."""
        self.primitive = wp.full(columns * self.rows, -1, dtype=wp.int32, device=device)
        """[column * row] Index of the primitive that was hit; -2: the ground, -1: no hit."""
        self._keys = wp.empty(columns * self.rows, dtype=wp.int64, device=device)
        order = np.argsort(elevation, kind="stable")
        tangent = np.clip(np.tan(elevation[order]), -1.0e6, 1.0e6).astype(np.float32)
        slot = ((tangent / (1.0 + np.abs(tangent)) + 1.0) * (0.5 * ELEVATION_SLOTS - 0.01)).astype(int)
        head = LidarHead()
        head.tangent, head.azimuth = (
            wp.array(v.astype(np.float32), dtype=float, device=device) for v in (tangent, azimuth[order])
        )
        head.row_index = wp.array(order.astype(np.int32), device=device)
        # one slot early: the division above may round differently than in a kernel
        slots = np.searchsorted(slot, np.arange(ELEVATION_SLOTS + 3) - 1).astype(np.int32)
        head.row_slots = wp.array(slots, device=device)
        head.direction = _as_floats(self.direction)
        head.step = self.step
        self._head = head
        self._azimuth_range = azimuth.min(), azimuth.max()

    def cast(
        self,
        primitives: Primitives,
        pose: np.ndarray,
        first: int = 0,
        count: int | None = None,
        reach: float = MAX_DEPTH,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the hits of ``count`` columns (by default all) from column ``first`` on, with the head at ``pose`` [7].

        Writes these columns of :attr:`distance` and :attr:`primitive`, and returns them as [count, row]. ``reach``:
        largest distance of a hit [m]. Several threads may call this at the same time for different columns.
        """
        count = self.columns - first if count is None else count
        head = self._head_at(pose, reach, first, first + count)
        part = slice(first * self.rows, (first + count) * self.rows)
        self._keys[part].fill_(int(EMPTY_KEY))
        bound = wp.empty(len(primitives.cluster_first), dtype=float, device=self.device)
        wp.launch(
            lidar_raster.cull_clusters,
            len(bound),
            inputs=[primitives.ball, head],
            outputs=[bound],
            device=self.device,
        )
        distance = bound.numpy()
        seen = np.flatnonzero(distance < float(shapes.FAR))
        seen = seen[np.argsort(distance[seen], kind="stable")].astype(np.int32)
        lanes, slices = (1, 1) if self.device == "cpu" else (24, min(self.rows, 16))  # near clusters cover every row
        wp.launch(
            lidar_raster.raster_clusters,
            (len(seen), lanes, slices),
            inputs=[
                primitives.shapes,
                primitives.clusters,
                _as_floats(primitives.lower),
                _as_floats(primitives.upper),
                wp.array(seen, device=self.device),
                head,
                lanes,
                slices,
            ],
            outputs=[self._keys],
            device=self.device,
        )
        run = self.rows if self.device == "cpu" else 1
        wp.launch(
            lidar_raster.resolve_keys,
            count * self.rows // run,
            inputs=[primitives.ground, self._keys, head, run],
            outputs=[self.distance, self.primitive],
            device=self.device,
        )
        shape = (count, self.rows)
        return self.distance[part].numpy().reshape(shape), self.primitive[part].numpy().reshape(shape)

    def _head_at(self, pose: np.ndarray, reach: float, first: int, end: int) -> LidarHead:
        """Returns the kernel struct of the head at ``pose`` [7] for columns ``first`` to ``end`` - 1; ``reach``:
        largest distance of a hit [m]."""
        head = LidarHead()
        for name in struct_fields(LidarHead):
            setattr(head, name, getattr(self._head, name))
        head.eye = wp.vec3(*map(float, pose[:3]))
        head.rotation = wp.mat33(*map(float, frames.to_matrix(frames.normalize(pose[3:])).T.ravel()))
        head.first_column = first
        head.end_column = end
        head.max_range = float(reach)
        low, high = self._azimuth_range
        turn = 0.5 * (low + high) + 0.5 * (first + end - 1) * self.step
        reaches = 0.5 * (high - low + abs(self.step) * (end - first)) + 1e-4
        head.azimuth_middle = wp.vec2(float(np.cos(turn)), float(np.sin(turn)))
        head.azimuth_half_range = (
            wp.vec2(float(np.cos(reaches)), float(np.sin(reaches))) if reaches < 1.5 else wp.vec2(-1.0, 0.0)
        )
        return head
