"""Checks of a demo's options before any process starts."""

from __future__ import annotations


def check_device(device: str) -> None:
    """Refuse a device that is not there: DeviceUnavailable. For the CPU nothing is imported, which takes a second."""
    if device != "cpu":
        from vinesim.plants.device_buffers import find_device

        find_device(device)
