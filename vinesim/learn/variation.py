"""How the worlds of a learning task differ: ranges of physical numbers, from a TOML file.

Each number is drawn evenly between the two ends of its range. A world keeps its numbers after a reset.
"""

from __future__ import annotations

import math
import pathlib

import msgspec

from vinesim.core.toml_loader import load_toml

MAX_DELAY = 25
"""Longest delay of an action, in actions (1 s)."""
Range = tuple[float, float]


class Variation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Ranges [low, high] of the numbers of the worlds.

    Raises :class:`ValueError` for a range that ends before it begins, a number that is not above 0, and a delay below 0
    or above :data:`MAX_DELAY`.
    """

    length: Range = (0.35, 0.6)
    """[m] Length of a shoot. GUESSED."""
    thickness: Range = (0.007, 0.01)
    """[m] Diameter of a shoot at its base. GUESSED."""
    modulus: Range = (2e9, 6e9)
    """[Pa] Young's modulus of a shoot. Woody canes have 5.9 GPa (three-point bending, Bu et al. 2025, BioResources
    20(3):6662); the lower end is GUESSED, for half-green ones."""
    damping: Range = (0.02, 0.02)
    """[s] Damping of a shoot's joints, per stiffness. GUESSED; bare canes have 0.008 s (docs/plants.md)."""
    cane: Range = (1.1, 1.5)
    """[m] Length of a dormant cane. GUESSED. The task *prune* refuses canes so short that they swing too fast."""
    peduncle: Range = (0.05, 0.1)
    """[m] Length of a peduncle. GUESSED."""
    bunch_mass: Range = (0.2, 0.5)
    """[kg] Mass of a bunch. GUESSED."""
    friction: Range = (1.0, 1.0)
    """Factor of all coefficients of friction of the plants. GUESSED: they are as in a client."""
    delay: tuple[int, int] = (0, 0)
    """Delay of an action, in whole actions of 40 ms. GUESSED: none."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(f"{name} from {low} to {high}: give finite numbers")
            if name == "delay" and (low, high) != (int(low), int(high)):
                raise ValueError(f"delay from {low} to {high}: give whole numbers of actions")
            if low > high:
                raise ValueError(f"{name} from {low} to {high}: give the lower end first")
            if name != "delay" and low <= 0.0:
                raise ValueError(f"{name} from {low}: give numbers above 0")
        if self.delay[0] < 0 or self.delay[1] > MAX_DELAY:
            raise ValueError(f"delay from {self.delay[0]} to {self.delay[1]}: give 0 to {MAX_DELAY} actions")


def as_variation(given: Variation | str | pathlib.Path) -> Variation:
    """Returns the variation in a TOML file, or the one given. Raises :class:`~vinesim.core.toml_loader.DataError` for a
    file that cannot be used."""
    return given if isinstance(given, Variation) else load_toml(pathlib.Path(given), Variation)
