"""Warnings about plants that no vine has: one line for each number outside of what was measured. Such a plant is
simulated nevertheless."""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
import logging
from collections.abc import Iterator

log = logging.getLogger(__name__)

MOST_LINES = 100
"""Number of different warnings after which a process prints no more of them."""


@dataclasses.dataclass(frozen=True, slots=True)
class PlausibleRange:
    """The values of a quantity that plants have."""

    low: float
    high: float
    unit: str
    source: str


RANGES = {
    "diameter": PlausibleRange(
        0.001,
        0.11,
        "m",
        "rachis 2.5 mm, canes 4 to 10.5 mm, arms to 34 mm, trunk to 104 mm: data/plants/vine.toml",
    ),
    "density": PlausibleRange(
        300.0, 1300.0, "kg/m^3", "fresh shoots 800 to 1050 kg/m^3: data/plants/vine.toml; dry wood is lighter"
    ),
    "modulus": PlausibleRange(
        5e7,
        2e10,
        "Pa",
        "green shoots from 0.2 GPa, woody 5.89 GPa: Bu et al. 2025, BioResources 20(3):6662; dry wood to 15 GPa",
    ),
    "mass": PlausibleRange(
        0.001,
        3.0,
        "kg",
        "bunches 0.25 to 1 kg: data/plants/vine.toml; ends guessed: a marker, the heaviest bunches",
    ),
    "frequency": PlausibleRange(
        0.2, 50.0, "Hz", "fruit branches 11.8 +- 4.5 Hz: TCSAE 2011; steps of 10 ms resolve up to 50 Hz"
    ),
}
"""Range of each quantity, with its source."""

_silent: contextvars.ContextVar[bool] = contextvars.ContextVar("_silent", default=False)
_told: set[str] = set()


def check(place: str, quantity: str, value: float, name: str | None = None) -> None:
    """Log one warning if ``value`` is outside the range of a ``quantity``, a key of :data:`RANGES`.

    A text is logged once in a process. ``place``: what has the value; ``name``: the name of the value for the user, by
    default ``quantity``.
    """
    known = RANGES[quantity]
    if known.low <= value <= known.high or _silent.get() or len(_told) >= MOST_LINES:
        return
    line = (
        f"{place}: {name or quantity} is {value:.3g} {known.unit}; plants have {known.low:g} to {known.high:g} "
        f"{known.unit} ({known.source}); check the unit"
    )
    if line not in _told:
        _told.add(line)
        log.warning("%s", line)


def check_rod(place: str, radius: tuple[float, float]) -> None:
    """Check the diameters of a rod with the ``radius`` [m] at its base and at its tip."""
    base, tip = (2.0 * float(one) for one in radius)
    check(place, "diameter", base, "diameter" if base == tip else "diameter at its base")
    if base != tip:
        check(place, "diameter", tip, "diameter at its tip")


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Within this context, :func:`check` logs nothing: for trial values of a search."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)
