"""Who finds out what each pixel sees: Warp's rasteriser, its form for GPUs, or the Taichi twin; all find the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from vinesim.kernels.visibility import Pinhole
    from vinesim.sensors.primitives import Primitives

RENDERERS = ("warp", "taichi", "taichi-gpu")
"""By name, the default first (docs/decisions/renderers.md)."""


class NoRenderer(ValueError):
    """The text says which renderer cannot be had, and what to do."""

    exit_code = 3


class Raster(Protocol):
    """Something that draws keys: depth [um] above, number of the primitive below (see kernels/visibility.py)."""

    def fill(self, primitives: Primitives, lens: Pinhole, clusters: np.ndarray | None, keys: wp.array) -> None:
        """The nearest primitive of every pixel, of all clusters or of some [k]."""
        ...


def raster_of(renderer: str, device: str) -> Raster | None:
    """The rasteriser of that name for primitives on ``device``; None for Warp's own on a CPU."""
    if renderer not in RENDERERS:
        raise NoRenderer(f"renderer {renderer!r}: give one of {', '.join(RENDERERS)}")
    if renderer != "warp":
        return _twin(renderer, device)
    if device != "cpu":
        from vinesim.sensors.tiles import Tiles

        return Tiles(device)
    return None


def _twin(renderer: str, device: str) -> Raster:
    if device != "cpu":
        raise NoRenderer(
            f"renderer {renderer!r} with device {device!r}: that device is Warp's; leave one of the two out"
        )
    try:
        from vinesim.sensors.twin import Twin
    except ImportError as missing:
        raise NoRenderer(
            f"renderer {renderer!r}: {missing.name} is not installed; type: pip install 'vinesim[taichi]'"
        ) from None
    try:
        return Twin(gpu=renderer == "taichi-gpu")
    except RuntimeError:
        raise NoRenderer(
            f"renderer {renderer!r}: Taichi finds no Vulkan or Metal GPU here; use taichi or warp"
        ) from None
