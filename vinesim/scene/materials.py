"""Materials of surfaces: friction and contact stiffness of each pair of materials, read from ``data/materials``."""

from __future__ import annotations

import enum
import functools
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np

from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import DataError, load_toml
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.plant_parameters import Number


class Material(enum.IntEnum):
    """Material of a body's surface, as far as contacts depend on it."""

    UNKNOWN = 0
    """Material for which the table lists no pair."""
    BARK = 1
    """Canes, arms and trunks."""
    SHOOT = 2
    """Green shoots and stalks of bunches."""
    BERRY = 3
    """Skin of berries."""
    HAND = 4
    """Skin of people's hands."""
    RUBBER = 5
    PLASTIC = 6
    STEEL = 7
    """Steel and other bare metal."""
    SOIL = 8
    LEAF = 9


OF_ORGAN = {
    Organ.GROUND: Material.SOIL,
    Organ.WIRE: Material.STEEL,
    Organ.TRUNK: Material.BARK,
    Organ.ARM: Material.BARK,
    Organ.CANE: Material.BARK,
    Organ.PEDUNCLE: Material.SHOOT,
    Organ.BUNCH: Material.BERRY,
    Organ.BOX: Material.PLASTIC,
}
"""Materials of plants, trellis and crates; poles are missing, because their material is unknown."""


class Quantity(NamedTuple):
    """A contact property that has a value for each pair of materials."""

    unit: str
    """Unit of the value in the file."""
    default: Callable[[PhysicsParameters], float]
    """Function that returns the value of pairs that the file does not list."""


QUANTITIES = {
    "friction": Quantity("1", lambda p: p.friction),
    "stiffness": Quantity("N/m", lambda p: p.contact_stiffness),
}
"""Contact properties, by the name of their table in the file. Contacts use those that are fields of
:class:`vinesim.kernels.contact.friction_law.Surface`."""

_ContactFile = msgspec.defstruct(
    "_ContactFile", [(name, dict[str, Number], {}) for name in QUANTITIES], frozen=True, forbid_unknown_fields=True
)
"""Structure of a file in ``data/materials``: one table for each quantity, with numbers by pair of materials, such as
``bark-steel``, in either order.
"""


def materials_of_organs(organs: np.ndarray) -> np.ndarray:
    """Returns the :class:`Material` [k], int32, of pieces of plants and trellis with the given ``organs`` [k]
    (:class:`Organ`)."""
    table = np.zeros(max(Organ) + 1, np.int32)
    for organ, material in OF_ORGAN.items():
        table[organ] = material
    return table[organs]


def pair_table(quantity: str, default: float, name: str = "contact") -> np.ndarray:
    """Returns the values of one of :data:`QUANTITIES` for all pairs of materials, symmetric [material, material].

    ``default`` is used for pairs that the file does not list. ``name`` is the name of a file in ``data/materials``, or
    a path. Raises :class:`DataError` for an unknown pair or a wrong unit.
    """
    table = np.full((len(Material), len(Material)), float(default))
    for (a, b), value in _listed(quantity, name).items():
        table[a, b] = table[b, a] = value
    return table


def pair_tables(parameters: PhysicsParameters) -> dict[str, np.ndarray]:
    """Returns the values of all :data:`QUANTITIES` for all pairs of materials, each [material, material]."""
    return {name: pair_table(name, quantity.default(parameters)) for name, quantity in QUANTITIES.items()}


def pair_numbers(name: str = "contact") -> dict[str, dict[str, Number]]:
    """Returns all numbers of the file with their sources, by quantity and by pair as written in the file."""
    return msgspec.structs.asdict(load_toml(find_data_file("materials", name, ".toml"), _ContactFile))


@functools.cache
def _listed(quantity: str, name: str) -> dict[tuple[int, int], float]:
    path = find_data_file("materials", name, ".toml")
    known = {material.name.lower(): int(material) for material in Material if material}
    pairs: dict[tuple[int, int], float] = {}
    for text, number in pair_numbers(name)[quantity].items():
        place = f"{path}: {quantity}.{text}"
        words = text.split("-")
        if len(words) != 2 or not known.keys() >= set(words):
            raise DataError(f"{place} is no pair of materials; give two of {', '.join(known)} with a hyphen between")
        if number.unit != QUANTITIES[quantity].unit:
            raise DataError(f"{place}.unit is {number.unit!r}; give the value in {QUANTITIES[quantity].unit!r}")
        if not number.value > 0.0:
            raise DataError(f"{place}.value is {number.value}; give a number above 0")
        first, second = sorted(known[word] for word in words)
        if (first, second) in pairs:
            raise DataError(f"{place} is given twice; remove one of the two")
        pairs[first, second] = number.value
    return pairs
