"""The tasks of a robot client by name: planned before the start, begun once physics and robot exist."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from vinesim.client.tasks import meet_planning, pick_planning, swap_planning
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.meet_person import MeetPerson
from vinesim.robot.tasks.pick import PickBunch
from vinesim.robot.tasks.swap_boxes import SwapBoxes, SwapPlan
from vinesim.robot.tasks.task import Task
from vinesim.scene.model import Model
from vinesim.world import Physics

TASKS = ("pick", "exchange", "meet")
"""Names of the tasks that :func:`plan_task` plans."""


class UnknownTask(ValueError):
    """There is no task of that name; the text lists those that there are."""


def validate_task_name(job: str | None) -> str | None:
    """The name ``job``, or None; :class:`UnknownTask` if there is no such task."""
    if job is not None and job not in TASKS:
        raise UnknownTask(f"no job {job!r}; give {', '.join(TASKS[:-1])} or {TASKS[-1]}")
    return job


def plan_task(job: str, model: Model, near: np.ndarray) -> tuple[Callable[[Physics, Robot], Task], np.ndarray]:
    """Plan a task: a function that begins it, and the pose [7] at which the robot must start.

    ``near`` [7]: its start pose otherwise. Takes 1 to 2 s: not for the real-time loop. Raises :class:`UnknownTask`, and
    :class:`PlacementError` if the scene has no room for the task.
    """
    if validate_task_name(job) == "pick":
        plan = next(pick_planning.plan_picks(model, near[:2]))
        return functools.partial(PickBunch, plan=plan), plan.base_pose
    if job == "meet":
        return functools.partial(MeetPerson, plan=meet_planning.plan_meeting(model, near)), near
    boxes = swap_planning.plan_swap(model, near)
    return functools.partial(_begin_swap, swap=boxes), near


def _begin_swap(physics: Physics, robot: Robot, swap: SwapPlan) -> SwapBoxes:
    """Fill the box that is to be full, and begin the exchange."""
    swap_planning.fill_box(physics, swap.full_box)
    return SwapBoxes(physics, robot, swap)
