"""The task of a carrier that works with a person: it takes a box, holds it before the person, and waits for a bunch.

meet = MeetPerson(physics, robot, plan)
while not meet.is_done:
    meet.control(time)
    robot.control(time)
    physics.step()
assert meet.succeeded, meet.reason
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.box_handling import LIFT_HEIGHT, BoxHandling
from vinesim.robot.tasks.task import TaskFailed
from vinesim.world import Physics

REST_TIME = 1.0
"""[s] For which a bunch must lie in the box. GUESSED"""


@dataclasses.dataclass(frozen=True)
class MeetPlan:
    """Which box to bring to which place, and the bunch that the person there picks."""

    bunch: int
    stand: np.ndarray
    """[2] m, where the person picks it."""
    box: int
    path_to_box: np.ndarray
    """[n, 2] m, from the start to a place with room to turn, straight before a long side of the box."""
    path_to_person: np.ndarray
    """[n, 2] m, from that place to the place where the robot waits."""
    heading: float
    """[rad] Heading of the robot at the waiting place, with the box towards the person."""


class MeetPerson(BoxHandling):
    """Brings a box to a person and waits for a bunch in it; ``succeeded`` and ``reason`` give the result."""

    key_phases = frozenset({"hold the box", "rest"})

    def __init__(self, physics: Physics, robot: Robot, plan: MeetPlan, *, timeout: float = 180.0) -> None:
        super().__init__(physics, robot, timeout=timeout)
        self.plan = plan

    def report(self) -> dict[str, Any]:
        """See :class:`Task`."""
        return {"handed_over": self.succeeded, "bunch": self.plan.bunch, "box": self.plan.box, **super().report()}

    def focus(self) -> np.ndarray:
        """See :class:`Task`."""
        return self.box_pose(self.plan.box)[:3]

    def run(self) -> Iterator[str]:
        """See :class:`Task`."""
        plan = self.plan
        low = float(self.box_pose(plan.box)[2])
        there = plan.path_to_box[-1] if len(plan.path_to_box) else self._base_pose()[:2]
        yield from self._follow_path("to the box", plan.path_to_box, self._away_from(plan.box, there) + math.pi)
        yield from self._take("take the box", "front", plan.box)
        yield from self._follow_path("to the person", plan.path_to_person, plan.heading)
        while plan.bunch not in self._bunches_in(plan.box):
            yield "hold the box"
        yield from self.wait(REST_TIME, "rest")
        if plan.bunch not in self._bunches_in(plan.box):
            raise TaskFailed(f"bunch {plan.bunch} fell out of the box")
        if self.box_pose(plan.box)[2] < low + 0.5 * LIFT_HEIGHT:
            raise TaskFailed("the box has been lost")
