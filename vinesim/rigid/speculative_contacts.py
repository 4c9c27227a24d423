"""Contacts of crates that are about to close within the step, so that thin walls do not end up inside each other.

A crate that falls by half a metre moves 31 mm a step, its walls are 12 mm thick: found only where they overlap, they
would be pushed apart sideways, or not at all. Crates that are fast and approach another get a margin of what they move
in a step. A contact within it lets its gap close, but no further (a *speculative contact*).
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from vinesim.rigid.static_world import CRATE_WALL

MAX_STEP = CRATE_WALL / 4.0
"""[m] A crate that moves less in a step has no margin. TUNED."""
MAX_MARGIN = 0.1
"""[m] Of a crate at 10 m/s."""

PASSING = 0.1
"""[1] A crate whose motion relative to another points so little towards it passes it. TUNED."""
STIFFNESS = 100.0
"""[1] times an effective mass over dt^2: of a gap that would close further, so much is left as 1 is to it."""
NEVER_REACHED = 1e4
"""[m] No gap closes by as much in a step."""


class SpeculativeContacts:
    """Margins of fast crates, and the accelerations that close the gaps within them."""

    def __init__(self) -> None:
        self._bodies = self._geoms = self._crate_of_geom = np.zeros(0, int)
        self._dof = np.zeros((0, 6), int)
        self._radius = np.zeros(0)
        self._has_margins = False

    def find_crates(self, m: mujoco.MjModel, numbers: Iterable[int]) -> None:
        """Find the bodies and geoms of the boxes of these ``numbers`` in a world that was compiled anew."""
        self._bodies = bodies = np.array(sorted(m.body(f"box/{number}").id for number in numbers), int)
        self._dof = m.body_dofadr[bodies][:, None] + np.arange(6)
        self._geoms = np.flatnonzero(np.isin(m.geom_bodyid, bodies))
        self._crate_of_geom = np.searchsorted(bodies, m.geom_bodyid[self._geoms])
        corner = np.linalg.norm(m.geom_pos[self._geoms], axis=1) + m.geom_rbound[self._geoms]
        self._radius = np.zeros(len(bodies))
        np.maximum.at(self._radius, self._crate_of_geom, corner)

    def set_margins(self, m: mujoco.MjModel, d: mujoco.MjData) -> bool:
        """Before ``mj_step1``: the margin of each crate; whether one has any."""
        if len(self._bodies) == 0:
            return False
        velocity = d.qvel[self._dof]
        if not self._has_margins and not velocity.any():
            return False
        linear = velocity[:, :3]
        angular = velocity[:, 3:]
        step = m.opt.timestep * (np.linalg.norm(linear, axis=1) + np.linalg.norm(angular, axis=1) * self._radius)
        margin = np.zeros(len(step))
        for crate in np.flatnonzero(step > MAX_STEP).tolist():
            if self._is_approaching(crate, linear, step, d.xpos[self._bodies]):
                margin[crate] = min(1.5 * step[crate], MAX_MARGIN)
        m.body_margin[self._bodies] = margin
        m.geom_margin[self._geoms] = margin[self._crate_of_geom]
        self._has_margins = bool(margin.any())
        return self._has_margins

    def _is_approaching(self, crate: int, velocity: np.ndarray, step: np.ndarray, position: np.ndarray) -> bool:
        """Whether a crate is near another in the next step, and not just passing it."""
        offset = position - position[crate]
        relative = velocity - velocity[crate]
        distance = np.linalg.norm(offset, axis=1)
        closing = -(offset * relative).sum(1)
        is_met = closing > PASSING * distance * np.linalg.norm(relative, axis=1)
        return bool((is_met & (distance < self._radius + self._radius[crate] + step + step[crate])).any())

    def limit_closing(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After the constraints are made: contacts that are open may close, and no further, within the step.

        Those that do not close at the speed of now are given up: MuJoCo's friction would push a body away from what it
        slides along. MuJoCo computes stiffness and damping anew from ``solref`` whenever it solves. Without damping
        there is no friction either.
        """
        contact = d.contact
        dt = m.opt.timestep
        is_open = np.flatnonzero((contact.dist > 0.0) & (contact.efc_address >= 0))
        row = contact.efc_address[is_open]
        gap = contact.dist[is_open]
        is_closing = d.efc_vel[row] * dt < -gap
        d.efc_margin[row] = np.where(is_closing, d.efc_pos[row] - gap, -NEVER_REACHED)
        contact.solref[is_open] = -STIFFNESS / dt**2, 0.0
