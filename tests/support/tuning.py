"""Specimens whose numbers tests choose."""

from __future__ import annotations

from vinesim.scene.plant_parameters import Number, Specimen


def number(value: float, unit: str) -> Number:
    return Number(value, unit, "GUESSED", "test")


def cane(modulus: float = 5e9, damping: float = 0.004, **changes: object) -> Specimen:
    """A metre of cane, 9 to 6 mm thick: 3.5 Hz."""
    fields: dict = {
        "length": number(1.0, "m"), "base_diameter": number(0.009, "m"), "tip_diameter": number(0.006, "m"),
        "density": number(900.0, "kg/m^3"),
    }  # fmt: skip
    return Specimen(
        organ="cane", modulus=number(modulus, "Pa"), damping=number(damping, "s"), **(fields | changes)
    )  # fmt: skip


def bunch(modulus: float = 0.3e9, damping: float = 0.05) -> Specimen:
    """Half a kilogram on a peduncle of 8 cm: 1.4 Hz."""
    return Specimen(
        organ="bunch", length=number(0.08, "m"), base_diameter=number(0.0045, "m"),
        tip_diameter=number(0.0045, "m"), modulus=number(modulus, "Pa"), density=number(1000.0, "kg/m^3"),
        damping=number(damping, "s"), tip_mass=number(0.5, "kg"), segments=4,
    )  # fmt: skip
