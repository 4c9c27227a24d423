"""The logistic task: a robot with a clamp at either end replaces a full box by an empty one.

    exchange = SwapBoxes(physics, robot, plan)
    while not exchange.is_done:
        exchange.control(time)
        robot.control(time)
        physics.step()
    assert exchange.succeeded, exchange.reason

The rear clamp fetches the empty box, and the front clamp takes the full one. Then the base turns round, and the rear
clamp puts the empty box down. The poses of base, clamps and boxes are read from the physics. Boxes are held by friction
only.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.box_handling import CLAMP_TIME, LIFT_HEIGHT, BoxHandling
from vinesim.robot.tasks.task import TaskFailed
from vinesim.world import Physics

RELEASE_HEIGHT = 0.004
"""[m] Height of a box's underside above the ground at which the robot's clamp releases the box. It is so small because
the box then stands on the ground even if the clamp sags.
"""
PLACEMENT_TOLERANCE = 0.05
"""[m] Largest permitted distance between the empty box and the place where the full box stood. GUESSED"""


@dataclasses.dataclass(frozen=True)
class SwapPlan:
    """Plan of the task: which boxes to exchange, and the paths between them."""

    start: np.ndarray
    """[7] Pose of the base at the beginning."""
    full_box: int
    empty_box: int
    path_to_empty: np.ndarray
    """[n, 2] m, from the start to a place in front of a long side of the empty box, where the base can turn."""
    path_to_full: np.ndarray
    """[n, 2] m, from the end of ``path_to_empty`` to a place in front of a long side of the full box, where the base
    can turn."""


class SwapBoxes(BoxHandling):
    """Replaces a full box by an empty one. ``succeeded`` and ``reason`` hold the result."""

    GROUPS = ("lift_front", "clamp_front", "lift_rear", "clamp_rear")

    def __init__(self, physics: Physics, robot: Robot, plan: SwapPlan, *, timeout: float = 180.0) -> None:
        super().__init__(physics, robot, timeout=timeout)
        self.plan = plan
        self._target_pose = self.box_pose(plan.full_box)
        """Pose [7] at which the full box stood at the beginning."""
        self._contents = self._bunches_in(plan.full_box)

    def report(self) -> dict[str, Any]:
        """Returns the result of the task as plain values for JSON: exchanged or not, boxes, number of bunches, and
        durations of the phases."""
        boxes = {"full": self.plan.full_box, "empty": self.plan.empty_box, "bunches": len(self._contents)}
        return {"exchanged": self.succeeded, **boxes, **super().report()}

    def focus(self) -> np.ndarray:
        """Returns the position of the full box [3] m in the world, at which the head camera is to look."""
        return self.box_pose(self.plan.full_box)[:3]

    # ------------------------------------------------------------------ the task

    def run(self) -> Iterator[str]:
        """The task: take the empty box, take the full box, turn, and put the empty box down. Yields the name of the
        phase, once per step."""
        swap = self.plan
        yield from self._follow_path(
            "to the empty box", swap.path_to_empty, self._away_from(swap.empty_box, swap.path_to_empty[-1])
        )
        yield from self._take("take the empty box", "rear", swap.empty_box)
        yield from self._follow_path(
            "to the full box", swap.path_to_full, self._away_from(swap.full_box, swap.path_to_full[-1]) + math.pi
        )
        yield from self._take("take the full box", "front", swap.full_box)
        yield from self._follow_path(
            "turn", np.zeros((0, 2)), self._away_from(swap.full_box, swap.path_to_full[-1], self._target_pose)
        )
        yield from self._put_down("rear", swap.empty_box)
        self._check_result()

    def _put_down(self, end: str, box: int) -> Iterator[str]:
        """Put the box in the clamp at ``end`` down where the full box stood, and return to where the base can turn."""
        phase = "leave the empty box"
        here = self._base_pose()[:2].copy()
        yield from self._align_clamp(phase, end, self._target_pose)
        down = float(self.robot.rigid.joint_measurements(self.robot.name)[0][self._lift_index(end)])
        yield from self._move_lift(
            phase, end, down - float(self.box_pose(box)[2] - self._target_pose[2]) + RELEASE_HEIGHT
        )
        fingers = self.robot.description.joint_indices(f"clamp_{end}")
        self.robot.command_position(self.robot.upper_limit[fingers], fingers)
        yield from self.wait(CLAMP_TIME, phase)
        yield from self._drive_straight(phase, here, backwards=end == "front")

    def _check_result(self) -> None:
        """Raise :class:`TaskFailed` if a box is not where it should be, or if a bunch has fallen out."""
        swap = self.plan
        off = float(np.linalg.norm(self.box_pose(swap.empty_box)[:2] - self._target_pose[:2]))
        if off > PLACEMENT_TOLERANCE:
            raise TaskFailed(f"the empty box stands {off:.2f} m from where the full one stood")
        if self.box_pose(swap.full_box)[2] < self._target_pose[2] + 0.5 * LIFT_HEIGHT:
            raise TaskFailed("the full box has been lost on the way")
        if lost := sorted(set(self._contents) - set(self._bunches_in(swap.full_box))):
            raise TaskFailed(f"{len(lost)} of {len(self._contents)} bunches fell out of the full box: {lost}")
