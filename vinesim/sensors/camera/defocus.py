"""Depth of field: the ``[lens]`` table of a camera's data sheet, and the blur of what is out of focus.

A thin lens images a point that is out of focus as a disc, the *circle of confusion*. The picture is cut into layers of
similar discs by depth. Each layer is blurred on its own, and hides what is behind it. Only colours are blurred; labels
and depths stay those of the lens's centre.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np

from vinesim.scene.plant_parameters import Number

MOST_NEAR = 2.0
"""Largest disc of things before the plane of focus, as a multiple of the disc of infinity: GUESSED, a limit for the
cost of things close to the lens."""
_STEP = 0.8
"""Difference between the discs of neighbouring layers [px], where :data:`_MOST_LAYERS` suffice."""
_MOST_LAYERS = 20
_LEAST_WEIGHT = 1e-3
"""Weight of a layer, summed over a pixel, below which it is taken as empty there."""
_FOCUS_WINDOW = 0.25
"""Margin of the window in which automatic focus looks, as a share of width and height."""
_FOCUS_QUANTILE = 0.3
"""Quantile of the depths in that window that comes into focus: near things, but not the nearest twig. GUESSED."""
_NEAREST_FOCUS = 0.25
"""Least distance of focus [m]: that of the kit lens of a DSLR."""


class LensSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table ``[lens]`` of a camera's data sheet. Without it everything is in focus."""

    f_number: Annotated[Number, "1", (0.5, 64.0)]
    """Focal length divided by the diameter of the aperture."""
    sensor_width: Annotated[Number, "mm", (0.5, 100.0)]
    """Width of the part of the sensor that the picture shows; it determines the focal length in millimetres."""
    focus: Annotated[Number | None, "m", (0.05, 1000.0)] = None
    """Distance of the plane of focus; None: automatic focus, see :func:`automatic_focus`."""

    def infinity_disc(self, focal: float, width: int, focus: float) -> float:
        """Returns the diameter [px] of the disc of a point at infinity.

        That of a point at depth z is this one times abs(1 - focus / z): with the focal length f and the aperture f / N,
        c = f^2 / N * abs(z - focus) / (z * (focus - f)) on the sensor (thin lens).

        Args:
            focal: focal length [px].
            width: width of the picture [px].
            focus: distance of the plane of focus [m].
        """
        pixel = 1e-3 * self.sensor_width.value / width
        length = focal * pixel
        return length * length / (self.f_number.value * max(focus - length, 0.1 * length) * pixel)


def automatic_focus(depth: np.ndarray) -> float:
    """Returns the distance [m] at which a camera focuses that has things at ``depth`` [height, width] m before it, inf
    for the sky: that of near things in the middle of the picture."""
    rows, columns = (slice(int(_FOCUS_WINDOW * n), max(n - int(_FOCUS_WINDOW * n), 1)) for n in depth.shape)
    window = depth[rows, columns]
    seen = window[np.isfinite(window)]
    return max(float(np.quantile(seen, _FOCUS_QUANTILE)), _NEAREST_FOCUS) if seen.size else 1e3


def defocused(radiance: np.ndarray, depth: np.ndarray, samples: int, disc: float, focus: float) -> np.ndarray:
    """Returns the picture [height, width, 3], float32, that a lens makes of ``radiance``.

    Args:
        radiance: linear RGB [height * samples, width * samples, 3].
        depth: depth of each sample [m], in the same form; inf for the sky.
        samples: number of samples along each side of a pixel.
        disc: diameter of the disc of infinity [px].
        focus: distance of the plane of focus [m].
    """
    height, width = (n // samples for n in depth.shape)
    with np.errstate(divide="ignore"):
        size = np.clip(disc * (1.0 - focus / np.maximum(depth, 1e-6)), -MOST_NEAR * disc, disc).astype(np.float32)
    lowest, highest = float(size.min()), float(size.max())
    count = int(np.clip(np.ceil((highest - lowest) / _STEP), 1, _MOST_LAYERS)) + 1
    step = max((highest - lowest) / (count - 1), 1e-6)
    place = (size - lowest) / step
    source = np.ones((*depth.shape, 4), np.float32)
    source[..., :3] = radiance
    total = np.zeros((height, width, 4), np.float32)
    covered = np.zeros((2, height, width), np.float32)
    # from the nearest layer to the farthest; a layer hides all but its neighbour, with which it shares surfaces
    for layer in range(count):
        share = np.maximum(1.0 - np.abs(place - layer), 0.0)
        rows, columns = (np.flatnonzero(share.any(axis)) for axis in (1, 0))
        if not len(rows):
            covered[0] = np.maximum(covered[0], covered[1])
            continue
        diameter = abs(lowest + layer * step)
        reach = int(np.ceil(0.5 * diameter)) + 1
        box = tuple(
            slice(max(int(found[0]) // samples - reach, 0), min(int(found[-1]) // samples + reach + 1, end))
            for found, end in ((rows, height), (columns, width))
        )
        fine = tuple(slice(one.start * samples, one.stop * samples) for one in box)
        part = _averaged(source[fine] * share[fine][..., None], samples)
        part = _blurred(part, diameter)
        total[box] += part * (1.0 - covered[0][box])[..., None]
        covered[0] = np.maximum(covered[0], covered[1])
        covered[1][box] = np.minimum(covered[1][box] + part[..., 3], 1.0)
    return total[..., :3] / np.maximum(total[..., 3:], _LEAST_WEIGHT)


def _averaged(values: np.ndarray, samples: int) -> np.ndarray:
    """Returns the means of squares of ``samples`` x ``samples``."""
    if samples == 1:
        return values
    height, width = (n // samples for n in values.shape[:2])
    return cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)


def _blurred(values: np.ndarray, diameter: float) -> np.ndarray:
    """Returns ``values`` [height, width, 4] spread over discs of ``diameter`` [px]."""
    if diameter < 0.5:
        return values
    radius = 0.5 * diameter
    reach = int(np.ceil(radius))
    fine = (np.arange(5 * (2 * reach + 1)) + 0.5) / 5.0 - (reach + 0.5)
    inside = (np.hypot(*np.meshgrid(fine, fine)) <= radius).astype(np.float32)
    disc = inside.reshape(2 * reach + 1, 5, 2 * reach + 1, 5).sum((1, 3))
    return cv2.filter2D(values, cv2.CV_32F, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
