"""Compilation of all kernels before they are needed: by one process at a time, on all cores, with progress.

Warp compiles a module at its first launch and keeps the result on disk. Processes that start together would each
compile the same modules, in silence and one after the other. :func:`compile_kernels` compiles them once; others wait for it.
"""

import concurrent.futures
import contextlib
import hashlib
import importlib
import os
import pathlib
import pkgutil
import sys
import types

import warp as wp

import vinesim.kernels
from vinesim import disk_cache

SENSOR_PACKAGES = ("raster", "sensing", "shading")
"""Kernels of cameras and lidars; the others are those of physics."""
TIMEOUT = 600.0
"""How long another process may take to compile, before this one compiles as well [s]."""
_CUDA_ONLY = (
    "vinesim.kernels.articulation.lean_prediction",
    "vinesim.kernels.contact.tree_islands",
    "vinesim.kernels.raster.cuda_raster",
)
_CPU_ONLY = (
    "vinesim.kernels.articulation.eight_trees",
    "vinesim.kernels.contact.delassus",
    "vinesim.kernels.contact.forces",
    "vinesim.kernels.contact.islands",
    "vinesim.kernels.contact.jacobians",
    "vinesim.kernels.contact.narrowphase_plants",
    "vinesim.kernels.contact.narrowphase_rigid",
    "vinesim.kernels.contact.projected_gauss_seidel",
    "vinesim.kernels.contact.sleeping_trees",
    "vinesim.kernels.contact.sweep_order",
    "vinesim.kernels.contact.wire_contacts",
    "vinesim.kernels.contact.wire_shapes",
    "vinesim.kernels.joint_servos",
)
"""Modules whose kernels are never launched on a GPU; some have vectors of a CPU in native code."""


def compile_kernels(packages: tuple[str, ...] = (), device: str = "cpu") -> int:
    """Compile the kernels of some ``packages`` of :mod:`vinesim.kernels`, all unless given.

    For the CPU always, and for ``device`` (``"cpu"``, ``"cuda"``, ``"cuda:N"``; it must be there). Returns how many
    modules were compiled for the CPU: 0 where all are in Warp's cache, which takes a millisecond to find.
    """
    if device != "cpu":
        with disk_cache.exclusive("kernels-cuda", TIMEOUT, waiting_for="another process that compiles kernels"):
            _compile(_modules(packages, without=_CPU_ONLY), device)
    stamp = _stamp(packages)
    if _is_valid(stamp):
        return 0
    with disk_cache.exclusive("kernels", TIMEOUT, waiting_for="another process that compiles kernels"):
        if _is_valid(stamp):
            return 0
        if not os.access(wp.config.kernel_cache_dir, os.W_OK):
            vinesim.kernels.use_temporary_cache(f"{wp.config.kernel_cache_dir} is read-only")
        modules = _modules(packages)
        folders = [os.path.join(wp.config.kernel_cache_dir, m.get_module_identifier(1)) for m in modules]
        missing = [m for m, folder in zip(modules, folders, strict=True) if not os.path.isdir(folder)]
        _compile(missing, "cpu")
        with contextlib.suppress(OSError):  # then the next start looks again
            _stamp(packages).write_text("\n".join(folders))
    return len(missing)


def _compile(modules: list[wp.Module], device: str) -> None:
    """Compile modules, or load them if they are, on all cores; the compiler works without the interpreter lock."""

    def compile_one(number: int) -> None:
        name = modules[number].name.removeprefix("vinesim.kernels.")
        disk_cache.progress.info("compiling kernels for %s: %s (%d of %d)", device, name, number + 1, len(modules))
        wp.force_load(device, [modules[number]], max_workers=0)

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(compile_one, range(len(modules))):
            pass


def _modules(packages: tuple[str, ...], without: tuple[str, ...] = _CUDA_ONLY) -> list[wp.Module]:
    """All Warp modules of the packages that have kernels, long ones first."""
    found = []
    for info in pkgutil.walk_packages(vinesim.kernels.__path__, "vinesim.kernels."):
        part = info.name.split(".")[2]
        if info.ispkg or info.name in without or (packages and part not in packages):
            continue
        python: types.ModuleType = importlib.import_module(info.name)
        module = wp.get_module(python.__name__)
        if module.kernels:
            found.append(module)
    # those that take longest first, by and large, so that no core waits for the last one
    return sorted(found, key=lambda module: -os.path.getsize(sys.modules[module.name].__file__ or ""))


def _stamp(packages: tuple[str, ...]) -> pathlib.Path:
    """A file in Warp's cache that lists the compiled modules of this version of the kernels."""
    h = hashlib.blake2b(repr((packages, wp.config.version, wp.config.cpu_compiler_flags)).encode(), digest_size=8)
    for file in sorted(pathlib.Path(vinesim.kernels.__path__[0]).rglob("*.py")):
        h.update(file.name.encode() + file.read_bytes())
    return pathlib.Path(wp.config.kernel_cache_dir) / f"vinesim-{h.hexdigest()}"


def _is_valid(stamp: pathlib.Path) -> bool:
    """Whether all modules that a stamp lists are still there."""
    try:
        return all(map(os.path.isdir, stamp.read_text().split("\n")))
    except OSError:
        return False
