"""Pictures through a lens with distortion: drawn by a pinhole camera that sees at least as much, then resampled."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.scene import camera_geometry
from vinesim.scene.camera_geometry import pixel_rays
from vinesim.scene.values import CameraInfo

MAX_GROWTH = 4.0
"""Largest number of pixels of the pinhole picture for each pixel of the distorted picture."""


class LensError(ValueError):
    """No picture can be drawn with these coefficients of distortion. The text is one line."""


class LensMap:
    """The pinhole that is drawn for a camera, and the map from its pictures to the camera's. Pictures of a camera
    without distortion are not changed."""

    def __init__(self, info: CameraInfo) -> None:
        self.pinhole = info
        """Intrinsics of the pinhole that is drawn."""
        self._columns = self._rows = np.zeros((0, 0), np.float32)
        """[height, width] Place in the pinhole's picture from which each pixel is taken."""
        self._nearest = np.zeros((0, 0), np.intp)
        """[height, width] Pixel of the pinhole's picture that is nearest to this place, counted row by row."""
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
        """The camera's picture from the pinhole's ``drawn`` [height, width]: each pixel takes the nearest value."""
        return drawn if not self._nearest.size else drawn.reshape(-1)[self._nearest]

    def smooth(self, drawn: np.ndarray) -> np.ndarray:
        """As :meth:`nearest` for colours [height, width, 3] uint8, with linear interpolation between pixels."""
        if not self._nearest.size:
            return drawn
        import cv2  # imported here, since most cameras do not need it

        return cv2.remap(drawn, self._columns, self._rows, cv2.INTER_LINEAR)


@functools.lru_cache(maxsize=16)
def lens_map(info: CameraInfo) -> LensMap:
    """The map of a camera, made once. :class:`LensError` if its distortion cannot be drawn."""
    return LensMap(info)
