"""Device buffers: arrays that NumPy and kernels both use. On a CPU they share memory, with a GPU there are two copies.

A kernel walks a tree from parent to child and back. If its arrays were in the host's memory, every step would wait for
the bus. So with a GPU the host keeps its arrays in pinned memory that the device can reach, and the device has a copy
of every array that has a row for each body. The rows of the awake trees are copied to the device before the kernels
that need them, and back after. Kernels read lists and arrays of trees directly in the host's memory.

The device's copies have another order: 32 trees lie side by side, first their first bodies, then their second bodies,
up to the last body of the largest tree. The 32 threads of a warp then read one stretch of memory instead of 32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import host_element
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants.gather_scatter import copy_rows

WARP_SIZE = 32
"""Threads of a GPU that run in step: a warp."""


class DeviceUnavailable(ValueError):
    """Raised if a device does not exist. The message names the device and a solution."""

    exit_code = 3


class DeviceLost(RuntimeError):
    """Raised if a device failed during a computation. The message names the device, the failure and a solution."""

    exit_code = 3


def find_device(name: str) -> wp.Device:
    """Returns the Warp device with the name ``cpu``, ``cuda`` or ``cuda:N``. Raises :class:`DeviceUnavailable` if it
    does not exist."""
    if not isinstance(name, str) or (name != "cpu" and name.partition(":")[0] != "cuda"):
        raise DeviceUnavailable(f"device {name!r}: give cpu, cuda or cuda:N")
    if name != "cpu" and wp.get_cuda_device_count() == 0:
        raise DeviceUnavailable(
            f"device {name!r}: Warp finds no NVIDIA GPU here (none, or no driver for it); use cpu, which needs none"
        )
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        raise DeviceUnavailable(
            f"device {name!r}: this machine has {wp.get_cuda_device_count()} NVIDIA GPUs, counted from cuda:0"
        ) from None


def device_fault(name: str) -> str | None:
    """Test a device by writing and reading back a number. Returns None if the device works, else the reason why not."""
    try:
        find_device(name)
        wp.ones(1, dtype=float, device=name).numpy()
    except (DeviceUnavailable, RuntimeError) as fault:
        return " ".join(str(fault).split())
    return None


class DeviceBuffers:
    """The arrays of one model on one device, by name.

    Args:
        device: see :func:`find_device`.
        interleave: number of trees that lie side by side in the kernels' copies; 0 for no copies. Unless given, 0 on
            the CPU and :data:`WARP_SIZE` with a GPU.
    """

    def __init__(self, device: str, interleave: int | None = None) -> None:
        self.device = find_device(device)
        interleave = (WARP_SIZE if self.device.is_cuda else 0) if interleave is None else interleave
        self.has_copies = interleave > 0
        """Whether kernels work on copies of the host's arrays."""
        self.pitch = max(interleave, 1)
        """Distance between consecutive bodies of a tree in the kernels' arrays [places]."""
        self.arrays: dict[str, wp.array] = {}
        """The arrays that kernels work on, by name."""
        self.host: dict[str, np.ndarray] = {}
        """The arrays that NumPy works on, by name."""
        self._dtypes: dict[str, type] = {}
        self._points: set[str] = set()

    def set_layout(self, first: np.ndarray, size: np.ndarray) -> None:
        """Give each body its place in the kernels' arrays. ``first``, ``size`` [tree]: first body and number of
        bodies."""
        trees = np.arange(len(first))
        there = first
        if self.has_copies:
            group = trees // self.pitch
            deepest = np.zeros(len(trees) // self.pitch + 1, np.int64)
            np.maximum.at(deepest, group, size)
            there = (np.cumsum(deepest) - deepest)[group] * self.pitch + trees % self.pitch
        tree = np.repeat(trees, size)
        self.slots = (there[tree] + (np.arange(len(tree)) - first[tree]) * self.pitch).astype(np.int32)
        """[body] Place of each body in the kernels' arrays."""
        self.slot_count = int(deepest.sum()) * self.pitch if self.has_copies else len(tree)
        self._largest = int(size.max(initial=1))
        for name, data in (("tree_first", there), ("host_first", first), ("tree_size", size)):
            self.add_constant(name, data.astype(np.int32), wp.int32)

    @property
    def max_tree_size(self) -> int:
        """Number of bodies of the largest tree."""
        return self._largest

    @property
    def max_tree_extent(self) -> int:
        """Number of places from the first body of the largest tree to its last, both included."""
        return (self._largest - 1) * self.pitch + 1

    def pinned(self, data: np.ndarray) -> np.ndarray:
        """Returns ``data`` if the device can reach it, else a copy that the device can reach. Use the returned array
        instead of ``data``."""
        if self.device.is_cpu or data.size == 0:
            return data
        dtype = wp.dtype_from_numpy(data.dtype)
        pinned = wp.empty(data.shape, dtype=dtype, device="cpu", pinned=True).numpy()
        pinned[...] = data
        return pinned

    def add_constant(self, name: str, data: np.ndarray, dtype: type) -> None:
        """Add an array that is never written."""
        self.arrays[name] = wp.array(data, dtype=dtype, device=self.device)
        self.host[name] = data

    def add_shared(self, name: str, data: np.ndarray, dtype: type) -> None:
        """Add an array that kernels read and write in the host's memory; with a GPU it must come from
        :meth:`pinned`."""
        self.arrays[name] = self.reach(data, dtype, name)
        self.host[name] = data

    def reach(self, data: np.ndarray, dtype: Any, name: str) -> wp.array:
        """Returns a Warp array over the memory of ``data``. With a GPU, ``data`` must come from :meth:`pinned`.
        ``name`` is used in error messages."""
        if self.device.is_cpu:
            shared = wp.array(data, dtype=dtype, device="cpu", copy=False)
            if data.size and shared.ptr != data.ctypes.data:
                raise ValueError(f"{name} cannot be shared with Warp; give a C-contiguous array of its own")
            return shared
        shape = data.shape[: data.ndim - host_element(dtype).ndim]
        return wp.array(ptr=data.ctypes.data, shape=shape, dtype=dtype, device=self.device)

    def host_array(self, name: str) -> wp.array:
        """Returns a shared array as a Warp array on the CPU, for use with ``wp.copy``."""
        shared = self.arrays[name]
        data = self.host[name]
        if self.device.is_cpu or data.size == 0:
            return shared
        return wp.array(ptr=data.ctypes.data, shape=shared.shape, dtype=shared.dtype, device="cpu", pinned=True)

    def add_body_rows(self, name: str, data: np.ndarray, dtype: type, *, body_indices: bool = False) -> None:
        """Add an array with a row of four-byte numbers for each body. Host and kernels may both write to it.

        See :meth:`row_copier` and :meth:`upload`. ``body_indices``: the numbers are indices of bodies, or negative.
        """
        if not self.has_copies:
            self.add_shared(name, data, dtype)
            return
        self.host[name] = data
        self._dtypes[name] = dtype
        self._points |= {name} if body_indices else set()
        self.arrays[name] = wp.zeros(self.slot_count, dtype=dtype, device=self.device)
        self.upload([name])

    def add_scratch(self, name: str, dtype: type) -> None:
        """Add an array with a row for each body that only kernels use."""
        self.arrays[name] = wp.empty(self.slot_count, dtype=dtype, device=self.device)

    def upload(self, names: list[str]) -> None:
        """Copy all rows of some arrays to the device. This is too slow for every tick."""
        for name in names if self.has_copies else []:
            data = self.host[name]
            there = np.zeros((self.slot_count, *data.shape[1:]), data.dtype)
            there[self.slots] = np.where(data >= 0, self.slots[data], data) if name in self._points else data
            self.arrays[name].assign(there)

    def download(self, names: Iterable[str]) -> None:
        """Copy all rows of some arrays with a row for each body to the host. This is too slow for every tick."""
        if not self.has_copies:
            return
        body = np.zeros(self.slot_count, np.int32)
        body[self.slots] = np.arange(len(self.slots))
        for name in names:
            here = self.arrays[name].numpy()[self.slots]
            self.host[name][...] = np.where(here >= 0, body[here], here) if name in self._points else here

    def row_copier(
        self, names: tuple[str, ...], trees: str, count: wp.array, *, to_host: bool = False
    ) -> Callable[[int], None]:
        """Returns a function that copies the rows of the first ``count`` [1] trees of the list ``trees`` to the device,
        or to the host (``to_host``).

        The argument of that function is an upper bound of the count. The function does nothing where host and kernels
        share memory.
        """
        if not self.has_copies:
            return lambda capacity: None
        widths = np.array([self.host[name][:1].size for name in names])
        starts = np.append(0, np.cumsum(widths * self._largest))
        here = (1, "host_first", [self.host[name].ctypes.data for name in names])
        there = (self.pitch, "tree_first", [self.arrays[name].ptr for name in names])
        (pitch, first, source), (pitch_there, first_there, target) = (there, here) if to_host else (here, there)
        ints = [wp.array(x, dtype=wp.int32, device=self.device) for x in (starts, widths)]
        addresses = [wp.array(np.array(x, np.uint64), dtype=wp.uint64, device=self.device) for x in (source, target)]
        a = self.arrays
        given = [pitch, pitch_there, a[first], a[first_there], a["tree_size"], *ints, count, a[trees], addresses[0]]
        copy = KernelLaunch(copy_rows, given, [addresses[1]], width=int(starts[-1]), block=256)
        return KernelGraph(copy, device=str(self.device))

    def synchronize(self) -> None:
        """Wait until the device has done all its work."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
