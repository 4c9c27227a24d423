"""Ties of imported shoots: where a shoot passes a wire closely, a spring binds it to the wire."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.plant_parameters import Trellis

TIE_SPACING = 0.2
"""[m] Smallest distance between ties of one tree to one wire. GUESSED from how canes are bound along wires."""


def tie_to_wires(plant: Model, vineyard: Model, gap: float, trellis: Trellis) -> Model:
    """Add ties to a plant without ties, where its shoots in the drawn shape pass wires of the vineyard.

    A piece that grows directly on old wood is not tied, because it hardly moves.

    Args:
        plant: the plant, in world coordinates.
        vineyard: model with the wires; :attr:`Model.tie_wire` of the result indexes its pieces.
        gap: largest gap between the surfaces of shoot and wire [m].
        trellis: stiffness and damping of a tie.
    """
    canes = np.flatnonzero((plant.body_organ == int(Organ.CANE)) & (plant.body_parent >= 0))
    if not len(canes) or gap <= 0.0:
        return plant
    pose = plant.forward_kinematics(plant.joint_settled)[canes]
    start = pose[:, :3]
    length = plant.body_length[canes].astype(float)
    way = frames.rotate(pose[:, 3:], length[:, None] * [1.0, 0.0, 0.0])
    radius = plant.body_radius[canes].astype(float)
    wires = _wires_near(vineyard, np.concatenate([start, start + way]), gap + float(radius.max()))
    wire_start = vineyard.fixed_start[wires].astype(float)
    share, distance = _nearest(start, way, wire_start, vineyard.fixed_end[wires] - wire_start)
    thick = radius[:, :1] + share * (radius[:, 1:] - radius[:, :1])
    apart = distance - thick - vineyard.fixed_radius[wires].max(1)
    near, wire = np.nonzero(apart <= gap)
    tied: dict[tuple[int, int], list[np.ndarray]] = {}
    rows = []
    # closest first; distances are rounded to 0.1 mm, so that the choice among pieces along a wire does not depend on
    # rounding errors
    for i in np.argsort(apart[near, wire].round(4), kind="stable").tolist():
        cane = near[i]
        line = wires[wire[i]]
        anchor = start[cane] + share[cane, wire[i]] * way[cane]
        others = tied.setdefault((int(plant.body_tree[canes[cane]]), int(vineyard.fixed_index[line])), [])
        if all(np.linalg.norm(anchor - other) >= TIE_SPACING for other in others):
            others.append(anchor)
            rows.append((int(canes[cane]), int(line), float(share[cane, wire[i]] * length[cane]), *anchor.tolist()))
    body, line, along, *anchor = np.array(sorted(rows), float).reshape(-1, 6).T
    ties = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, box=0, tie=len(rows))
    ties.tie_body[:] = body
    ties.tie_wire[:] = line
    ties.tie_point[:, 0] = along
    ties.tie_anchor[:] = np.stack(anchor, 1)
    ties.tie_stiffness[:] = trellis.tie_stiffness.value
    ties.tie_damping[:] = trellis.tie_damping.value * trellis.tie_stiffness.value
    ties.tie_slip[:] = trellis.tie_slip.value
    ties.tie_strength[:] = trellis.tie_strength.value
    fields = {name: getattr(ties, name) for name in Model.array_fields() if name.startswith("tie_")}
    return dataclasses.replace(plant, **fields).check()


def _wires_near(vineyard: Model, points: np.ndarray, reach: float) -> np.ndarray:
    """Returns the pieces of wire [k] with a bounding box within ``reach`` [m] of the bounding box of ``points`` [p, 3]
    m."""
    ends = np.stack([vineyard.fixed_start, vineyard.fixed_end]).astype(float)
    thick = reach + vineyard.fixed_radius.max(1, initial=0.0)[:, None]
    near = (ends.min(0) <= points.max(0) + thick) & (ends.max(0) >= points.min(0) - thick)
    return np.flatnonzero((vineyard.fixed_organ == int(Organ.WIRE)) & near.all(1))


def _nearest(
    start: np.ndarray, way: np.ndarray, wire_start: np.ndarray, wire_way: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each piece [k] and wire [w] the point of the piece nearest to the wire, as a fraction of the piece's
    length [k, w], and its distance [k, w] m.

    Segments from ``start`` [k, 3] along ``way`` [k, 3], and from ``wire_start`` [w, 3] along ``wire_way`` [w, 3]
    (Ericson 2005, Real-Time Collision Detection, 5.1.9).
    """
    a = (way * way).sum(1)[:, None]
    e = (wire_way * wire_way).sum(1)
    off = start[:, None] - wire_start
    b = way @ wire_way.T
    c = (way[:, None] * off).sum(-1)
    f = (wire_way * off).sum(-1)
    cross = a * e - b * b
    parallel = cross <= 1e-9 * a * e
    share = np.where(parallel, 0.5, np.clip((b * f - c * e) / np.where(parallel, 1.0, cross), 0.0, 1.0))
    along = np.clip((b * share + f) / e, 0.0, 1.0)
    share = np.clip((b * along - c) / a, 0.0, 1.0)
    apart = off + share[..., None] * way[:, None] - along[..., None] * wire_way
    return share, np.linalg.norm(apart, axis=-1)
