"""``vinesim bench lidar``: rays of one revolution compared with Open3D's ray caster (Embree), with plants at rest and
moving.

Scene and method are those of :mod:`vinesim.bench.camera`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np

from vinesim.bench.camera import demo_scene, embree_scene, median_cpu_times, triangle_mesh
from vinesim.scene.values import Measurement
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.lidar.lidar_rasterizer import LidarRasterizer
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import rest_snapshot

_STAND = np.array([3.7, 1.25, 1.0, 0.0, 0.0, 0.0, 1.0])
"""Pose [7] of the level lidar between two rows."""


def _grid(spec: LidarSpec) -> LidarRasterizer:
    """Returns a rasteriser for the rays of one revolution."""
    turn = -2.0 * np.pi * spec.rate.value
    lasers = np.arange(len(spec.elevation.value))
    columns = round(1.0 / (spec.rate.value * spec.firing_period.value))
    return LidarRasterizer(
        np.radians(spec.elevation.value),
        turn * spec.laser_period.value * lasers,
        turn * spec.firing_period.value,
        columns,
    )


def lidar() -> Iterator[Measurement]:
    """Measure processor times of all rays of a revolution, of a whole scan, and of rays while twenty trees move."""
    model, primitives = demo_scene()
    spec = LidarSpec.load("vlp16")
    head = _grid(spec)
    caster = RayCaster(primitives)
    thin = Lidar(spec.ideal())
    wide = Lidar(spec)
    rays = head.direction.numpy()
    reach = spec.farthest.value
    trees = np.unique(model.body_tree[model.bunch_body])[:20]
    awake = dataclasses.replace(rest_snapshot(model), moved_trees=trees)

    def follow() -> None:
        primitives.update(awake)
        head.cast(primitives, _STAND, reach=reach)

    count = len(rays)
    cases: dict[str, Callable[[], object]] = {
        f"VLP-16, {count} rays, rasterised": lambda: head.cast(primitives, _STAND, reach=reach),
        f"VLP-16, {count} rays, one by one": lambda: caster.cast(_STAND[:3], rays, reach),
        f"VLP-16, {count} shots, scan of thin beams": lambda: thin.scan(primitives, _STAND),
        f"VLP-16, {count} shots, scan of true beams": lambda: wide.scan(primitives, _STAND),
        f"20 trees moved, {count} rays, rasterised": follow,
    }
    if find_spec("open3d") is None:
        for case, spent in zip(cases, median_cpu_times(*cases.values()), strict=True):
            yield Measurement("lidar", case, spent, "CPU ms")
        return
    import open3d as o3d

    vertices, faces = triangle_mesh(primitives)
    scene = embree_scene(vertices, faces)
    tensor = o3d.core.Tensor(np.concatenate([np.broadcast_to(_STAND[:3].astype(np.float32), rays.shape), rays], 1))  # pyright: ignore[reportArgumentType, reportCallIssue] it does take arrays
    *ours, theirs = median_cpu_times(*cases.values(), lambda: scene.cast_rays(tensor))
    start = time.process_time()
    embree_scene(vertices, faces).cast_rays(tensor)
    rebuilt = (time.process_time() - start) * 1e3
    peer = f"Open3D {o3d.__version__}, {len(faces)} triangles"
    for case, spent in zip(cases, ours, strict=True):
        name, value = (peer + ", rebuilt", rebuilt) if "moved" in case else (peer, theirs)
        yield Measurement("lidar", case, spent, "CPU ms", name, value, value / spent)
