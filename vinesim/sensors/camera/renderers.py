"""Who finds out what each pixel sees: Warp's rasteriser, its form for GPUs, or the Taichi twin; all find the same."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from vinesim.kernels.raster.camera_raster import Pinhole
    from vinesim.sensors.scene.primitives import Primitives

RENDERERS = ("warp", "taichi", "taichi-gpu")
"""By name, the default first (docs/decisions/renderers.md)."""


class RendererUnavailable(ValueError):
    """The text says which renderer cannot be had, and what to do."""

    exit_code = 3


class PrimitiveRasterizer(Protocol):
    """Something that draws keys: depth [um] above, number of the primitive below (see kernels/raster/camera_raster.py)."""

    def rasterize(self, primitives: Primitives, lens: Pinhole, clusters: np.ndarray | None, keys: wp.array) -> None:
        """The nearest primitive of every pixel, of all clusters or of some [k]."""
        ...


def check_renderer(renderer: str) -> str:
    """Its name, if it is known and installed; :class:`RendererUnavailable` in words if not."""
    if renderer not in RENDERERS:
        raise RendererUnavailable(f"renderer {renderer!r}: give one of {', '.join(RENDERERS)}")
    if renderer != "warp" and importlib.util.find_spec("taichi") is None:
        raise RendererUnavailable(
            f"renderer {renderer!r}: Taichi is not installed; type: pip install 'vinesim[taichi]'"
        )
    return renderer


def create_rasterizer(renderer: str, device: str) -> PrimitiveRasterizer | None:
    """The rasteriser of that name for primitives on ``device``; None for Warp's own on a CPU."""
    if check_renderer(renderer) != "warp":
        if device != "cpu":
            raise RendererUnavailable(
                f"renderer {renderer!r} with device {device!r}: that is Warp's; leave one of the two out"
            )
        from vinesim.sensors.camera.taichi_rasterizer import TaichiRasterizer

        try:
            return TaichiRasterizer(gpu=renderer == "taichi-gpu")
        except RuntimeError:
            raise RendererUnavailable(
                f"renderer {renderer!r}: Taichi finds no Vulkan or Metal GPU; use taichi or warp"
            ) from None
    if device == "cpu":
        return None
    from vinesim.sensors.camera.cuda_rasterizer import CudaRasterizer

    return CudaRasterizer(device)
