"""A server and clients with physics as programs, without ROS and sensors, and their newest status lines."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from vinesim.client.programs import START_TIMEOUT, Program, ProgramFailed, ProgramGroup, free_port
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

SCENE = "demo"
FACTOR = 0.2
"""Real-time factor of the world: 20 steps a second, so that a machine with other load can follow."""
POLL_PERIOD = 0.02
"""Time between two reads of the programs' output [s]."""


class SmallWorld:
    """One server, and people who stand next to each other."""

    def __init__(self, group: ProgramGroup, people: int) -> None:
        self._group = group
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.server = self._start_server()
        self.server.next_line(START_TIMEOUT)
        self.model = generate(load_scene(SCENE))
        self.place = bunch_centres(self.model)[0, :2] - (1.5, 0.0)
        """Place of the first person [m]; the others stand behind."""
        self.clients: dict[str, Program] = {}
        self.newest: dict[str, dict[str, Any]] = {}
        self.heard: dict[str, float] = {}
        """Time of the newest status line of each person [s]."""
        for i in range(people):
            name = f"person_{i}"
            where = ("--pose", f"{self.place[0] - i:.3f}", f"{self.place[1]:.3f}", "0")
            common = ("--connect", self.endpoint, "--scene", SCENE, "--status", "json", *where)
            self.clients[name] = group.start(
                name, "-m", "vinesim", "client", "--role", "human", "--name", name, *common
            )

    def _start_server(self) -> Program:
        words = ("--listen", self.endpoint, "--status", "json", "--real-time-factor", f"{FACTOR:g}")
        return self._group.start("server", "-m", "vinesim", "server", *words)

    def kill_server(self) -> None:
        """Kill the server, start another one in its place, and wait until that one lists all people. Raises
        :class:`ProgramFailed` if it prints nothing for :data:`START_TIMEOUT`."""
        self.server.child.kill()
        self.server.child.wait()
        self.server = self._start_server()
        names = {f"vineyard/{name}" for name in self.clients}
        while not names <= {*json.loads(self.server.next_line(START_TIMEOUT))["actors"]}:
            self.read_clients()

    def read(self) -> None:
        """Read new status lines. Raises :class:`ProgramFailed` if a program has ended."""
        self.server.new_lines()
        self.read_clients()

    def read_clients(self) -> None:
        """Read new status lines of the people. Raises :class:`ProgramFailed` if one has ended."""
        for name, client in self.clients.items():
            for line in client.new_lines():
                self.newest[name] = json.loads(line)
                self.heard[name] = time.monotonic()

    def all_served(self, since: float, others: int) -> bool:
        """Whether all people have said after ``since`` [s] that they are served and see so many ``others``."""
        return len(self.newest) == len(self.clients) and all(
            self.heard[name] > since and not one["network"] and len(one["others"]) == others
            for name, one in self.newest.items()
        )

    def wait_until_served(self, since: float, others: int, timeout: float) -> float:
        """Wait for :meth:`all_served`. Returns the time since ``since`` [s]; more than ``timeout`` [s] if in vain."""
        while not self.all_served(since, others):
            self.read()
            if time.monotonic() > since + timeout:
                break
            time.sleep(POLL_PERIOD)
        return time.monotonic() - since

    def wait_until_ready(self) -> None:
        """Wait until all people see each other. Raises :class:`ProgramFailed` after :data:`START_TIMEOUT`."""
        start = time.monotonic()
        if self.wait_until_served(start, len(self.clients) - 1, START_TIMEOUT) > START_TIMEOUT:
            raise ProgramFailed(f"not ready after {START_TIMEOUT:.0f} s")


def beside(place: np.ndarray, number: int) -> tuple[float, float]:
    """Returns a place within 5 m of another ``place`` [m], by number."""
    return float(place[0]) - 2.0 + 0.4 * (number % 10), float(place[1]) + 1.0 + 0.4 * (number // 10)
