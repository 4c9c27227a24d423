"""Wind speed at each tree: a profile over height, and shelter by leaves upwind.

Above the canopy the mean wind follows the logarithmic law, below its top it falls off exponentially (Inoue, J.
Meteorol. Soc. Japan 41, 1963). Leaves take momentum from the air, and mixing from above restores it. Let q be the ratio
of the squared speed to its value upwind of the first row, and a the drag area per volume of canopy [1/m]. Then

    dq/dx = -a q + (1 - q) / L

along the wind. This equation is solved cell by cell on a grid aligned with the wind, once for each model and wind.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.model import Model
from vinesim.scene.terrain import above_ground

ATTENUATION = 0.4
"""[1] Attenuation coefficient of the exponential profile in the canopy. GUESSED: used for orchards; cereals have 2 to
3."""
DISPLACEMENT = 0.65
ROUGHNESS = 0.1
"""[1] Zero-plane displacement and roughness length as fractions of the canopy's height. READ: usual for tall crops."""
RECOVERY_DEPTHS = 10.0
"""[1] Length L over which mixing restores the wind, divided by the depth of the canopy. GUESSED: wakes of windbreaks
are 10 to 20 heights long."""
CELL = 0.5
"""[m] Edge of the cells of the grid."""
MIN_DEPTH = 0.3
"""[m] Lower bound of the depth of a canopy; thinner canopies are treated as this deep."""


def height_profile(height: np.ndarray, top: float) -> np.ndarray:
    """Returns the ratio [...] of the mean wind at ``height`` [...] m above ground to the wind at the ``top`` [m] of the
    canopy."""
    z = np.maximum(np.asarray(height, float) / top, 0.0)
    above = np.log((np.maximum(z, 1.0) - DISPLACEMENT) / ROUGHNESS) / np.log((1.0 - DISPLACEMENT) / ROUGHNESS)
    return np.where(z < 1.0, np.exp(-ATTENUATION * (1.0 - z)), above)


@dataclasses.dataclass(frozen=True, slots=True)
class TreeDrag:
    """Drag areas of the trees of a model at rest."""

    area: np.ndarray
    """[tree] m^2, drag area Cd A."""
    centre: np.ndarray
    """[tree, 3] m, centre of the drag area; for a tree without drag, its foot."""
    profile: np.ndarray
    """[tree] Wind speed that would cause the same drag if it were uniform over the tree's height, as a share of the
    wind speed at the top of the canopy."""
    depth: float
    """Depth of the canopy [m]: between the 5 % and 95 % quantiles of the drag area over height."""

    @classmethod
    def of(cls, model: Model, body_q: np.ndarray) -> TreeDrag:
        """Returns the drag areas of ``model`` with its bodies at the rest poses ``body_q`` [body, 7]."""
        first = model.tree_first
        area = model.body_drag.astype(float)
        point = body_q[:, :3] + frames.rotate(body_q[:, 3:].astype(float), model.body_com.astype(float))
        total = np.add.reduceat(area, first)
        centre = model.tree_pose[:, :3].astype(float)
        has = total > 0.0
        centre[has] = np.add.reduceat(area[:, None] * point, first)[has] / total[has, None]
        if not has.any():
            return cls(total, centre, np.ones(len(first)), MIN_DEPTH)
        height = above_ground(model.terrain, point)
        order = np.argsort(height, kind="stable")
        share = np.cumsum(area[order]) / area.sum()
        low, top = (float(height[order[np.searchsorted(share, part)]]) for part in (0.05, 0.95))
        square = height_profile(height, max(top, MIN_DEPTH)) ** 2
        profile = np.sqrt(np.add.reduceat(area * square, first) / np.where(has, total, 1.0))
        return cls(total, centre, profile, max(top - low, MIN_DEPTH))

    def air_share(self, mean: np.ndarray) -> np.ndarray:
        """Returns the ratio [tree] of the air speed at each tree to the undisturbed speed at the top of the canopy.

        ``mean`` [3] m/s is the mean wind.
        """
        return self.profile * np.sqrt(self._sheltered_pressure(np.asarray(mean, float)[:2]))

    def _sheltered_pressure(self, wind: np.ndarray) -> np.ndarray:
        """Returns the ratio q [tree] of the squared wind speed at each tree, behind the leaves upwind, to the
        undisturbed squared speed."""
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
        q = np.ones_like(density)  # at the upwind face of each cell
        for i in range(len(q) - 1):
            q[i + 1] = balance[i] + (q[i] - balance[i]) * left[i]
        return q[column, row]
