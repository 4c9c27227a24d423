"""A spinning head's rays, rasterised: the nearest primitive along each ray of a grid of azimuths and elevations.

Rows are rays of one elevation, columns follow each other in even steps of azimuth; each row has an azimuth of its own
to start from, as lasers that fire in turn have, or the sub-rays of one beam. The oracle is
:class:`~vinesim.sensors.raycast.RayCaster`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.sensors.camera import REACH
from vinesim.sensors.primitives import Primitives
from vinesim.sensors.raycast import RayCaster


class Sweep:
    """The rays of one revolution, and what they met when they were fired last."""

    def __init__(
        self, elevation: np.ndarray, azimuth: np.ndarray, step: float, columns: int, device: str = "cpu"
    ) -> None:
        """Ray (column k, row r) leaves at ``elevation[r]`` and ``azimuth[r] + k * step`` [rad], in the head's frame:
        x forward, z up, azimuth counter-clockwise seen from above.
        """
        elevation, azimuth = np.asarray(elevation, float), np.asarray(azimuth, float)
        self.rows, self.columns, self.step, self.device = len(elevation), columns, float(step), device
        e, a = np.tile(elevation, columns), (azimuth + step * np.arange(columns)[:, None]).ravel()
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1).astype(np.float32)
        self.direction = wp.array(rays, dtype=wp.vec3, device=device)
        """Unit vectors in the head's frame [column * row]: column by column, as shots are fired."""
        self.distance = wp.zeros(columns * self.rows, dtype=float, device=device)
        """To the nearest hit [column * row] m; 1e30 where nothing is met."""
        self.primitive = wp.full(columns * self.rows, -1, dtype=wp.int32, device=device)
        """What was met [column * row]: -2 the ground, -1 nothing."""
        self._caster: RayCaster | None = None

    def hits(
        self, primitives: Primitives, pose: np.ndarray, first: int = 0, count: int | None = None, reach: float = REACH
    ) -> tuple[np.ndarray, np.ndarray]:
        """Fire ``count`` columns from ``first`` on (all that follow), with the head at ``pose`` [7] in the world.

        Fills that part of :attr:`distance` and :attr:`primitive`, and returns it [count, row].
        """
        count = self.columns - first if count is None else count
        if self._caster is None or self._caster.primitives is not primitives:
            self._caster = RayCaster(primitives)
        part = slice(first * self.rows, (first + count) * self.rows)
        rays = frames.rotate(frames.normalize(pose[3:]), self.direction.numpy()[part].astype(float))
        distance, primitive = self._caster.cast(pose[:3], rays, reach)
        self.distance.numpy()[part] = np.where(np.isfinite(distance), distance, 1.0e30)
        self.primitive.numpy()[part] = primitive
        shape = (count, self.rows)
        return self.distance.numpy()[part].reshape(shape), self.primitive.numpy()[part].reshape(shape)
