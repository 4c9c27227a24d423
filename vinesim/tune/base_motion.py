"""Motion of a shaken base: a sine sweep, or a curve through the samples of a track."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.interpolate import make_interp_spline

FADE = 0.1
"""[1] Fraction of a sweep in which its amplitude grows from zero, and in which it falls back to zero."""
SPLINE_DEGREE = 7
"""Degree of the spline through samples. For motion at a quarter of the sample rate its acceleration has an error of
0.2 %; degree 5 has 1.3 % and degree 3 has 20 %."""


@dataclasses.dataclass(frozen=True, slots=True)
class Sweep:
    """A sine of constant amplitude whose frequency changes linearly with time."""

    direction: np.ndarray
    """Direction of the motion: unit vector in the world [3]."""
    amplitude: float
    """Amplitude [m]."""
    frequencies: tuple[float, float]
    """Frequencies at the start and at the end of the sweep [Hz]."""
    start: float
    """Time at which the sweep starts [s]."""
    duration: float
    """Duration of the sweep [s]."""

    def position(self, time: np.ndarray) -> np.ndarray:
        """Returns the position [k, 3] m in the world at times [k] s."""
        size, _, phase, _ = self._terms(time)
        return (size * np.sin(phase))[:, None] * self.direction

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Returns the velocity [k, 3] m/s in the world at times [k] s."""
        size, growth, phase, rate = self._terms(time)
        return (growth * np.sin(phase) + size * rate * np.cos(phase))[:, None] * self.direction

    def _terms(self, time: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns amplitude [k] m and its derivative [m/s], phase [k] rad and its derivative [rad/s]."""
        t = np.clip(np.asarray(time, float) - self.start, 0.0, self.duration)
        fade = FADE * self.duration
        edge = np.minimum(np.minimum(t, self.duration - t) / fade, 1.0)
        size = 0.5 * self.amplitude * (1.0 - np.cos(math.pi * edge))
        growth = 0.5 * self.amplitude * math.pi / fade * np.sin(math.pi * edge) * np.sign(0.5 * self.duration - t)
        first, last = self.frequencies
        chirp = (last - first) / self.duration
        return size, growth, 2.0 * math.pi * (first + 0.5 * chirp * t) * t, 2.0 * math.pi * (first + chirp * t)


class SampledMotion:
    """A smooth curve through samples.

    Args:
        time: [k] s, increasing.
        position: [k] or [k, 3] m.
    """

    def __init__(self, time: np.ndarray, position: np.ndarray) -> None:
        self._ends = float(time[0]), float(time[-1])
        curve = make_interp_spline(time, position, k=SPLINE_DEGREE)
        self._slope = curve.derivative(1)
        self._bend = curve.derivative(2)

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Returns the velocity [k] or [k, 3] m/s at times [k] s; outside the samples, the velocity at the nearest
        sample."""
        return self._slope(np.clip(time, *self._ends))

    def acceleration(self, time: np.ndarray) -> np.ndarray:
        """Returns the acceleration [k] or [k, 3] m/s^2 at times [k] s; outside the samples, the acceleration at the
        nearest sample."""
        return self._bend(np.clip(time, *self._ends))
