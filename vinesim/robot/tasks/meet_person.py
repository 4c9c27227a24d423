"""A task in which a robot works with a person: it takes a box, holds it in front of the person, and waits for a bunch.

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
"""[s] Time for which a bunch must be in the box. GUESSED"""


@dataclasses.dataclass(frozen=True)
class MeetPlan:
    """Plan of the task: which box to bring to which place, and which bunch the person there picks."""

    bunch: int
    stand: np.ndarray
    """[2] m, place where the person picks the bunch."""
    box: int
    path_to_box: np.ndarray
    """[n, 2] m, from the start to a place in front of a long side of the box, where the base can turn."""
    path_to_person: np.ndarray
    """[n, 2] m, from the end of ``path_to_box`` to the place where the robot waits."""
    heading: float
    """[rad] Heading of the waiting robot, with the box towards the person."""


class MeetPerson(BoxHandling):
    """Brings a box to a person and waits for a bunch in it. ``succeeded`` and ``reason`` hold the result."""

    key_phases = frozenset({"hold the box", "rest"})

    def __init__(self, physics: Physics, robot: Robot, plan: MeetPlan, *, timeout: float = 180.0) -> None:
        super().__init__(physics, robot, timeout=timeout)
        self.plan = plan

    def report(self) -> dict[str, Any]:
        """Returns the result of the task as plain values for JSON: handed over or not, bunch, box, and durations of
        the phases."""
        return {"handed_over": self.succeeded, "bunch": self.plan.bunch, "box": self.plan.box, **super().report()}

    def focus(self) -> np.ndarray:
        """Returns the position of the box [3] m in the world, at which the head camera is to look."""
        return self.box_pose(self.plan.box)[:3]

    def run(self) -> Iterator[str]:
        """The task: take the box, bring it to the person, and wait until the bunch rests in it. Yields the name of
        the phase, once per step."""
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
