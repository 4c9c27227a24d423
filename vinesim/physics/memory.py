"""Where arrays live that NumPy and kernels both use: once on a CPU, twice with a GPU.

A kernel walks a tree from parent to child and back. Were its arrays in the host's memory, every step would wait for the
bus. So with a GPU the host keeps its arrays in pinned memory that the device can reach, the device has a copy of all
that has a row for each body, and the rows of the awake trees are carried over and back around the kernels that need
them. Lists and numbers of trees are read where they are.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.kernels.carry import carry
from vinesim.kernels.launch import bind


class NoDevice(ValueError):
    """The text says which device cannot be had, and what to do."""

    exit_code = 3


def device_of(name: str) -> wp.Device:
    """The Warp device called ``cpu``, ``cuda`` or ``cuda:N``; :class:`NoDevice` in words if there is none."""
    if name != "cpu" and name.partition(":")[0] != "cuda":
        raise NoDevice(f"device {name!r}: give cpu, cuda or cuda:N")
    if name != "cpu" and wp.get_cuda_device_count() == 0:
        raise NoDevice(
            f"device {name!r}: Warp sees no NVIDIA GPU here (none, or no driver for it); use cpu, which needs none"
        )
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        raise NoDevice(
            f"device {name!r}: this machine has {wp.get_cuda_device_count()} NVIDIA GPUs, counted from cuda:0"
        ) from None


class Memory:
    """The arrays of one model on one device, by name.

    Args:
        device: see :func:`device_of`.
        apart: give kernels copies of their own to work on; what a GPU needs, and what a test can ask of the CPU.
    """

    def __init__(self, device: str, apart: bool | None = None) -> None:
        self.device = device_of(device)
        self.apart = self.device.is_cuda if apart is None else apart
        self.arrays: dict[str, wp.array] = {}
        """What kernels work on."""
        self.host: dict[str, np.ndarray] = {}
        """What NumPy works on."""

    def within_reach(self, data: np.ndarray) -> np.ndarray:
        """``data`` itself if the device can reach it, a copy that it can reach otherwise: use that from now on."""
        if self.device.is_cpu or data.size == 0:
            return data
        dtype = wp.dtype_from_numpy(data.dtype)
        pinned = wp.empty(data.shape, dtype=dtype, device="cpu", pinned=True).numpy()
        pinned[...] = data
        return pinned

    def constant(self, name: str, data: np.ndarray, dtype: type) -> None:
        """An array that nobody will write."""
        if self.device.is_cpu and not self.apart:
            self.reach(name, data, dtype)
        else:
            self.arrays[name], self.host[name] = wp.array(data, dtype=dtype, device=self.device), data

    def reach(self, name: str, data: np.ndarray, dtype: type) -> None:
        """An array that kernels read and write where it is; with a GPU it must come from :meth:`within_reach`."""
        if self.device.is_cpu:
            shared = wp.array(data, dtype=dtype, device="cpu", copy=False)
            if data.size and shared.ptr != data.ctypes.data:
                raise ValueError(f"{name} cannot be shared with Warp; give a C-contiguous array of its own")
        else:
            shape = data.shape if dtype in (float, wp.int32, wp.bool) else data.shape[:1]
            shared = wp.array(ptr=data.ctypes.data, shape=shape, dtype=dtype, device=self.device)
        self.arrays[name], self.host[name] = shared, data

    def rows(self, name: str, data: np.ndarray, dtype: type) -> None:
        """An array with a row of four-byte numbers for each body, written by both sides: see :meth:`carrier`."""
        if self.apart:
            self.arrays[name], self.host[name] = wp.array(data, dtype=dtype, device=self.device), data
        else:
            self.reach(name, data, dtype)

    def scratch(self, name: str, count: int, dtype: type) -> None:
        """``count`` elements that only kernels see."""
        self.arrays[name] = wp.empty(count, dtype=dtype, device=self.device)

    def carrier(self, names: tuple[str, ...], trees: str, stride: int, *, back: bool) -> Callable[[int], None]:
        """A function of n that carries rows of the first n ``trees`` to the device, or ``back`` to the host.

        ``stride``: bodies of the largest tree. Nothing happens where both sides share their memory.
        """
        if not self.apart:
            return lambda count: None
        launches = []
        for name in names:
            data = self.host[name]
            width = data[0].size if len(data) else 1
            pair = [self._numbers(data.ctypes.data, data.size), self._numbers(self.arrays[name].ptr, data.size)]
            if back:
                pair.reverse()
            given = [width, stride * width, *(self.arrays[a] for a in ("tree_first", "tree_size", trees)), pair[0]]
            launch = bind(carry, given, [pair[1]], device=str(self.device), block=256)
            launches.append((launch, stride * width))

        def all_of(count: int) -> None:
            for launch, threads in launches:
                launch(count * threads)

        return all_of

    def upload(self, names: list[str]) -> None:
        """Copy whole arrays to the device."""
        if self.apart:
            for name in names:
                count = self.host[name].size
                wp.copy(self._numbers(self.arrays[name].ptr, count), self._numbers(self.host[name].ctypes.data, count))

    def _numbers(self, address: int, count: int) -> wp.array:
        """So many four-byte numbers at an address that the device can reach."""
        return wp.array(ptr=address, shape=(count,), dtype=wp.int32, device=self.device)

    def wait(self) -> None:
        """Until the device has done all that was asked of it."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
