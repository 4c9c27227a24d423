"""Simulates laboratory experiments on a specimen with noise, and predicts how uncertain a fit to them would be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from vinesim.core.errors import UsageError
from vinesim.scene.plant_parameters import Specimen
from vinesim.tune.base_motion import Sweep
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.specimen import TIP
from vinesim.tune.trajectory import Trajectory
from vinesim.tune.tuning import tune

TRUTH_STEP = 1e-3
"""[s] Step of the simulation that represents the real plant."""
TRUTH_SEGMENTS = 64
"""Smallest number of segments in the simulation that represents the real plant."""
HIDDEN = 2.0
"""[1] Largest ratio of the modulus and damping of a hidden specimen to those of its model, and the reverse."""
MAX_SHARE = 0.3
"""[1] Largest ratio of the shaking frequency to the picture rate; beyond it samples do not determine acceleration."""
KINDS = {
    "pull-release": {"displacement": 0.1, "duration": 3.0},
    "push": {"displacement": 0.1, "duration": 3.0},
    "shake": {"amplitude": 0.005, "from_frequency": 1.0, "to_frequency": 8.0, "duration": 10.0},
}
"""Kinds of experiments, each with its specific numbers and their default values (m, Hz, s)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment:
    """A laboratory experiment on a plant: how the plant is moved and observed. A number that is None has its default in
    :data:`KINDS`, see :meth:`number`."""

    kind: str = "pull-release"
    """``pull-release``: held aside, then released after :attr:`hold`. ``push``: at rest, then a steady force on its
    tip. ``shake``: at rest, then its base is shaken in a sine sweep."""
    displacement: float | None = None
    """[m] Displacement of the tip by the pull, or by the push after it has come to rest."""
    angle: float = 90.0
    """[deg] Direction of the force or of the shaking about the base's x axis: 0 along its y, 90 along its z axis."""
    amplitude: float | None = None
    """[m] Amplitude of the shaken base."""
    from_frequency: float | None = None
    """[Hz] Frequency at the start of the sweep."""
    to_frequency: float | None = None
    """[Hz] Frequency at the end of the sweep."""
    duration: float | None = None
    """[s] Duration of the recording after the force begins or ends, or of the sweep."""
    hold: float = 0.2
    """Duration of the recording before the force begins or ends, or before the sweep [s]."""
    rate: float = 30.0
    """[1/s] Picture rate."""
    noise: float = 0.002
    """[m] Standard deviation of a tracked position, in each axis."""
    force_noise: float | None = None
    """[1] Standard deviation of the force gauge relative to its reading; None: no gauge."""
    markers: tuple[str, ...] = (TIP,)
    axes: str = "xyz"
    """World axes along which positions are tracked, such as ``xz``."""
    seed: int = 0

    def number(self, name: str) -> float:
        """Returns the number ``name`` of this experiment: the given one, or the default of its kind."""
        given = getattr(self, name)
        return KINDS[self.kind][name] if given is None else given

    def check(self) -> None:
        """Raise :class:`UsageError` for the first number that is out of range or belongs to another kind."""
        if self.kind not in KINDS:
            raise UsageError(f"no experiment {self.kind!r}; there are: {', '.join(KINDS)}")
        for name in sorted({name for numbers in KINDS.values() for name in numbers} - KINDS[self.kind].keys()):
            if (value := getattr(self, name)) is not None:
                others = " or ".join(kind for kind, numbers in KINDS.items() if name in numbers)
                raise UsageError(
                    f"{name} is {value}, but belongs to {others}, not to {self.kind}; leave it out, or take {others}"
                )
        for name in ("displacement", "amplitude", "from_frequency", "to_frequency", "duration", "rate"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise UsageError(f"{name} is {value}; give a finite number above 0")
        if self.kind == "shake":
            fastest = max(self.number("from_frequency"), self.number("to_frequency"))
            if fastest > MAX_SHARE * self.rate:
                raise UsageError(
                    f"the sweep reaches {fastest:g} Hz, for which {self.rate:g} pictures a second are too few; give "
                    f"a rate of {fastest / MAX_SHARE:g} or more, or lower frequencies"
                )
            if self.force_noise is not None:
                raise UsageError(f"force_noise is {self.force_noise}, but a shaken plant is not pulled; leave it out")
        for name in ("hold", "noise", "force_noise"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise UsageError(f"{name} is {value}; give a finite number of 0 or more")
        if not self.axes or set(self.axes) - set("xyz"):
            raise UsageError(f"axes is {self.axes!r}; give one or more of x, y, z")


def measure(
    specimen: Specimen,
    experiment: Experiment = Experiment(),
    *,
    exact: bool = False,
    step: float = TRUTH_STEP,
    segments: int = TRUTH_SEGMENTS,
) -> Trajectory:
    """Simulate an experiment on a specimen in steps of ``step`` [s] with at least ``segments`` segments, and return its
    track; ``exact``: without noise."""
    experiment.check()
    e = experiment
    rng = np.random.default_rng(experiment.seed)
    specimen = msgspec.structs.replace(specimen, segments=max(segments, specimen.segments))
    candidates = Candidates(specimen, e.markers, dt=step)
    row = np.zeros((1, len(COLUMNS)))
    row[0, 3:5] = specimen.bow
    shaking = _sweep(candidates, e) if e.kind == "shake" else None
    if shaking is None:
        row[0, 5:] = pull_for(candidates, e.number("displacement"), math.radians(e.angle))
    time = np.arange(math.ceil((e.hold + e.number("duration")) * e.rate - 1e-9)) / e.rate
    after = time if shaking else np.maximum(time - e.hold, 0.0)
    tick = np.floor(after / step + 1e-6).astype(int)
    ticks, index = np.unique(tick, return_inverse=True)
    moved = shaking.velocity(step * np.arange(ticks[-1] + 2)) if shaking else None
    motion = candidates.run(row, ticks, pushed=e.kind == "push", base_velocity=moved)
    position = motion.at(index, (after - tick * step)[None])[0][0].astype(float)
    base = shaking.position(time) if shaking else None
    if base is not None:
        position += base[:, None]
    held = time <= e.hold
    force = None
    if e.force_noise is not None:
        size = float(np.linalg.norm(row[0, 5:]))
        force = np.where(held if e.kind == "pull-release" else ~held, size, 0.0)
        force = force * (1.0 + (0.0 if exact else e.force_noise) * rng.normal())  # the error of a gauge is one of scale
    if not exact:
        position += rng.normal(0.0, e.noise, position.shape)
    for axis in range(3):
        if "xyz"[axis] not in e.axes:
            position[..., axis] = np.nan
    return Trajectory(time, position, e.markers, force, f"{e.kind} of seed {e.seed}", base)


def hidden_specimen(specimen: Specimen, seed: int) -> Specimen:
    """Returns a specimen whose modulus and damping are drawn from a ``seed``: up to :data:`HIDDEN` times more or less
    than those of ``specimen``, with logarithms of equal probability. A fit that begins at ``specimen`` has to find
    them."""
    rng = np.random.default_rng((seed, 1))  # the noise of the track has the seed alone
    factor = np.exp(rng.uniform(-math.log(HIDDEN), math.log(HIDDEN), 2)).tolist()
    numbers = {
        name: msgspec.structs.replace(
            number, value=number.value * one, grade="GUESSED", source=f"drawn from seed {seed}, about {number.value:g}"
        )
        for name, number, one in zip(("modulus", "damping"), (specimen.modulus, specimen.damping), factor, strict=True)
    }
    return msgspec.structs.replace(specimen, **numbers)


def _sweep(candidates: Candidates, experiment: Experiment) -> Sweep:
    """Returns the motion of the shaken base."""
    e = experiment
    angle = math.radians(experiment.angle)
    direction = np.array([math.cos(angle), math.sin(angle)]) @ candidates.pull_axes()
    direction[np.abs(direction) < 1e-12] = 0.0  # avoids a column of rounding errors
    frequencies = e.number("from_frequency"), e.number("to_frequency")
    return Sweep(direction, e.number("amplitude"), frequencies, e.hold, e.number("duration"))


def pull_for(candidates: Candidates, displacement: float, angle: float) -> np.ndarray:
    """Returns the pull [2] N along the base's y and z that moves the tip by ``displacement`` [m] at ``angle`` [rad].

    Raises :class:`UsageError` if there is no such pull.
    """
    specimen = candidates.specimen
    tip = Candidates(specimen, (TIP,), dt=candidates.dt)
    way = np.array([math.cos(angle), math.sin(angle)])
    row = np.zeros((2, len(COLUMNS)))
    row[:, 3:5] = specimen.bow
    size = 0.01 * 3.0 * specimen.modulus.value * math.pi * (0.5 * specimen.base_diameter.value) ** 4
    size = size / 4.0 / specimen.length.value**2
    for _ in range(12):
        row[1, 5:] = size * way
        rest, moved = tip.shape(row)[:, 0]
        reached = float(np.linalg.norm(moved - rest))
        if abs(reached / displacement - 1.0) < 1e-3:
            return size * way
        size *= min(max(displacement / max(reached, 1e-9), 0.1), 10.0)
    reach = specimen.length.value
    raise UsageError(f"displacement is {displacement} m; a plant of {reach} m cannot be pulled that far; give less")


def expected_deviations(
    specimen: Specimen, track: Trajectory, parameters: Sequence[str] = ("modulus", "damping"), *, pushed: bool = False
) -> dict[str, float]:
    """Returns the standard deviation of each parameter's posterior after a fit to ``track``: relative, or in rad for
    bows."""
    fit = tune(specimen, track, parameters, pushed=pushed)
    if not fit.ok:
        raise UsageError(f"this experiment cannot be fitted: {fit.faults[0]}")
    return dict(zip(fit.posterior.names[: fit.posterior.physical], fit.posterior.deviation.tolist(), strict=False))
