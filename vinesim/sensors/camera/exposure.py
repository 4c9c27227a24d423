"""Conversion of radiance to 8-bit colours: light metering, exposure, white balance, glare of lamps, tone curve."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import warp as wp

from vinesim.core.thread_pool import ThreadPool
from vinesim.kernels.shading import deferred, tone_rows
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.scene_primitives import Primitives

NOON_EXPOSURE = 0.75
"""Exposure (factor on radiance) that suits a sunny noon."""
KEY_VALUE = 0.13
"""Geometric mean of the exposed luminance at which automatic exposure aims; white is 1."""
ADAPTED_SHARE = 0.5
"""Share of the difference to the key value, in stops, that automatic exposure corrects. Below 1, dark scenes stay
darker than bright ones."""
LOW_SUN_SHARE = 0.7
"""Share of the loss of daylight under a low sun, in stops, that :func:`usual_exposure` corrects."""
MIN_EXPOSURE = 0.25
MAX_EXPOSURE = 8.0
"""Largest value of automatic exposure; ``MIN_EXPOSURE`` is the smallest."""
ADAPTATION_TIME = 0.25
"""Time constant [s] with which automatic exposure, in stops, follows its target."""
_METERING_STRIDE = 8
"""Distance [px] between pixels that the light meter samples, in rows and columns."""
_GLARE = ((2.0, 0.5), (9.0, 0.12))
"""Gaussian halos around lamps by light that a lens scatters: standard deviation [1/100 of the picture's height] and
strength of each."""
_GLARE_REACH = 4.0
"""Radius of a halo around a lamp [standard deviations]."""


def usual_exposure(brightness: float) -> float:
    """Returns the exposure that suits daylight of this ``brightness``, where a sunny noon has brightness 1."""
    return NOON_EXPOSURE * max(brightness, 0.01) ** -LOW_SUN_SHARE


class LightMeter:
    """Automatic exposure of one camera: what is metered, and how fast exposure follows."""

    def __init__(
        self,
        width: int,
        height: int,
        samples: int = 1,
        fixed: float | None = None,
        device: str = "cpu",
        key: float = KEY_VALUE,
        share: float = ADAPTED_SHARE,
    ) -> None:
        """``width``, ``height``: of the metered picture [sample]; ``samples``: number of samples along each side of a
        pixel; ``fixed``: fixed exposure; ``key``: geometric mean of the exposed luminance at which it aims; ``share``:
        of the difference to the key, in stops, that is corrected."""
        self.width = width
        self.height = height
        self.fixed = fixed
        self.device = device
        self._step = _METERING_STRIDE * samples
        if min(width, height) < self._step:
            self._step = 1
        self._key = key
        self._share = share
        self._sum = wp.zeros(2, dtype=wp.int64, device=device)
        self.exposure = wp.array([fixed or 0.0], dtype=float, device=device)
        """[1] Factor on radiance."""
        self._time: float | None = None

    def update(self, radiance: wp.array, time: float, brightness: float = 1.0) -> wp.array:
        """Returns :attr:`exposure` for ``radiance`` [sample], rendered for ``time`` [s]; ``brightness``: of the
        daylight, 1 at a sunny noon."""
        if self.fixed is not None:
            return self.exposure
        since = np.inf if self._time is None else time - self._time
        keep = float(np.exp(-since / ADAPTATION_TIME)) if since >= 0.0 else 0.0
        self._time = time
        wp.launch(
            deferred.meter_luminance,
            (self.width // self._step) * (self.height // self._step),
            inputs=[radiance, self.width, self.height, self._step],
            outputs=[self._sum],
            device=self.device,
        )
        wp.launch(
            deferred.update_exposure,
            1,
            inputs=[usual_exposure(brightness), self._key, self._share, MIN_EXPOSURE, MAX_EXPOSURE, keep],
            outputs=[self._sum, self.exposure],
            device=self.device,
        )
        return self.exposure


class Exposure:
    """Exposure and tone mapping of one camera; exposure is automatic unless a ``fixed`` value is given."""

    def __init__(
        self,
        width: int,
        height: int,
        samples: int = 1,
        fixed: float | None = None,
        device: str = "cpu",
        workers: ThreadPool | None = None,
    ) -> None:
        """``width``, ``height``: of the picture [px]; ``samples``: number of colour samples along each side of a pixel;
        ``fixed``: fixed exposure; ``workers``: threads that share the rows on a CPU."""
        self.width = width
        self.height = height
        self.samples = samples
        self.device = device
        self._workers = workers or ThreadPool(1)
        self.radiance = wp.empty(width * height * samples * samples, dtype=wp.vec3, device=device)
        self._numbers = self.radiance.view(float) if device == "cpu" else None
        """View of ``radiance`` as scalars [sample, 3], for vectorised kernels; None on a GPU."""
        self._rgb = wp.empty((width * height, 3), dtype=wp.uint8, device=device)
        self._meter = LightMeter(width * samples, height * samples, samples, fixed, device)
        self._exposure = self._meter.exposure
        self._tone = wp.array(textures.tone_curve(), dtype=wp.uint8, device=device)

    def tone_map(self, balance: np.ndarray, time: float, brightness: float = 1.0) -> wp.array:
        """Convert :attr:`radiance`, rendered for ``time`` [s], to a picture [pixel, 3] uint8 on the device.

        ``balance``: white balance, factors [3] on linear light; ``brightness``: brightness of the daylight, 1 at a
        sunny noon.
        """
        self._meter.update(self.radiance, time, brightness)
        count = self._workers.size
        rows = [self.height * i // count for i in range(count + 1)]
        develop = functools.partial(self._tone_map_rows, wp.vec3(*map(float, balance)))
        self._workers.share([functools.partial(develop, *ends) for ends in itertools.pairwise(rows)])
        return self._rgb

    def _tone_map_rows(self, balance: wp.vec3, first: int, end: int) -> None:
        """Convert the radiance of rows ``first`` to ``end`` - 1 to 8-bit colours."""
        if self.device == "cpu" and self.samples == 1:
            wp.launch(
                tone_rows.tone_map_rows,
                end - first,
                inputs=[self._numbers, self.width, balance, self._exposure, self._tone, first],
                outputs=[self._rgb],
                device="cpu",
            )
            return
        run = self.width if self.device == "cpu" else 1
        inputs = [self.radiance, self.width, self.samples, balance, self._exposure, self._tone, first * self.width, run]
        wp.launch(
            deferred.tone_map,
            self.width * (end - first) // run,
            inputs=inputs,
            outputs=[self._rgb],
            device=self.device,
        )

    def add_glare(self, primitives: Primitives, seen: wp.array) -> None:
        """Add the glare of a lens to :attr:`radiance`: halos around the lamps in the picture.

        ``seen``: [sample] index of the visible primitive.
        """
        lamps = primitives.lamp_primitives
        if not len(lamps):
            return
        is_lamp = np.zeros(primitives.count + 2, bool)  # sky and ground, -1 and -2, are the last two
        is_lamp[lamps] = True
        lit = is_lamp[seen.numpy()].reshape(self.height * self.samples, -1)
        if not lit.any():
            return
        radiance = self.radiance.numpy()
        glare(radiance.reshape(*lit.shape, 3), lit)
        if self.device != "cpu":
            self.radiance.assign(radiance)


def glare(picture: np.ndarray, lit: np.ndarray) -> None:
    """Add halos around the lamps to the radiance ``picture`` [height, width, 3], in place; ``lit`` [height, width]:
    pixels that show lamps.

    Lamps cover few pixels. The matrix products here contain only rows and columns with lamps and take 2 ms, while a
    blur of the whole picture takes 150 ms.
    """
    rows = np.flatnonzero(lit.any(1))
    columns = np.flatnonzero(lit.any(0))
    lamp = picture[np.ix_(rows, columns)] * lit[np.ix_(rows, columns)][..., None]
    lamp = np.ascontiguousarray(lamp.transpose(2, 0, 1))
    for width, strength in _GLARE:
        sigma = width * lit.shape[0] / 100.0
        down, i = _gaussian(rows, lit.shape[0], sigma)
        across, j = _gaussian(columns, lit.shape[1], sigma)
        picture[i, j] += strength * (down @ lamp @ across.T).transpose(1, 2, 0)


def _gaussian(sources: np.ndarray, size: int, sigma: float) -> tuple[np.ndarray, slice]:
    """Returns Gaussian weights [target, source] from rows (or columns) ``sources`` [px] to all rows (or columns) within
    reach, and the range of these target rows.

    ``size``: number of rows [px]; ``sigma``: standard deviation [px].
    """
    reach = int(_GLARE_REACH * sigma) + 1
    places = slice(max(int(sources[0]) - reach, 0), min(int(sources[-1]) + reach + 1, size))
    away = (np.arange(places.start, places.stop)[:, None] - sources) / sigma
    return np.exp(-0.5 * away * away, dtype=np.float32) / np.float32(np.sqrt(2.0 * np.pi) * sigma), places
