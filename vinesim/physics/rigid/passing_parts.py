"""Body parts of a remote person that jumped or pushed too hard: they touch nothing until they are clear of robots.

The kinematic parts give way to nothing, so one that a message puts into a robot, or moves faster than a person can,
would throw the robot aside. Such a part passes through rigid bodies instead, and is solid again where it overlaps no
robot.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.physics.rigid.static_world import ROBOTS


class PassingParts:
    """Which parts [k] of one person touch nothing now."""

    def __init__(self, count: int) -> None:
        self.is_passing = np.zeros(count, bool)
        self._geoms = self._obstacles = np.zeros(0, int)
        self._bits = np.zeros((count, 2), int)

    def find_indices(self, m: mujoco.MjModel, bodies: np.ndarray) -> None:
        """Find the geoms of the parts' ``bodies`` [k] and those of robots in a world that was compiled anew."""
        self._geoms = m.body_geomadr[bodies]
        self._bits = np.stack([m.geom_contype[self._geoms], m.geom_conaffinity[self._geoms]], 1)
        self._obstacles = np.flatnonzero(m.geom_contype & ROBOTS)
        self._apply(m)

    def update(self, m: mujoco.MjModel, d: mujoco.MjData, places: np.ndarray, released: np.ndarray) -> None:
        """Parts that are ``released`` [k] bool touch nothing from now on; others do again if they are clear of robots.

        ``places`` [k, 3] m: origins of the parts at the end of this step.
        """
        if not (self.is_passing.any() or released.any()):
            return
        passing = released | (self.is_passing & self._overlaps(m, d, places))
        if (passing != self.is_passing).any():
            self.is_passing = passing
            self._apply(m)

    def _overlaps(self, m: mujoco.MjModel, d: mujoco.MjData, places: np.ndarray) -> np.ndarray:
        """[k] Whether the bounding sphere of a part, wherever it turns, meets the bounding box of a robot's geom."""
        reach = m.geom_rbound[self._geoms] + np.linalg.norm(m.geom_pos[self._geoms], axis=1)
        others = self._obstacles
        axes = d.geom_xmat[others].reshape(-1, 3, 3)
        offset = np.einsum("gij,kgi->kgj", axes, places[:, None] - d.geom_xpos[others])
        outside = np.maximum(abs(offset - m.geom_aabb[others, :3]) - m.geom_aabb[others, 3:], 0.0)
        return (np.sqrt((outside * outside).sum(2)) < reach[:, None]).any(1)

    def _apply(self, m: mujoco.MjModel) -> None:
        bits = np.where(self.is_passing[:, None], 0, self._bits)
        bodies = m.geom_bodyid[self._geoms]
        m.geom_contype[self._geoms] = m.body_contype[bodies] = bits[:, 0]
        m.geom_conaffinity[self._geoms] = m.body_conaffinity[bodies] = bits[:, 1]
