"""Prior knowledge: the numbers in ``data/plants``, each with an uncertainty that depends on its grade."""

from __future__ import annotations

import dataclasses
import math

from vinesim.scene.plant_parameters import Specimen, load_plant

GRADE_DEVIATIONS = {"READ": 0.5, "DERIVED": 0.7, "GUESSED": 1.0, "FITTED": 0.3}
"""[1] Standard deviation of the natural logarithm by grade; it is large because plants differ."""
DENSITY_DEVIATION = 0.15
"""Standard deviation of the logarithm of wood density [1], from the range in ``data/plants``, 800 to 1050 kg/m^3."""
BOW_DEVIATION = 0.5
"""[rad] Standard deviation of a bow."""


@dataclasses.dataclass(frozen=True, slots=True)
class Prior:
    """A normal distribution of one fitted number."""

    mean: float
    deviation: float
    """Standard deviation; ``inf``: nothing is known."""
    source: str


def physical_priors(specimen: Specimen, plant: str = "vine") -> dict[str, Prior]:
    """Returns the priors of the numbers that belong to the plant, by the names of a candidate's columns."""
    known = load_plant(plant)
    part = known.cane if specimen.organ == "cane" else known.peduncle
    modulus = known.cane.woody_modulus if specimen.organ == "cane" else known.peduncle.modulus
    priors = {
        name: Prior(
            math.log(number.value / own.value), GRADE_DEVIATIONS[number.grade], f"{number.grade}: {number.source}"
        )
        for name, number, own in (
            ("modulus", modulus, specimen.modulus),
            ("damping", part.damping, specimen.damping),
        )
    }
    if specimen.organ == "cane":
        spread = DENSITY_DEVIATION
        source = f"{part.density.grade}: {part.density.source}"
    else:
        spread = known.bunch.mass_variation.value
        source = f"{known.bunch.mass_variation.grade}: variation of bunches"
    priors["mass"] = Prior(0.0, spread, source)
    for i, axis in enumerate("yz"):
        priors[f"bow_{axis}"] = Prior(specimen.bow[i], BOW_DEVIATION, "GUESSED: canes are bent by up to a radian")
    return priors
