"""Kernels that read uneven ground, or have native code for GPUs, compile for CUDA. Warp compiles to PTX, which needs no
GPU."""

from __future__ import annotations

import ast
import importlib
import pathlib
import re

import pytest
import warp as wp

from vinesim.kernels import compilation

LAWS = ("raster.ground", "contact.ground_distance")
"""Modules with the functions that read the heights."""
ARCHITECTURE = 75
"""The oldest that Warp supports: Turing."""


def uses(name: str) -> set[str]:
    """The modules of whose functions a module of kernels makes use, directly or not."""
    sources = compilation._sources()
    found = set()
    to_do = [name]
    while to_do:
        for node in ast.walk(ast.parse(sources[to_do.pop()])):
            if isinstance(node, ast.ImportFrom) and any(one.name.islower() for one in node.names):
                imported = (node.module or "").removeprefix("vinesim.kernels.")
                if imported in sources and imported not in found:
                    found.add(imported)
                    to_do.append(imported)
    return found


MODULES = sorted(
    name for name in compilation.module_names(without=compilation._CPU_ONLY) if not uses(name).isdisjoint(LAWS)
)


def test_the_modules_that_read_heights_are_known() -> None:
    assert {"raster.ray_cast", "raster.camera_raster", "lidar.lidar_raster", "shading.deferred"} <= set(MODULES)
    assert "worlds.narrowphase" in MODULES
    assert "plants.integration" not in MODULES


@pytest.mark.long
@pytest.mark.parametrize("name", [*MODULES, "worlds.contact_step"])
def test_a_module_compiles_for_cuda(name: str, tmp_path: pathlib.Path) -> None:
    module = importlib.import_module(f"vinesim.kernels.{name}")
    (file,) = wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=True)
    entries = re.findall(r"\.visible \.entry (\w+)\(", file.read_text())
    kernels = [kernel.key for kernel in wp.get_module(module.__name__).kernels.values()]
    assert len(entries) >= len(kernels) > 0
    assert all(any(kernel in entry for entry in entries) for kernel in kernels)
