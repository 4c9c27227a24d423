"""Model of the depth measured by stereo cameras such as RealSense D400.

Noise follows sigma_z = z^2 sigma_d / (f B), where sigma_d is the error of disparity. The first imager is at the
camera's pose, the second to its right by the baseline. Points that are hidden from the second imager (to the left of
near objects) have no depth. The matcher finds one surface in each window, so uneven surfaces are smoothed, thin ones
are lost, and near surfaces grow at their edges.
"""

from __future__ import annotations

import functools
import itertools
from typing import Annotated

import cv2
import msgspec
import numpy as np
import warp as wp

from vinesim.core.thread_pool import ThreadPool
from vinesim.kernels.raster.pinhole import NEAR_DEPTH, Pinhole
from vinesim.kernels.stereo import stereo_depth, stereo_input, stereo_rows
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraInfo
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer
from vinesim.sensors.raster.primitive_arrays import PosedPrimitives


class StereoSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of a stereo camera's measurement (table ``[stereo]`` in ``data/cameras``), in pixels of its
    imagers."""

    baseline: Annotated[Number, "m", (0.001, 2.0)]
    """Distance between the two imagers."""
    focal: Annotated[Number, "px", (10.0, 10000.0)]
    """Focal length of the imagers, at the resolution at which their pictures are matched."""
    field: Annotated[Number, "deg", (10.0, 170.0)]
    """Horizontal field of view of the imagers."""
    noise: Annotated[Number, "px", (0.0, 10.0)]
    """Standard deviation of disparity on a well-textured plane."""
    step: Annotated[Number, "px", (0.0, 10.0)]
    """Resolution of disparity; 0 for no quantisation."""
    window: Annotated[Number, "px", (1.0, 63.0)]
    """Width of the matching window. The matcher finds one surface in a window, and noise is correlated over its width.
    """
    fattening: Annotated[Number, "1", (0.1, 10.0)]
    """Weight of the nearest surface in a window, relative to other surfaces. Above 1 near surfaces grow at edges."""
    support: Annotated[Number, "1", (0.0, 1.0)]
    """Share of a window that one surface must cover for a match."""
    slant_kept: Annotated[Number, "deg", (0.0, 90.0)]
    """Angle between ray and normal up to which slant never prevents a match."""
    slant_lost: Annotated[Number, "deg", (0.0, 90.0)]
    """Angle between ray and normal from which no surface is matched."""
    contrast: Annotated[Number, "1", (0.0, 255.0)]
    """Range of grey levels within a window below which the scene has no texture, so that only the projector's texture
    can be matched."""
    projector: Annotated[Number, "m", (0.0, 100.0)]
    """Distance up to which the projector's texture is always matched; from twice this distance on it never is."""
    saturation: Annotated[Number, "1", (0.0, 256.0)]
    """Mean grey level of a window from which the window is overexposed."""


class Stereo:
    """The depth measurement of one stereo camera: second imager, matching and noise."""

    def __init__(
        self,
        spec: StereoSpec,
        info: CameraInfo,
        reach: tuple[float, float],
        device: str = "cpu",
        *,
        second_from_first: bool = False,
        workers: ThreadPool | None = None,
    ) -> None:
        """``reach``: nearest and farthest measured depth [m].

        ``second_from_first``: compute the second imager's view from the first imager's depth instead of rendering it
        (on a CPU); ``workers``: threads that share the rows, without effect on the result.
        """
        self.info = info
        self.device = device
        self._workers = workers or ThreadPool(1)
        self._second_from_first = second_from_first and device == "cpu"
        s = self._parameters = stereo_depth.Stereo()
        s.baseline = spec.baseline.value
        s.focal_baseline = spec.focal.value * spec.baseline.value
        s.scale = min(spec.focal.value / info.fx, 1.0)
        s.stride = max(1, round(spec.window.value / 5.0 / s.scale))
        s.sigma = spec.noise.value
        s.step = spec.step.value
        s.nearest, s.farthest = reach
        s.fattening = spec.fattening.value
        s.support = spec.support.value
        s.slant_kept, s.slant_lost = (float(np.cos(np.radians(a.value))) for a in (spec.slant_kept, spec.slant_lost))
        reach_of_window = np.sqrt(8.0) * s.stride * s.scale / spec.focal.value
        s.slope = float(reach_of_window * np.tan(np.radians(min(spec.slant_kept.value, 85.0))))
        s.contrast = spec.contrast.value
        s.projector = spec.projector.value
        s.saturation = spec.saturation.value
        # the second imager's picture must extend to the left as far as nearest surfaces appear there, within its field
        left = -info.cx / info.fx
        right = (info.width - 1 - info.cx) / info.fx
        edge = max(-float(np.tan(np.radians(0.5 * spec.field.value))), left - s.baseline / max(reach[0], 1e-3))
        focal = spec.focal.value
        self._columns = int(np.ceil((right - edge) * focal)) + 1
        self._rows = int(np.ceil(info.height * focal / info.fy)) + 1
        self._centre = -edge * focal, info.cy / info.fy * focal
        self._focal = focal
        self._second = CameraRasterizer(self._columns, self._rows, device, self._workers)
        self._window = max(1, round(spec.window.value))
        cells = int(np.ceil(info.height * s.scale)), int(np.ceil(info.width * s.scale))
        self._noise = wp.empty((2, *cells), dtype=float, device=device)
        margin = self._window - 1
        self._normal = wp.empty(
            (2, cells[0] + margin, cells[1] + margin) if device != "cpu" else 0, dtype=float, device=device
        )
        self._pixels = _imager_pixels(cells, s.scale, info)
        pixels = info.width * info.height
        self._depth = wp.empty(pixels, dtype=float, device=device)
        self._disparity = wp.empty(pixels, dtype=float, device=device)
        self._grey = wp.empty(pixels, dtype=wp.uint8, device=device)
        self._second_depth = self._second.depth
        if self._second_from_first:
            self._second_depth = wp.empty(cells[0] * self._columns, dtype=float, device=device)

    def measure(
        self,
        primitives: PosedPrimitives,
        lens: Pinhole,
        depth: np.ndarray,
        rgb: np.ndarray,
        rng: np.random.Generator | None,
    ) -> np.ndarray:
        """Returns the measured depth [height, width] m for exact ``depth`` [height, width] m and the picture ``rgb``.

        ``rng``: source of the noise; None: the noise of the last :meth:`draw_noise` is used.
        """
        if rng is not None:
            self.draw_noise(rng)
        second = self._second_pinhole(lens)
        if not self._second_from_first:
            self._second.draw(primitives, second)
        self._set_picture(depth, rgb)
        self._measure_on_cpu(lens, second)
        return self._depth.numpy().reshape(self.info.height, self.info.width).copy()

    def measure_on_device(self, primitives: PosedPrimitives, lens: Pinhole, depth: wp.array, rgb: wp.array) -> wp.array:
        """Compute the measured depth [pixel] m on a GPU from arrays [pixel] on that GPU, as :meth:`measure` does.

        The noise is that of the last :meth:`draw_noise`. The call does not wait for the result.
        """
        second = self._second_pinhole(lens)
        self._second.draw(primitives, second)
        wp.launch(
            stereo_input.convert_picture,
            len(self._depth),
            inputs=[depth, rgb, self._parameters.focal_baseline],
            outputs=[self._disparity, self._grey],
            device=self.device,
        )
        _, rows, columns = self._noise.shape
        wp.launch(
            stereo_depth.measure_depth,
            rows * columns,
            inputs=[
                self._parameters,
                lens,
                second,
                self._disparity,
                self._grey,
                self._second_depth,
                self._noise,
                1,
            ],
            outputs=[self._depth],
            device=self.device,
        )
        return self._depth

    def _set_picture(self, depth: np.ndarray, rgb: np.ndarray) -> None:
        """Compute disparity and grey levels of a picture for the kernels of a CPU."""
        disparity = self._disparity.numpy().reshape(depth.shape)
        np.divide(np.float32(self._parameters.focal_baseline), depth, out=disparity)
        cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY, dst=self._grey.numpy().reshape(depth.shape))

    def draw_noise(self, rng: np.random.Generator) -> None:
        """Draw the noise of the next measurement, which does not depend on the picture.

        A GPU draws other random numbers than a CPU.
        """
        if self.device == "cpu":
            self._noise.numpy()[:] = self._correlated_noise(rng)
            return
        wp.launch(
            stereo_input.draw_normals,
            self._normal.size,
            inputs=[int(rng.integers(1 << 31))],
            outputs=[self._normal.flatten()],
            device=self.device,
        )
        wp.launch(
            stereo_input.correlate,
            self._noise.shape,
            inputs=[self._normal, self._window],
            outputs=[self._noise],
            device=self.device,
        )

    def _measure_on_cpu(self, lens: Pinhole, second: Pinhole) -> None:
        rows = self._noise.shape[1]
        warped = self._second_from_first

        def measure(first: int, end: int) -> None:
            if warped:
                wp.launch(
                    stereo_rows.warp_to_second,
                    end - first,
                    inputs=[self._parameters, self._pixels, lens, second, self._disparity, first],
                    outputs=[self._second_depth],
                    device=self.device,
                )
            arrays = [self._disparity, self._grey, self._second_depth, int(warped), self._noise, first]
            wp.launch(
                stereo_rows.measure_depth_rows,
                end - first,
                inputs=[self._parameters, self._pixels, lens, second, *arrays],
                outputs=[self._depth],
                device=self.device,
            )

        bounds = [rows * i // self._workers.size for i in range(self._workers.size + 1)]
        self._workers.share([functools.partial(measure, *ends) for ends in itertools.pairwise(bounds)])

    def _second_pinhole(self, lens: Pinhole) -> Pinhole:
        """Returns the lens of the second imager: parallel to the first imager, and to its right by the baseline."""
        other = Pinhole()
        turn = np.array(lens.rotation).reshape(3, 3)
        other.eye = wp.vec3(*map(float, np.array(lens.eye) + self._parameters.baseline * turn[0]))
        other.rotation = lens.rotation
        other.fx = other.fy = float(self._focal)
        other.cx, other.cy = map(float, self._centre)
        other.width = self._columns
        other.height = self._rows
        other.max_depth = lens.max_depth
        other.first_row = 0
        other.end_row = self._rows
        wide = max(other.cx, other.width - other.cx) / other.fx
        high = max(other.cy, other.height - other.cy) / other.fy
        other.near_radius = float(NEAR_DEPTH) * float(np.sqrt(1.0 + wide * wide + high * high))
        return other

    def _correlated_noise(self, rng: np.random.Generator) -> np.ndarray:
        """Returns two fields [2, row, column] of normal numbers with variance 1 that are correlated over the width of a
        matching window."""
        _, rows, columns = self._noise.shape
        wide = self._window - 1
        raw = rng.standard_normal((2, rows + wide, columns + wide), np.float32)
        if not wide:
            return raw
        sums = [cv2.boxFilter(field, -1, (self._window, self._window), normalize=False) for field in raw]
        low = wide // 2
        return np.stack([s[low : low + rows, low : low + columns] for s in sums]) / np.float32(self._window)


def _imager_pixels(cells: tuple[int, int], scale: float, info: CameraInfo) -> stereo_rows.ImagerPixels:
    """Returns the mapping from an imager's rows and columns to those of a picture.

    ``cells``: numbers of rows and columns of the imager; ``scale``: width of a pixel of the picture in pixels of the
    imager.
    """
    o = stereo_rows.ImagerPixels()
    for name, count, size in (("row", cells[0], info.height), ("column", cells[1], info.width)):
        ends = np.ceil(np.arange(count + 1, dtype=np.float32) / np.float32(scale)).astype(np.int32)
        right = np.minimum(ends[1:], size)
        setattr(o, f"first_{name}", wp.array(np.append(ends[:-1], right[-1]), dtype=wp.int32, device="cpu"))
        middle = np.minimum((ends[:-1] + right) // 2, size - 1)
        setattr(o, f"middle_{name}", wp.array(middle, dtype=wp.int32, device="cpu"))
    return o
