"""An imported plant: skeleton and wood in one TOML file for scenes; missing numbers are filled in and marked.

plant = import_plant("vine.mtg", unit="cm")
plant.write("vine.toml")  # in a scene: [[imported]] file = "vine.toml"
"""

from __future__ import annotations

import functools
import json
import pathlib
from typing import Annotated, Literal

import msgspec
import numpy as np

from vinesim.core.data_files import is_file
from vinesim.core.errors import UsageError, writing
from vinesim.core.toml_loader import load_toml
from vinesim.scene import plant_parameters
from vinesim.scene.plant_import.helios import read_cylinders, read_helios_xml
from vinesim.scene.plant_import.mtg import read_mtg
from vinesim.scene.plant_import.ply import read_ply
from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton, check_skeleton
from vinesim.scene.plant_parameters import Number

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units of length that a plant file may use [m]."""
SUFFIXES = (".mtg", ".ply", ".txt", ".xml")


class Wood(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Properties of the wood, which the files of other programs do not contain."""

    woody_modulus: Annotated[Number, "Pa"]
    """Young's modulus of bending at the base of a shoot."""
    green_modulus: Annotated[Number, "Pa"]
    """Young's modulus of bending at the tip of a shoot, and of side shoots."""
    woody_share: Annotated[Number, "1"]
    density: Annotated[Number, "kg/m^3"]
    damping: Annotated[Number, "s"]
    drag: Annotated[Number, "1"]
    old_wood: Annotated[Number, "m"]
    """Diameter above which wood is fixed instead of simulated."""


class ImportedPlant(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One plant from a file of another program: skeleton and properties of its wood. The base is at the origin, z
    up."""

    source: str
    """Name and format of the file from which the plant was read."""
    shape: Literal["drawn", "slack"] = "drawn"
    """Shape given by the points: the plant as it hangs under its weight (``drawn``) or without weight (``slack``)."""
    piece: Annotated[float, msgspec.Meta(gt=0.0)] = 0.06
    """[m] Approximate length of the rigid bodies of the wood."""
    notes: tuple[str, ...] = ()
    """What was repaired or left out when the file was read."""
    filled: tuple[int, ...] = ()
    """Indices of the nodes that had no diameter in the file; their diameters were filled in."""
    nodes: tuple[tuple[int, float, float, float, float], ...]
    """Parent (-1: the base), x, y, z [m] and diameter [m] of each node, parents first."""
    bunches: tuple[tuple[int, float], ...] = ()
    """Node and mass [kg] of each bunch."""
    wood: Wood

    def skeleton(self) -> Skeleton:
        """Returns the plant's skeleton as arrays."""
        table = np.array(self.nodes, float).reshape(-1, 5)
        bunch = np.zeros(len(table))
        for node, mass in self.bunches:
            bunch[node] = mass
        return Skeleton(table[:, 1:4], table[:, 0].astype(int), table[:, 4], bunch, self.source, self.notes)

    def write(self, path: str | pathlib.Path) -> None:
        """Write the plant as a TOML file. Raises :class:`~vinesim.core.errors.WriteError` if that fails."""
        lines = [
            f"source = {json.dumps(self.source, ensure_ascii=False)}",
            f'shape = "{self.shape}"',
            f"piece = {self.piece!r} # m, length of a rigid body",
            f"notes = {json.dumps(self.notes, ensure_ascii=False)}",
            f"filled = {list(self.filled)} # nodes whose diameter the file does not tell",
            f"bunches = {[list(one) for one in self.bunches]} # node, mass [kg]",
            "nodes = [ # parent, x, y, z [m], diameter [m]",
            *(f"  {list(node)}," for node in self.nodes),
            "]",
            "",
            "[wood]",
        ]
        for name in Wood.__struct_fields__:
            number: Number = getattr(self.wood, name)
            source = json.dumps(number.source, ensure_ascii=False)
            lines.append(
                f'{name} = {{ value = {number.value!r}, unit = "{number.unit}", grade = "{number.grade}", '
                f"source = {source} }}"
            )
        with writing(path):
            pathlib.Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def import_plant(
    path: str | pathlib.Path,
    *,
    unit: str = "m",
    diameter_unit: str | None = None,
    plants: str = "vine",
    shape: Literal["drawn", "slack"] = "drawn",
    piece: float = 0.06,
    old_wood: float | None = None,
) -> ImportedPlant:
    """Read a plant from a file of another program; missing numbers are filled in from plant parameters.

    Args:
        path: an MTG (``.mtg``), a PLY skeleton (``.ply``), cylinders of TreeQSM or Helios (``.txt``), or Helios' XML.
        unit: unit of the coordinates, ``m``, ``cm`` or ``mm``; cylinders and XML are in metres.
        diameter_unit: unit of diameters and radii; ``unit`` unless given.
        plants: file of plant parameters, or its name in ``data/plants``, with the properties of the wood.
        shape: shape given by the points: the plant under its weight (``drawn``) or without weight (``slack``).
        piece: approximate length of the rigid bodies of the wood [m].
        old_wood: diameter above which wood is fixed instead of simulated [m]; 1.5 times the thickest cane unless given.

    Raises:
        PlantFileError: for a file that cannot be used. UsageError: for an argument out of range.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise PlantFileError(f"{path}: is no plant file that can be read; give one of: {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise PlantFileError(f"{path}: no such file; give a plant file ({', '.join(SUFFIXES)})")
    for name, value in (("unit", unit), ("diameter_unit", diameter_unit or unit)):
        if value not in UNITS:
            raise UsageError(f"{name} is {value!r}; give one of: {', '.join(UNITS)}")
    if not 0.005 <= piece <= 1.0:
        raise UsageError(f"piece is {piece} m; give 0.005 to 1 m")
    metres = UNITS[unit], UNITS[diameter_unit or unit]
    suffix = path.suffix.lower()
    if suffix == ".mtg":
        skeleton = read_mtg(path, *metres)
    elif suffix == ".ply":
        skeleton = read_ply(path, *metres)
    elif metres != (1.0, 1.0):
        raise UsageError(f"unit is {unit!r}, but {suffix} files are in metres; leave it out")
    else:
        skeleton = read_cylinders(path) if suffix == ".txt" else read_helios_xml(path)
    wood = _fill_wood(plants, old_wood)
    diameter, filled = _fill_diameters(skeleton, plants)
    points = skeleton.position - skeleton.position[0]
    rows = [
        (int(parent), round(float(x), 5), round(float(y), 5), round(float(z), 5), round(float(thick), 6))
        for parent, (x, y, z), thick in zip(skeleton.parent, points, diameter, strict=True)
    ]
    return ImportedPlant(
        source=f"{path.name}, {skeleton.format}",
        shape=shape,
        piece=piece,
        notes=skeleton.notes,
        filled=tuple(np.flatnonzero(filled).tolist()),
        nodes=tuple(rows),
        bunches=tuple((int(i), round(float(skeleton.bunch[i]), 4)) for i in np.flatnonzero(skeleton.bunch)),
        wood=wood,
    )


def _fill_wood(plants: str, old_wood: float | None) -> Wood:
    """Returns moduli, density, damping and drag from plant parameters, marked as filled in."""
    cane = plant_parameters.load_plant(plants).cane
    numbers = {}
    for name in ("woody_modulus", "green_modulus", "woody_share", "density", "damping", "drag"):
        number = getattr(cane, name)
        numbers[name] = msgspec.structs.replace(
            number, source=f"filled from cane.{name} of {plants!r}: {number.source}"
        )
    thick = 1.5 * cane.base_diameter.value[1] if old_wood is None else old_wood
    source = "filled: half more than the thickest cane" if old_wood is None else "given when it was imported"
    numbers["old_wood"] = Number(float(f"{thick:.6g}"), "m", "GUESSED", source)
    return Wood(**numbers)


def _fill_diameters(skeleton: Skeleton, plants: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns diameters [node] m with missing ones filled in, and which of them were filled in [node] bool.

    A missing diameter between two known ones is interpolated over the length of the wood; elsewhere it follows a cane's
    taper.
    """
    parent = skeleton.parent
    diameter = skeleton.diameter.copy()
    filled = ~np.isfinite(diameter)
    if not filled.any():
        return diameter, filled
    way = np.zeros(len(parent))
    for node in range(1, len(parent)):
        way[node] = way[parent[node]] + np.linalg.norm(skeleton.position[node] - skeleton.position[parent[node]])
    cane = plant_parameters.load_plant(plants).cane
    base = cane.base_diameter.at(0.5)
    tip = cane.tip_diameter.value
    # nearest node towards a tip with a known diameter, along the first child that has one
    above = np.full(len(parent), -1)
    for node in range(len(parent) - 1, 0, -1):
        known = above[node] if filled[node] else node
        if known >= 0:
            above[parent[node]] = known
    taper = base + (tip - base) * way / way.max()
    for node in np.flatnonzero(filled):
        below = parent[node]
        over = above[node]
        if below >= 0 and over >= 0:
            length = way[over] - way[below]
            share = (way[node] - way[below]) / length if length > 0.0 else 0.0
            diameter[node] = diameter[below] + share * (diameter[over] - diameter[below])
        elif over >= 0:
            diameter[node] = diameter[over]
        else:
            diameter[node] = min(taper[node], diameter[below]) if below >= 0 else taper[node]
    return diameter, filled


@functools.cache
def load_imported_plant(path: str) -> ImportedPlant:
    """Returns the imported plant in a TOML file. Raises :class:`PlantFileError` if the file cannot be used."""
    file = pathlib.Path(path)
    if not is_file(file):
        raise PlantFileError(f"{file}: no such file; write it with: vinesim scene import-plant")
    plant = load_toml(file, ImportedPlant, PlantFileError)
    for node, _ in plant.bunches:
        if not 0 <= node < len(plant.nodes):
            raise PlantFileError(f"{file}: bunches names node {node}; give one of 0 to {len(plant.nodes) - 1}")
    check_skeleton(file, plant.skeleton())
    for name in Wood.__struct_fields__:
        value = getattr(plant.wood, name).value
        if not value > 0.0:
            raise PlantFileError(f"{file}: wood.{name}.value is {value}; give a number above 0")
    return plant
