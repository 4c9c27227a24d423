"""Rays through the vineyard: one bounding volume hierarchy over plants, one over links, refitted when things move."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels import rays
from vinesim.sensors.camera import REACH
from vinesim.sensors.primitives import Primitives


class RayCaster:
    """Exact nearest hits of any rays."""

    def __init__(self, primitives: Primitives) -> None:
        self.primitives = primitives
        self._built = self._version = -1
        self._struct = rays.Hierarchies()
        self._refit()

    def hierarchies(self) -> rays.Hierarchies:
        """The hierarchies around the present poses."""
        if self._version != self.primitives.version or self._built != self.primitives.built:
            self._refit()
        return self._struct

    def _refit(self) -> None:
        p = self.primitives
        if self._built != p.built:
            split = p.plant_count
            constructor = "sah" if p.device == "cpu" else None
            lower, upper = (p.lower, p.upper) if split == p.count else (p.lower[:split], p.upper[:split])
            self._plants = wp.Bvh(lower, upper, constructor=constructor)
            self._rigid = wp.Bvh(p.lower[split:], p.upper[split:], constructor=constructor) if split < p.count else None
            self._struct.plants = self._plants.id
            self._struct.rigid = self._rigid.id if self._rigid else self._plants.id
            self._struct.first_rigid = split if self._rigid else -1
        else:
            self._plants.refit()
            if self._rigid:
                self._rigid.refit()
        self._built, self._version = p.built, p.version

    def cast(self, origin: np.ndarray, direction: np.ndarray, reach: float = REACH) -> tuple[np.ndarray, np.ndarray]:
        """Distances [ray], in lengths of ``direction`` (inf: nothing is met), and primitives (-2 ground, -1 none)."""
        p = self.primitives
        direction = np.ascontiguousarray(direction, np.float32).reshape(-1, 3)
        origin = np.ascontiguousarray(np.broadcast_to(np.asarray(origin, np.float32), direction.shape))
        start, ray = (wp.array(v, dtype=wp.vec3, device=p.device) for v in (origin, direction))
        distance = wp.empty(len(direction), dtype=float, device=p.device)
        primitive = wp.empty(len(direction), dtype=wp.int32, device=p.device)
        wp.launch(
            rays.cast,
            len(direction),
            inputs=[p.shapes, self.hierarchies(), start, ray, float(reach)],
            outputs=[distance, primitive],
            device=p.device,
        )
        found = primitive.numpy()
        return np.where(found == -1, np.inf, distance.numpy()), found
