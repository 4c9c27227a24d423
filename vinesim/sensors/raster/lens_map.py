"""Lens distortion: pictures are rendered by a pinhole camera whose view contains the distorted one, then resampled."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.scene import camera_geometry
from vinesim.scene.camera_geometry import pixel_rays
from vinesim.scene.values import CameraInfo

MAX_GROWTH = 4.0
"""Largest ratio of the numbers of pixels of the pinhole picture and of the distorted picture."""


class LensError(ValueError):
    """Error: no picture can be rendered with given coefficients of distortion. The message is one line."""


class LensMap:
    """The pinhole camera that is rendered in place of a distorted camera, and the map from its pictures to distorted
    ones.

    Without distortion, pictures are not changed.
    """

    def __init__(self, info: CameraInfo) -> None:
        self.pinhole = info
        """Intrinsics of the pinhole camera that is rendered."""
        self._columns = self._rows = np.zeros((0, 0), np.float32)
        """[height, width] Column and row [px] of the pinhole's picture at which each distorted pixel is sampled."""
        self._nearest = np.zeros((0, 0), np.intp)
        """[height, width] Flat index of the pixel in the pinhole's picture that is nearest to the sampling point."""
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
        """Returns the distorted picture from the pinhole's picture ``drawn`` [height, width], with nearest-pixel
        sampling."""
        return drawn if not self._nearest.size else drawn.reshape(-1)[self._nearest]

    def smooth(self, drawn: np.ndarray) -> np.ndarray:
        """Returns the distorted picture from the pinhole's colours ``drawn`` [height, width, 3] uint8, with bilinear
        interpolation."""
        if not self._nearest.size:
            return drawn
        import cv2  # imported here, because most cameras do not need it

        return cv2.remap(drawn, self._columns, self._rows, cv2.INTER_LINEAR)


@functools.lru_cache(maxsize=16)
def lens_map(info: CameraInfo) -> LensMap:
    """Returns the lens map of a camera, which is computed once; :class:`LensError` if its distortion cannot be
    rendered."""
    return LensMap(info)
