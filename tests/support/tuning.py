"""Specimens whose numbers tests choose."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from vinesim.scene.plant_parameters import Number, Specimen
from vinesim.tune.candidates import COLUMNS, Candidates


def number(value: float, unit: str) -> Number:
    return Number(value, unit, "GUESSED", "test")


def cane(modulus: float = 5e9, damping: float = 0.004, **changes: object) -> Specimen:
    """A metre of cane, 9 to 6 mm thick: 3.5 Hz."""
    fields: dict = {
        "length": number(1.0, "m"),
        "base_diameter": number(0.009, "m"),
        "tip_diameter": number(0.006, "m"),
        "density": number(900.0, "kg/m^3"),
    }
    return Specimen(organ="cane", modulus=number(modulus, "Pa"), damping=number(damping, "s"), **(fields | changes))


def bunch(modulus: float = 0.3e9, damping: float = 0.05) -> Specimen:
    """Half a kilogram on a peduncle of 8 cm: 1.4 Hz."""
    return Specimen(
        organ="bunch",
        length=number(0.08, "m"),
        base_diameter=number(0.0045, "m"),
        tip_diameter=number(0.0045, "m"),
        modulus=number(modulus, "Pa"),
        density=number(1000.0, "kg/m^3"),
        damping=number(damping, "s"),
        tip_mass=number(0.5, "kg"),
        segments=4,
    )


def hanging(specimen: Specimen, modulus: float = 1.0, mass: float = 1.0) -> np.ndarray:
    """Points [100, 3] m on the axis of a cane that hangs at rest, at every hundredth of its length, with so many times
    its modulus and mass."""
    places = specimen.length.value * np.linspace(0.01, 1.0, 100)
    marked = msgspec.structs.replace(specimen, markers={f"p{i}": float(place) for i, place in enumerate(places)})
    row = np.zeros((1, len(COLUMNS)))
    row[0, :5] = math.log(modulus), 0.0, math.log(mass), *specimen.bow
    return Candidates(marked, tuple(marked.markers), dt=0.01).shape(row)[0]


def scan(axis: np.ndarray, count: int = 4000, noise: float = 1e-3) -> np.ndarray:
    """Points [n, 3] m on the bark about an axis that begins at the origin, in any order."""
    rng = np.random.default_rng(3)
    line = np.concatenate([np.zeros((1, 3)), axis])
    at = rng.uniform(0.0, len(line) - 1.0, count)
    points = np.stack([np.interp(at, np.arange(len(line)), line[:, i]) for i in range(3)], -1)
    side = rng.normal(size=(count, 3))
    return points + 0.004 * side / np.linalg.norm(side, axis=1, keepdims=True) + rng.normal(0.0, noise, (count, 3))
