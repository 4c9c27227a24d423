"""Synthetic laboratories of ``vinesim bench tune``: canes and bunches, start values, and times of release.

Canes of 1 m (9 to 6 mm, 900 kg/m^3), modulus 2 to 9 GPa, damping ratio 0.01 to 0.1, pulled by 10 cm. Bunches of 0.5 kg
on a peduncle of 8 cm (4.5 mm), modulus 0.15 to 0.6 GPa, damping 25 to 100 ms, pulled by 4 cm. 30 pictures a second for
3 s with 2 mm of noise in each axis; start values up to five times off.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.scene.plant_parameters import Number, Specimen
from vinesim.tune import Experiment

MODULUS_BAR = 0.03
DAMPING_BAR = 0.15
"""Largest accepted relative error of a fitted damping; ``MODULUS_BAR`` is for the modulus."""
BUNCH_MODULUS_BAR = 0.1
"""Largest accepted relative error of the modulus of a peduncle: the weight of the bunch hides its stiffness."""


@dataclasses.dataclass(frozen=True, slots=True)
class Case:
    """One synthetic laboratory."""

    truth: Specimen
    guess: Specimen
    """Specimen with the start values that a user would give."""
    experiment: Experiment


def _number(value: float, unit: str) -> Number:
    return Number(value, unit, "GUESSED", "benchmark")


def bench_cane(modulus: float, damping: float, segments: int = 8) -> Specimen:
    """Returns the cane of this benchmark; ``modulus`` [Pa], ``damping`` [s], ``segments``: number of rigid bodies."""
    return Specimen(
        organ="cane",
        length=_number(1.0, "m"),
        base_diameter=_number(0.009, "m"),
        tip_diameter=_number(0.006, "m"),
        modulus=_number(modulus, "Pa"),
        density=_number(900.0, "kg/m^3"),
        damping=_number(damping, "s"),
        segments=segments,
    )


def draw_case(seed: int) -> Case:
    """Draw a case from a ``seed``: modulus, damping, start values and the time of release."""
    rng = np.random.default_rng(seed)
    modulus = 1e9 * math.exp(rng.uniform(math.log(2.0), math.log(9.0)))
    ratio = math.exp(rng.uniform(math.log(0.01), math.log(0.1)))
    damping = ratio / (math.pi * 3.48 * math.sqrt(modulus / 5e9))
    off = np.exp(rng.uniform(-math.log(5.0), math.log(5.0), 2))
    experiment = Experiment(seed=seed, hold=0.2 + float(rng.uniform(0.0, 1.0 / 30.0)))
    return Case(bench_cane(modulus, damping), bench_cane(modulus * off[0], damping * off[1]), experiment)


def bench_bunch(modulus: float, damping: float) -> Specimen:
    """Returns the bunch of this benchmark; ``modulus`` [Pa], ``damping`` [s]."""
    return Specimen(
        organ="bunch",
        length=_number(0.08, "m"),
        base_diameter=_number(0.0045, "m"),
        tip_diameter=_number(0.0045, "m"),
        modulus=_number(modulus, "Pa"),
        density=_number(1000.0, "kg/m^3"),
        damping=_number(damping, "s"),
        tip_mass=_number(0.5, "kg"),
        segments=4,
    )


def draw_bunch(seed: int) -> Case:
    """Draw a case of a bunch from a ``seed``: modulus, damping, start values and the time of release."""
    rng = np.random.default_rng(seed)
    modulus, damping = (middle * math.exp(rng.uniform(-math.log(2.0), math.log(2.0))) for middle in (0.3e9, 0.05))
    off = np.exp(rng.uniform(-math.log(5.0), math.log(5.0), 2))
    experiment = Experiment(seed=seed, displacement=0.04, hold=0.2 + float(rng.uniform(0.0, 1.0 / 30.0)))
    return Case(bench_bunch(modulus, damping), bench_bunch(modulus * off[0], damping * off[1]), experiment)
