"""Shoots on a date: how far they, their laterals, leaves and bunches have grown by then.

A shoot grows along the path that it has at harvest. So the same vine is shown on every date.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene import season
from vinesim.scene.generation.shoot_slots import AXIS_SEGMENTS, LATERAL_NODES, MAX_NODES
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.season import SeasonState, load_season
from vinesim.scene.spec import Scene

_EARLY_LATE = 0.12
"""Largest difference of the number of unfolded leaves from the mean, as a share of it: GUESSED."""
_LATERAL_DELAY = 5.0
"""Leaves that unfold between a leaf and the first leaf of the lateral in its axil: GUESSED."""
_YOUNG_PEDUNCLE = 0.6
"""Length and thickness of a peduncle at fruit set, as a share of those at maturity: GUESSED."""


def grow_to_date(scene: Scene, shoots: Shoots, state: SeasonState) -> Shoots:
    """Returns the shoots as they are on the scene's date. ``shoots``: as they are at harvest."""
    curves = load_season()
    temperatures = scene.season.temperatures or curves.climate.temperatures.value
    count = len(shoots.vine)
    # the last uniform numbers of a shoot's leaves are those of its lateral, whose fate is seldom asked for
    unfolded = state.unfolded * (1.0 + _EARLY_LATE * (2.0 * shoots.leaf_uniform[0, :, -1] - 1.0))
    share = np.array(
        [season.shoot_share(curves, float(u), float(n)) for u, n in zip(unfolded, shoots.nodes, strict=True)]
    )
    share = np.maximum(share, 0.5 * curves.growth.shortest.value / shoots.length)
    points = _along(shoots.points, share[:, None] * np.linspace(0.0, AXIS_SEGMENTS, AXIS_SEGMENTS + 1))
    young = curves.growth.young_diameter.value
    thick = young + (1.0 - young) * 0.5 * (share + state.woody)

    final = (shoots.lateral_at + 1) / AXIS_SEGMENTS
    lateral_unfolded = unfolded - final * shoots.nodes - _LATERAL_DELAY
    lateral = np.array([season.shoot_share(curves, float(u), float(LATERAL_NODES)) for u in lateral_unfolded])
    lateral_at, lateral_start = _attach(points, final, share)
    lateral_points = (
        lateral_start[:, None]
        + (shoots.lateral_points - shoots.lateral_points[:, :1]) * np.maximum(lateral, 0.2)[:, None, None]
    )

    place = (shoots.bunch_at + 1) / AXIS_SEGMENTS
    bunch_at, bunch_start = _attach(points[:, None], place, share[:, None])
    size = state.berry_size
    small = _YOUNG_PEDUNCLE + (1.0 - _YOUNG_PEDUNCLE) * size
    peduncle = bunch_start[:, :, None] + small * (shoots.peduncle - shoots.peduncle[:, :, :1])
    fruit = dict(shoots.fruit)
    for name, factor in (("mass", state.berry_mass), ("length", size), ("radius", size), ("thick", small)):
        fruit[name] = factor * fruit[name]
    return dataclasses.replace(
        shoots,
        points=points,
        length=share * shoots.length,
        base=thick * shoots.base,
        has_lateral=shoots.has_lateral & (lateral >= 0.2),
        lateral_at=lateral_at,
        lateral_points=lateral_points,
        has_bunch=shoots.has_bunch & (place <= share[:, None]) & (state.berry_mass > 0.0),
        bunch_at=bunch_at,
        peduncle=peduncle,
        fruit=fruit,
        nodes=np.clip(np.ceil(unfolded).astype(int), 1, shoots.nodes),
        woody=2.0 * state.woody - 1.0,
        leaf_grown=_leaf_areas(curves, temperatures, state, unfolded, shoots, count),
    )


def _along(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns the points [shoot, k, 3] m at the positions ``at`` [shoot, k], counted in pieces, along polylines
    ``points`` [shoot, point, 3] m."""
    piece = np.minimum(at.astype(int), points.shape[1] - 2)
    rest = (at - piece)[..., None]
    rows = np.arange(len(points))[:, None]
    return points[rows, piece] * (1.0 - rest) + points[rows, piece + 1] * rest


def _attach(points: np.ndarray, place: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the index [...] of the segment of a grown shoot whose tip is nearest to ``place`` [...], a share of the
    final length, and that tip [..., 3] m. ``points``: [..., point, 3] m; ``share``: [...] grown share."""
    at = np.clip(np.round(place / share * AXIS_SEGMENTS).astype(int) - 1, 0, AXIS_SEGMENTS - 1)
    points = np.broadcast_to(points, (*at.shape, *points.shape[-2:]))
    return at, np.take_along_axis(points, (at + 1)[..., None, None], axis=-2)[..., 0, :]


def _leaf_areas(
    curves: season.SeasonCurves,
    temperatures: tuple[float, ...],
    state: SeasonState,
    unfolded: np.ndarray,
    shoots: Shoots,
    count: int,
) -> np.ndarray:
    """Returns the area of each leaf [shoot, MAX_NODES + LATERAL_NODES] as a share of that of a grown leaf."""
    first = int(np.ceil(state.calendar.budburst))
    days = np.arange(first - 1, state.day + 1)
    budburst = state.calendar.budburst
    number = np.array([season.unfolded_leaves(curves, temperatures, budburst, float(day)) for day in days])
    rank = np.broadcast_to(np.arange(MAX_NODES + LATERAL_NODES, dtype=float), (count, MAX_NODES + LATERAL_NODES)).copy()
    start = (shoots.lateral_at + 1) / AXIS_SEGMENTS * shoots.nodes + _LATERAL_DELAY
    rank[:, MAX_NODES:] += start[:, None] - MAX_NODES
    early = unfolded / max(state.unfolded, 1e-9)
    day = np.interp(rank / early[:, None], number, days)
    return np.vectorize(lambda age: season.leaf_share(curves, age))(np.maximum(state.day - day, 0.0) + 1.0)
