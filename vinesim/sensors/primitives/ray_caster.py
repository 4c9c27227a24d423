"""Ray caster: bounding volume hierarchies over plants and over rigid bodies, which are refitted after motion."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.raster import ray_cast
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import MAX_DEPTH
from vinesim.sensors.raster.primitive_arrays import BOX, CONE, CYLINDER, ELLIPSOID, SPHEROID


def enclosing_primitive(primitives: Primitives, point: np.ndarray) -> int:
    """Returns the index of a solid primitive that contains ``point`` [3] m, or -1; leaves and meshes are not solid."""
    point = np.asarray(point, float)
    reach = primitives.ball.numpy()
    near = np.flatnonzero(np.linalg.norm(reach[:, :3] - point, axis=1) <= reach[:, 3])
    if not len(near):
        return -1
    first = primitives.cluster_first[near]
    size = primitives.cluster_size[near]
    which = np.concatenate([np.arange(f, f + n) for f, n in zip(first, size, strict=True)])
    kind = np.repeat(primitives.cluster_kind[near], size)
    a, b, c = (getattr(primitives.shapes, name).numpy()[which].astype(float) for name in "abc")
    held = np.zeros(len(which), bool)
    for number in np.unique(kind):
        mine = kind == number
        held[mine] = _contains(int(number), a[mine], b[mine], c[mine], point)
    return int(which[held][0]) if held.any() else -1


def _contains(kind: int, a: np.ndarray, b: np.ndarray, c: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Returns [k] whether each of k primitives of one ``kind`` contains ``point`` [3] m.

    ``a``, ``b``, ``c``: [k, 4] vectors of the primitives as in :mod:`vinesim.kernels.raster.primitives`.
    """
    away = point - a[:, :3]
    if kind == SPHEROID:
        along = (away * b[:, :3]).sum(1)
        return (away**2).sum(1) - along**2 + (along / b[:, 3]) ** 2 < a[:, 3] ** 2
    if kind in (CONE, CYLINDER):
        axis = b[:, :3] - a[:, :3]
        share = (away * axis).sum(1) / (axis**2).sum(1)
        inner = np.clip(share, 0.0, 1.0)
        radius = a[:, 3] + (inner * (b[:, 3] - a[:, 3]) if kind == CONE else 0.0)
        near = np.linalg.norm(away - inner[:, None] * axis, axis=1) < radius
        return near if kind == CONE else near & (share > 0.0) & (share < 1.0)
    if kind in (BOX, ELLIPSOID):
        part = frames.rotate(frames.conjugate(b), away) / np.stack([a[:, 3], c[:, 0], c[:, 1]], 1)
        return (np.abs(part).max(1) if kind == BOX else np.linalg.norm(part, axis=1)) < 1.0
    return np.zeros(len(a), bool)


class RayCaster:
    """Finds the exact nearest hit of any ray with the primitives of a scene."""

    def __init__(self, primitives: Primitives) -> None:
        self.primitives = primitives
        self._layout_version = self._pose_version = -1
        self._struct = ray_cast.Hierarchies()
        self._struct.ground = primitives.ground
        self._refit()

    def hierarchies(self) -> ray_cast.Hierarchies:
        """Returns the bounding volume hierarchies for kernels, refitted to the present poses of the primitives."""
        if self._pose_version != self.primitives.pose_version or self._layout_version != self.primitives.layout_version:
            self._refit()
        return self._struct

    def _refit(self) -> None:
        p = self.primitives
        if self._layout_version != p.layout_version:
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
        self._layout_version = p.layout_version
        self._pose_version = p.pose_version

    def cast(
        self, origin: np.ndarray, direction: np.ndarray, reach: float = MAX_DEPTH
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the nearest hits of rays: distance [ray] in lengths of ``direction`` (inf: no hit), and index of the
        primitive [ray] (-2: the ground, -1: no hit).

        ``origin``: [ray, 3] m; ``direction``: [ray, 3] vectors of any length; ``reach``: largest distance of a hit.
        """
        p = self.primitives
        direction = np.ascontiguousarray(direction, np.float32).reshape(-1, 3)
        origin = np.ascontiguousarray(np.broadcast_to(np.asarray(origin, np.float32), direction.shape))
        start, ray = (wp.array(v, dtype=wp.vec3, device=p.device) for v in (origin, direction))
        distance = wp.empty(len(direction), dtype=float, device=p.device)
        primitive = wp.empty(len(direction), dtype=wp.int32, device=p.device)
        wp.launch(
            ray_cast.cast_rays,
            len(direction),
            inputs=[p.shapes, self.hierarchies(), start, ray, float(reach)],
            outputs=[distance, primitive],
            device=p.device,
        )
        found = primitive.numpy()
        return np.where(found == -1, np.inf, distance.numpy()), found

    def cast_camera(self, lens: Pinhole) -> tuple[np.ndarray, np.ndarray]:
        """Returns depth [height, width] m (inf: no hit) and index of the primitive [height, width] (-2: the ground, -1:
        no hit) in the picture of a camera."""
        p = self.primitives
        count = lens.width * lens.height
        depth = wp.empty(count, dtype=float, device=p.device)
        primitive = wp.empty(count, dtype=wp.int32, device=p.device)
        wp.launch(
            ray_cast.cast_camera,
            count,
            inputs=[p.shapes, self.hierarchies(), lens],
            outputs=[depth, primitive],
            device=p.device,
        )
        shape = (lens.height, lens.width)
        found = primitive.numpy()
        return np.where(found == -1, np.inf, depth.numpy()).reshape(shape), found.reshape(shape)
