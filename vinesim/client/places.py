"""Where an actor starts, and what it can reach from there."""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.world.model import Model
from vinesim.world.scene import Scene

REACH = (0.35, 0.85)
"""How far a bunch may be ahead of a robot's base to be pushed by an arm [m]."""
HEIGHT = (1.2, 1.75)
"""Height of a bunch's centre that an arm reaches [m]."""


class NoPlace(ValueError):
    """A start place or a bunch that the scene does not have; the text says what it has."""


def spawn_pose(scene: Scene, number: int, back: float = 0.0) -> np.ndarray:
    """Pose [7] of a start place, moved backwards by ``back`` [m]; a line beside the vines if the scene names none."""
    if not scene.spawns:
        return frames.pose([-2.0 - back, 1.5 * number, 0.0])
    if number >= len(scene.spawns):
        known = ", ".join(f"{i} {spawn.name}" for i, spawn in enumerate(scene.spawns))
        raise NoPlace(f"scene {scene.name!r} has no start place {number}; it has: {known}")
    spawn = scene.spawns[number]
    ahead = np.array([np.cos(spawn.yaw), np.sin(spawn.yaw), 0.0])
    return frames.pose(np.array([spawn.x, spawn.y, 0.0]) - back * ahead, frames.yaw(spawn.yaw))


def bunch_centres(model: Model) -> np.ndarray:
    """Centres of all bunches at rest [bunch, 3] m."""
    body_q = model.forward(model.joint_settled)[model.bunch_body]
    axis = frames.rotate(body_q[:, 3:], np.array([1.0, 0.0, 0.0]))
    return body_q[:, :3] + 0.5 * model.bunch_length[:, None] * axis


def bunch_in_reach(model: Model, pose: np.ndarray) -> int:
    """The bunch that an arm reaches best from a base at ``pose`` [7]: in front, at arm's height, nearest to 0.6 m."""
    local = frames.rotate(frames.conjugate(pose[3:]), bunch_centres(model) - pose[:3])
    distance = np.hypot(local[:, 0], local[:, 1])
    sideways = np.abs(np.arctan2(local[:, 1], local[:, 0]))
    fits = (distance > REACH[0]) & (distance < REACH[1]) & (local[:, 2] > HEIGHT[0]) & (local[:, 2] < HEIGHT[1])
    fits &= sideways < 0.7
    if not fits.any():
        x, y = pose[:2]
        raise NoPlace(
            f"no bunch within reach of a robot at ({x:.2f}, {y:.2f}): none {REACH[0]} to {REACH[1]} m ahead "
            f"at {HEIGHT[0]} to {HEIGHT[1]} m height; choose another start place or seed"
        )
    return int(np.argmin(np.where(fits, np.abs(distance - 0.6) + 0.2 * sideways, np.inf)))


def checked_bunch(model: Model, bunch: int | None) -> int | None:
    """The bunch, if the vineyard has it."""
    if bunch is not None and not 0 <= bunch < len(model.bunch_body):
        raise NoPlace(f"no bunch {bunch}: this vineyard has 0 to {len(model.bunch_body) - 1}")
    return bunch
