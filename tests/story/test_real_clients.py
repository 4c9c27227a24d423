"""Whole clients in processes of their own: a server that is killed, and ten robots in one world."""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tests.support.waiting import deadline
from vinesim.client.client import Client
from vinesim.client.programs import START_TIMEOUT, Program, ProgramGroup, free_port, program_group
from vinesim.client.tasks.start_poses import bunch_centres, start_pose
from vinesim.core import frames
from vinesim.net.codec.control import RetainedRecord
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

SCENE = "demo"
WITNESS_PLACE = (2.5, 1.4)
"""Where the person of this process stands, out of the robots' reach [m]."""
LATE_PLACE = (3.5, 1.4)
"""Where the person who comes later stands [m]."""


class Clients:
    """Robots as their users start them, without ROS, and their newest status lines."""

    def __init__(self, group: ProgramGroup, endpoint: str, count: int, *options: str) -> None:
        self.programs = {f"robot_{i}": self._start(group, endpoint, i, options) for i in range(count)}
        self.newest: dict[str, dict[str, Any]] = {}
        self.heard: dict[str, float] = {}
        """Time of the newest line of each robot [s]."""

    @staticmethod
    def _start(group: ProgramGroup, endpoint: str, i: int, options: tuple[str, ...]) -> Program:
        name = f"robot_{i}"
        pose = start_pose(load_scene(SCENE), 0, queue=i)
        place = ("--pose", *(f"{value:.4f}" for value in (*pose[:2], frames.to_yaw(pose[3:]))))
        common = ("--connect", endpoint, "--scene", SCENE, "--no-ros", "--sensor-hz", "0.1", "--status", "json")
        return group.start(
            name, "-m", "vinesim", "client", "--role", "robot", "--name", name, *place, *common, *options
        )

    def read(self) -> None:
        for name, program in self.programs.items():
            for line in program.new_lines():
                self.newest[name] = json.loads(line)
                self.heard[name] = time.monotonic()

    def said_since(self, moment: float) -> list[dict[str, Any]]:
        """Returns the newest line of each robot, if all came after a ``moment`` [s]; else nothing."""
        if len(self.newest) < len(self.programs) or min(self.heard.values()) <= moment:
            return []
        return list(self.newest.values())


def start_server(group: ProgramGroup, endpoint: str, folder: pathlib.Path, factor: str) -> Program:
    words = ("--status", "json", "--state-dir", str(folder), "--real-time-factor", factor)
    server = group.start("server", "-m", "vinesim", "server", "--listen", endpoint, *words)
    server.next_line(START_TIMEOUT)
    return server


def records(client: Client) -> dict[int, RetainedRecord]:
    """Returns the retained records that a client knows, by object."""
    return {record.object: record for _, record in client.replicator._state.retained.state}


def wait_for(condition: Callable[[], object], what: str, each: Callable[[], None], seconds: float = 240.0) -> None:
    """Call ``each`` until ``condition()`` holds."""
    end = time.monotonic() + deadline(seconds)
    while not condition():
        each()
        assert time.monotonic() < end, f"waited in vain for: {what}"
        time.sleep(0.005)


@pytest.fixture
def group() -> Iterator[ProgramGroup]:
    with program_group(5.0) as programs:
        yield programs


@pytest.mark.long
def test_clients_with_physics_go_on_when_the_server_is_killed(group: ProgramGroup, tmp_path: pathlib.Path) -> None:
    """F08: two robots and a person; the person picks a bunch before the server is killed, one while it is dead, and one
    after its successor has come. All see each other, and the server's records are the person's."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = start_server(group, endpoint, tmp_path, "0.3")
    clients = Clients(group, endpoint, 2)
    scene = load_scene(SCENE)
    model = generate(scene)
    near = np.argsort(np.linalg.norm(bunch_centres(model)[:, :2] - WITNESS_PLACE, axis=1), kind="stable")
    with ZenohBus("witness", connect=endpoint) as bus:
        witness = Client(scene, model, None, bus, name="witness", pose=frames.pose(np.array([*WITNESS_PLACE, 0.0])))

        def each() -> None:
            witness.tick()
            clients.read()
            server.new_lines()

        def all_served(since: float, picked: int) -> bool:
            said = clients.said_since(since)
            return (
                len(said) == 2
                and all(len(one["others"]) == 2 and one["bunches_picked"] == picked for one in said)
                and not any(one["network"] for one in said)
                and not bus.status_message
                and set(witness.remote_actors) == {"robot_0", "robot_1"}
            )

        witness.physics.pick(int(near[0]))
        wait_for(lambda: all_served(0.0, 1), "all to see each other, and the first pick", each)
        server.child.kill()
        server.child.wait()
        before = {name: one["time"] for name, one in clients.newest.items()}
        killed = time.monotonic()
        witness.physics.pick(int(near[1]))

        def alone() -> None:
            witness.tick()
            clients.read()

        wait_for(
            lambda: (
                bus.status_message and all(one["network"] for one in clients.said_since(killed) or [{"network": ""}])
            ),
            "all to notice",
            alone,
        )
        moment = time.monotonic()
        wait_for(lambda: clients.said_since(moment), "a status of each robot", alone)
        assert all(one["time"] > before[name] for name, one in clients.newest.items()), "they simulate alone"
        server = start_server(group, endpoint, tmp_path, "0.3")
        restarted = time.monotonic()
        wait_for(lambda: all_served(restarted, 2), "the pick that was made without a server", each)
        witness.physics.pick(int(near[2]))
        wait_for(lambda: all_served(restarted, 3), "the last pick", each)
        kept = records(witness)
        assert len(kept) >= 3
        with ZenohBus("late", connect=endpoint) as late_bus:
            late = Client(
                scene,
                model,
                None,
                late_bus,
                name="late",
                pose=frames.pose(np.array([LATE_PLACE[0], LATE_PLACE[1], 0.0])),
            )

            def both() -> None:
                each()
                late.tick()

            wait_for(lambda: records(late) == kept, "the same records at one who comes later", both)
            assert (late.physics.state.bunch_attached == witness.physics.state.bunch_attached).all()
            late.leave()
        witness.leave()


@pytest.mark.long
def test_ten_robots_of_ten_clients_share_a_world(group: ProgramGroup, tmp_path: pathlib.Path) -> None:
    """F13: each is a process with physics and sensors. All see all others, and the world goes on for two seconds."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = start_server(group, endpoint, tmp_path, "auto")
    clients = Clients(group, endpoint, 10)

    def each() -> None:
        clients.read()
        server.new_lines()
        time.sleep(0.05)

    wait_for(
        lambda: len(clients.newest) == 10 and all(len(one["others"]) == 9 for one in clients.newest.values()),
        "ten robots to see nine others each",
        each,
        900.0,
    )
    start = {name: one["time"] for name, one in clients.newest.items()}
    wait_for(
        lambda: all(one["time"] >= start[name] + 2.0 for name, one in clients.newest.items()),
        "two seconds of simulated time",
        each,
        900.0,
    )
    assert all(len(one["others"]) == 9 for one in clients.newest.values())
    assert not any(one["network"] for one in clients.newest.values())
    faults = {name: one["faults"] for name, one in clients.newest.items()}
    strange = {"malformed", "messages_foreign", "messages_refused"}
    assert not any(strange & {key for key, count in found.items() if count} for found in faults.values()), faults
