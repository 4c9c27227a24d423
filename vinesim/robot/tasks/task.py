"""Base class of a robot's tasks. A task is a generator that commands the robot and yields the name of its phase, once
per step.

    class Wave(Task):
        def run(self):
            for angle in (0.5, -0.5, 0.0):
                self.robot.command_position([angle], ["arm_left_3_joint"])
                yield from self.wait(1.0, "wave")

        def focus(self):
            return self.robot.frame_pose(self.robot.description.groups["arm_left"].tool)[:3]

A :class:`TaskFailed` that is raised in the generator ends the task. Its text becomes the task's ``reason``.
"""

from __future__ import annotations

import abc
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot

log = logging.getLogger(__name__)


class TaskFailed(Exception):
    """A task that cannot continue. The text gives the reason."""


class Task(abc.ABC):
    """Base class of tasks. :meth:`run` is advanced by one step in each :meth:`control`."""

    key_phases: frozenset[str] = frozenset()
    """Names of the phases in which pictures are most useful."""

    def __init__(self, robot: Robot, *, timeout: float) -> None:
        """``timeout`` [s]: time after which the task fails."""
        self.robot = robot
        self.timeout = timeout
        self.time = 0.0
        """Start of the present step [s]."""
        self.phase = ""
        """Name of the present phase."""
        self.durations: dict[str, float] = {}
        """[s] Duration of each phase, by name of the phase, in their order."""
        self.is_done = False
        """Whether the task has ended, successfully or not."""
        self.reason = ""
        """Reason of a failure; empty unless the task has failed."""
        self._started: float | None = None
        self._coroutine = self.run()

    @property
    def succeeded(self) -> bool:
        """Whether the task has ended without a failure."""
        return self.is_done and not self.reason

    def frame_score(self) -> float:
        """Returns how useful a picture would be now, from 0 to 1; 1 in one of :attr:`key_phases`."""
        return float(self.phase in self.key_phases)

    def report(self) -> dict[str, Any]:
        """Returns the result of the task as plain values for JSON."""
        phases = {phase: round(seconds, 2) for phase, seconds in self.durations.items()}
        return {"succeeded": self.succeeded, "reason": self.reason, "phase": self.phase, "phases_s": phases}

    @abc.abstractmethod
    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the head camera is to look."""

    @abc.abstractmethod
    def run(self) -> Iterator[str]:
        """The task itself: command the robot and yield the name of the phase, once per step. May raise
        :class:`TaskFailed`."""

    def control(self, time: float) -> None:
        """Command the robot for the step that starts at ``time`` [s]. Call this before ``robot.control``."""
        if self.is_done:
            return
        if self._started is None:
            self._started = time
        self.time = time
        try:
            if time - self._started > self.timeout:
                raise TaskFailed(f"not done after {self.timeout:g} s")
            self.phase = next(self._coroutine)
            self.durations[self.phase] = self.durations.get(self.phase, 0.0) + self.robot.rigid.dt
        except StopIteration:
            self.is_done = True
        except TaskFailed as failure:
            self.is_done = True
            self.reason = f"{self.phase}: {failure}"
            log.warning("%s: %s", self.robot.name, self.reason)

    def wait(self, seconds: float, phase: str) -> Iterator[str]:
        """Wait for ``seconds`` [s] of simulated time, in the phase ``phase``."""
        end = self.time + seconds
        while self.time < end:
            yield phase
