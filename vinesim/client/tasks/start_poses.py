"""Start poses of actors, and the bunches that they can reach from there."""

from __future__ import annotations

import msgspec
import numpy as np

from vinesim.core import frames
from vinesim.scene.generation.uneven_ground import build_terrain
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, Spawn
from vinesim.scene.terrain import above_ground, on_ground

PUSH_REACH = (0.35, 0.85)
"""[m] Horizontal distances from the base at which an arm can push a bunch."""
PUSH_HEIGHT = (1.2, 1.75)
"""[m] Heights of a bunch's centre that an arm reaches."""


BASE_CLEARANCE = 0.55
"""[m] Free distance that a robot's base needs around its centre."""


QUEUE_SPACING = 1.5
"""[m] Distance between robots of one client that start behind each other. GUESSED"""
OVERHEAD = 1.8
"""[m] Fixed pieces wholly above this height do not block a base with its arms tucked, which is 1.6 m high."""
MAX_CANDIDATES = 200
"""Number of nearest bunches that are tried."""


class PlacementError(ValueError):
    """The scene lacks the requested start place, bunch, box or room; the message says what it has."""


def spawn_pose(scene: Scene, number: int, back: float = 0.0) -> np.ndarray:
    """Returns the pose [7] of a start place, moved backwards by ``back`` [m]; a place next to the vines if the scene
    has none.

    Raises :class:`PlacementError` if the scene has no start place of that ``number``.
    """
    terrain = build_terrain(scene)
    if not scene.spawns:
        return on_ground(terrain, frames.pose([-2.0 - back, 1.5 * number, 0.0]))
    if number >= len(scene.spawns):
        known = ", ".join(f"{i} {spawn.name}" for i, spawn in enumerate(scene.spawns))
        raise PlacementError(f"scene {scene.name!r} has no start place {number}; it has: {known}")
    spawn = scene.spawns[number]
    ahead = np.array([np.cos(spawn.yaw), np.sin(spawn.yaw), 0.0])
    level = frames.pose(np.array([spawn.x, spawn.y, 0.0]) - back * ahead, frames.from_yaw(spawn.yaw))
    return on_ground(terrain, level)


def start_pose(scene: Scene, number: int, back: float = 0.0, queue: int = 0) -> np.ndarray:
    """Returns the pose [7] of the ``queue``-th robot of a client: at the next start places, then in line behind the
    first robots."""
    lap, place = divmod(number + queue, max(len(scene.spawns), 1)) if queue else (0, number)
    return spawn_pose(scene, place, back + QUEUE_SPACING * lap)


def with_start_pose(scene: Scene, x: float, y: float, yaw: float) -> Scene:
    """Returns a copy of the scene with a single start place, at (x, y) [m] with ``yaw`` [rad]."""
    return msgspec.structs.replace(scene, spawns=(Spawn(name="given", x=x, y=y, yaw=yaw),))


def bunch_centres(model: Model) -> np.ndarray:
    """Returns the centres of all bunches at rest [bunch, 3] m in the world."""
    body_q = model.forward_kinematics(model.joint_settled)[model.bunch_body]
    axis = frames.rotate(body_q[:, 3:], np.array([1.0, 0.0, 0.0]))
    return body_q[:, :3] + 0.5 * model.bunch_length[:, None] * axis


def find_reachable_bunch(model: Model, pose: np.ndarray) -> int:
    """Returns the bunch that an arm reaches best from a base at ``pose`` [7]: ahead, at arm's height, closest to 0.6 m
    away.

    Raises :class:`PlacementError` if no bunch is in reach.
    """
    local = frames.rotate(frames.conjugate(pose[3:]), bunch_centres(model) - pose[:3])
    distance = np.hypot(local[:, 0], local[:, 1])
    sideways = np.abs(np.arctan2(local[:, 1], local[:, 0]))
    fits = (
        (distance > PUSH_REACH[0])
        & (distance < PUSH_REACH[1])
        & (local[:, 2] > PUSH_HEIGHT[0])
        & (local[:, 2] < PUSH_HEIGHT[1])
    )
    fits &= sideways < 0.7
    if not fits.any():
        x, y = pose[:2]
        raise PlacementError(
            f"no bunch within reach of a robot at ({x:.2f}, {y:.2f}): none {PUSH_REACH[0]} to {PUSH_REACH[1]} m ahead "
            f"at {PUSH_HEIGHT[0]} to {PUSH_HEIGHT[1]} m height; choose another start place or seed"
        )
    return int(np.argmin(np.where(fits, np.abs(distance - 0.6) + 0.2 * sideways, np.inf)))


def validate_bunch(model: Model, bunch: int | None) -> int | None:
    """Returns the number ``bunch``, or None. Raises :class:`PlacementError` if the vineyard has no such bunch."""
    if bunch is not None and not 0 <= bunch < len(model.bunch_body):
        raise PlacementError(f"no bunch {bunch}: this vineyard has 0 to {len(model.bunch_body) - 1}")
    return bunch


def ground_clearance(model: Model, points: np.ndarray, *, without: int = -1) -> np.ndarray:
    """Returns the horizontal distance [n] m from points [n, 2] m to the nearest obstacle or box; infinite if there is
    none.

    Obstacles are poles, trunks, wires and arms, except those that are entirely above :data:`OVERHEAD`.

    ``without``: number of a box that is ignored.
    """
    ends = (above_ground(model.terrain, end) for end in (model.fixed_start, model.fixed_end))
    solid = np.minimum(*ends) < OVERHEAD
    clearance = np.full(len(points), np.inf)
    if solid.any():
        start = model.fixed_start[solid, :2]
        radii = model.fixed_radius[solid].max(1)
        along = model.fixed_end[solid, :2] - start
        offset = points[:, None] - start
        share = np.clip((offset * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-12), 0.0, 1.0)
        clearance = (np.linalg.norm(offset - share[..., None] * along, axis=-1) - radii).min(1)
    for box, pose in enumerate(model.box_pose.astype(float)):
        if box != without:
            beside = np.pad(points - pose[:2], ((0, 0), (0, 1)))
            local = np.abs(frames.rotate(frames.conjugate(pose[3:]), beside))[:, :2]
            clearance = np.minimum(
                clearance, np.linalg.norm(np.maximum(local - 0.5 * model.box_size[box, :2], 0.0), axis=1)
            )
    return clearance


def find_push_pose(model: Model, near: np.ndarray) -> tuple[int, np.ndarray]:
    """Returns a bunch that an arm can push, and a pose [7] of the base with room around it, nearest to ``near`` [2] m.

    Raises :class:`PlacementError` if there is no such bunch.
    """
    centres = bunch_centres(model)
    height = above_ground(model.terrain, centres)
    high = np.flatnonzero((height > PUSH_HEIGHT[0]) & (height < PUSH_HEIGHT[1]))
    high = high[np.argsort(np.linalg.norm(centres[high, :2] - near, axis=1), kind="stable")][:MAX_CANDIDATES]
    centres = centres[high]
    heading = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    places = centres[:, None, :2] - 0.6 * ahead
    fits = (ground_clearance(model, places.reshape(-1, 2)) > BASE_CLEARANCE).reshape(places.shape[:2])
    if not fits.any():
        raise PlacementError(
            f"no bunch of this vineyard can be pushed: none hangs {PUSH_HEIGHT[0]} to {PUSH_HEIGHT[1]} m high "
            f"with {BASE_CLEARANCE} m of "
            "room for a robot before it; choose another scene or seed"
        )
    distance = np.where(fits, np.linalg.norm(places - near, axis=-1), np.inf)
    bunch, turn = np.unravel_index(int(np.argmin(distance)), distance.shape)
    stand = frames.pose(np.append(places[bunch, turn], 0.0), frames.from_yaw(heading[turn]))
    return int(high[bunch]), on_ground(model.terrain, stand)


def find_approach_pose(model: Model, place: np.ndarray, length: float) -> np.ndarray:
    """Returns the pose [7] of a base 1.6 m from a robot at ``place`` [7], at the end of the straight line of ``length``
    [m] with the most room. Another robot can approach along that line."""
    heading = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    best = place
    most = -np.inf
    for side in heading:
        goal = place[:2] + 1.6 * np.array([np.cos(side), np.sin(side)])
        for angle in heading:
            back = np.array([np.cos(angle), np.sin(angle)])
            line = goal - np.linspace(0.0, length, 40)[:, None] * back
            clearance = min(
                float(ground_clearance(model, line).min()), float(np.linalg.norm(line - place[:2], axis=1).min()) - 0.6
            )
            if clearance > most:
                best = on_ground(model.terrain, frames.pose(np.append(goal, 0.0), frames.from_yaw(angle)))
                most = clearance
    return best
