"""Ties of shoots to wires."""

from __future__ import annotations

import numpy as np

from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.plant_bodies import Bodies
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.ids import Organ
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene

TIED_SEGMENT = 10
"""Index of the segment of a shoot that a string binds to the net, at the segment's start."""


def find_ties(
    scene: Scene, parameters: VineParameters, structure: FixedStructure, shoots: Shoots, bodies: Bodies
) -> dict[str, np.ndarray]:
    """Tie shoots to nearby wires: to the net in a tendone, to the catch wires in a hedge. Returns the ``tie_`` arrays
    of the model.

    Each tie is bound to the nearest piece of wire. A shoot between two catch wires is bound to one of them.
    """
    layout = scene.layout
    trellis = parameters.trellis
    tendone = scene.training == "tendone"
    start = shoots.points[:, :-1]
    end = shoots.points[:, 1:]
    spacing = np.array([layout.vine_spacing, layout.row_spacing])
    low = -0.5 * spacing
    high = (np.array([layout.vines, layout.rows]) - 0.5) * spacing
    if tendone:
        lines = [
            (axis, low[axis], d / max(round(d / trellis.tendone_wire_spacing.value), 1))
            for axis, d in enumerate(spacing)
        ]
    else:
        lines = [(2, layout.height, trellis.vsp_wire_spacing.value)]
    crossings = []
    for axis, first, step in lines:
        share, found = _crossing(start[..., axis], end[..., axis], first, step)
        point = start + share[..., None] * (end - start)
        found &= (point[..., :2] >= low).all(-1) & (point[..., :2] <= high).all(-1)
        apart = point[..., 2] - layout.height
        if not tendone:
            wire = np.round(apart / step)
            found &= (wire >= 1) & (wire <= trellis.vsp_wires.value)
            apart = point[..., 1] - layout.row_spacing * np.round(point[..., 1] / layout.row_spacing)
        crossings.append((share, np.where(found, np.abs(apart), np.inf)))
    share, apart = (np.stack(values, -1) for values in zip(*crossings, strict=True))
    tied = apart < trellis.tie_reach.value
    if tendone:  # a string binds each shoot beyond its middle; otherwise a long shoot would fall over
        share[:, TIED_SEGMENT, 0] = 0.0
        tied[:, TIED_SEGMENT, 0] = np.abs(start[:, TIED_SEGMENT, 2] - layout.height) < trellis.tie_string.value
    shoot, slot, which = np.nonzero(tied)
    along = share[shoot, slot, which] * bodies.length[shoot, slot]
    anchor = start[shoot, slot] + share[shoot, slot, which, None] * (end - start)[shoot, slot]
    stiffness = trellis.tie_stiffness.value
    return {
        "shoot": shoot,
        "slot": slot,
        "point": along[:, None] * [1.0, 0.0, 0.0],
        "anchor": anchor,
        "wire": nearest_wire(structure, anchor, 1 - which if tendone else 0 * which),
        "stiffness": np.full(len(slot), stiffness),
        "damping": np.full(len(slot), trellis.tie_damping.value * stiffness),
    }


def nearest_wire(structure: FixedStructure, points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Returns the index [k] of the piece of wire that is nearest to each of ``points`` [k, 3] m, among the wires along
    x (``axis`` [k] is 0) or y (1)."""
    fixed = structure.fixed
    wires = np.flatnonzero(fixed["fixed_organ"] == int(Organ.WIRE))
    start = fixed["fixed_start"][wires]
    way = (fixed["fixed_end"] - fixed["fixed_start"])[wires]
    nearest = np.full(len(points), -1)
    for a in np.unique(axis):
        runs = np.abs(way[:, a]) > np.abs(way[:, 1 - a])
        here = np.flatnonzero(axis == a)
        posts, post = np.unique(start[runs, a], return_inverse=True)
        lines, line = np.unique(np.delete(start[runs], a, 1), axis=0, return_inverse=True)
        piece = np.full((len(lines), len(posts)), -1)
        piece[line.ravel(), post] = wires[runs]
        place = np.delete(points[here], a, 1)
        closest = ((place[:, None] - lines) ** 2).sum(-1).argmin(1)
        nearest[here] = piece[closest, np.maximum(np.searchsorted(posts, points[here, a], "right") - 1, 0)]
    return nearest


def _crossing(start: np.ndarray, end: np.ndarray, first: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Find where pieces cross lines. ``start``, ``end`` [...] m: the coordinates of their ends across the lines, which
    are at ``first`` + n ``step``.

    Returns the share [...] of the piece's length at the crossing, and [...] bool whether the piece crosses a line.
    """
    low = (start - first) / step
    high = (end - first) / step
    line = np.maximum(np.floor(low), np.floor(high))
    found = np.floor(low) != np.floor(high)
    return np.where(found, (line - low) / np.where(found, high - low, 1.0), 0.0), found
