"""The first viewpoint of a page: it shows the actor and vines, and nothing hides the actor."""

from __future__ import annotations

import numpy as np

from vinesim.client.spectator import FOLLOW_DISTANCE, FOLLOW_YAW, standing_view
from vinesim.core import frames
from vinesim.scene.model import Model
from vinesim.scene.terrain import Terrain

NEAR = 3.0
"""Distance from the nearest tree below which an actor is viewed over its shoulder [m]. GUESSED."""
BESIDE = 0.25
"""Angle between the line straight behind an actor and the line from the actor to the viewpoint [rad], used if plants
hide the actor more at larger angles. The picture of a phone held upright still contains the actor at this angle."""
YAWS = (FOLLOW_YAW, -FOLLOW_YAW, 0.45, -0.45, BESIDE, -BESIDE)
"""Tried angles between the line straight behind an actor among vines and the line from the actor to the viewpoint
[rad], in order of preference."""
HEAD = 1.3
"""Height of the point of an actor that must be visible [m]."""
HIDING = 0.3
"""Distance from the line of sight below which a part of a plant hides the actor with its leaves [m]. GUESSED."""
AROUND = 2.5
"""Radius of the group of trees around the tree nearest to a distant actor [m]. GUESSED."""
BEFORE_VINES = (2.5, 3.5, 4.5, 5.5, 6.5)
"""Tried distances of the viewpoint from the centre of the group of trees nearest to a distant actor [m]. GUESSED."""
BEARINGS = 32
"""Number of tried directions of the viewpoint around the group of trees nearest to a distant actor."""
AWAY = (0.15, 0.55)
"""Accepted range of the angle between a distant actor and the middle of the picture [rad]. A desktop shows 0.8."""
FREE = 0.7
"""Smallest distance of any part of a plant from the viewpoint [m], because near leaves fill the picture. GUESSED."""
MOST_HIDING = 3
"""Largest number of parts of plants that may hide a distant actor. GUESSED."""
LARGE = 8.0
"""Distance from the viewpoint beyond which vines are ignored when a picture is rated [m]. GUESSED."""
FIELD = 0.78
"""Half of the horizontal field of view of a rated picture [rad]."""
COLUMNS = 24
"""Number of columns into which a rated picture is divided."""


def first_view(root: np.ndarray, model: Model, bodies: np.ndarray) -> np.ndarray:
    """Returns the pose [7] m, 1 of a viewpoint for an actor with its base at ``root`` [7].

    The viewpoint is behind the shoulder of an actor among vines. For a distant actor it shows the nearest vines and the
    actor. ``bodies`` [body, 3] m are the positions of plant bodies.
    """
    distances = np.linalg.norm(model.tree_pose[:, :2] - root[:2], axis=1)
    if not len(distances) or distances.min() < NEAR:
        ahead = frames.rotate(root[3:], np.array([1.0, 0.0, 0.0]))
        heading = np.arctan2(ahead[1], ahead[0])
        views = [_behind(model.terrain, root, heading + yaw, root[:2]) for yaw in YAWS]
        near = _within(bodies, root[:2], FOLLOW_DISTANCE + HIDING)
        return min(views, key=lambda view: _hiding(view, root, near))
    nearest = model.tree_pose[np.argmin(distances), :2]
    vines = model.tree_pose[np.linalg.norm(model.tree_pose[:, :2] - nearest, axis=1) < AROUND, :2].mean(0)
    near = _within(bodies, vines, max(BEFORE_VINES) + LARGE)
    views = [view for view in _before(model.terrain, vines) if _shows(view, root, near)]
    if views:
        return max(views, key=lambda view: _columns_with_vines(view, near))
    way = vines - root[:2]
    return _behind(model.terrain, root, np.arctan2(way[1], way[0]) + BESIDE, vines)


def _behind(terrain: Terrain | None, root: np.ndarray, heading: float, target: np.ndarray) -> np.ndarray:
    """Returns the pose [7] of eyes behind an actor at ``root`` [7], looking at ``target`` [2] m.

    ``heading`` [rad]: direction from the eyes to the actor.
    """
    eye = root[:2] - FOLLOW_DISTANCE * np.array([np.cos(heading), np.sin(heading)])
    return _looking(terrain, eye, target)


def _before(terrain: Terrain | None, vines: np.ndarray) -> list[np.ndarray]:
    """Returns poses [7] of eyes in all directions around the point ``vines`` [2] m, looking at it."""
    return [
        _looking(terrain, vines + distance * np.array([np.cos(angle), np.sin(angle)]), vines)
        for distance in BEFORE_VINES
        for angle in np.linspace(0.0, 2.0 * np.pi, BEARINGS, endpoint=False)
    ]


def _within(points: np.ndarray, place: np.ndarray, distance: float) -> np.ndarray:
    """Returns the subset of ``points`` [n, 3] m within the horizontal ``distance`` [m] of ``place`` [2] m."""
    return points[np.linalg.norm(points[:, :2] - place, axis=1) < distance]


def _looking(terrain: Terrain | None, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    x, y = target - eye
    return standing_view(float(eye[0]), float(eye[1]), float(np.arctan2(y, x)), terrain)


def _shows(view: np.ndarray, root: np.ndarray, bodies: np.ndarray) -> bool:
    """Returns whether a view shows a distant actor at ``root`` [7] at the side of the picture, without a leaf that
    fills the picture."""
    x, y, _ = frames.rotate(frames.conjugate(view[3:]), root[:3] - view[:3])
    if not AWAY[0] < abs(np.arctan2(y, x)) < AWAY[1]:
        return False
    is_free = bool((np.linalg.norm(bodies - view[:3], axis=1) > FREE).all())
    return is_free and _hiding(view, root, bodies) <= MOST_HIDING


def _hiding(view: np.ndarray, root: np.ndarray, bodies: np.ndarray) -> int:
    """Returns the number of ``bodies`` [body, 3] m that hide an actor at ``root`` [7], or are too near to the eyes."""
    way = root[:3] + np.array([0.0, 0.0, HEAD]) - view[:3]
    along = np.clip((bodies - view[:3]) @ way / (way @ way), 0.0, 1.0)
    return int((np.linalg.norm(bodies - view[:3] - along[:, None] * way, axis=1) < HIDING).sum())


def _columns_with_vines(view: np.ndarray, bodies: np.ndarray) -> int:
    """Returns the number of columns of the picture that contain near vines."""
    local = frames.rotate(frames.conjugate(view[3:]), bodies - view[:3])
    angles = np.arctan2(local[:, 1], local[:, 0])[np.hypot(local[:, 0], local[:, 1]) < LARGE]
    return int(np.count_nonzero(np.histogram(angles, COLUMNS, (-FIELD, FIELD))[0]))
