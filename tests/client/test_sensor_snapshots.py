"""What sensors read of the client's world: stamps of scans are those of the steps in which they began, however late
they are computed; wires are where they are."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import threading
import types
from collections.abc import Iterator

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.client.client import Client
from vinesim.client.processes import sensor_process, sensor_worker
from vinesim.client.processes.sensor_process import SensorProcess
from vinesim.client.processes.sensor_worker import SensorWorker
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraOutput, LidarScan

STAND = 0.25
CATCH_UP = 3e-3
"""How long the client stands once, and its steps while it catches up [s]."""
SCAN_PERIOD = 0.1
"""Of the robot's lidar [s]."""


class Node:
    """Stands for the ROS node of the sensors: the lidar has a subscriber, the camera has none."""

    def __init__(self) -> None:
        self.set_parameters: dict[str, object] = {}
        self.sent: dict[str, int] = {}
        self.dropped: dict[str, int] = {}
        self.scans: list[LidarScan] = []
        self.publish = self.scans.append

    def rate(self, _name: str) -> float:
        return 1.0 / SCAN_PERIOD

    def outputs_wanted(self, name: str) -> CameraOutput:
        return CameraOutput.DEPTH if name == "lidar" else CameraOutput.NONE


class OneProcess:
    """The client's writer of snapshots and the worker that reads them, in one process, by turns."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack, model: Model) -> None:
        self.node = Node()
        monkeypatch.setattr(SensorWorker, "_open_node", lambda *_: self.node)
        monkeypatch.setattr(sensor_process, "WorkerProcess", self._worker_process)
        scene = load_scene("demo")
        vinebot = load_description("vinebot")
        self.client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        self.sensors = stack.enter_context(SensorProcess("robot", scene, model, vinebot, ros=True))
        self.sensors.attach(self.client)
        self.worker = SensorWorker(self.config, self.channel, self.worker_pipe, stack)
        self.channel.wanted["world"][0] = True

    def _worker_process(self, _name, _modules, _entry, config, open_channel, _receive, rehearsal):
        self.pipe, self.worker_pipe = multiprocessing.Pipe()
        self.config = config
        self.channel = open_channel(multiprocessing.get_context("spawn"))
        run = types.SimpleNamespace(
            shared=self.channel,
            send=lambda kind, value: self.pipe.send((kind, value)),
            process=types.SimpleNamespace(pid=os.getpid()),
        )
        return types.SimpleNamespace(
            is_ready=True,
            current=lambda: run,
            wait_until_ready=lambda _timeout: None,
            raise_failure=lambda: None,
            close=self.channel.close,
        )

    def render(self) -> None:
        """Let the worker take the newest snapshot."""
        assert self.worker._take_messages()
        if (world := self.worker._read()) is not None:
            snapshot, earlier = world
            self.worker.scheduler.advance(snapshot, earlier.pop()[1], earlier)
            self.channel.wanted["shown"][0] = self.worker._last_number


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[OneProcess]:
    with contextlib.ExitStack() as stack:
        yield OneProcess(monkeypatch, stack, assemble([cane((50.0, 5.0, 1.0), radius=0.005)]))


@pytest.mark.parametrize("turn", [2, 30], ids=["worker in time", "worker 0.3 s late"])
def test_scans_are_stamped_when_they_began_while_a_client_catches_up(world: OneProcess, turn: int):
    """Stamps rise, and are those of steps that are whole revolutions apart."""
    client = world.client
    steps = 120
    passed = np.full(steps, client.physics.dt)
    passed[steps // 2] = STAND
    passed[steps // 2 + 1 :] = CATCH_UP
    simulated = []
    stamps = []
    for step, now in enumerate(itertools.accumulate(passed, initial=1000.0)):
        client.world_time.follow(client.physics.time, now)
        client.tick()
        simulated.append(client.physics.time)
        stamps.append(client.physics.time + client.world_time.offset)
        if step % turn == turn - 1:
            world.render()
    found = [scan.time for scan in world.node.scans]
    assert len(found) >= 3
    assert (np.diff(found) > 0.0).all()
    revolutions = np.diff(np.interp(found, stamps, simulated)) / SCAN_PERIOD
    np.testing.assert_allclose(revolutions, np.round(revolutions), atol=1e-3)


def test_wires_that_a_swinging_shoot_takes_along_are_read_as_they_are(monkeypatch: pytest.MonkeyPatch):
    model = generate(load_scene("demo"))
    tree = int(model.body_tree[model.tie_body[model.tie_wire >= 0]][0])
    with contextlib.ExitStack() as stack:
        world = OneProcess(monkeypatch, stack, model)
        physics = world.client.physics
        seen = 0
        physics.plants.wake(np.array([tree]))
        physics.state.joint_qd[model.bodies_of(tree)] = 0.3
        for _ in range(20):
            world.client.tick()
            world.client.tick()  # a snapshot is written every second step
            assert world.worker._take_messages()
            snapshot, _ = world.worker._read()
            expected = physics.snapshot().wires
            np.testing.assert_array_equal(snapshot.wires.segment, expected.segment)
            np.testing.assert_array_equal(snapshot.wires.q, expected.q)
            seen = max(seen, len(expected.segment))
        assert seen > 0


def test_a_subscriber_that_leaves_and_returns_between_two_checks_does_not_hold_the_steps_for_ever(world: OneProcess):
    """The worker has then said that it wants no snapshots, and still has the promise to the sensor."""
    client = world.client
    client.tick()
    client.tick()
    world.render()
    world.channel.wanted["world"][0] = False
    while not client.held():
        client.tick()
    assert client.physics.time < 1.0
    world.render()
    assert not client.held()


def test_counts_include_the_snapshots_that_were_written_before_they_were_asked_for(world: OneProcess, monkeypatch):
    """Also if the worker takes the request first: the digests of two runs in lockstep are of the same frames."""
    monkeypatch.setattr(sensor_worker, "report_ready", lambda *_: None)  # it lowers the priority of its process
    world.client.tick()
    world.client.tick()
    world.pipe.send(("count", None))
    thread = threading.Thread(target=world.worker.run, daemon=True)
    thread.start()
    try:
        while world.pipe.recv()[0] != "counted":
            pass
        assert world.channel.wanted["shown"][0] == world.sensors._snapshot_count
    finally:
        world.pipe.send(("stop", None))
        thread.join()
