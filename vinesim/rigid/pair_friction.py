"""Friction between two rigid bodies by their materials: MuJoCo itself takes one of the two geoms' coefficients."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.scene.materials import Material, pair_table
from vinesim.scene.physics_parameters import PhysicsParameters


class PairFriction:
    """Gives the contacts that MuJoCo found the coefficients of ``data/materials``, between its two stages."""

    def __init__(self, parameters: PhysicsParameters) -> None:
        self._table = pair_table("friction", parameters.friction)
        self._is_listed = self._table != parameters.friction
        self._material = np.zeros(0, np.int32)
        """[geom] material; unknown where the geom has a coefficient of its own, which MuJoCo then takes."""

    def find_materials(self, m: mujoco.MjModel) -> None:
        """Find the materials of all geoms of a world that was compiled anew."""
        material = m.geom_user[:, 0]
        has_own = m.geom_user[:, 1] > 0.0
        self._material = np.where(has_own, int(Material.UNKNOWN), material).astype(np.int32)

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After ``mj_step1``: write the coefficients of listed pairs and, if there are any, the constraints anew."""
        if d.ncon == 0:
            return
        first, second = self._material[d.contact.geom].T
        listed = np.flatnonzero(self._is_listed[first, second])
        if len(listed) == 0:
            return
        d.contact.friction[listed, :2] = self._table[first[listed], second[listed], None]
        mujoco.mj_makeConstraint(m, d)
        mujoco.mj_island(m, d)
        mujoco.mj_projectConstraint(m, d)
        mujoco.mj_fwdVelocity(m, d)
