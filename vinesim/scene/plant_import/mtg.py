"""Reads multiscale tree graphs, the text files of OpenAlea's MTG (FORM-A): topology by columns, features by name.

The reader takes every entity with coordinates (XX, YY, ZZ), whatever its class; the point is the end of the entity. The
wood of an entity runs to this point from the point of its parent, or of the nearest ancestor with coordinates. Classes,
scales and all other features are ignored. Grammar: Godin et al. 1997, AMAPmod. As in OpenAlea's own reader, ``+``
begins a branch, which ends at the first line that begins in an earlier column, and a line ``*`` measures the entity of
the line above again, at a later date: the last measurement of each feature counts.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import re

import numpy as np

from vinesim.core.text_files import CUT, NumberReader, TextError, is_cut
from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton, read_plant, sort_nodes

_SECTIONS = ("CODE", "CLASSES", "DESCRIPTION", "FEATURES", "MTG")
_STEP = re.compile(r"(\^|/|<<|<|\+\+|\+)([A-Za-z]+)?(\d{1,9})?")
_DIAMETERS = {"diameter": 1.0, "diam": 1.0, "topdia": 1.0, "radius": 2.0}
"""Features (in lower case) that contain the thickness of wood, with the factor that converts them to a diameter."""
_AXES = ("xx", "yy", "zz")
_MISSING = ("", "na", "nan", "n/a", "?", "-")
"""Cells without a measurement, in lower case."""
_BUNCH = "bunch"
"""Name of the feature with the mass [kg] of a bunch that hangs from an entity."""


@dataclasses.dataclass
class _Entity:
    below: int
    """Index of the entity on which this entity grows or of which it is a part; -1 for none."""
    values: dict[str, float]


def read_mtg(path: pathlib.Path, unit: float, diameter_unit: float) -> Skeleton:
    """Returns the skeleton of the plant in a file of a multiscale tree graph (MTG).

    Args:
        path: the file.
        unit: unit of its coordinates [m].
        diameter_unit: unit of its diameters [m].

    Raises:
        PlantFileError: for a line that cannot be read, no coordinates, or several plants.
    """
    text = read_plant(path)
    header, lines = _sections(path, text)
    table, columns = _table_head(path, header, lines)
    entities = _entities(path, table, columns)
    placed = [i for i, e in enumerate(entities) if "zz" in e.values]
    if not placed:
        raise PlantFileError(
            f"{path}: no entity has coordinates XX, YY and ZZ; give a file with geometry (write them as FEATURES)"
        )
    number = {entity: node for node, entity in enumerate(placed)}
    parent = np.full(len(placed), -1)
    for node, entity in enumerate(placed):
        below = entities[entity].below
        while below >= 0 and below not in number:
            below = entities[below].below
        parent[node] = number.get(below, -1)
    values = [entities[i].values for i in placed]
    notes = [f"{len(entities) - len(placed)} entities have no coordinates of their own"] * (len(placed) < len(entities))
    return sort_nodes(
        path,
        unit * np.array([[v["xx"], v["yy"], v["zz"]] for v in values]),
        parent,
        diameter_unit * np.array([_thickness(v) for v in values]),
        np.array([v.get(_BUNCH, 0.0) for v in values]),
        "OpenAlea MTG",
        (*notes, *([CUT] if is_cut(text) else [])),
    )


def _thickness(values: dict[str, float]) -> float:
    """Returns the first diameter that was measured [diameter unit], else 0 if one was given, else NaN."""
    given = [scale * values[name] for name, scale in _DIAMETERS.items() if name in values]
    return next((one for one in given if one), 0.0 if given else math.nan)


def _sections(path: pathlib.Path, text: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Returns the names of the features, and the lines of the section MTG with their line numbers."""
    section = ""
    features = []
    lines = []
    for number, raw in enumerate(text.split("\n"), 1):
        line = raw.split("#", 1)[0].rstrip()
        head = re.match(r"\s*([A-Z]+)\s*:\s*(.*)", line)
        if head and head[1] in _SECTIONS:
            section = head[1]
            if section == "CODE" and head[2].strip() != "FORM-A":
                raise PlantFileError(f"{path}: line {number}: CODE is {head[2].strip()!r}; only FORM-A can be read")
        elif line.strip() and section == "FEATURES":
            features.append(line.split()[0])
        elif line.strip() and section == "MTG":
            lines.append((number, line))
    if not lines:
        raise PlantFileError(f"{path}: has no section 'MTG:'; give a multiscale tree graph in text form (FORM-A)")
    return features, lines


def _table_head(
    path: pathlib.Path, features: list[str], lines: list[tuple[int, str]]
) -> tuple[list[tuple[int, str]], dict[int, str]]:
    """Returns the lines below the table's head, and the feature of each column after the topology columns."""
    number, head = lines[0]
    cells = head.split("\t")
    if len(cells) == 1 and len(cells[0].split()) > 1 and cells[0].split()[0] in ("ENTITY-CODE", "TOPO"):
        raise PlantFileError(f"{path}: line {number}: has no tabs; separate the columns by tabs")
    if cells[0].strip() not in ("ENTITY-CODE", "TOPO"):
        raise PlantFileError(f"{path}: line {number}: begins with {cells[0].strip()!r}; give ENTITY-CODE or TOPO there")
    columns = {i: cell.strip().lower() for i, cell in enumerate(cells) if i and cell.strip()}
    known = {feature.lower() for feature in features}
    if unknown := [name for name in columns.values() if name not in known]:
        raise PlantFileError(f"{path}: line {number}: column {unknown[0]!r} is not in FEATURES; add it there")
    return lines[1:], columns


def _entities(path: pathlib.Path, table: list[tuple[int, str]], columns: dict[int, str]) -> list[_Entity]:
    """Returns all entities, each with the index of the entity on which it grows or of which it is a part."""
    entities: list[_Entity] = []
    first_feature = min(columns, default=1 << 30)
    last: list[int] = []  # by column, the entity that the next line continues
    numbers = NumberReader()
    for number, line in table:
        cells = line.split("\t")
        column = next((i for i, cell in enumerate(cells[:first_feature]) if cell.strip()), None)
        place = f"{path}: line {number}"
        if column is None:
            raise PlantFileError(f"{place}: has features but no entity; give one, or remove the line")
        code = cells[column].replace(" ", "")
        features = _features(place, cells, columns, numbers)
        if code == "*" and entities:  # the same entity at a later date
            measured = {name: value for name, value in features.items() if value or name not in _DIAMETERS}
            entities[-1].values.update(measured)
            continue
        steps = _steps(place, code)
        same = steps[0][0] == "^"
        if column > len(last) or (same and column >= len(last)):
            raise PlantFileError(f"{place}: {code!r} has nothing above it to continue; give it fewer tabs")
        below = last[column] if same else last[column - 1] if column else -1
        steps = steps[same:]
        branch = same and steps[0][0].startswith("+")  # the lines of a branch begin one column further right
        for operator, index in steps:
            repeat = index - entities[below].values["index"] if len(operator) == 2 and below >= 0 else 1
            if not 1 <= repeat <= 10_000:
                raise PlantFileError(
                    f"{place}: {code!r} counts from {index - repeat:g} to {index:g}; give a rising number"
                )
            for _ in range(int(repeat)):
                entities.append(_Entity(below, {"index": float(index)}))
                below = len(entities) - 1
        entities[below].values.update(features)
        last = [*last[: column + 1], below] if branch else [*last[:column], below]
    return entities


def _steps(place: str, code: str) -> list[tuple[str, int]]:
    """Returns the operators and indices of one topology code of an MTG file. For ``^<E2+U1`` these are ``^``, ``<2``
    and ``+1``.
    """
    found = []
    at = 0
    while at < len(code):
        match = _STEP.match(code, at)
        is_continued = match is not None and match[1] == "^"
        if match is None or is_continued != (match[2] is None) or (is_continued and at):
            raise PlantFileError(
                f"{place}: {code!r} cannot be read from {code[at:]!r} on; give /, <, +, << or ++ with a class and a "
                "number, as in ^<E2"
            )
        found.append((match[1], int(match[3] or 0)))
        at = match.end()
    if found[0][0] == "^" and len(found) == 1:
        raise PlantFileError(f"{place}: '^' continues with nothing; give an entity behind it")
    return found


def _features(place: str, cells: list[str], columns: dict[int, str], numbers: NumberReader) -> dict[str, float]:
    """Returns the features of one line of the file, by name: coordinates, thickness, and mass of a hanging bunch. All
    other features are ignored.
    """
    values = {}
    for i, name in columns.items():
        if i >= len(cells) or cells[i].strip().lower() in _MISSING:
            continue
        if name in _AXES or name == _BUNCH or name in _DIAMETERS:
            try:
                values[name] = numbers.read(cells[i])
            except TextError as bad:
                raise PlantFileError(f"{place}: {name} is {bad}") from None
    axes = [name.upper() for name in _AXES if name in values]
    if 0 < len(axes) < len(_AXES):
        raise PlantFileError(f"{place}: has {' and '.join(axes)} alone; give XX, YY and ZZ, or none of them")
    return values
