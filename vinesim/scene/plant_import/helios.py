"""Reads plants of Helios (Bailey 2019, Front. Plant Sci. 10:1185): cylinder files, and the XML of a plant's structure.

``writeQSMCylinderFile`` writes every internode as a cylinder, in 17 columns separated by tabs, as TreeQSM does. For the
first cylinder of a branch, the parent column also names the previous row, although the branch starts elsewhere. The
reader joins such a cylinder to the cylinder on whose surface it starts. ``writePlantStructureXML`` contains points only
for shoots whose nodes were prescribed; for other shoots it contains angles from which Helios grows them. This reader
cannot use these angles.
"""

from __future__ import annotations

import pathlib
import xml.etree.ElementTree as ElementTree

import numpy as np

from vinesim.core.text_files import CUT, NumberReader, TextError, is_cut
from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton, read_plant, sort_nodes

_COLUMNS = 9
"""Number of columns that are read: radius, length, start (3), axis (3), parent."""
_NEAR = 0.01
"""[m] Largest distance between the start of a cylinder and the surface of its parent."""


def read_cylinders(path: pathlib.Path) -> Skeleton:
    """Returns the skeleton of a plant from a cylinder file (TreeQSM, or Helios' ``writeQSMCylinderFile``) with lengths
    in metres.

    Raises :class:`PlantFileError` for a row that is not a cylinder or does not start on another cylinder.
    """
    rows = []
    numbers = NumberReader()
    text = read_plant(path)
    for number, line in enumerate(text.split("\n")[1:], 2):
        if not line.strip():
            continue
        cells = line.split("\t")
        try:
            rows.append([numbers.read(cell) for cell in cells[:_COLUMNS]])
        except TextError as bad:
            raise PlantFileError(f"{path}: line {number}: a cell is {bad}, with tabs between") from None
        if len(rows[-1]) < _COLUMNS or not rows[-1][0] > 0.0 or not rows[-1][1] > 0.0:
            raise PlantFileError(
                f"{path}: line {number}: give radius and length above 0 [m], start, axis and parent, with tabs between"
            )
    table = np.array(rows)
    if not len(table):
        raise PlantFileError(f"{path}: has no cylinders; give a row for each below its head")
    start = table[:, 2:5]
    way = table[:, 1:2] * table[:, 5:8]
    end = start + way
    parent = table[:, 8].astype(int)
    moved = 0
    joined = np.zeros(len(table), int)  # node 0 is the base, node i + 1 the end of cylinder i
    for i in range(1, len(table)):
        one = parent[i] - 1
        if not (0 <= one < i and np.linalg.norm(end[one] - start[i]) <= table[one, 0] + _NEAR):
            one = _bearer(path, table, start, way, i)
            moved += 1
        # a branch from the start of a cylinder grows on the end of that cylinder's parent
        on_end = np.linalg.norm(end[one] - start[i]) <= np.linalg.norm(start[one] - start[i])
        joined[i] = one + 1 if on_end else joined[one]
    notes = (f"{moved} branches were joined to the cylinder that they start on, not to their named parent",)
    return sort_nodes(
        path,
        np.concatenate([start[:1], end]),
        np.concatenate([[-1], joined]),
        2.0 * np.concatenate([table[:1, 0], table[:, 0]]),
        np.zeros(len(table) + 1),
        "cylinders (TreeQSM, Helios)",
        (*(notes if moved else ()), *([CUT] if is_cut(text) else [])),
    )


def _bearer(path: pathlib.Path, table: np.ndarray, start: np.ndarray, way: np.ndarray, i: int) -> int:
    """Returns the index of the parent of cylinder ``i``: the earlier cylinder on whose surface or axis cylinder ``i``
    starts.
    """
    share = np.clip(((start[i] - start[:i]) * way[:i]).sum(1) / (way[:i] ** 2).sum(1), 0.0, 1.0)
    off = np.linalg.norm(start[:i] + share[:, None] * way[:i] - start[i], axis=1) - table[:i, 0]
    nearest = int(np.argmin(off))
    if off[nearest] > _NEAR:
        raise PlantFileError(
            f"{path}: cylinder {i + 1} starts {off[nearest]:.3g} m off all before it; give cylinders that are joined"
        )
    return nearest


def read_helios_xml(path: pathlib.Path) -> Skeleton:
    """Returns the skeleton of a plant from Helios' ``writePlantStructureXML``. The file must contain the points of
    every shoot."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as bad:
        raise PlantFileError(f"{path}: not valid XML: {bad}; give what writePlantStructureXML writes") from None
    plants = root.findall("plant_instance")
    if root.tag != "helios" or len(plants) != 1:
        raise PlantFileError(f"{path}: <{root.tag}> with {len(plants)} plants; give <helios> with one <plant_instance>")
    base = _numbers(path, plants[0], "base_position", 3)
    position = []
    parent = []
    diameter = []
    ends: dict[tuple[int, int], int] = {}
    for shoot in plants[0].findall("shoot"):
        name = f"{path}: shoot {shoot.get('ID')}"
        if shoot.find("prescribed_internode_nodes") is None:
            raise PlantFileError(
                f"{name}: has no prescribed_internode_nodes, only the angles from which Helios grows it; write the "
                "cylinders instead: writeQSMCylinderFile(plant, 'plant.txt')"
            )
        nodes = _numbers(path, shoot, "prescribed_internode_nodes").reshape(-1, 3)
        radii = _numbers(path, shoot, "prescribed_internode_radii")
        if len(radii) != len(nodes) or len(nodes) < 2:
            raise PlantFileError(f"{name}: has {len(nodes)} nodes and {len(radii)} radii; give as many, at least 2")
        bearer = int(_numbers(path, shoot, "parent_shoot_ID", 1)[0])
        at = -1
        if bearer >= 0:
            at = ends.get((bearer, int(_numbers(path, shoot, "parent_node_index", 1)[0])), -1)
            if at < 0:
                raise PlantFileError(f"{name}: grows on node of shoot {bearer} that is not before it; reorder")
        for i, (node, radius) in enumerate(zip(nodes, radii, strict=True)):
            if i or bearer < 0:  # the first node of a branch lies on its parent
                position.append(base + node)
                parent.append(at)
                diameter.append(2.0 * radius)
                at = len(parent) - 1
            if i:
                ends[int(shoot.get("ID", "-1")), i - 1] = at
    return sort_nodes(
        path,
        np.array(position),
        np.array(parent),
        np.array(diameter),
        np.zeros(len(parent)),
        "Helios XML",
        ("leaves, flowers and fruits are left out",) * (plants[0].find(".//leaf") is not None),
    )


def _numbers(path: pathlib.Path, where: ElementTree.Element, tag: str, count: int | None = None) -> np.ndarray:
    """Returns the numbers in the child element ``tag`` of ``where``. ``count``: their required number."""
    found = where.find(tag)
    try:
        numbers = np.array((found.text or "").split() if found is not None else [], float)
    except ValueError:
        numbers = np.zeros(0)
    if count is not None and len(numbers) != count:
        raise PlantFileError(f"{path}: <{where.tag} {where.get('ID')}>: <{tag}> has no {count} numbers; give them")
    return numbers
