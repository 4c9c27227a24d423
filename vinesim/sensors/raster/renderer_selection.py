"""Renderers by name: Warp on a CPU, Warp on CUDA, Taichi. All of them find the same primitive in every pixel."""

from __future__ import annotations

import importlib.util

from vinesim.sensors.raster.primitive_arrays import PrimitiveRasterizer

RENDERERS = ("warp", "taichi", "taichi-gpu")
"""Names of the renderers, the default first (docs/decisions/renderers.md)."""


class RendererUnavailable(ValueError):
    """Error: a renderer is unknown or cannot run on this machine. The message contains the remedy."""

    exit_code = 3


def check_renderer(renderer: str, device: str = "cpu") -> str:
    """Returns ``renderer`` if it is known, installed and can draw on ``device``; raises :class:`RendererUnavailable`
    otherwise."""
    if renderer not in RENDERERS:
        raise RendererUnavailable(f"renderer {renderer!r}: give one of {', '.join(RENDERERS)}")
    if renderer != "warp" and importlib.util.find_spec("taichi") is None:
        raise RendererUnavailable(
            f"renderer {renderer!r}: Taichi is not installed; type: pip install 'vinesim[taichi]'"
        )
    if renderer != "warp" and device != "cpu":
        raise RendererUnavailable(
            f"renderer {renderer!r} with device {device!r}: that is Warp's; leave one of the two out"
        )
    return renderer


def create_rasterizer(renderer: str, device: str) -> PrimitiveRasterizer | None:
    """Returns the rasteriser of the renderer with this name, for primitives on ``device``; None for Warp on a CPU,
    whose kernels ``CameraRasterizer`` launches."""
    if check_renderer(renderer, device) != "warp":
        from vinesim.sensors.raster.taichi_rasterizer import TaichiRasterizer

        try:
            return TaichiRasterizer(gpu=renderer == "taichi-gpu")
        except RuntimeError:
            raise RendererUnavailable(
                f"renderer {renderer!r}: Taichi finds no Vulkan or Metal GPU; use taichi or warp"
            ) from None
    if device == "cpu":
        return None
    from vinesim.sensors.raster.cuda_rasterizer import CudaRasterizer

    return CudaRasterizer(device)
