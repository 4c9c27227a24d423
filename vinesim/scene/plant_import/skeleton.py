"""The skeleton that all readers of plant files return: a checked tree of points with diameters."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from vinesim.core.text_files import TextError, read_text
from vinesim.core.toml_loader import DataError

MAX_NODES = 20_000
"""Largest number of points of one plant."""
MIN_DIAMETER = 1e-5
"""[m] Smallest diameter of wood; a thinner one is an error of its unit."""
MAX_HEIGHT = 30.0
"""[m] Largest distance of a plant's points from its base. A larger plant is refused, because its unit of length must be
wrong."""


class PlantFileError(DataError):
    """Raised for a plant file that cannot be used. The message is one line with file, place, error and correction."""


@dataclasses.dataclass(frozen=True, slots=True)
class Skeleton:
    """The wood of one plant as points joined to their parents; a parent comes before its children."""

    position: np.ndarray
    """[node, 3] m, position of each node, z up."""
    parent: np.ndarray
    """[node] index of the node below; -1 for the base, which is the first node."""
    diameter: np.ndarray
    """[node] m, diameter of the wood that ends at the node; NaN if the file does not contain it."""
    bunch: np.ndarray
    """[node] kg, mass of the bunch that hangs at the node; 0 for none."""
    format: str
    notes: tuple[str, ...] = ()
    """What was repaired or left out when the file was read, one fact each."""


def read_plant(path: pathlib.Path) -> str:
    r"""Returns the text of a plant file with ``\n`` as line end. Raises :class:`PlantFileError` if it is no text."""
    try:
        return read_text(path)
    except TextError as bad:
        raise PlantFileError(bad.at(path)) from None


def check_skeleton(path: pathlib.Path, skeleton: Skeleton) -> Skeleton:
    """Check that ``skeleton`` is one connected plant, and return it. Raises :class:`PlantFileError` otherwise."""
    nodes = np.arange(len(skeleton.parent))
    if len(nodes) < 2:
        raise PlantFileError(f"{path}: has {len(nodes)} points with coordinates; give a plant of at least 2")
    if len(nodes) > MAX_NODES:
        raise PlantFileError(f"{path}: has {len(nodes)} points; give at most {MAX_NODES}, thin the skeleton out")
    bases = np.flatnonzero(skeleton.parent < 0)
    if len(bases) != 1 or bases[0] != 0 or (skeleton.parent[1:] >= nodes[1:]).any():
        raise PlantFileError(f"{path}: has {len(bases)} plants or a loop; give one plant, all of whose wood is joined")
    if not np.isfinite(skeleton.position).all():
        raise PlantFileError(
            f"{path}: point {_first(np.asarray(~np.isfinite(skeleton.position).all(1)))} is not finite; mend it"
        )
    with np.errstate(over="ignore"):
        size = float(np.linalg.norm(skeleton.position - skeleton.position[0], axis=1).max())
    if not 0.0 < size <= MAX_HEIGHT:
        raise PlantFileError(
            f"{path}: reaches {size:.4g} m from its base; give the unit of its lengths (m, cm or mm), at most "
            f"{MAX_HEIGHT:.0f} m"
        )
    known = ~np.isnan(skeleton.diameter)
    if (bad := known & ~((skeleton.diameter >= MIN_DIAMETER) & (skeleton.diameter <= 1.0))).any():
        node = _first(bad)
        size = skeleton.diameter[node]
        remedy = f"give {MIN_DIAMETER:g} m or more, or 0 where it is unknown"
        if size > 1.0:
            remedy = "give the unit of diameters, up to 1 m"
        raise PlantFileError(f"{path}: diameter of point {node} is {size:.4g} m; {remedy}")
    if (bad := ~((skeleton.bunch >= 0.0) & (skeleton.bunch <= 5.0))).any():
        node = _first(bad)
        raise PlantFileError(f"{path}: bunch of point {node} is {skeleton.bunch[node]:.4g} kg; give 0 to 5 kg")
    return skeleton


def _first(mask: np.ndarray) -> int:
    return int(np.flatnonzero(mask)[0])


def sort_nodes(
    path: pathlib.Path,
    position: np.ndarray,
    parent: np.ndarray,
    diameter: np.ndarray,
    bunch: np.ndarray,
    format: str,
    notes: tuple[str, ...] = (),
) -> Skeleton:
    """Sort nodes so that the base is first and parents precede children. Returns the checked skeleton.

    A diameter of 0 counts as missing, as programs write it for wood that was not measured.
    """
    count = len(parent)
    if unmeasured := int((diameter == 0.0).sum()):
        diameter = np.where(diameter == 0.0, np.nan, diameter)
        notes = (*notes, f"{unmeasured} diameters are 0, which is taken as not measured")
    if ((parent < -1) | (parent >= count)).any():
        node = _first((parent < -1) | (parent >= count))
        raise PlantFileError(f"{path}: parent of point {node} is {parent[node]}; give one of 0 to {count - 1}")
    depth = np.where(parent < 0, 0, -1)
    for level in range(count):
        children = (depth < 0) & (parent >= 0) & (depth[parent] == level)
        if not children.any():
            break
        depth[children] = level + 1
    if (depth < 0).any():
        raise PlantFileError(f"{path}: point {_first(depth < 0)} is in a loop or joined to none; give a tree")
    order = np.argsort(depth, kind="stable")
    place = np.empty(count, int)
    place[order] = np.arange(count)
    parent = np.where(parent < 0, -1, place[parent])[order]
    return check_skeleton(path, Skeleton(position[order], parent, diameter[order], bunch[order], format, notes))
