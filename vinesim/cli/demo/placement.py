"""Start poses of the robots of a demo, as options of ``vinesim client``; and checks of the demo's options."""

from __future__ import annotations

import math

import numpy as np

from vinesim.client.tasks import start_poses
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene

APPROACH_DISTANCE = 14
"""Distance from which the visitor approaches [m], beyond the interest radius."""
VISITOR_DISTANCE = 3.0
"""Distance from which a visitor watches a task [m]."""


def choose_poses(scene: Scene, model: Model) -> tuple[int, tuple[list[str], list[str]]]:
    """Returns the bunch to push, and the options for the start poses of picker and visitor.

    If a bunch is within reach of the scene's first start pose, the poses are the scene's first two start poses.
    Otherwise the picker is placed at a bunch, and the visitor at a distance from the picker.
    """
    start = start_poses.spawn_pose(scene, 0)
    try:
        return start_poses.find_reachable_bunch(model, start), (["--spawn", "0"], ["--spawn", "1"])
    except start_poses.PlacementError:
        bunch, picker = start_poses.find_push_pose(model, start[:2])
    visitor = start_poses.find_approach_pose(model, picker, APPROACH_DISTANCE)
    return bunch, (_pose_option(picker), _pose_option(visitor))


def visitor_pose(scene: Scene) -> list[str] | None:
    """Returns command line options for the pose of a visitor that watches a task: next to the picker, towards the
    second start place. None if the scene has no second start place."""
    if len(scene.spawns) < 2:
        return None
    here, there = (start_poses.spawn_pose(scene, i)[:2] for i in (0, 1))
    way = (there - here) / max(float(np.linalg.norm(there - here)), 1e-9)
    place = here + VISITOR_DISTANCE * way
    return ["--pose", f"{place[0]:.4f}", f"{place[1]:.4f}", f"{math.atan2(-way[1], -way[0]):.4f}"]


def _pose_option(pose: np.ndarray) -> list[str]:
    return ["--pose", *(f"{value:.4f}" for value in (pose[0], pose[1], 2.0 * math.atan2(pose[5], pose[6])))]


# Checks of a demo's options before any process starts.


def check_device(device: str) -> None:
    """Raise DeviceUnavailable for a missing device. For the CPU the function skips the imports, which take a second."""
    if device != "cpu":
        from vinesim.plants.device_buffers import find_device

        find_device(device)
