"""``vinesim bench tick``: the whole tick of a robot client with the push job, split into its five parts.

The real client steps back to back on a clock that advances by one step a tick, so that it sends as many messages a tick
as in real time. Its bus is in memory. Sensors and ROS run in other processes and are not part of these times.

Budgets stand beside processor time, which other programs on the machine change little; the wall time of whole ticks is
given too.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from vinesim import frames
from vinesim.client.client import Client
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.start_poses import QUEUE_SPACING, find_push_pose, start_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.values import Measurement

WARM_UP_TICKS, MEASURED_TICKS = 300, 2000
PARTS = ("receive", "control", "step", "sense", "send")
"""Parts of a tick, in their order."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One client that is measured, and its budgets [ms, p50]."""

    scene: str
    robots: int
    has_visitor: bool
    """Whether a second client with a robot is near: its copy is simulated here, and states are exchanged."""
    tick_budget: float
    step_budget: float | None = None


CASES = (
    Case("demo", 1, False, tick_budget=1.2, step_budget=0.6),
    Case("demo", 1, True, tick_budget=1.2),
    Case("demo", 10, False, tick_budget=2.0),
    Case("tendone", 1, False, tick_budget=2.0),
)


def client_measurements() -> Iterator[Measurement]:
    """Whole ticks and their parts, each beside its budget where there is one."""
    robot = load_description("vinebot")
    for case in CASES:
        scene = load_scene(case.scene)
        yield from _measure(case, scene, generate(scene), robot)


class PushingClient:
    """A client in whose world the first robot pushes a bunch again and again; a second client may watch beside it."""

    def __init__(
        self, scene: Scene, model: Model, robot: RobotDescription, stack: contextlib.ExitStack, *,
        robots: int = 1, has_visitor: bool = False,
    ) -> None:  # fmt: skip
        self._hub, self._now = MemoryHub(), 0.0
        bunch, pose = find_push_pose(model, start_pose(scene, 0)[:2])
        self.client = client = self._add_client(scene, model, robot, "robot_0", pose, stack)
        for i in range(1, robots):
            name, behind = f"robot_{i}", frames.pose([-QUEUE_SPACING * i, 0.0, 0.0])
            client.add_robot(robot, name, frames.compose(pose, behind), stack.enter_context(self._hub.bus(name)))
        self._visitor: Client | None = None
        if has_visitor:
            behind = frames.compose(pose, frames.pose([-QUEUE_SPACING, 0.0, 0.0]))
            self._visitor = self._add_client(scene, model, robot, "visitor", behind, stack)
        rest = client.physics.state.body_q[model.bunch_body[bunch]].copy()
        client.trace = trace = Trace(model, bunch, rest, WARM_UP_TICKS + MEASURED_TICKS)
        self.push = PushBunch(client.robot, client.side_of(trace.centre()), trace.centre)
        client.pre_step += [self.push.control, LookAt(client.robot, trace.centre)]

    def _add_client(
        self, scene: Scene, model: Model, robot: RobotDescription, name: str, pose: np.ndarray,
        stack: contextlib.ExitStack,
    ) -> Client:  # fmt: skip
        bus = stack.enter_context(self._hub.bus(name))
        return Client(scene, model, robot, bus, name=name, pose=pose, clock=lambda: self._now)

    def tick(self) -> np.ndarray:
        """One tick of both clients; processor times of the parts of the first one's, then its wall time [6] s."""
        client, now = self.client, self._now
        start = time.perf_counter()
        marks = [time.thread_time()]
        client.receive(now)
        marks.append(time.thread_time())
        client.control()
        marks.append(time.thread_time())
        client.physics.step()
        marks.append(time.thread_time())
        client.sense()
        marks.append(time.thread_time())
        client.send(now)
        marks.append(time.thread_time())
        wall = time.perf_counter() - start
        if self._visitor is not None:
            self._visitor.tick()
        self._hub.advance(client.physics.dt)
        self._now += client.physics.dt
        return np.append(np.diff(marks), wall)


def _measure(case: Case, scene: Scene, model: Model, robot: RobotDescription) -> Iterator[Measurement]:
    """Rows of one case."""
    with contextlib.ExitStack() as stack:
        pushing = PushingClient(
            scene, model, robot, stack, robots=case.robots, has_visitor=case.has_visitor
        )  # fmt: skip
        for _ in range(WARM_UP_TICKS):
            pushing.tick()
        *parts, wall = 1e3 * np.array([pushing.tick() for _ in range(MEASURED_TICKS)]).T
    text = f"{case.scene}, {len(model.bunch_body)} bunches, {case.robots} robot{'s' * (case.robots > 1)}, one pushes"
    text += ", a visitor beside" * case.has_visitor
    whole = np.sum(parts, axis=0)
    yield _row(f"{text}: whole tick, p50", float(np.median(whole)), case.tick_budget)
    yield _row(f"{text}: whole tick, p99", float(np.percentile(whole, 99)))
    yield _row(f"{text}: wall time, p50", float(np.median(wall)))
    yield _row(f"{text}: wall time, p99", float(np.percentile(wall, 99)))
    for name, times in zip(PARTS, parts, strict=True):
        budget = case.step_budget if name == "step" else None
        yield _row(f"{text}: {name}, p50", float(np.median(times)), budget)


def _row(case: str, value: float, budget: float | None = None) -> Measurement:
    """A row, beside its budget if it has one."""
    if budget is None:
        return Measurement("tick", case, value, "ms/tick")
    return Measurement("tick", case, value, "ms/tick", "budget", budget, budget / value)
