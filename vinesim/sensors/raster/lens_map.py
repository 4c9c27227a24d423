"""Pictures through a lens with distortion: taken by a pinhole that sees at least as much, and moved to their pixels."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.scene import camera_geometry
from vinesim.scene.camera_geometry import pixel_rays
from vinesim.scene.values import CameraInfo

MAX_GROWTH = 4.0
"""Pixels of the pinhole for each one of the picture, at most."""


class LensError(ValueError):
    """Coefficients of distortion that no picture can be drawn with. The text is one line."""


class LensMap:
    """What is drawn for a camera, and how its pictures follow from that: unchanged if it has no distortion."""

    def __init__(self, info: CameraInfo) -> None:
        self.pinhole = info
        """Intrinsics of what is drawn."""
        self._columns = self._rows = np.zeros((0, 0), np.float32)
        """Where in it each pixel is taken from [height, width]."""
        self._nearest = np.zeros((0, 0), np.intp)
        """The pixel there, counted row by row."""
        if not info.distortion:
            return
        if len(info.distortion) not in camera_geometry.MODELS:
            raise LensError(f"distortion has {len(info.distortion)} coefficients; give 5 (plumb_bob) or 8 (rational)")
        across, down = pixel_rays(info)
        if not (np.isfinite(across).all() and np.isfinite(down).all()):
            raise LensError(
                f"distortion {list(info.distortion)} folds the picture of {info.width}x{info.height} px over itself; "
                "give coefficients that are valid up to its corners"
            )
        columns = across * np.float32(info.fx)
        rows = down * np.float32(info.fy)
        left = int(np.floor(columns.min()))
        top = int(np.floor(rows.min()))
        width = int(np.ceil(columns.max())) - left + 1
        height = int(np.ceil(rows.max())) - top + 1
        if width * height > MAX_GROWTH * info.width * info.height:
            raise LensError(
                f"distortion {list(info.distortion)} needs {width}x{height} px to be drawn for a picture of "
                f"{info.width}x{info.height} px; give a weaker one or a greater focal length"
            )
        self.pinhole = dataclasses.replace(
            info, width=width, height=height, cx=float(-left), cy=float(-top), distortion=()
        )
        self._columns = columns - np.float32(left)
        self._rows = rows - np.float32(top)
        self._nearest = np.rint(self._rows).astype(np.intp) * width + np.rint(self._columns).astype(np.intp)

    def nearest(self, drawn: np.ndarray) -> np.ndarray:
        """What was drawn, [height, width] of the pinhole, as the picture shows it: the nearest value of each pixel."""
        return drawn if not self._nearest.size else drawn.reshape(-1)[self._nearest]

    def smooth(self, drawn: np.ndarray) -> np.ndarray:
        """The same for colours [height, width, 3] uint8, between pixels linearly."""
        if not self._nearest.size:
            return drawn
        import cv2  # here, as most cameras do without

        return cv2.remap(drawn, self._columns, self._rows, cv2.INTER_LINEAR)


@functools.lru_cache(maxsize=16)
def lens_map(info: CameraInfo) -> LensMap:
    """The map of a camera, made once. :class:`LensError` if there is none."""
    return LensMap(info)
