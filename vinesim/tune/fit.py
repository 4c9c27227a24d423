"""The result of a fit: as text, as JSON, and as a file of plant parameters for scenes."""

from __future__ import annotations

import dataclasses
import datetime
import math
import pathlib
import re
from typing import Any

import msgspec
import numpy as np

from vinesim.core.data_files import find_data_file
from vinesim.core.errors import writing
from vinesim.scene.plant_parameters import Specimen
from vinesim.tune.features import Features
from vinesim.tune.posterior import Z90, Posterior, Sample
from vinesim.tune.priors import Prior
from vinesim.tune.problem import SOFT
from vinesim.tune.trajectory import Trajectory

_UNITS = {"modulus": "Pa", "damping": "s", "mass": "1", "bow_y": "rad", "bow_z": "rad"}
WEAK = 0.3
"""Smallest share of a parameter in the direction of a ridge with which the data do not decide the parameter [1]."""
_LOGARITHMIC = ("modulus", "damping", "mass")


@dataclasses.dataclass(frozen=True, slots=True)
class Minimum:
    """A minimum of the loss of a fit, other than the best minimum."""

    modulus: float
    """Young's modulus of the plant at this minimum [Pa]."""
    loss_ratio: float
    """Ratio of this minimum's loss to the loss of the best minimum [1]."""


@dataclasses.dataclass(frozen=True, slots=True)
class Estimate:
    """One fitted number of a plant, with its 90 % interval and its prior."""

    name: str
    value: float
    low: float
    """Lower end of the 90 % interval of the number; ``high`` is its upper end."""
    high: float
    unit: str
    prior: str
    """Text with the 90 % interval of the number before the fit (prior), and the source of this interval."""
    known: bool
    """Whether the number is determined by the track rather than by the prior."""


@dataclasses.dataclass(frozen=True, slots=True)
class Comparison:
    """A fitted number beside its true value, which only simulated experiments have."""

    name: str
    truth: float
    value: float
    low: float
    """Lower end of the 90 % interval."""
    high: float
    unit: str

    @property
    def inside(self) -> bool:
        """Whether the 90 % interval contains the truth."""
        return self.low <= self.truth <= self.high

    def line(self) -> str:
        """Returns the comparison as one line of text."""
        off = f"{100.0 * (self.value / self.truth - 1.0):+.2f} %" if self.truth else f"{self.value:+.4f} {self.unit}"
        where = "inside" if self.inside else "outside"
        gaps = (self.high - self.low, abs(self.truth - self.low), abs(self.truth - self.high))
        numbers = (_rounded(x, min(gaps)) for x in (self.truth, self.value, self.low, self.high))
        truth, value, low, high = numbers
        return (
            f"truth    {self.name} {truth} {self.unit}; estimate {value} ({off}), {where} the 90 % interval {low} to "
            f"{high}"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """The result of :func:`vinesim.tune.tune`."""

    specimen: Specimen
    """The measured plant with its numbers before the fit."""
    track: Trajectory
    features: Features
    """Frequency, logarithmic decrement and other features of the track, found without a plant model, for comparison."""
    posterior: Posterior
    sample: Sample | None
    """Random samples of the posterior; None unless they were requested."""
    noise: float
    """[m] Robust standard deviation of the residuals (track minus fitted track) of all columns together."""
    column_noise: np.ndarray
    """[column] m, robust standard deviation of the residuals of each column of the track (axis of a marker). Columns
    differ, because cameras measure distances less exactly than directions."""
    frequency: float
    """[Hz] Frequency of the swing of the fitted plant."""
    damping_ratio: float
    """[1] Damping ratio of the swing of the fitted plant."""
    model: np.ndarray
    """[sample, column] m, the track as the fitted plant would produce it, with a column for each tracked axis of a
    marker (:attr:`Trajectory.column_names`); NaN where ``track`` is NaN."""
    jacobian: np.ndarray
    """[observation, parameter] Derivatives of the fitted track with respect to the parameters."""
    minima: tuple[Minimum, ...]
    """Minima of the loss other than the best one, sorted by their loss."""
    faults: tuple[str, ...]
    """Reasons not to trust the fit; empty if there are none."""
    dt: float
    """[s] Duration of a step of the simulations of the fit."""
    force: tuple[float, float] | None
    """[N] Force on the tip that the gauge measured, and its standard deviation; None without a reading."""
    priors: dict[str, Prior]

    @property
    def ok(self) -> bool:
        """Whether the fit has no faults."""
        return not self.faults

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """The plant's fitted numbers, in SI units."""
        weak = {name for ridge in self.posterior.ridges for name, x in ridge.direction.items() if abs(x) > WEAK}
        return tuple(self._estimate(name, name not in weak) for name in self.posterior.names[: self.posterior.physical])

    def estimate(self, name: str) -> Estimate:
        """Returns the fitted number of this name."""
        return next(estimate for estimate in self.estimates if estimate.name == name)

    def compare(self, truth: Specimen) -> list[Comparison]:
        """Returns the plant's fitted numbers beside those of ``truth``."""
        true = {"modulus": truth.modulus.value, "damping": truth.damping.value}
        true |= {"mass": truth.density.value / self.specimen.density.value}
        true |= {"bow_y": truth.bow[0], "bow_z": truth.bow[1]}
        return [Comparison(e.name, true[e.name], e.value, e.low, e.high, e.unit) for e in self.estimates]

    def _estimate(self, name: str, known: bool) -> Estimate:
        low, high = self.posterior.interval(name)
        if self.sample is not None:
            low, high = np.quantile(self.sample.draws[:, self.posterior.names.index(name)], [0.05, 0.95]).tolist()
        middle = float(self.posterior.mean[self.posterior.names.index(name)])
        prior = self.priors[name]
        ends = [prior.mean - Z90 * prior.deviation, prior.mean + Z90 * prior.deviation]
        own = {"modulus": self.specimen.modulus.value, "damping": self.specimen.damping.value}.get(name, 1.0)
        if name in _LOGARITHMIC:
            middle, low, high, *ends = (own * math.exp(x) for x in (middle, low, high, *ends))
        words = f"{_short(ends[0])} to {_short(ends[1])} {_UNITS[name]}, {prior.source}"
        return Estimate(name, middle, low, high, _UNITS[name], words, known)

    @property
    def outliers(self) -> int:
        """Number of samples that have less than half of the full weight, or that are left out as gross errors."""
        off = np.abs(self.model - self.track.position[:, self.track.tracked]) / self.column_noise
        return int(((off > math.sqrt(3.0) * SOFT) | self.features.gross).sum())

    @property
    def left_out(self) -> int:
        """Number of samples that are left out as gross errors."""
        return int(self.features.gross.sum())

    @property
    def gaps(self) -> int:
        """Number of positions that are missing in the track."""
        return int(np.isnan(self.track.position[:, self.track.tracked]).sum())

    # ------------------------------------------------------------------ words

    def lines(self) -> list[str]:
        """Returns the fit as text, one fact in each line."""
        f = self.features
        lines = []
        lines.append(f"{'fitted' if self.ok else 'FAILED'}: {self.track.source}, {len(self.track.time)} samples")
        for e in self.estimates:
            note = "" if e.known else "  NOT DECIDED BY THE DATA"
            value, low, high = (_rounded(x, e.high - e.low) for x in (e.value, e.low, e.high))
            lines.append(f"{e.name:8s} {value} {e.unit}, 90 % {low} to {high}{note}")
            lines.append(f"{'':8s} before: {e.prior}")
        lines.append(
            f"swing    {self.frequency:.3f} Hz, damping ratio {self.damping_ratio:.4f}; of the track alone: "
            f"{f.frequency:.3f} Hz, {f.damping_ratio:.4f} (log decrement {f.log_decrement:.3f})"
        )
        lines.append(
            f"noise    {self._noise_words()}; {self.outliers - self.left_out} outliers have less weight, "
            f"{self.left_out} are left out; {self.gaps} positions missing"
        )
        for ridge in self.posterior.ridges:
            lines.append(f"ridge    {_ridge_words(ridge.direction)}: {self._remedy(ridge.direction)}")
        for minimum in self.minima[:3]:
            lines.append(
                f"minimum  another at {_short(minimum.modulus)} Pa, with {minimum.loss_ratio:.1f} times the loss"
            )
        return lines + [f"fault    {fault}" for fault in self.faults]

    def _noise_words(self) -> str:
        """Returns a text about the noise of each column, with a single value if all are alike."""
        low = float(self.column_noise.min())
        high = float(self.column_noise.max())
        if high < 2.0 * low:
            return f"{1e3 * self.noise:.2f} mm"
        names = (
            f"{1e3 * noise:.2f} mm in {name}"
            for name, noise in zip(self.track.column_names, self.column_noise, strict=True)
        )
        return ", ".join(names)

    def _remedy(self, direction: dict[str, float]) -> str:
        if "modulus" in direction and "mass" in direction and self.track.base is not None:
            return "shaking determines only the ratio of modulus to mass; fix the mass, or measure a pull and its force"
        if "modulus" in direction and "mass" in direction and self.force is None:
            return (
                "a free swing determines only the ratio of modulus to mass; fix the mass, or add a column 'force [N]' "
                "of the pull"
            )
        return "the value is mostly the prior's; fix one of the numbers, or measure it otherwise"

    def as_json(self) -> dict[str, Any]:
        """Returns the fit as plain values for JSON."""
        return {
            "ok": self.ok,
            "source": self.track.source,
            "estimates": [dataclasses.asdict(e) for e in self.estimates],
            "frequency_hz": self.frequency,
            "damping_ratio": self.damping_ratio,
            "track": {
                "frequency_hz": self.features.frequency,
                "damping_ratio": self.features.damping_ratio,
                "log_decrement": self.features.log_decrement,
                "release_s": self.features.release,
            },
            "noise_m": self.noise,
            "column_noise_m": dict(zip(self.track.column_names, self.column_noise.tolist(), strict=True)),
            "outliers": self.outliers,
            "left_out": self.left_out,
            "gaps": self.gaps,
            "ridges": [dataclasses.asdict(ridge) for ridge in self.posterior.ridges],
            "minima": [dataclasses.asdict(minimum) for minimum in self.minima],
            "faults": list(self.faults),
        }

    # ------------------------------------------------------------------ file

    def fitted_specimen(self) -> Specimen:
        """Returns the specimen with its fitted numbers. They have the grade FITTED, or GUESSED if the track does not
        determine them: together they still swing as the track does."""
        text = f"{datetime.date.today().isoformat()}, vinesim tune of {self.track.source}"
        changes: dict[str, Any] = {}
        bow = list(self.specimen.bow)
        for e in self.estimates:
            told = f"{text}: 90 % {_short(e.low)} to {_short(e.high)}"
            if e.name.startswith("bow"):
                bow["yz".index(e.name[-1])] = float(_short(e.value))
            for field in {"modulus": ("modulus",), "damping": ("damping",), "mass": ("density", "tip_mass")}.get(
                e.name, ()
            ):
                number = getattr(self.specimen, field)
                if number is not None:
                    value = number.value * e.value if e.name == "mass" else e.value
                    told = told + " times" * (e.name == "mass") + "; not decided by the track" * (not e.known)
                    grade = "FITTED" if e.known else "GUESSED"
                    changes[field] = _replaced(number, float(f"{value:.5g}"), told, grade)
        return msgspec.structs.replace(self.specimen, bow=(bow[0], bow[1]), **changes)

    def write_plant(self, path: str | pathlib.Path, plant: str = "vine") -> None:
        """Write a file of plant parameters for scenes (``plants = "FILE"``).

        The file contains the parameters of ``plant`` with the fitted numbers, and the table ``[specimen]``. A cane's
        modulus becomes ``woody_modulus``; ``green_modulus`` is scaled by the same factor.
        """
        text = find_data_file("plants", plant, ".toml").read_text("utf-8")
        text = text.split("\n[specimen]")[0].rstrip() + "\n"
        fitted = self.fitted_specimen()
        part = "cane" if fitted.organ == "cane" else "peduncle"
        keys = {"modulus": "woody_modulus" if part == "cane" else "modulus", "damping": "damping", "density": "density"}
        for field, key in keys.items():
            number = getattr(fitted, field)
            if number is not getattr(self.specimen, field):
                if key == "woody_modulus":
                    text = _scale_green(text, number)
                text = _replace_line(text, part, key, number)
        if part == "peduncle" and fitted.tip_mass is not None and fitted.tip_mass is not self.specimen.tip_mass:
            text = _replace_line(text, "bunch", "mass", fitted.tip_mass)
        with writing(path):
            pathlib.Path(path).write_text(text + "\n" + specimen_toml(fitted), encoding="utf-8")


def _ridge_words(direction: dict[str, float]) -> str:
    """Returns a sentence about a direction that the data hardly determine, without names that hardly take part."""
    strong = {name: x for name, x in direction.items() if abs(x) > WEAK}
    first, *rest = sorted(strong, key=lambda name: -abs(strong[name]))
    others = [f"{name} {'rises' if strong[name] * strong[first] > 0.0 else 'falls'}" for name in rest]
    return f"the track hardly changes if {first} rises" + f" and {', '.join(others)} with it" * bool(others)


def specimen_toml(specimen: Specimen) -> str:
    """Returns the table ``[specimen]`` as TOML text."""
    lines = ["[specimen]", f'organ = "{specimen.organ}"']
    for name in ("length", "base_diameter", "tip_diameter", "modulus", "density", "damping", "tip_mass"):
        number = getattr(specimen, name)
        if number is not None:
            lines.append(f"{name} = {_number(number)}")
    if specimen.direction is not None:
        lines.append(f"direction = {list(specimen.direction)}")
    if specimen.axis:
        lines.append("axis = [\n" + "".join(f"    {list(point)},\n" for point in specimen.axis) + "]")
    else:
        lines.append(f"bow = {list(specimen.bow)}")
    lines.append(f"segments = {specimen.segments}")
    if specimen.markers:
        lines.append("markers = { " + ", ".join(f'"{k}" = {v}' for k, v in specimen.markers.items()) + " }")
    return "\n".join(lines) + "\n"


def _number(number: Any) -> str:
    source = number.source.replace("\\", "/").replace('"', "'")
    return (
        f'{{ value = {float(number.value)!r}, unit = "{number.unit}", grade = "{number.grade}", source = "{source}" }}'
    )


def _replaced(number: Any, value: float, source: str, grade: str) -> Any:
    return msgspec.structs.replace(number, value=value, grade=grade, source=source)


def _replace_line(text: str, table: str, key: str, number: Any) -> str:
    """Returns the text of a TOML file with the line of the number ``key`` in ``table`` replaced."""
    before, head, after = re.split(rf"(^\[{table}\][^\n]*\n)", text, maxsplit=1, flags=re.MULTILINE)
    after = re.sub(rf"^{key} = [^\n]*", lambda _: f"{key} = {_number(number)}", after, count=1, flags=re.MULTILINE)
    return before + head + after


def _scale_green(text: str, woody: Any) -> str:
    """Returns the text of a TOML file with a shoot's green modulus scaled, so that its ratio to the woody modulus is
    unchanged."""
    values = [
        float(re.search(rf"^{key} = {{ value = ([^,]+),", text, re.MULTILINE)[1])  # pyright: ignore[reportOptionalSubscript]
        for key in ("woody_modulus", "green_modulus")
    ]
    source = f"as far below the woody modulus as before; {woody.source}"
    return _replace_line(
        text,
        "cane",
        "green_modulus",
        _replaced(woody, float(f"{woody.value * values[1] / values[0]:.5g}"), source, woody.grade),
    )


def _rounded(value: float, gap: float) -> str:
    """Returns a number with four digits, or with as many as tell it from a number at the distance ``gap``."""
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(gap)) + 1 if value and gap > 0.0 else 4
    return f"{value:#.{min(max(digits, 4), 9)}g}".rstrip(".")


def _short(value: float) -> str:
    return f"{value:.4g}"
