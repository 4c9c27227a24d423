"""The rasteriser on a CUDA GPU: launches of its two kernels, and memory of the lists of tiles."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.raster import cuda_raster
from vinesim.kernels.raster.pinhole import EMPTY_KEY, Pinhole
from vinesim.sensors.raster.primitive_arrays import PosedPrimitives

_LISTS = int(cuda_raster.TILE_LISTS)


class CudaRasterizer:
    """Rasteriser on a CUDA GPU. It lists tiles (small rectangles of the picture that cover each primitive), then draws
    the tiles. The result is a key for each pixel: depth and primitive as one integer.

    The host does not wait for the GPU.

    Args:
        groups: number of tiles of each list that are drawn at the same time.
        lanes: number of threads that draw one tile together.
        listers: number of threads that list the tiles of one cluster.
        block: number of threads in a CUDA block that draws tiles.
        room: capacity of each list in tiles. Tiles beyond it are drawn when they are listed, which is slow.
    """

    def __init__(
        self,
        device: str,
        *,
        groups: int = 1024,
        lanes: int = 32,
        listers: int = 8,
        block: int = 64,
        room: int = 16384,
    ) -> None:
        self.device = device
        self._groups = groups
        self._lanes = lanes
        self._listers = listers
        self._block = block
        self._count = wp.zeros(_LISTS, dtype=wp.int32, device=device)
        self._pieces = wp.empty((_LISTS, room), dtype=wp.vec4i, device=device)
        self._all = wp.empty(0, dtype=wp.int32, device=device)

    def rasterize(
        self, primitives: PosedPrimitives, lens: Pinhole, clusters: np.ndarray | None, keys: wp.array
    ) -> None:
        """Write depth and index of the nearest primitive of every pixel to ``keys`` [pixel].

        ``clusters`` [k]: clusters (runs of primitives) to draw; None: all.
        """
        if len(self._all) != len(primitives.cluster_first):
            self._all = wp.array(np.arange(len(primitives.cluster_first), dtype=np.int32), device=self.device)
        which = self._all if clusters is None else wp.array(np.asarray(clusters, np.int32), device=self.device)
        keys.fill_(int(EMPTY_KEY))
        self._count.zero_()
        wp.launch(
            cuda_raster.list_tiles,
            (len(which), self._listers),
            inputs=[primitives.shapes, primitives.clusters, primitives.ball, which, lens, self._listers],
            outputs=[self._count, self._pieces, keys],
            device=self.device,
        )
        wp.launch(
            cuda_raster.draw_tiles,
            _LISTS * self._groups * self._lanes,
            inputs=[primitives.shapes, self._count, self._pieces, lens, self._groups, self._lanes],
            outputs=[keys],
            device=self.device,
            block_dim=self._block,
        )
