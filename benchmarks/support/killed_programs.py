"""A vineyard of real programs that may be killed: two linked servers, two robots, a person, a ROS listener."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import signal
import socket
import time
from typing import Any

import numpy as np

from vinesim.client.client import Client
from vinesim.client.programs import Program, ProgramFailed, ProgramGroup
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.core import frames
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.ros import middleware
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

SCENE = "demo"
ROBOTS = ("left", "right")
"""Names of the robots: left is connected to the server, right to the router."""
WITNESS = "witness"
"""Name of the person in this process, who picks bunches and is never killed."""
WITNESS_PLACE = (2.5, 1.4)
"""Where the person stands, out of the robots' reach [m]."""
REACH = (0.5, 11.5, -5.5, 5.5)
"""Area with x from, x to, y from, y to [m]: bunches in it are in cells that all clients subscribe to."""
SENSOR_HZ = "2"
"""Rate of pictures [Hz], enough to notice whether they go on."""
CAMERA = "head_front_camera/rgb/image_raw"
TOPICS = ("/clock", "/joint_states", f"/{CAMERA}", "/right/joint_states", f"/right/{CAMERA}")
"""Topics that the listener must go on to receive."""
SETTLING = 1.0
"""A program counts as going on if it does so for at least this long after a kill [s]."""


@dataclasses.dataclass
class RestartedProgram:
    """A program as its user starts it; it is started again after it was killed."""

    name: str
    arguments: tuple[str, ...]
    process: Program
    lines: list[tuple[float, dict[str, Any]]] = dataclasses.field(default_factory=list)
    """Time of arrival [s, monotonic] and content of each JSON line since the last kill of any program, after the newest
    line from before that kill."""

    def read(self) -> None:
        """Read new lines of the program. Raises :class:`ProgramFailed` if it has ended."""
        now = time.monotonic()
        self.lines += [(now, json.loads(line)) for line in self.process.new_lines() if line.startswith("{")]

    def since(self, moment: float) -> list[dict[str, Any]]:
        """Returns the lines of JSON since a ``moment`` [s, monotonic]."""
        return [values for came, values in self.lines if came > moment]


class Vineyard:
    """The programs and the person of one vineyard. A context manager that ends all at its exit."""

    def __init__(self, group: ProgramGroup, folder: pathlib.Path, *, ros: bool, seed: int) -> None:
        """Start all programs. ``folder``: for the server's state; ``ros``: start ROS processes and a listener, too."""
        self._group = group
        self._random = np.random.default_rng(seed)
        self.ros = ros and middleware.unavailable_reason() is None
        self.programs: dict[str, RestartedProgram] = {}
        self.picked: set[int] = set()
        """Bunches that the person has picked."""
        server = _free_endpoint()
        router = _free_endpoint()
        command = ("-m", "vinesim", "server", "--status", "json", "--listen")
        self._start("server", *command, server, "--state-dir", str(folder / "state"))
        if self.ros:
            words = [word for topic in TOPICS for word in ("--topic", topic)]
            self._start("ROS listener", "-m", "vinesim.ros.tools.topic_monitor", "--announce", *words)
        self._wait_for_endpoint(server)
        self._start("router", *command, router, "--connect", server)
        self._wait_for_endpoint(router)
        for i, (name, endpoint) in enumerate(zip(ROBOTS, (server, router), strict=True)):
            options = ("--standby", "--spawn", str(i), "--sensor-hz", SENSOR_HZ, "--namespace", name if i else "")
            options += () if self.ros else ("--no-ros",)
            self._start(
                name,
                "-m",
                "vinesim",
                "client",
                "--status",
                "json",
                "--scene",
                SCENE,
                "--name",
                name,
                "--connect",
                endpoint,
                *options,
            )
        self._stack = contextlib.ExitStack()
        scene = load_scene(SCENE)
        self._model = generate(scene)
        bus = self._stack.enter_context(ZenohBus(WITNESS, connect=server))
        place = frames.pose(np.array([*WITNESS_PLACE, 0.0]))
        self.witness = Client(scene, self._model, None, bus, name=WITNESS, pose=place)
        self._stack.callback(self.witness.leave)
        self._next_tick = time.monotonic()

    def _start(self, name: str, *arguments: str) -> None:
        self.programs[name] = RestartedProgram(name, arguments, self._group.start(name, *arguments))

    def _wait_for_endpoint(self, endpoint: str) -> None:
        """Return when a server listens at ``endpoint``."""
        host, port = endpoint.removeprefix("tcp/").split(":")
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 1.0):
                return
            time.sleep(0.05)
        raise ProgramFailed(f"nothing listens on {endpoint}")

    # ------------------------------------------------------------------ while all goes on

    def step(self) -> None:
        """Step the person if due, and read the programs' output. Raises :class:`ProgramFailed` if a program has
        ended."""
        time.sleep(max(self._next_tick - time.monotonic(), 0.0))
        self._next_tick = max(self._next_tick + self.witness.physics.dt, time.monotonic())
        self.witness.tick()
        for program in self.programs.values():
            program.read()
        if self.ros and self.witness.physics.tick % 20 == 0:
            self.programs["ROS listener"].process.write_line("counts")

    def pick(self) -> None:
        """Let the person pick a bunch, unless half of all bunches are picked."""
        places = bunch_centres(self._model)[:, :2]
        x0, x1, y0, y1 = REACH
        near = np.logical_and((places > (x0, y0)).all(1), (places < (x1, y1)).all(1))
        left = np.flatnonzero(near & self.witness.physics.state.bunch_attached)
        if len(left) > len(places) // 2:
            bunch = int(self._random.choice(left))
            self.witness.physics.pick(bunch)
            self.picked.add(bunch)

    def workers(self, robot: str) -> dict[str, int]:
        """Returns the process ids of a robot client's workers, by their kind."""
        lines = self.programs[robot].lines
        return {what.removesuffix(f" of {robot}"): pid for what, pid in lines[-1][1]["processes"].items()}

    def sensor_restarts(self, robot: str) -> int:
        """Returns how often the sensor process of a robot was restarted, by the client's newest line."""
        return int(self.programs[robot].lines[-1][1]["sensor_restarts"])

    # ------------------------------------------------------------------ a kill

    def kill(self, name: str, worker: str = "") -> float:
        """Kill a program and start it again, or kill a ``worker`` of a robot client, which restarts it. Returns the
        time of the kill [s, monotonic]."""
        program = self.programs[name]
        for other in self.programs.values():
            del other.lines[:-1]
        now = time.monotonic()
        if worker:
            os.kill(self.workers(name)[worker], signal.SIGKILL)
        else:
            os.kill(program.process.child.pid, signal.SIGKILL)
            program.process.child.wait()
            self._start(name, *program.arguments)
        return now

    def missing(self, moment: float) -> list[str]:
        """Returns one text for each program or function that has not worked since a kill, such as "ada: steps".

        ``moment`` [s, monotonic]: time of the kill.
        """
        missing = []
        for name in ROBOTS:
            missing += [f"{name}: {what}" for what in self._missing_of_robot(name, moment)]
        others = set(self.witness.remote_actors)
        if others != set(ROBOTS):
            missing.append(f"{WITNESS}: others ({', '.join(sorted(others))})")
        if set(np.flatnonzero(~self.witness.physics.state.bunch_attached).tolist()) != self.picked:
            missing.append(f"{WITNESS}: picked bunches")
        missing += self._missing_of_server(moment)
        return missing + (self._missing_topics(moment + SETTLING) if self.ros else [])

    def _missing_of_robot(self, name: str, moment: float) -> list[str]:
        said = self.programs[name].since(moment + SETTLING)
        if len(said) < 2 or said[-1]["time"] <= said[0]["time"]:
            return ["steps"]
        newest = said[-1]
        missing = []
        if set(newest["others"]) != {WITNESS, *ROBOTS} - {name}:
            missing.append(f"others ({', '.join(newest['others'])})")
        if newest["bunches_picked"] != len(self.picked):
            missing.append(f"picked bunches ({newest['bunches_picked']} of {len(self.picked)})")
        if not newest["sensors_ready"]:
            missing.append("sensors")
        if f"standby of {name}" not in newest["processes"]:
            missing.append("standby process")
        return missing

    def _missing_of_server(self, moment: float) -> list[str]:
        said = self.programs["server"].since(moment + SETTLING)
        if not said:
            return ["server: status"]
        actors = {one.rpartition("/")[2] for one in said[-1]["actors"]}
        missing = [] if actors == {WITNESS, *ROBOTS} else [f"server: actors ({', '.join(sorted(actors))})"]
        if said[-1]["facts"] < len(self.picked):
            missing.append(f"server: retained records ({said[-1]['facts']} of {len(self.picked)})")
        return missing

    def _missing_topics(self, moment: float) -> list[str]:
        said = [one["counts"] for one in self.programs["ROS listener"].since(moment) if "counts" in one]
        if len(said) < 2:
            return ["ROS listener: counts"]
        return [f"ROS listener: {topic}" for topic in TOPICS if said[-1].get(topic, 0) <= said[0].get(topic, 0)]

    def close(self) -> None:
        """Let the person leave. The programs end with their process group."""
        self._stack.close()

    def __enter__(self) -> Vineyard:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _free_endpoint() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"
