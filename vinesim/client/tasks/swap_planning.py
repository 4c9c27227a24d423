"""Planning of box exchanges: paths between the boxes; and a box filled with bunches for the start."""

from __future__ import annotations

import numpy as np

from vinesim.client.tasks.path_planning import find_path
from vinesim.client.tasks.start_poses import PlacementError, ground_clearance
from vinesim.core import frames
from vinesim.robot.tasks.swap_boxes import SwapPlan
from vinesim.scene.model import Model
from vinesim.world import Physics

TURNING_RADIUS = 0.92
"""[m] A carrier with a box at either end needs this distance around its centre to turn."""
TURNING_DISTANCES = (1.20, 1.35, 1.50)
"""[m] Distances from the centre of a box at which it turns; the first with room is taken."""
LANE_HALF_WIDTH = 0.40
"""[m] It needs this on either side of its centre while it drives straight."""
BUNCHES_PER_LAYER = 6
"""Bunches side by side in one layer of a filled box."""


def plan_swap(model: Model, start: np.ndarray, full: int = 0, empty: int = 1) -> SwapPlan:
    """Plan the exchange of two boxes, from a base at ``start`` [7]; :class:`PlacementError` if there is no room for
    it."""
    if max(full, empty) >= len(model.box_pose):
        raise PlacementError(f"no box {max(full, empty)}: this scene has {len(model.box_pose)}; name more in its file")
    here = start[:2]
    legs = []
    for box in (empty, full):
        ways = [find_path(model, here, place, TURNING_RADIUS) for place in turning_places(model, box)]
        ways = [points for points in ways if points is not None]
        if not ways:
            raise PlacementError(
                f"no way for a carrier to turn before box {box}: it needs {TURNING_RADIUS} m around it; move the box"
            )
        shortest = min(ways, key=lambda points: float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))
        legs.append(shortest[1:])
        here = shortest[-1]
    return SwapPlan(start, full, empty, *legs)


def turning_places(model: Model, box: int) -> list[np.ndarray]:
    """Places [2] m straight before the long sides of a box, with room to turn and a free lane to the box."""
    pose = model.box_pose[box].astype(float)
    size = model.box_size[box].astype(float)
    across = np.array([0.0, 1.0, 0.0]) if size[0] >= size[1] else np.array([1.0, 0.0, 0.0])
    normal = frames.rotate(pose[3:], across)[:2]
    places = []
    for side in (1.0, -1.0):
        for far in TURNING_DISTANCES:
            place = pose[:2] + far * side * normal
            lane = pose[:2] + np.linspace(0.1, far, 12)[:, None] * side * normal
            if (
                ground_clearance(model, place[None])[0] > TURNING_RADIUS
                and ground_clearance(model, lane, without=box).min() > LANE_HALF_WIDTH
            ):
                places.append(place)
                break
    return places


def fill_box(physics: Physics, box: int, count: int = 6) -> None:
    """Detach ``count`` bunches and put them into a box in layers, as the start of an exchange.

    Call it between steps. The bunches farthest from the box are taken, so that those around it stay.
    """
    model = physics.model
    pose = model.box_pose[box].astype(float)
    size = model.box_size[box].astype(float)
    apart = np.linalg.norm(physics.state.body_q[model.bunch_body, :2] - pose[:2], axis=1)
    attached = np.flatnonzero(physics.state.bunch_attached)
    chosen = attached[np.argsort(-apart[attached], kind="stable")][:count]
    columns = BUNCHES_PER_LAYER // 2
    for i, bunch in enumerate(chosen.tolist()):
        layer, place = divmod(i, BUNCHES_PER_LAYER)
        column = place % columns
        row = place // columns
        x = (column - 0.5 * (columns - 1)) * (size[0] - 0.04) / columns
        y = (row - 0.5) * 0.5 * (size[1] - 0.04)
        # along y, centred at (x, y)
        start = np.array([x, y - 0.5 * float(model.bunch_length[bunch]), 0.10 + 0.14 * layer])
        physics.pick(bunch)
        turned = frames.pose(start, frames.from_yaw(0.5 * np.pi))
        physics.rigid.place_bunch(bunch, frames.compose(pose, turned), np.zeros(6))
