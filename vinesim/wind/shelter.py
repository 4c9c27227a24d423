"""How much of the wind reaches each tree: a profile with height, and shelter by the leaves upwind.

Above the canopy the mean follows the logarithmic law, below its top it falls off exponentially (Inoue, J. Meteorol.
Soc. Japan 41, 1963). Along the wind leaves take momentum from the air, and mixing from above gives it back. With q the
square of the speed as a share of that before the first row, and a the drag area in a volume of canopy [1/m],

    dq/dx = -a q + (1 - q) / L

is solved cell by cell on a grid that lies along the wind, once for a model and a wind.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.model import Model

ATTENUATION = 0.4
"""[1] Of the exponential profile below the top of the canopy. GUESSED: in use for orchards; cereals have 2 to 3."""
DISPLACEMENT = 0.65
ROUGHNESS = 0.1
"""[1] Zero-plane displacement and roughness length as shares of the canopy's height. READ: usual for tall crops."""
RECOVERY_DEPTHS = 10.0
"""[1] Length L in which mixing restores the wind, in depths of the canopy. GUESSED: wakes of windbreaks are 10 to 20
heights long."""
CELL = 0.5
"""[m] Edge of the cells of the grid."""
MIN_DEPTH = 0.3
"""[m] Least depth of a canopy."""


def height_profile(height: np.ndarray, top: float) -> np.ndarray:
    """Mean wind at heights [...] m above the ground as a share of that at the ``top`` [m] of the canopy [...]."""
    z = np.maximum(np.asarray(height, float) / top, 0.0)
    above = np.log((np.maximum(z, 1.0) - DISPLACEMENT) / ROUGHNESS) / np.log((1.0 - DISPLACEMENT) / ROUGHNESS)
    return np.where(z < 1.0, np.exp(-ATTENUATION * (1.0 - z)), above)


@dataclasses.dataclass(frozen=True, slots=True)
class TreeDrag:
    """Where the air takes hold of the trees of a model at rest."""

    area: np.ndarray
    """Drag area Cd A [tree] m^2."""
    centre: np.ndarray
    """Its centre [tree, 3] m; the foot of a tree without drag."""
    profile: np.ndarray
    """Uniform wind that drags as hard as the profile does, as a share of the wind at the top of the canopy [tree]."""
    depth: float
    """Of the canopy [m]: between the heights that a twentieth of the area lies below, and above."""

    @classmethod
    def of(cls, model: Model, body_q: np.ndarray) -> TreeDrag:
        """``body_q`` [body, 7]: poses at rest."""
        first = model.tree_first
        area = model.body_drag.astype(float)
        point = body_q[:, :3] + frames.rotate(body_q[:, 3:].astype(float), model.body_com.astype(float))
        total = np.add.reduceat(area, first)
        centre = model.tree_pose[:, :3].astype(float)
        has = total > 0.0
        centre[has] = np.add.reduceat(area[:, None] * point, first)[has] / total[has, None]
        if not has.any():
            return cls(total, centre, np.ones(len(first)), MIN_DEPTH)
        order = np.argsort(point[:, 2], kind="stable")
        share = np.cumsum(area[order]) / area.sum()
        low, top = (float(point[order[np.searchsorted(share, part)], 2]) for part in (0.05, 0.95))
        square = height_profile(point[:, 2], max(top, MIN_DEPTH)) ** 2
        profile = np.sqrt(np.add.reduceat(area * square, first) / np.where(has, total, 1.0))
        return cls(total, centre, profile, max(top - low, MIN_DEPTH))

    def air_share(self, mean: np.ndarray) -> np.ndarray:
        """Speed of the air at each tree [tree] as a share of the undisturbed one at the top of the canopy, in a mean
        wind [3] m/s."""
        return self.profile * np.sqrt(self._sheltered_pressure(np.asarray(mean, float)[:2]))

    def _sheltered_pressure(self, wind: np.ndarray) -> np.ndarray:
        """Share q [tree] of the square of the speed that the leaves upwind leave to each tree."""
        speed = float(np.hypot(*wind))
        if speed == 0.0 or not len(self.area):
            return np.ones(len(self.area))
        ahead = wind / speed
        place = self.centre[:, :2] @ np.array([ahead, [-ahead[1], ahead[0]]]).T
        column, row = np.floor((place - place.min(0)) / CELL).astype(int).T
        density = np.zeros((column.max() + 1, row.max() + 1))
        np.add.at(density, (column, row), self.area / (CELL * CELL * self.depth))
        rate = density + 1.0 / (RECOVERY_DEPTHS * self.depth)
        balance = 1.0 / (RECOVERY_DEPTHS * self.depth) / rate
        left = np.exp(-CELL * rate)
        q = np.ones_like(density)  # where a cell begins
        for i in range(len(q) - 1):
            q[i + 1] = balance[i] + (q[i] - balance[i]) * left[i]
        return q[column, row]
