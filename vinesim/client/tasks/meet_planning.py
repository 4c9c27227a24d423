"""Planning of a meeting: the bunch that a person picks, and where a carrier waits with a box beside it."""

from __future__ import annotations

import math

import numpy as np

from vinesim.client.tasks.path_planning import find_path
from vinesim.client.tasks.start_poses import PlacementError, bunch_centres, ground_clearance
from vinesim.client.tasks.swap_planning import TURNING_RADIUS, turning_places
from vinesim.robot.tasks.meet_person import MeetPlan
from vinesim.scene.model import Model

REACH = 0.55
"""[m] Horizontal distance from a bunch or a box at which a person stands to reach it. GUESSED"""
BOX_AHEAD = 0.75
"""[m] Approximate distance of a clamped box from the centre of the carrier."""
PERSON_CLEARANCE = 0.30
"""[m] A person needs this distance around where it stands and walks. GUESSED"""
BUNCH_HEIGHT = (1.1, 1.75)
"""[m] Heights of a bunch's centre that a hand takes with ease. GUESSED"""
MAX_PULL = 75.0
"""[N] A bunch that holds on with more is left alone: a hand pulls with 100 N."""
KEPT_AWAY = 2.2
"""[m] The carrier stays so far from where the person picks: its half length, the box, and some steps back. GUESSED"""
MAX_PATHS = 3
"""Waiting places that are tried for each place of a person: a search takes a second."""
DISTANCES = (1.2, 1.5, 1.8, 2.2)
"""[m] From where the person picks to where it gives; the first with room for both is taken."""


def plan_meeting(model: Model, near: np.ndarray, box: int = 0) -> MeetPlan:
    """The bunch nearest to a base at ``near`` [7] for which there is room; :class:`PlacementError` if there is none."""
    if box >= len(model.box_pose):
        raise PlacementError(f"no box {box}: this scene has {len(model.box_pose)}; name more in its file")
    ways = [find_path(model, near[:2], place, TURNING_RADIUS) for place in turning_places(model, box)]
    ways = [points for points in ways if points is not None]
    if not ways:
        raise PlacementError(f"no way for a carrier to box {box}: it needs {TURNING_RADIUS} m around it; move the box")
    to_box = min(ways, key=lambda points: float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))
    centres = bunch_centres(model)
    fits = (centres[:, 2] > BUNCH_HEIGHT[0]) & (centres[:, 2] < BUNCH_HEIGHT[1]) & (model.bunch_pull < MAX_PULL)
    order = np.argsort(np.linalg.norm(centres[:, :2] - to_box[-1], axis=1), kind="stable")
    for bunch in order[fits[order]].tolist():
        for stand in _standing_places(model, centres[bunch, :2]):
            if not _keeps_away(to_box, stand):
                continue
            for heading, base in _waiting_places(model, stand)[:MAX_PATHS]:
                path = find_path(model, to_box[-1], base, TURNING_RADIUS)
                if path is not None and _keeps_away(path, stand):
                    return MeetPlan(bunch, stand, box, to_box[1:], path[1:], heading)
    raise PlacementError("no bunch hangs where a person and a carrier have room beside each other; choose another seed")


def _keeps_away(path: np.ndarray, stand: np.ndarray) -> bool:
    """Whether a ``path`` [n, 2] m of a carrier leaves a person room, who goes some steps back from ``stand`` [2] m."""
    start = path[:-1]
    way = np.diff(path, axis=0)
    share = np.clip(((stand - start) * way).sum(1) / np.maximum((way * way).sum(1), 1e-12), 0.0, 1.0)
    return bool(np.linalg.norm(start + share[:, None] * way - stand, axis=1).min() > KEPT_AWAY)


def _standing_places(model: Model, bunch: np.ndarray) -> np.ndarray:
    """Places [k, 2] m around a bunch [2] m with room for a person, those with most room first."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    places = bunch + REACH * np.stack([np.cos(angles), np.sin(angles)], 1)
    room = ground_clearance(model, places)
    return places[np.argsort(-room, kind="stable")][: int((room > PERSON_CLEARANCE).sum())]


def _waiting_places(model: Model, stand: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Headings [rad] and places [2] m of a carrier whose box a person reaches by a free straight way from ``stand``."""
    found = []
    for far in DISTANCES:
        for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False).tolist():
            ahead = np.array([math.cos(angle), math.sin(angle)])
            gives = stand + far * ahead
            base = gives + (REACH + BOX_AHEAD) * ahead
            way = stand + np.linspace(0.0, far, 12)[:, None] * ahead
            if (
                ground_clearance(model, way).min() > PERSON_CLEARANCE
                and ground_clearance(model, base[None])[0] > TURNING_RADIUS
            ):
                found.append((math.atan2(-ahead[1], -ahead[0]), base))
    return found
