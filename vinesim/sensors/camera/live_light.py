"""Shading of live pictures on a CPU: points are sorted by class of surface, and each class has its own kernel."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import warp as wp

from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.shading import light_plants, light_points
from vinesim.kernels.shading.deferred import Light
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import BANDS_PER_THREAD, CameraRasterizer

_ROWS = 4
"""Number of rows of 2 x 2 pixel blocks whose points form one list: enough points to fill SIMD lanes, few enough for
caches."""


class LiveLight:
    """Shades the pixels that one camera's rasteriser has found, and holds the buffers for this."""

    def __init__(self, seen: CameraRasterizer) -> None:
        self._seen = seen
        self.list_count = -(-seen.height // (2 * _ROWS))
        points = self._points = light_points.Points()
        points.capacity = 4 * _ROWS * -(-seen.width // 2)
        places = self.list_count * light_points.CLASS_COUNT * points.capacity
        for name in ("u", "v", "z"):
            setattr(points, name, wp.empty(places, dtype=float, device="cpu"))
        for name in ("primitive", "pixels"):
            setattr(points, name, wp.empty(places, dtype=wp.int32, device="cpu"))
        points.count = wp.empty((self.list_count, light_points.CLASS_COUNT), dtype=wp.int32, device="cpu")
        self._tables = light_points.FloatTables()
        self._sources: list[wp.array] = []
        """Arrays that own the memory of the tables, kept so that the memory is not freed."""

    def shade(
        self,
        primitives: Primitives,
        light: Light,
        maps: light_points.ShadowMaps,
        lens: Pinhole,
        radiance: wp.array,
    ) -> None:
        """Write the radiance of all pixels to ``radiance`` [pixel], linear RGB."""
        self._update_tables(primitives, light)
        workers = self._seen.workers
        parts = min(BANDS_PER_THREAD * workers.size if workers.size > 1 else 1, self.list_count)
        ends = [self.list_count * i // parts for i in range(parts + 1)]
        task = functools.partial(self._shade_lists, primitives, light, maps, lens, radiance)
        workers.share([functools.partial(task, *pair) for pair in itertools.pairwise(ends)])

    def _shade_lists(
        self,
        primitives: Primitives,
        light: Light,
        maps: light_points.ShadowMaps,
        lens: Pinhole,
        radiance: wp.array,
        first: int,
        end: int,
    ) -> None:
        """Sort and shade the points of lists ``first`` to ``end`` - 1."""
        points = self._points
        tables = self._tables
        materials = primitives.materials
        arrays = [points.u, points.v, points.z, points.primitive, points.pixels, points.count]

        def launch(kernel: wp.Kernel, inputs: list[Any], outputs: list[wp.array]) -> None:
            wp.launch(kernel, end - first, inputs=inputs, outputs=outputs, device="cpu")

        seen = [self._seen.primitive, self._seen.keys, _ROWS, first, points]
        launch(light_points.sort_points, [primitives.shapes, materials, lens, *seen], arrays)
        where = [light, maps, lens, points, first]
        is_level = primitives.model.terrain is None
        ground = light_plants.light_ground if is_level else light_plants.light_uneven_ground
        for kernel in (light_points.light_sky, ground, light_plants.light_blades, light_plants.light_berries):
            launch(kernel, [tables, materials, *where], [radiance])
        solid = [light, maps.near, maps.far, lens, points, first]
        launch(light_points.light_others, [primitives.shapes, materials, *solid], [radiance])

    def _update_tables(self, primitives: Primitives, light: Light) -> None:
        """Make views of the primitives' arrays again if the arrays were replaced, because rigid bodies were added or
        removed."""
        shapes = primitives.shapes
        materials = primitives.materials
        sources = [shapes.a, shapes.b, shapes.c, shapes.d, materials.tint]
        sources += [materials.leaf_texture, materials.noise_texture, materials.soil_texture, light.sky_table]
        if len(sources) == len(self._sources) and all(a is b for a, b in zip(sources, self._sources, strict=True)):
            return
        names = ("a", "b", "c", "d", "tint", "leaf_texture", "noise", "soil", "sky_table")
        for name, source in zip(names, sources, strict=True):
            setattr(self._tables, name, _numbers(source))
        self._tables.outline = shapes.outline.flatten()
        self._tables.ground_sky = materials.ground_sky.flatten()
        self._sources = sources


def shadow_maps(near: ShadowMap, far: ShadowMap, depth: wp.array) -> light_points.ShadowMaps:
    """Returns the kernel struct of both shadow maps; ``depth``: depths of the near map, followed by those of the far
    map."""
    maps = light_points.ShadowMaps()
    maps.near = near
    maps.far = far
    maps.depth = depth
    return maps


def _numbers(vectors: wp.array) -> wp.array:
    """Returns a view of an array of vectors as scalars [vector, component]."""
    shape = int(np.prod(vectors.shape)), vectors.numpy().shape[-1]
    return wp.array(ptr=vectors.ptr, dtype=float, shape=shape, device="cpu", copy=False)
