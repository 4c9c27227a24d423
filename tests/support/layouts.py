"""Where batches of worlds run in tests: the fixture ``layout`` of the files that test batches.

``cpu`` is what a user without a GPU has. ``order of a GPU`` is a CPU whose kernels work on copies of the host's arrays,
with the bodies in the order of a GPU, so that most faults that a GPU would show are found without one. ``cuda`` needs
an NVIDIA GPU; ``pytest -m gpu`` runs these tests alone.
"""

import inspect
import pathlib
from typing import Any

import pytest
import warp as wp

from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import WARP_SIZE, DeviceBuffers

LAYOUTS: list[Any] = ["cpu", "order of a GPU"]
if any(pathlib.Path("/dev").glob("nvidia[0-9]*")):  # else each test would be one more that is skipped
    LAYOUTS.append(pytest.param("cuda", marks=pytest.mark.gpu))


def order_bodies_as_a_gpu(patch: pytest.MonkeyPatch, trees_abreast: int = WARP_SIZE) -> None:
    """Let batches on a CPU have ``trees_abreast`` trees side by side in the kernels' arrays."""

    def solver(*given: Any, device: str) -> ArticulationSolver:
        return ArticulationSolver(*given, buffers=DeviceBuffers(device, trees_abreast))

    patch.setattr("vinesim.worlds.worlds.ArticulationSolver", solver)


def apply(layout: str, patch: pytest.MonkeyPatch) -> None:
    """Let batches for which a test names no device have a layout. With ``cuda`` on a GPU, equal worlds stay equal to
    the bit."""
    if layout == "order of a GPU":
        order_bodies_as_a_gpu(patch)
    elif layout == "cuda":
        from vinesim.learn.arm_env import ArmEnv
        from vinesim.worlds.worlds import Worlds

        if wp.get_cuda_device_count() == 0:
            pytest.skip("this machine has an NVIDIA GPU, but Warp finds none")
        for one in (Worlds, ArmEnv):
            given = inspect.unwrap(one.__init__).__kwdefaults__
            patch.setitem(given, "device", "cuda")
            patch.setitem(given, "deterministic", True)
