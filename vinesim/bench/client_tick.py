"""``vinesim bench tick``: the whole tick of a robot client with the push task, paced in real time and back to back.

A paced client sleeps until each step is due, 100 times a second, as it does for users. Its caches are cold then, and a
step takes two to five times as long as back to back. So the paced figures count; the figures of steps back to back are
given in addition.

The real client steps on a clock that advances by one step a tick, so that it sends as many messages a tick as in real
time. Its bus is in memory. Where a case has subscribers, the client writes all records, true poses and snapshots that
its ROS process and its sensor process request when every topic has a subscriber. Those processes themselves do not run.

Times are given in processor time, which other programs on the machine change less, and in wall time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import time
import types
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from multiprocessing.context import BaseContext
from typing import Any
from unittest import mock

import numpy as np

from vinesim.client.client import Client
from vinesim.client.processes import ros_process, sensor_process
from vinesim.client.rate_loop import RateLoop
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.start_poses import QUEUE_SPACING, find_push_pose, start_pose
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.values import Measurement

WARM_UP_TICKS = 300
MEASURED_TICKS = 1000
PARTS = ("receive", "control", "step", "sense", "send")
"""Parts of a tick, in their order."""
TRUTH_PERIOD = 0.1
"""Simulated time between two true poses of all bunches [s], as the ROS process requests them by default."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One measured kind of client: its properties, and budgets of its median times [ms]."""

    scene: str
    robots: int = 1
    has_visitor: bool = False
    """Whether a second client with a robot is near: this client then simulates a copy of that robot and exchanges
    states."""
    has_subscribers: bool = False
    """Whether all topics of the first robot have subscribers."""
    tick_budget: float | None = None
    step_budget: float | None = None
    """Budget of a step of the physics back to back [ms, median]."""

    @property
    def text(self) -> str:
        """Description of the case."""
        text = f"{self.scene}, {self.robots} robot{'s' * (self.robots > 1)}, one pushes"
        return text + ", a visitor beside" * self.has_visitor + ", all topics subscribed" * self.has_subscribers


CASES = (
    Case("demo", has_subscribers=True),
    Case("demo", tick_budget=1.2, step_budget=0.6),
    Case("demo", has_visitor=True, tick_budget=1.2),
    Case("demo", robots=10, tick_budget=2.0),
    Case("tendone", tick_budget=2.0),
)


@dataclasses.dataclass(frozen=True)
class TickTimes:
    """Processor and wall times of measured ticks and of their parts [s]."""

    cpu: np.ndarray
    """Processor time of the thread in each part, and in the whole tick [tick, part + 1] s."""
    wall: np.ndarray
    """Wall time of each part, and of the whole tick [tick, part + 1] s."""


def client_measurements() -> Iterator[Measurement]:
    """Measure whole ticks and their parts, paced and back to back, each compared with its budget if it has one."""
    robot = load_description("vinebot")
    for case in CASES:
        scene = load_scene(case.scene)
        yield from _measure(case, scene, generate(scene), robot)


class PushingClient:
    """A client whose first robot pushes a bunch again and again, with the network in memory.

    With ``has_visitor`` a second client joins the same world. Its robot stands behind the first robot, so that both
    clients exchange states.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model,
        robot: RobotDescription,
        stack: contextlib.ExitStack,
        *,
        robots: int = 1,
        has_visitor: bool = False,
        has_subscribers: bool = False,
    ) -> None:
        self._hub = MemoryHub()
        self._now = 0.0
        bunch, pose = find_push_pose(model, start_pose(scene, 0)[:2])
        self.client = client = self._add_client(scene, model, robot, "robot_0", pose, stack)
        for i in range(1, robots):
            name = f"robot_{i}"
            behind = frames.pose([-QUEUE_SPACING * i, 0.0, 0.0])
            client.add_robot(robot, name, frames.compose(pose, behind), stack.enter_context(self._hub.bus(name)))
        self._visitor: Client | None = None
        if has_visitor:
            behind = frames.compose(pose, frames.pose([-QUEUE_SPACING, 0.0, 0.0]))
            self._visitor = self._add_client(scene, model, robot, "visitor", behind, stack)
        self._drain: Callable[[], int] = lambda: 0
        self.taken_steps = 0
        """Number of step records that the subscribers have taken."""
        if has_subscribers:
            self._drain = _subscribe_to_all(client, scene, model, robot, stack)
        rest = client.physics.state.body_q[model.bunch_body[bunch]].copy()
        client.trace = trace = Trace(model, bunch, rest, 1 << 16)
        self.push = PushBunch(client.robot, client.side_of(trace.centre()), trace.centre)
        client.pre_step += [self.push.control, LookAt(client.robot, trace.centre)]
        self._marks = np.zeros((2 * len(PARTS), 2))
        """Processor time of the thread and wall time at the begin and end of each part [2 * part, 2] s."""
        for i, name in enumerate(PARTS):
            owner = client.physics if name == "step" else client
            setattr(owner, name, functools.partial(self._time, i, getattr(owner, name)))

    def _time(self, part: int, work: Callable[..., None], *arguments: Any) -> None:
        marks = self._marks
        marks[2 * part] = time.thread_time(), time.perf_counter()
        work(*arguments)
        marks[2 * part + 1] = time.thread_time(), time.perf_counter()

    def _add_client(
        self,
        scene: Scene,
        model: Model,
        robot: RobotDescription,
        name: str,
        pose: np.ndarray,
        stack: contextlib.ExitStack,
    ) -> Client:
        bus = stack.enter_context(self._hub.bus(name))
        return Client(scene, model, robot, bus, name=name, pose=pose, clock=lambda: self._now)

    def tick(self) -> np.ndarray:
        """Step both clients once. Returns processor and wall time of the first client's parts, and of its whole tick
        [part + 1, 2] s."""
        client = self.client
        begin = time.thread_time(), time.perf_counter()
        client.tick()
        whole = time.thread_time() - begin[0], time.perf_counter() - begin[1]
        if self._visitor is not None:
            self._visitor.tick()
        self.taken_steps += self._drain()
        self._hub.advance(client.physics.dt)
        self._now += client.physics.dt
        return np.concatenate([self._marks[1::2] - self._marks[::2], [whole]])

    def measure(self, ticks: int, *, is_paced: bool) -> TickTimes:
        """Run ``ticks`` ticks and return their times. ``is_paced``: each tick begins when it is due in real time,
        otherwise the ticks follow each other."""
        loop = RateLoop(self.client.physics.dt)
        times = np.zeros((ticks, len(PARTS) + 1, 2))
        for row in times:
            if is_paced:
                loop.begin()
            row[:] = self.tick()
            if is_paced:
                loop.end()
        return TickTimes(times[..., 0], times[..., 1])


class _Demand:
    """Object in place of a worker process of the client, as if all topics had subscribers. It takes the messages that
    the client writes."""

    is_ready = True
    pid = 0
    standby_pid = None
    restarts = 0
    restart_time = 0.0

    def __init__(
        self,
        title: str,
        modules: Any,
        target: Any,
        config: Any,
        share: Callable[[BaseContext], Any],
        receive: Any,
        **_: Any,
    ) -> None:
        self.title = title
        self.shared = share(get_context())
        self.process = types.SimpleNamespace(pid=os.getpid())

    def current(self) -> _Demand:
        """Returns this object, in place of the present run of a worker process."""
        return self

    def send(self, kind: str, value: Any = None) -> None:
        """Ignore a message to the worker process."""

    def wait_until_ready(self, timeout: float) -> None:
        """Return at once: a real process may not be ready yet, this object always is."""

    def raise_failure(self) -> None:
        """Do nothing: this object never fails."""

    def close(self) -> None:
        """Release the shared memory."""
        self.shared.close()


def _subscribe_to_all(
    client: Client, scene: Scene, model: Model, robot: RobotDescription, stack: contextlib.ExitStack
) -> Callable[[], int]:
    """Request from the client all records that the topics of its first robot need. Returns a function that takes the
    waiting step records and returns their number."""
    with mock.patch.object(ros_process, "WorkerProcess", _Demand):
        ros = stack.enter_context(ros_process.RosProcess(client.name, model, robot))
    with mock.patch.object(sensor_process, "WorkerProcess", _Demand):
        sensors = stack.enter_context(sensor_process.SensorProcess(client.name, scene, model, robot))
    channel = ros.worker.current().shared
    channel.wanted["steps"][:] = True
    channel.wanted["truth_period"][0] = TRUTH_PERIOD
    sensors.worker.current().shared.wanted["world"][0] = True
    sensors.attach(client)
    ros.attach(client)

    def drain() -> int:
        count = 0
        while channel.steps.waiting_count:
            channel.steps.take(0.0)
            count += 1
        return count

    return drain


def _measure(case: Case, scene: Scene, model: Model, robot: RobotDescription) -> Iterator[Measurement]:
    """Yields the measurements of one kind of client: ticks that are paced in real time, and ticks back to back."""
    with contextlib.ExitStack() as stack:
        pushing = PushingClient(
            scene,
            model,
            robot,
            stack,
            robots=case.robots,
            has_visitor=case.has_visitor,
            has_subscribers=case.has_subscribers,
        )
        pushing.measure(WARM_UP_TICKS, is_paced=False)
        paced = pushing.measure(MEASURED_TICKS, is_paced=True)
        loop = pushing.measure(MEASURED_TICKS, is_paced=False)
    yield from _rows(f"{case.text}: paced", paced, case.tick_budget, None)
    yield from _rows(f"{case.text}: loop", loop, None, case.step_budget)


def _rows(text: str, times: TickTimes, tick_budget: float | None, step_budget: float | None) -> Iterator[Measurement]:
    """Yields the rows of one measurement: median and 99th percentile of the whole tick and of each part, in processor
    time and in wall time.

    ``text``: description of the case. ``tick_budget``, ``step_budget``: budgets of the processor time of the whole tick
    and of its physics step [ms]; None: no budget.
    """
    budgets = {"whole tick": tick_budget, "step": step_budget}
    for kind, values in (("CPU", times.cpu), ("wall", times.wall)):
        for name, column in zip((*PARTS, "whole tick"), 1e3 * values.T, strict=True):
            budget = budgets.get(name) if kind == "CPU" else None
            yield _row(f"{text}, {kind}, {name}, p50", float(np.median(column)), budget)
            yield _row(f"{text}, {kind}, {name}, p99", float(np.percentile(column, 99)))


def _row(case: str, value: float, budget: float | None = None) -> Measurement:
    """Returns a row with a time ``value`` [ms]. ``case``: description; ``budget``: largest accepted value [ms], None:
    none."""
    if budget is None:
        return Measurement("tick", case, value, "ms/tick")
    return Measurement("tick", case, value, "ms/tick", "budget", budget, budget / value)
