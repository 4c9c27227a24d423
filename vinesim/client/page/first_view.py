"""Where a page looks from at first: its actor and vines are in the picture, and nothing hides the actor."""

from __future__ import annotations

import numpy as np

from vinesim.client.spectator import FOLLOW_DISTANCE, FOLLOW_YAW, standing_view
from vinesim.core import frames
from vinesim.scene.model import Model

NEAR = 3.0
"""An actor that is nearer than this to a tree looks where it works [m]. GUESSED."""
BESIDE = 0.25
"""Angle of the eyes beside the line straight behind an actor [rad], where more is hidden; a phone held upright sees an
actor so far from the middle."""
YAWS = (FOLLOW_YAW, -FOLLOW_YAW, 0.45, -0.45, BESIDE, -BESIDE)
"""Angles of the eyes beside the line straight behind an actor among vines that are tried, the best ones first [rad]."""
HEAD = 1.3
"""Height above the ground to which nothing may hide an actor from the eyes [m]."""
HIDING = 0.3
"""Parts of plants nearer than this to the line from the eyes to there hide the actor, by their leaves [m]. GUESSED."""
AROUND = 2.5
"""Trees as far as this from the one nearest to an actor far away are what it comes to [m]. GUESSED."""
BEFORE_VINES = (2.5, 3.5, 4.5, 5.5, 6.5)
"""Distances of the eyes from these [m]. GUESSED."""
BEARINGS = 32
"""Directions around these that are tried."""
AWAY = (0.15, 0.55)
"""Angles from the middle of the picture at which an actor far away may be [rad]: a desktop shows 0.8."""
FREE = 0.7
"""No part of a plant is nearer than this to such eyes [m]: leaves would fill the picture. GUESSED."""
MOST_HIDING = 3
"""So many parts of plants may hide an actor far away. GUESSED."""
LARGE = 8.0
"""Vines count for a picture up to this distance [m]. GUESSED."""
FIELD = 0.78
COLUMNS = 24
"""Of a picture that is judged: half of its horizontal angle [rad], and parts side by side."""


def first_view(root: np.ndarray, model: Model, bodies: np.ndarray) -> np.ndarray:
    """Pose [7] m, 1 of eyes that see an actor with its base at ``root`` [7]: over its shoulder where it works if it is
    among vines, else from the vines that are nearest to it. ``bodies`` [body, 3] m: places of the plants' parts."""
    distances = np.linalg.norm(model.tree_pose[:, :2] - root[:2], axis=1)
    if not len(distances) or distances.min() < NEAR:
        ahead = frames.rotate(root[3:], np.array([1.0, 0.0, 0.0]))
        heading = np.arctan2(ahead[1], ahead[0])
        views = [_behind(root, heading + yaw, root[:2]) for yaw in YAWS]
        near = _within(bodies, root[:2], FOLLOW_DISTANCE + HIDING)
        return min(views, key=lambda view: _hiding(view, root, near))
    nearest = model.tree_pose[np.argmin(distances), :2]
    vines = model.tree_pose[np.linalg.norm(model.tree_pose[:, :2] - nearest, axis=1) < AROUND, :2].mean(0)
    near = _within(bodies, vines, max(BEFORE_VINES) + LARGE)
    views = [view for view in _before(vines) if _shows(view, root, near)]
    if views:
        return max(views, key=lambda view: _columns_with_vines(view, near))
    way = vines - root[:2]
    return _behind(root, np.arctan2(way[1], way[0]) + BESIDE, vines)


def _behind(root: np.ndarray, heading: float, target: np.ndarray) -> np.ndarray:
    """Pose [7] of eyes that have an actor at ``root`` [7] before them in a direction, looking at a ``target`` [2] m."""
    return _looking(root[:2] - FOLLOW_DISTANCE * np.array([np.cos(heading), np.sin(heading)]), target)


def _before(vines: np.ndarray) -> list[np.ndarray]:
    """Poses [7] of eyes all around a place [2] m, to which they look."""
    return [
        _looking(vines + distance * np.array([np.cos(angle), np.sin(angle)]), vines)
        for distance in BEFORE_VINES
        for angle in np.linspace(0.0, 2.0 * np.pi, BEARINGS, endpoint=False)
    ]


def _within(points: np.ndarray, place: np.ndarray, distance: float) -> np.ndarray:
    """Those of the points [n, 3] m that are at most so far from a ``place`` [2] m, seen from above."""
    return points[np.linalg.norm(points[:, :2] - place, axis=1) < distance]


def _looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    x, y = target - eye
    return standing_view(float(eye[0]), float(eye[1]), float(np.arctan2(y, x)))


def _shows(view: np.ndarray, root: np.ndarray, bodies: np.ndarray) -> bool:
    """Whether eyes see an actor at ``root`` [7] that is far away, at the side of the picture, and no leaf fills it."""
    x, y, _ = frames.rotate(frames.conjugate(view[3:]), root[:3] - view[:3])
    if not AWAY[0] < abs(np.arctan2(y, x)) < AWAY[1]:
        return False
    is_free = bool((np.linalg.norm(bodies - view[:3], axis=1) > FREE).all())
    return is_free and _hiding(view, root, bodies) <= MOST_HIDING


def _hiding(view: np.ndarray, root: np.ndarray, bodies: np.ndarray) -> int:
    """How many of the ``bodies`` [body, 3] m are before an actor at ``root`` [7], or around the eyes."""
    way = root[:3] + np.array([0.0, 0.0, HEAD]) - view[:3]
    along = np.clip((bodies - view[:3]) @ way / (way @ way), 0.0, 1.0)
    return int((np.linalg.norm(bodies - view[:3] - along[:, None] * way, axis=1) < HIDING).sum())


def _columns_with_vines(view: np.ndarray, bodies: np.ndarray) -> int:
    """In how many columns of the picture there are vines that are near."""
    local = frames.rotate(frames.conjugate(view[3:]), bodies - view[:3])
    angles = np.arctan2(local[:, 1], local[:, 0])[np.hypot(local[:, 0], local[:, 1]) < LARGE]
    return int(np.count_nonzero(np.histogram(angles, COLUMNS, (-FIELD, FIELD))[0]))
