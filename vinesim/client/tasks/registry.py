"""The tasks of a robot client by name. They are planned before the start and begin when physics and robot exist."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from vinesim.client.tasks.harvesting import NO_BOX, Candidates, HarvestByTruth, HarvestOptions
from vinesim.client.tasks.planning import box_approaches, fill_box, plan_meeting, plan_swap
from vinesim.client.tasks.pruning import PruningRule, plan_pruning
from vinesim.client.tasks.seen_harvest import HarvestBySight
from vinesim.client.tasks.seen_pruning import PruneBySight, VineStretch, vine_stretch
from vinesim.client.tasks.start_poses import PlacementError
from vinesim.core.errors import UsageError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.meet_person import MeetPerson
from vinesim.robot.tasks.prune import PruneCanes
from vinesim.robot.tasks.sight import RobotSight
from vinesim.robot.tasks.swap_boxes import SwapBoxes, SwapPlan
from vinesim.robot.tasks.task import Task
from vinesim.scene.model import Model
from vinesim.world import Physics

TASKS = ("pick", "exchange", "meet", "prune")
"""Names of the tasks that :func:`plan_task` plans."""


SEEING_TASKS = ("pick", "prune")
"""Names of the tasks in which the robot can find plants by its own camera."""


class UnknownTask(ValueError):
    """Error: no task has the given name. The message lists all tasks."""


def validate_task_name(job: str | None) -> str | None:
    """Returns the name ``job``, or None. Raises :class:`UnknownTask` if there is no such task."""
    if job is not None and job not in TASKS:
        raise UnknownTask(f"no job {job!r}; give {', '.join(TASKS[:-1])} or {TASKS[-1]}")
    return job


def validate_sight(job: str | None, see: bool) -> None:
    """Raises :class:`UsageError` if the robot is to see and ``job`` has no such way."""
    if see and job not in SEEING_TASKS:
        given = "no --job" if job is None else f"--job {job}"
        raise UsageError(f"--see with {given}: only {' and '.join(SEEING_TASKS)} go by the camera; leave out --see")


def plan_task(
    job: str,
    model: Model,
    near: np.ndarray,
    harvest: HarvestOptions | None = None,
    eyes: Callable[[Physics, Robot], RobotSight] | None = None,
) -> tuple[Callable[[Physics, Robot], Task], np.ndarray]:
    """Plan a task. Returns a function that begins it, and the pose [7] at which the robot must start.

    ``near`` [7]: usual start pose of the robot. ``harvest``: which bunches are picked; one, unless given. ``eyes``:
    makes the eyes of a robot that picks or prunes by sight; without it, it works by poses of the simulation. Planning
    takes 1 to 2 s, too long for the real-time loop. Raises :class:`UnknownTask`, :class:`UsageError` if the task has no
    way by sight, and :class:`PlacementError` if the scene has no room for the task.
    """
    validate_task_name(job)
    validate_sight(job, eyes is not None)
    if job == "pick":
        options = harvest or HarvestOptions()
        if not len(model.bunch_body):
            raise PlacementError("this vineyard has no bunch to pick; raise fruit.bunches in its scene file")
        if eyes is not None:
            if next(box_approaches(model), None) is None:
                raise PlacementError(NO_BOX)
            return functools.partial(_begin_harvest_by_sight, options=options, near=near[:2], eyes=eyes), near
        candidates = Candidates.of_model(model, near[:2])
        plan = candidates.next_plan(near[:2], set(), options, 0)
        if plan is None:
            raise PlacementError("no bunch hangs where a robot reaches it and drives to a box; choose another seed")
        return functools.partial(HarvestByTruth, options=options, candidates=candidates), plan.base_pose
    if job == "prune" and eyes is not None:
        stretch = vine_stretch(model, near[:2])
        return functools.partial(_begin_pruning_by_sight, stretch=stretch, eyes=eyes), stretch.start(model)
    if job == "prune":
        stops = plan_pruning(model, near[:2], PruningRule())
        return functools.partial(PruneCanes, stops=stops), stops[0].base_pose
    if job == "meet":
        return functools.partial(MeetPerson, plan=plan_meeting(model, near)), near
    boxes = plan_swap(model, near)
    return functools.partial(_begin_swap, swap=boxes), near


def _begin_harvest_by_sight(
    physics: Physics,
    robot: Robot,
    options: HarvestOptions,
    near: np.ndarray,
    eyes: Callable[[Physics, Robot], RobotSight],
) -> HarvestBySight:
    return HarvestBySight(physics, robot, options, near, eyes(physics, robot))


def _begin_pruning_by_sight(
    physics: Physics, robot: Robot, stretch: VineStretch, eyes: Callable[[Physics, Robot], RobotSight]
) -> PruneBySight:
    return PruneBySight(physics, robot, stretch, PruningRule(), eyes(physics, robot))


def _begin_swap(physics: Physics, robot: Robot, swap: SwapPlan) -> SwapBoxes:
    """Fill the box that must be full, and begin the exchange."""
    fill_box(physics, swap.full_box)
    return SwapBoxes(physics, robot, swap)
