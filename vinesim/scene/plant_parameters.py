"""Parameters of a grapevine: numbers read from ``data/plants``, each with unit, grade and source."""

from __future__ import annotations

import functools
import itertools
import math
import pathlib
import re
import typing
from typing import Annotated, Any, Literal

import msgspec

from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import DataError, load_toml, read_toml, to_struct
from vinesim.scene import plausibility

AXIS_LENGTH = 0.05
"""[1] Largest relative difference between the length of the axis (points along a measured cane) of a specimen and its
measured length.
"""
Grade = Literal["READ", "DERIVED", "GUESSED", "FITTED"]
"""Origin of a number: a publication, a derivation from one, a guess, or a fit to a measured plant."""


class Number(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number with its unit, its grade (see :data:`Grade`) and its source."""

    value: float
    unit: str
    grade: Grade
    source: str


class Range(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A range between two numbers, with its unit, its grade (see :data:`Grade`) and its source."""

    value: tuple[float, float]
    unit: str
    grade: Grade
    source: str

    def at(self, share: typing.Any) -> typing.Any:
        """Returns the value at the fraction ``share`` of the range: its lower end for 0, its upper end for 1."""
        return self.value[0] + (self.value[1] - self.value[0]) * share


class Colour(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A linear RGB reflectance, with its unit, its grade (see :data:`Grade`) and its source."""

    value: tuple[float, float, float]
    unit: str
    grade: Grade
    source: str


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Cane(_Part, frozen=True, kw_only=True):
    """Parameters of shoots of this year, which are woody at the base and green at the tip, and of their side shoots."""

    length: Annotated[Range, "m"]
    nodes: Annotated[Range, "1"]
    base_diameter: Annotated[Range, "m"]
    tip_diameter: Annotated[Number, "m"]
    woody_modulus: Annotated[Number, "Pa"]
    green_modulus: Annotated[Number, "Pa"]
    woody_share: Annotated[Number, "1"]
    density: Annotated[Number, "kg/m^3"]
    damping: Annotated[Number, "s"]
    first_bunch_node: Annotated[Range, "1"]
    lateral_share: Annotated[Number, "1"]
    lateral_length: Annotated[Range, "m"]
    lateral_diameter: Annotated[Number, "m"]
    drag: Annotated[Number, "1"]
    woody_strength: Annotated[Number, "Pa"] = Number(90e6, "Pa", "GUESSED", "as in vine.toml")
    """Modulus of rupture of the woody base; of green wood: ``green_strength``. See ``Model.body_strength``."""
    green_strength: Annotated[Number, "Pa"] = Number(45e6, "Pa", "GUESSED", "as in vine.toml")
    yield_share: Annotated[Number, "1"] = Number(0.65, "1", "GUESSED", "as in vine.toml")
    """Ratio of the stress above which wood keeps a set to its modulus of rupture."""
    toughness: Annotated[Number, "J/m^2"] = Number(1e4, "J/m^2", "GUESSED", "as in vine.toml")
    """Work that breaks cracked wood through, for each unit of its cross-section."""
    lateral_place: Annotated[Range, "1"] = Range((6 / 14, 11 / 14), "1", "GUESSED", "as in vine.toml")
    """Distance of a side shoot from the base of its shoot, as a share of the shoot's length."""
    lean_along: Annotated[Number, "1"] = Number(0.12, "1", "GUESSED", "shoots of a hedge that was tucked in carefully")
    """Standard deviation of the tangent of the angle at which a shoot of a hedge leaves the vertical, along the row."""
    lean_across: Annotated[Number, "1"] = Number(0.05, "1", "GUESSED", "catch wires hold shoots in the hedge's plane")
    """As ``lean_along``, across the row."""
    crookedness: Annotated[Number, "1"] = Number(1.0, "1", "GUESSED", "bends by 4 degrees from one piece to the next")
    """Bends between the pieces of a shoot of a hedge, in units of 0.07 along the row, 0.05 across and 0.03 upwards."""


class Peduncle(_Part, frozen=True, kw_only=True):
    """Parameters of peduncles: the stalks on which bunches hang."""

    length: Annotated[Range, "m"]
    diameter: Annotated[Range, "m"]
    modulus: Annotated[Number, "Pa"]
    density: Annotated[Number, "kg/m^3"]
    damping: Annotated[Number, "s"]
    pull: Annotated[Range, "N"]
    """Pulling forces at which peduncles break: 5 % are weaker, 5 % are stronger; see :mod:`vinesim.scene.strength`."""
    bend_strength: Annotated[Number, "Pa"]
    slant: Annotated[Range, "1"] = Range((0.1, 1.2), "1", "GUESSED", "stalks lead a bunch out beside what it hangs at")
    """Least and greatest tangent of the angle between the upper half of the stalk and the vertical, where
    ``Bunch.gap`` is given."""


class Bunch(_Part, frozen=True, kw_only=True):
    """Parameters of the bunches of berries."""

    mass: Annotated[Number, "kg"]
    mass_variation: Annotated[Number, "1"]
    mass_range: Annotated[Range, "kg"]
    length_range: Annotated[Range, "m"]
    stem_share: Annotated[Number, "1"]
    drag: Annotated[Number, "1"]
    gap: Annotated[Number | None, "m"] = None
    """Smallest level gap between the hulls of two bunches, and between a hull and wood or wires of its vine. Without it
    bunches keep 20 mm between their bounding cylinders, and arms and shoots are not taken into account."""
    press: Annotated[Number | None, "1"] = None
    """Share of a hull's half axes by which shoots, stalks and wires may press into a bunch, where ``gap`` is given;
    0 by default."""


class Rachis(_Part, frozen=True, kw_only=True):
    """Parameters of the rachis, the stem inside a bunch that continues the peduncle, and of the mutual support of the
    berries around it."""

    piece: Annotated[Number, "m"]
    diameter: Annotated[Range, "m"]
    modulus: Annotated[Number, "Pa"]
    damping: Annotated[Number, "s"]


class Leaf(_Part, frozen=True, kw_only=True):
    """Parameters of leaves: blade and petiole."""

    area: Annotated[Range, "m^2"]
    young_area: Annotated[Number, "1"]
    mass_per_area: Annotated[Number, "kg/m^2"]
    petiole: Annotated[Range, "m"]
    petiole_mass: Annotated[Number, "kg"]
    drag: Annotated[Number, "1"]


class Arm(_Part, frozen=True, kw_only=True):
    """Parameters of arms: permanent wood along the wires, on which shoots grow."""

    diameter: Annotated[Range, "m"]
    share: Annotated[Number, "1"]
    tendone_arms: Annotated[Number, "1"]
    tendone_shoots: Annotated[Number, "1"]
    vsp_arms: Annotated[Number, "1"]
    vsp_shoots: Annotated[Number, "1"]


class Trunk(_Part, frozen=True, kw_only=True):
    """Parameters of the trunk, from the ground to the head."""

    diameter: Annotated[Range, "m"]
    beside_pole: Annotated[Number, "m"]


class Trellis(_Part, frozen=True, kw_only=True):
    """Parameters of poles, wires and ties."""

    pole_diameter: Annotated[Number, "m"]
    wire_diameter: Annotated[Number, "m"]
    tendone_wire_spacing: Annotated[Number, "m"]
    vsp_wire_spacing: Annotated[Number, "m"]
    vsp_wires: Annotated[Number, "1"]
    wire_tension: Annotated[Number, "N"]
    tie_reach: Annotated[Number, "m"]
    tie_string: Annotated[Number, "m"]
    tie_stiffness: Annotated[Number, "N/m"]
    tie_damping: Annotated[Number, "s"]
    tie_slip: Annotated[Number, "N"] = Number(10.0, "N", "GUESSED", "as in vine.toml")
    """Force along its wire at which a tie slips."""
    tie_strength: Annotated[Number, "N"] = Number(60.0, "N", "GUESSED", "as in vine.toml")
    """Force at which a tie breaks, or lets go of its wire."""
    wire_modulus: Annotated[Number, "Pa"] = Number(2e11, "Pa", "GUESSED", "as in vine.toml")
    """Young's modulus of a wire."""
    wire_strength: Annotated[Number, "Pa"] = Number(6e8, "Pa", "GUESSED", "as in vine.toml")
    """Stress at which a wire breaks."""
    wire_anchor: Annotated[Number, "N/m"] = Number(5e4, "N/m", "GUESSED", "as in vine.toml")
    """Stiffness along the wire of the post at each end of a piece."""


class Specimen(_Part, frozen=True, kw_only=True):
    """A measured cane, or a measured bunch on its peduncle, which :mod:`vinesim.tune` fits. Its base is clamped at the
    origin."""

    organ: Literal["cane", "bunch"]
    length: Annotated[Number, "m"]
    """Length of the cane or the peduncle."""
    base_diameter: Annotated[Number, "m"]
    tip_diameter: Annotated[Number, "m"]
    modulus: Annotated[Number, "Pa"]
    """Young's modulus of bending."""
    density: Annotated[Number, "kg/m^3"]
    damping: Annotated[Number, "s"]
    """Ratio of joint damping to joint stiffness."""
    tip_mass: Annotated[Number, "kg"] | None = None
    """Point mass at the tip of a cane, or mass of the bunch on a peduncle."""
    direction: tuple[float, float, float] | None = None
    """Direction of growth at the base, in the world (z up); by default x for a cane, downwards for a peduncle."""
    bow: tuple[float, float] = (0.0, 0.0)
    """[rad] Bend of the slack shape from base to tip, about the specimen's y and z axes."""
    axis: tuple[tuple[float, float, float], ...] = ()
    """[m] Points of a cane's axis from base to tip, as the cane hangs at rest under its weight. Without points the
    slack shape is straight except for ``bow``."""
    segments: Annotated[int, msgspec.Meta(ge=2, le=64)] = 8
    """Number of rigid bodies of the rod."""
    markers: dict[str, float] = {}
    """[m] Distance of named markers from the base, along the rod. The marker ``tip`` always exists: the cane's tip or
    the lowest point of the bunch."""


class VineParameters(_Part, frozen=True, kw_only=True):
    """All parameters of a vine and its trellis."""

    cane: Cane
    peduncle: Peduncle
    bunch: Bunch
    rachis: Rachis
    leaf: Leaf
    arm: Arm
    trunk: Trunk
    trellis: Trellis
    specimen: Specimen | None = None
    """The measured plant to which numbers of grade FITTED were fitted; scenes do not use it."""


class Berry(_Part, frozen=True, kw_only=True):
    """Parameters of the berries, bunches and leaves of one variety. Those that are missing are a table grape's: bunches
    as in the plant's file, and berries that turn evenly from green to their colour."""

    name: str
    colour: Annotated[Colour, "1"]
    """Colour of a ripe berry."""
    radius: Annotated[Number, "m"]
    elongation: Annotated[Number, "1"]
    unripe: Annotated[Colour | None, "1"] = None
    """Colour of a green berry."""
    turning: Annotated[Colour | None, "1"] = None
    """Colour of a berry halfway through veraison (the change of colour)."""
    veraison: Annotated[Number | None, "1"] = None
    """Standard deviation of the ripeness (0 to 1) of the berries of one bunch that is changing its colour."""
    bunch_mass: Annotated[Number | None, "kg"] = None
    bunch_mass_variation: Annotated[Number | None, "1"] = None
    bunch_mass_range: Annotated[Range | None, "kg"] = None
    compactness: Annotated[Number | None, "1"] = None
    """Density of the bunch, note of OIV descriptor 204: 1 very loose, 9 very dense."""
    peduncle_length: Annotated[Range | None, "m"] = None
    peduncle_pull: Annotated[Range | None, "N"] = None
    """As ``Peduncle.pull``."""
    leaf_area: Annotated[Number | None, "m^2"] = None
    sinus_depth: Annotated[Number | None, "1"] = None
    """Depth of the leaf's upper lateral sinuses, note of OIV descriptor 094: 1 very shallow, 9 very deep."""


class Varieties(_Part, frozen=True, kw_only=True):
    """Content of the file of varieties."""

    varieties: tuple[Berry, ...]


@functools.cache
def load_plant(name: str) -> VineParameters:
    """Returns the parameters in the file ``name``, or else in the file of that name in ``data/plants``. A file that
    begins with ``like = "vine"`` has only the numbers that differ from those in that file. Raises
    :class:`DataError` if the file cannot be used, for example because a unit is wrong."""
    path = find_data_file("plants", name, ".toml")
    vine = to_struct(_plant_tables(path), VineParameters, str(path))
    check_units(vine, str(path))
    for part in ("cane", "peduncle", "bunch", "rachis", "arm", "trunk"):
        _check_plausibility(getattr(vine, part), f"{path}: {part}")
    return vine


def _plant_tables(path: pathlib.Path) -> dict[str, Any]:
    """Returns the tables of a plant file. If ``like`` names another file, numbers that are missing are those there."""
    tables = read_toml(path)
    like = tables.pop("like", None)
    if like is None:
        return tables
    if not isinstance(like, str):
        raise DataError(f"{path}: like is {like!r}; give the name of another plant file in quotes")
    other = find_data_file("plants", like, ".toml")
    known = read_toml(other)
    if "like" in known:
        raise DataError(f"{path}: like is {like!r}, which is like a third file; name {known['like']!r} or a whole file")
    for name, table in tables.items():
        old = known.get(name)
        known[name] = old | table if isinstance(old, dict) and isinstance(table, dict) else table
    return known


def load_varieties() -> tuple[Berry, ...]:
    """Returns the varieties that ship with vinesim, in the order of ``Model.bunch_variety``."""
    path = find_data_file("plants", "varieties", ".toml")
    varieties = load_toml(path, Varieties).varieties
    for i, berry in enumerate(varieties):
        check_units(berry, f"{path}: varieties[{i}]")
    return varieties


class _SpecimenFile(_Part, frozen=True):
    specimen: Specimen


def load_specimen(path: str | pathlib.Path) -> Specimen:
    """Returns the table ``[specimen]`` of a file, which may also contain plant parameters.

    Raises :class:`DataError` if the table cannot be used.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file; give a TOML file with a table [specimen]")
    is_plant = re.search(r"^\[trellis\]", path.read_text("utf-8", "replace"), re.MULTILINE) is not None
    found = load_toml(path, VineParameters if is_plant else _SpecimenFile)
    if found.specimen is None:
        raise DataError(f"{path}: specimen is missing; add a table [specimen], the plant that was measured")
    _check_specimen(found.specimen, str(path))
    _check_plausibility(found.specimen, f"{path}: specimen")
    return found.specimen


def _check_specimen(specimen: Specimen, path: str) -> None:
    check_units(specimen, f"{path}: specimen")
    for name in ("length", "base_diameter", "tip_diameter", "modulus", "density", "damping", "tip_mass"):
        number = getattr(specimen, name)
        if number is not None and not number.value > 0.0:
            raise DataError(f"{path}: specimen.{name}.value is {number.value}; give a number above 0")
    if specimen.organ == "bunch" and specimen.tip_mass is None:
        raise DataError(f"{path}: specimen.tip_mass is missing; give the mass of the bunch in kg")
    if specimen.direction is not None and not any(specimen.direction):
        raise DataError(f"{path}: specimen.direction is {specimen.direction}; give a vector that is not zero")
    if specimen.axis:
        _check_axis(specimen, path)
    for name, place in specimen.markers.items():
        if name.lower() == "base":  # a track uses this name for the columns with the motion of the base
            raise DataError(f"{path}: specimen.markers.{name} is no name for a marker; give it another one")
        if not 0.0 < place <= specimen.length.value:
            raise DataError(
                f"{path}: specimen.markers.{name} is {place}; give its distance from the base, "
                f"above 0 and up to {specimen.length.value} m"
            )


def _check_plausibility(part: msgspec.Struct, place: str) -> None:
    """Log a line for each number that no vine has."""
    for name in part.__struct_fields__:
        value = getattr(part, name)
        quantity = name.removesuffix("_range").rpartition("_")[2]  # base_diameter, woody_modulus, tip_mass, mass_range
        if quantity in plausibility.RANGES and isinstance(value, Number | Range):
            for one in value.value if isinstance(value, Range) else (value.value,):
                plausibility.check(place, quantity, one, name)


def _check_axis(specimen: Specimen, path: str) -> None:
    if specimen.organ != "cane" or specimen.direction is not None or any(specimen.bow):
        raise DataError(f"{path}: specimen.axis tells the shape of a cane; leave out direction and bow, or the axis")
    pieces = [math.dist(a, b) for a, b in itertools.pairwise(specimen.axis)]
    if not pieces or min(pieces) <= 0.0 or abs(sum(pieces) / specimen.length.value - 1.0) > AXIS_LENGTH:
        raise DataError(
            f"{path}: specimen.axis has {len(specimen.axis)} points on a way of {sum(pieces):.3g} m; give two or more, "
            f"all different, over the length of {specimen.length.value:.3g} m"
        )


def check_units(part: msgspec.Struct, place: str) -> None:
    """Raise :class:`DataError` for the first number of ``part`` whose unit is not that of its field."""
    hints = typing.get_type_hints(type(part), include_extras=True)
    for name in part.__struct_fields__:
        value = getattr(part, name)
        unit = getattr(hints[name], "__metadata__", None)
        if isinstance(value, _Part):
            check_units(value, f"{place}: {name}" if ":" not in place else f"{place}.{name}")
        elif unit and isinstance(value, Number | Range | Colour) and value.unit != unit[0]:
            joint = "." if ": " in place else ": "
            raise DataError(f"{place}{joint}{name}.unit is {value.unit!r}; give the value in {unit[0]!r}")
