"""Which renderer draws, and what is said where one cannot be had."""

import importlib.util

import pytest

from vinesim.sensors.raster import renderer_selection
from vinesim.sensors.raster.cuda_rasterizer import CudaRasterizer


def test_warp_draws_on_a_cpu_by_itself_and_in_pieces_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    assert renderer_selection.create_rasterizer("warp", "cpu") is None
    monkeypatch.setattr(CudaRasterizer, "__init__", lambda self, device: setattr(self, "device", device))
    raster = renderer_selection.create_rasterizer("warp", "cuda:1")
    assert isinstance(raster, CudaRasterizer)
    assert raster.device == "cuda:1"


def test_an_unknown_renderer_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(renderer_selection.RendererUnavailable, match="'vulkan': give one of warp, taichi, taichi-gpu"):
        renderer_selection.check_renderer("vulkan")


def test_without_taichi_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for name in ("taichi", "taichi-gpu"):
        with pytest.raises(renderer_selection.RendererUnavailable, match=r"pip install 'vinesim\[taichi\]'"):
            renderer_selection.check_renderer(name)
    assert renderer_selection.check_renderer("warp") == "warp"


def test_taichi_on_warps_device_is_a_contradiction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    with pytest.raises(renderer_selection.RendererUnavailable, match="leave one of the two out"):
        renderer_selection.create_rasterizer("taichi", "cuda")
