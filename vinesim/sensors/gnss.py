"""GNSS receivers: the position of an antenna on WGS 84, with the errors of the receiver's kind of fix, and outages.

Errors and outages are functions of simulated time and of the seed alone. They do not depend on when somebody listens.
An error is the sum of a part that drifts, with a given correlation time (a Gauss-Markov process), and of white noise.
Outages begin at random times (a Poisson process). Plants do not shade the antenna.
"""

from __future__ import annotations

import functools
import math
from typing import Annotated

import msgspec
import numpy as np

from vinesim.core import geodesy
from vinesim.core.geodesy import Geodetic
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraOutput, FixKind, GnssFix, GnssMount, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import SensorMaker, SensorSetting

NODES = 20
"""Number of random numbers of the drift in one correlation time. Between them it is interpolated."""
MEMORY = 6 * NODES
"""Number of random numbers that determine the drift at one time: after six correlation times, 0.2 % is left."""
WINDOW = 3600.0
"""Length of the intervals of time for which the beginnings of outages are drawn together [s]."""


class Accuracy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations of one kind of fix."""

    horizontal: Annotated[Number, "m", (0.0, 100.0)]
    """Of east and of north."""
    vertical: Annotated[Number, "m", (0.0, 200.0)]

    @property
    def axes(self) -> np.ndarray:
        """Standard deviations [3] m, east, north, up."""
        return np.array([self.horizontal.value, self.horizontal.value, self.vertical.value])


class GnssSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The data sheet of one model of GNSS receiver, from a file in ``data/gnss``."""

    model: str
    rate: Annotated[Number, "Hz", (0.01, 100.0)]
    correlation_time: Annotated[Number, "s", (0.1, 1e5)]
    """Time after which the correlation of the drift has fallen to 1/e."""
    slow_share: Annotated[Number, "1", (0.0, 1.0)]
    """Share of the variance that drifts; the rest is white noise."""
    recovery: Annotated[Number, "s", (0.0, 1000.0)]
    """Time after an outage with float ambiguities, before they are fixed again."""
    fixed: Accuracy
    float: Accuracy
    single: Accuracy

    @classmethod
    def load(cls, name: str) -> GnssSpec:
        """Read a receiver's data sheet: ``name`` is the path of a file, or the name of a file in ``data/gnss``."""
        return spec_file.load("gnss", name, cls)


class Gnss:
    """One GNSS receiver. Its antenna is at the sensor's pose."""

    def __init__(self, spec: GnssSpec, mount: GnssMount, setting: SensorSetting = SensorSetting()) -> None:
        self.spec = spec
        self.name = mount.name
        self._mount = mount
        self._datum = setting.datum if mount.datum is None else Geodetic(*mount.datum)
        self._seed = setting.seed
        self._normals = functools.lru_cache(2 * MEMORY)(lambda node: self._rng("drift", node).standard_normal(3))
        self._beginnings = functools.lru_cache(4)(self._draw_beginnings)

    @property
    def rate(self) -> float:
        """Rate of the receiver [Hz]."""
        return self.spec.rate.value

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> GnssFix:
        """Measure as :class:`vinesim.sensors.sensor.Sensor` defines it; exactly if EXACT_DEPTH is wanted alone."""
        is_exact = CameraOutput.EXACT_DEPTH in outputs and CameraOutput.RGB not in outputs
        return self.measure(np.asarray(pose, float)[:3], snapshot.time, is_exact=is_exact)

    def measure(self, position: np.ndarray, time: float, *, is_exact: bool = False) -> GnssFix:
        """Returns the fix of an antenna at ``position`` [3] m in the world at simulated ``time`` [s]. ``is_exact``:
        without errors and outages."""
        kind = FixKind(self._mount.fix) if is_exact else self.kind(time)
        spread = np.zeros(3)
        if kind is not FixKind.NONE and not is_exact:
            spread = getattr(self.spec, kind).axes
        error = spread * self.error(time) if spread.any() else np.zeros(3)
        place = geodesy.from_local(position + error, self._datum)
        if kind is FixKind.NONE:
            place = Geodetic(math.nan, math.nan, math.nan)
        return GnssFix(time, self.name, self._mount.frame, kind, *place, spread**2)

    def kind(self, time: float) -> FixKind:
        """Returns the kind of fix at simulated ``time`` [s]: none in an outage, and no fixed ambiguities until the
        receiver has recovered from one."""
        own = FixKind(self._mount.fix)
        window = math.floor(time / WINDOW)
        since = time - np.concatenate([self._beginnings(window - 1), self._beginnings(window)])
        since = since[since >= 0.0]
        if (since < self._mount.outage_duration).any():
            return FixKind.NONE
        is_recovering = (since < self._mount.outage_duration + self.spec.recovery.value).any()
        return FixKind.FLOAT if is_recovering and own is FixKind.FIXED else own

    def error(self, time: float) -> np.ndarray:
        """Returns the error [3] east, north, up at simulated ``time`` [s], in standard deviations."""
        slow = self.spec.slow_share.value
        white = self._rng("noise", round(1e3 * time)).standard_normal(3)
        return math.sqrt(slow) * self._drift(time) + math.sqrt(1.0 - slow) * white

    def _drift(self, time: float) -> np.ndarray:
        """Returns a Gauss-Markov process [3] of variance 1 at simulated ``time`` [s]."""
        at = NODES * time / self.spec.correlation_time.value
        node = math.floor(at)
        kept = math.exp(-1.0 / NODES)
        weights = math.sqrt(1.0 - kept**2) * kept ** np.arange(MEMORY)
        before, after = (weights @ [self._normals(last - k) for k in range(MEMORY)] for last in (node, node + 1))
        return before + (at - node) * (after - before)

    def _draw_beginnings(self, window: int) -> np.ndarray:
        """Returns the times [s] at which outages begin in one window."""
        rng = self._rng("outage", window)
        count = rng.poisson(self._mount.outage_rate * WINDOW / 3600.0)
        return WINDOW * (window + rng.random(count))

    def _rng(self, what: str, number: int) -> np.random.Generator:
        return spec_file.noise_rng(self._seed, f"{self.name}/{what}", number)


MAKER = SensorMaker(
    lambda name: GnssSpec.load(name).rate.value,
    lambda mount, setting: Gnss(GnssSpec.load(mount.type), mount, setting),
    lambda: None,
)
