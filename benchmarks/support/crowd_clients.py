"""Whole clients without renderers, several in one process, which a benchmark controls by lines of JSON.

Each client has the whole physics and a session of its own on Zenoh. The clients of one process step in turn, at the
pace of the world's clock. The process reads one command a line from standard input, and answers each with one line:

* ``{"do": "report"}``: nothing but the answer.
* ``{"do": "work"}``: each actor picks its bunch and pushes its box.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from benchmarks.support.json_process import JsonProcess
from vinesim.client.client import Client
from vinesim.client.rate_loop import paced_loop
from vinesim.core import frames
from vinesim.net.codec.control import encode_records
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose

PUSH = 0.15
"""Distance by which each actor pushes its box [m]."""
PUSH_TIME = 1.0
"""Duration of a push [s] of simulated time."""
HEIGHT = 1.75
"""Height of people [m]."""


def place_of(number: int, count: int, apart: float) -> np.ndarray:
    """Returns the position [2] m of the actor ``number`` among ``count`` actors in rows ``apart`` [m]."""
    row = int(np.ceil(np.sqrt(count)))
    return apart * np.array([number % row, number // row], float)


def yard(count: int, apart: float) -> Model:
    """Returns a model with a short cane and its bunch 0.35 m from each of ``count`` places, and a box before each
    place. ``apart``: distance of neighbours [m]."""
    trees = []
    boxes = []
    for number in range(count):
        x, y = place_of(number, count, apart)
        tree = TreeBuilder(frames.pose(np.array([x - 0.2, y + 0.6, 1.6])))
        tip = tree.add_rod(-1, 0.3, (0.006, 0.004), RodMaterial(2e9, 900.0), 3)[-1]
        tree.add_bunch(tip, 0.4, clusters=False)
        trees.append(tree)
        boxes.append(frames.pose([x + 0.55, y, 0.001]))
    return assemble(
        trees, box_pose=np.array(boxes), box_size=np.tile([0.2, 0.3, 0.2], (count, 1)), box_mass=np.full(count, 1.0)
    )


def is_person(number: int) -> bool:
    """Returns whether the actor ``number`` is a person: every second one is."""
    return number % 2 == 1


class Worker:
    """One client and its work."""

    def __init__(self, number: int, count: int, apart: float, client: Callable[..., Client]) -> None:
        self.number = number
        self.began = np.inf
        x, y = place_of(number, count, apart)
        robot = None if is_person(number) else load_description("logistic")
        self.client = client(
            robot, name=f"actor{number}", pose=frames.pose([x, y, 0.0]), source=None if robot else self._walk(x, y)
        )
        self.client.physics.wind = None

    def _walk(self, x: float, y: float) -> Callable[[float], HumanPose]:
        def source(_: float) -> HumanPose:
            share = min(max((self.client.physics.time - self.began) / PUSH_TIME, 0.0), 1.0)
            return standing_pose(frames.pose([x + (0.25 + PUSH) * share, y, 0.0]), HEIGHT)

        return source

    def work(self) -> None:
        """Pick the bunch, and begin to push the box."""
        self.began = self.client.physics.time
        self.client.physics.pick(self.number)

    def tick(self) -> None:
        """Step the client."""
        if self.client.physics.time < self.began + PUSH_TIME:
            for robot in self.client.robots.values():
                speed = 0.0 if self.began == np.inf else (0.15 + PUSH) / PUSH_TIME
                robot.command_base(speed, 0.0, self.client.physics.time)
        self.client.tick()

    def report(self, count: int) -> dict[str, Any]:
        """Returns what the benchmark compares."""
        client = self.client
        records = {}
        for kind in (ObjectKind.BUNCH, ObjectKind.BOX):
            for number in range(count):
                record = client.replicator.record(object_id(kind, number))
                if record is not None:
                    digest = hashlib.blake2b(encode_records([record]), digest_size=8).hexdigest()
                    cell = client.replicator.record_cell(object_id(kind, number))
                    claim = (record.ownership, record.authority, record.author)
                    records[f"{kind.name}/{number}"] = (digest, record.moving, claim, cell)
        return {
            "number": self.number,
            "time": client.physics.time,
            "bytes_in": client.replicator.bus.bytes_in,
            "bodies": len(client.remote_actors),
            "known": len(client.replicator.peers),
            "placed": len(client.replicator.peer_positions()),
            "owned": len(client.replicator.owned),
            "records": records,
            "window": list(client.replicator.record_window),
            "missed": client.replicator.bus.missed,
            "admissions": client.replicator.bus.admissions,
            "faults": {name: value for name, value in client.physics.faults.items() if value},
        }


class CrowdProcess(JsonProcess):
    """A process with some of the clients, as the benchmark controls it. A context manager."""

    def __init__(self, connect: str, numbers: list[int], count: int, apart: float) -> None:
        wanted = {"connect": connect, "numbers": numbers, "count": count, "apart": apart}
        super().__init__("benchmarks.support.crowd_clients", wanted)


def run(connect: str, numbers: list[int], count: int, apart: float) -> None:
    """Step the clients ``numbers`` of ``count`` until standard input ends."""
    from vinesim.net.transport.zenoh_bus import ZenohBus

    scene = load_scene("demo")
    model = yard(count, apart)
    commands: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    with contextlib.ExitStack() as stack:
        executor = stack.enter_context(ThreadPoolExecutor(1, "spawner"))

        def client(robot: Any, *, name: str, **options: Any) -> Client:
            bus = stack.enter_context(ZenohBus(name, connect=connect))
            return Client(scene, model, robot, bus, name=name, executor=executor, **options)

        workers = [Worker(number, count, apart, client) for number in numbers]
        threading.Thread(target=_read_commands, args=(commands,), daemon=True).start()
        first = workers[0].client
        loop = paced_loop(first, is_shared=True)
        first.replicator.report_pace(loop.report)
        for worker in workers[1:]:
            worker.client.follow_steps(lambda: loop.next_time)
        first.wait_for_clock(5.0)
        while True:
            loop.begin()
            for worker in workers:
                worker.tick()
            loop.end()
            while not commands.empty():
                command = commands.get()
                if command is None:
                    return
                if command["do"] == "work":
                    for worker in workers:
                        worker.work()
                answer = {
                    "clients": [worker.report(count) for worker in workers],
                    "world": loop.next_time,
                    "steps": loop.ticks,
                    "skipped": loop.dropped,
                    "cpu": time.process_time(),
                }
                sys.stdout.write(json.dumps(answer) + "\n")
                sys.stdout.flush()


def _read_commands(commands: queue.SimpleQueue) -> None:
    for line in sys.stdin:
        commands.put(json.loads(line))
    commands.put(None)


if __name__ == "__main__":
    run(**json.loads(sys.argv[1]))
