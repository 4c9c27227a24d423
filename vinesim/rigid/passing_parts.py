"""Body parts of a remote person: how much they push, and when they touch nothing.

The kinematic parts give way to nothing, so one that a message moves against a robot would push it with any force. A
part that moves is therefore light, and heavy again when it stands still and touches nothing: a robot that drives into a
person who stands is stopped. One that jumps, or pushes too hard while it moves, passes through rigid bodies
until it overlaps no robot.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.rigid.static_world import ROBOTS

HEAVY_PART_MASS = 1e4
"""[kg] No force changes the motion of a body as heavy as this within a step."""
LIGHT_PART_MASS = 0.3
"""[kg] A contact can slow such a part down within a step, but not move it: so it pushes a robot with a force that its
speed and its depth bound, m (v 2/tau + depth/tau^2) with MuJoCo's time constant tau of contacts (20 ms), however heavy
the robot is. DERIVED: two legs that walk at 1.5 m/s push with 80 N, half of
:data:`vinesim.rigid.human_body.MAX_REMOTE_FORCE`."""
STILL_SPEED = 0.05
"""[m/s] A part that is slower stands still: more than the noise of tracked points. TUNED."""


class PassingParts:
    """Which parts [k] of one remote person are light, and which touch nothing now."""

    def __init__(self, count: int) -> None:
        self.is_passing = np.zeros(count, bool)
        self.is_light = np.ones(count, bool)
        self._bodies = self._geoms = self._obstacles = np.zeros(0, int)
        self._bits = np.zeros((count, 2), int)

    def find_indices(self, m: mujoco.MjModel, bodies: np.ndarray) -> None:
        """Find the geoms of the parts' ``bodies`` [k] and those of robots in a world that was compiled anew."""
        self._bodies = bodies
        self._geoms = m.body_geomadr[bodies]
        self._bits = np.stack([m.geom_contype[self._geoms], m.geom_conaffinity[self._geoms]], 1)
        self._obstacles = np.flatnonzero(m.geom_contype & ROBOTS)
        self._apply(m)

    def update(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        places: np.ndarray,
        speed: np.ndarray,
        force: np.ndarray,
        released: np.ndarray,
    ) -> None:
        """Parts that are ``released`` [k] bool touch nothing from now on; others do again if they are clear of robots.

        ``places`` [k, 3] m: origins of the parts at the end of this step; ``speed`` [k] m/s of the parts;
        ``force`` [k] N on them in the last step.
        """
        passing = released | self.is_passing
        if passing.any():
            passing = released | (passing & self._overlaps(m, d, places))
        light = passing | (speed > STILL_SPEED) | (self.is_light & (force > 0.0))
        if (passing != self.is_passing).any() or (light != self.is_light).any():
            self.is_passing = passing
            self.is_light = light
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
        m.geom_contype[self._geoms] = m.body_contype[self._bodies] = bits[:, 0]
        m.geom_conaffinity[self._geoms] = m.body_conaffinity[self._bodies] = bits[:, 1]
        mass = np.where(self.is_light, LIGHT_PART_MASS, HEAVY_PART_MASS)
        m.body_mass[self._bodies] = m.body_subtreemass[self._bodies] = mass
        m.dof_M0[m.body_dofadr[self._bodies][:, None] + np.arange(3)] = mass[:, None]  # MuJoCo takes it from here
        m.body_invweight0[self._bodies, 0] = 1.0 / mass  # softness of contacts
