"""A job told in the order in which it happens: a generator that commands, then yields once a tick.

    class Wave(Task):
        def run(self):
            for angle in (0.5, -0.5, 0.0):
                self.robot.command_position([angle], ["arm_left_3_joint"])
                yield from self.wait(1.0, "wave")

        def focus(self):
            return self.robot.frame_pose(self.robot.description.groups["arm_left"].tool)[:3]

What goes wrong ends the job with a reason in words.
"""

from __future__ import annotations

import abc
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.robot.drives.robot import Robot

log = logging.getLogger(__name__)


class TaskFailed(Exception):
    """The job cannot go on; the text says why."""


class Task(abc.ABC):
    """Runs :meth:`run` one tick at a time. ``reason`` is empty as long as all goes well."""

    key_phases: frozenset[str] = frozenset()
    """Phases of which a picture tells most."""

    def __init__(self, robot: Robot, *, timeout: float) -> None:
        """Given up after ``timeout`` [s]."""
        self.robot, self.timeout = robot, timeout
        self.time = 0.0
        """Of the present tick [s]."""
        self.phase = ""
        """What it is at."""
        self.durations: dict[str, float] = {}
        """How long each phase took, in their order [s]."""
        self.is_done = False
        self.reason = ""
        """Why it failed, if it did."""
        self._started: float | None = None
        self._coroutine = self.run()

    @property
    def succeeded(self) -> bool:
        """Whether it came to its end."""
        return self.is_done and not self.reason

    def frame_score(self) -> float:
        """How much there is to see now, from 0 to 1."""
        return float(self.phase in self.key_phases)

    def report(self) -> dict[str, Any]:
        """How it went, as plain values for JSON."""
        phases = {phase: round(seconds, 2) for phase, seconds in self.durations.items()}
        return {"succeeded": self.succeeded, "reason": self.reason, "phase": self.phase, "phases_s": phases}

    @abc.abstractmethod
    def focus(self) -> np.ndarray:
        """What to look at [3] m in the world."""

    @abc.abstractmethod
    def run(self) -> Iterator[str]:
        """The job: commands the robot and yields the name of the phase, once a tick; raises :class:`TaskFailed`."""

    def control(self, time: float) -> None:
        """Command the robot for the tick that starts at ``time`` [s]; ``robot.control`` comes after it."""
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
        """Let ``seconds`` [s] pass."""
        end = self.time + seconds
        while self.time < end:
            yield phase
