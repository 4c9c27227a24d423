"""Free bunches of the rigid world, by number; part of :class:`vinesim.rigid.rigid_world.RigidWorld`."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid import free_bunch
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.mujoco_sleep import wake_body
from vinesim.rigid.mujoco_world import WorldCore
from vinesim.rigid.static_world import FIRST_FIXED_GEOM, FIXED


class BunchAccess(WorldCore):
    """Picked bunches as free bodies."""

    @property
    def bunch_room(self) -> int:
        """Number of free bunches that still get bodies without the world being compiled anew."""
        return self._pool_size - 1 - max(self._bunch_slot.values(), default=-1)

    def add_bunch(self, bunch: int, body: FreeBunch, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Add a bunch at ``pose`` [7] with ``velocity`` [6] (of its origin, angular; world axes)."""
        self.add_bunches({bunch: (body, pose, velocity)})

    def add_bunches(self, bunches: dict[int, tuple[FreeBunch, np.ndarray, np.ndarray]]) -> None:
        """Add several bunches, each with its pose [7] and velocity [6]; ``ValueError`` if one exists already."""
        if known := sorted(bunches.keys() & self._free_bunches.keys()):
            raise ValueError(f"bunch {known[0]} is free already")
        derived = {bunch: self._derive(body) for bunch, (body, _, _) in bunches.items()}
        unused = iter(sorted(set(range(self._pool_size + len(bunches))) - set(self._bunch_slot.values())))
        for bunch, (body, _, _) in bunches.items():
            self._free_bunches[bunch] = body
            self._bunch_slot[bunch] = next(unused)
        if max(self._bunch_slot[bunch] for bunch in bunches) >= self._pool_size:
            self._recompile()
        else:
            for bunch, (body, _, _) in bunches.items():
                free_bunch.activate(self.mj_model, self._bunch_slot[bunch], body, derived[bunch])
            self._update_tables()
        for bunch, (_, pose, velocity) in bunches.items():
            self.place_bunch(bunch, pose, velocity)

    def place_bunch(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put a free bunch at ``pose`` [7] with ``velocity`` [6] in world axes, and wake it."""
        joint = self._bunch_joint(bunch)
        pose = np.asarray(pose, float)
        rotation = frames.normalize(pose[3:])
        joint.qpos[:] = np.concatenate([pose[:3], frames.to_wxyz(rotation)])
        joint.qvel[:3] = velocity[:3]
        joint.qvel[3:] = frames.rotate(frames.conjugate(rotation), np.asarray(velocity[3:], float))
        wake_body(self.mj_model, self.mj_data, self._body_of_object(f"bunch/{bunch}", "bunch"))
        self._kinematics_current = False

    def remove_bunch(self, bunch: int) -> None:
        """Remove a free bunch; the world is compiled anew."""
        del self._free_bunches[bunch], self._bunch_slot[bunch]
        self._passing_bunches.discard(bunch)
        self._recompile()

    def let_pass(self, bunch: int) -> None:
        """Let a bunch that has just been picked pass through the fixed pieces (wood, wires, poles) if it overlaps one,
        until it is clear of them: as it hung there, that overlap was no contact."""
        self.update_kinematics()
        self._passing_bunches.add(bunch)
        self._end_passing()

    def _end_passing(self) -> None:
        """Let passing bunches that are clear of all fixed pieces touch these again; MuJoCo's poses must be current."""
        clear = {bunch for bunch in self._passing_bunches if not self._overlaps_fixed_piece(bunch)}
        self._passing_bunches -= clear
        self._set_passing(clear, False)

    def _set_passing(self, bunches: set[int], passing: bool) -> None:
        """Let free bunches touch fixed pieces or not."""
        m = self.mj_model
        bits = free_bunch.CONAFFINITY & ~FIXED if passing else free_bunch.CONAFFINITY
        for bunch in bunches:
            m.body_conaffinity[self._body_of_object(f"bunch/{bunch}", "bunch")] = bits
            m.geom_conaffinity[self._geoms_of_bunch(bunch)] = bits

    def _overlaps_fixed_piece(self, bunch: int) -> bool:
        m = self.mj_model
        d = self.mj_data
        geoms = self._geoms_of_bunch(bunch)
        low = (d.geom_xpos[geoms] - m.geom_rbound[geoms, None]).min(0)
        high = (d.geom_xpos[geoms] + m.geom_rbound[geoms, None]).max(0)
        start = self.model.fixed_start
        end = self.model.fixed_end
        radius = self.model.fixed_radius.mean(1)[:, None]
        near = (np.minimum(start, end) - radius < high) & (low < np.maximum(start, end) + radius)
        pieces = np.flatnonzero(near.all(1)) + FIRST_FIXED_GEOM
        pairs = itertools.product(geoms, pieces.tolist())
        return any(mujoco.mj_geomDistance(m, d, geom, piece, 0.0, None) < 0.0 for geom, piece in pairs)

    def _geoms_of_bunch(self, bunch: int) -> range:
        """MuJoCo's numbers of the shapes of a free bunch."""
        first = int(self.mj_model.body_geomadr[self._body_of_object(f"bunch/{bunch}", "bunch")])
        return range(first, first + len(self._free_bunches[bunch].radius))

    def bunch_pose(self, bunch: int) -> np.ndarray:
        """World pose [7] of a free bunch."""
        qpos = self._bunch_joint(bunch).qpos
        return np.concatenate([qpos[:3], frames.from_wxyz(qpos[3:])])

    def _bunch_joint(self, bunch: int) -> Any:  # MuJoCo's view of a joint has no public type
        return self.mj_data.joint(free_bunch.slot_name(self._bunch_slot[bunch]))
