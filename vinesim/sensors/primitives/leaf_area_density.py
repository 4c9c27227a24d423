"""Leaf area density of a canopy on a grid, and the share of sky light that reaches points below it (Beer-Lambert)."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.shading import shadow_maps
from vinesim.scene.terrain import Terrain

_HEIGHT = 3.0
"""Height of the grid above the ground [m]."""
_BLADE_AREA = 1.1
"""Area of a leaf blade divided by the square of its length from petiole to tip [1]: GUESSED, mean of the outlines."""


class LeafDensity:
    """Leaf area per volume [1/m] in the cells of a grid that covers a vineyard and follows its ground."""

    def __init__(
        self,
        blades: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        device: str = "cpu",
        terrain: Terrain | None = None,
    ) -> None:
        """``blades``: [leaf, 4] position [m] and length [m] of each leaf blade; ``low``, ``high``: [2] lowest and
        highest x and y [m] of the grid; ``terrain``: the uneven ground, below which no leaf hangs."""
        self._device = device
        self._terrain = terrain
        blades = self._above_ground(blades)
        cell = max(0.15, float((high - low).max()) / 600.0)
        size = np.maximum(((high - low) / cell).astype(int) + 1, 1)
        corner = np.array([low[0], low[1], 0.0])
        density = np.zeros((*size, int(_HEIGHT / cell) + 1), np.float32)
        index = ((blades[:, :3] - corner) / cell).astype(int)
        inside = ((index >= 0) & (index < density.shape)).all(1)
        np.add.at(density, tuple(index[inside].T), _BLADE_AREA * blades[inside, 3] ** 2 / cell**3)
        self._grid = wp.array(density, dtype=float, device=device)
        self._corner = wp.vec3(*map(float, corner))
        self._cell = float(cell)

    def visible_sky(self, points: np.ndarray) -> np.ndarray:
        """Returns the share of the sky light [k] that reaches ``points`` [k, 3] m through the leaves, 0 to 1."""
        points = self._above_ground(points)
        share = wp.zeros(len(points), dtype=float, device=self._device)
        position = wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device=self._device)
        wp.launch(
            shadow_maps.sky_visibility,
            len(points),
            inputs=[self._grid, self._corner, self._cell, position],
            outputs=[share],
            device=self._device,
        )
        return share.numpy()

    def _above_ground(self, points: np.ndarray) -> np.ndarray:
        """Returns ``points`` [k, 3 or more] m with z above the uneven ground instead of above the world's origin."""
        if self._terrain is None:
            return points
        points = np.array(points)
        points[:, 2] -= self._terrain.height(points[:, 0], points[:, 1])
        return points
