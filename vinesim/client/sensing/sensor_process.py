"""What a robot perceives and tells ROS, seen from the tick: a process of its own does the work.

Rendering and publishing hold Python's interpreter lock for milliseconds at a time. In threads beside the tick they cost
it its beat (docs/decisions/senses-process.md has the figures), so they live in a process, to which the tick hands one
letter a tick through shared memory and of which it never waits for an answer.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import pathlib
import pickle
import types
from typing import Any, Self

import numpy as np

from vinesim.client.client import Client
from vinesim.client.sensing.latest_value import LatestValue, poller
from vinesim.client.sensing.sensor_worker import SensorConfig, StepSnapshot, run_sensor_worker
from vinesim.client.tasks.tasks import RosCommandHandler
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.robot import Robot
from vinesim.ros import ros_setup
from vinesim.ros.commands.types import Command
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene

log = logging.getLogger(__name__)

SNAPSHOT_PERIOD = 2
"""Ticks between two views for the eyes: 50 Hz, faster than any camera here."""
START_TIMEOUT = 300.0
"""How long the process may take to start; a first run compiles kernels [s]."""
SAVE_TIMEOUT = 10.0
"""How long the process may take to write its pictures [s]."""
EXIT_TIMEOUT = 1.2
"""How long it may take to end [s]."""


class SensorProcessError(RuntimeError):
    """The process of the senses failed; the text says how."""

    exit_code = 3


class SensorProcess:
    """Cameras, lidars and the ROS node of the client's robot. A context: the process ends with it."""

    def __init__(
        self,
        name: str,
        scene: Scene,
        model: Model,
        description: RobotDescription,
        *,
        namespace: str = "",
        ros: bool = True,
        keep_pictures: bool = False,
        sensor_hz: float | None = None,
        clock: bool | None = None,
        renderer: str = "warp",
    ) -> None:
        """Starts the process; :meth:`attach` gives it something to perceive.

        ``keep_pictures`` renders the first camera even if no ROS peer listens, and keeps the picture of the greatest
        displacement of the watched bunch for :meth:`save`. ``sensor_hz`` replaces the sensors' own rates. ``clock``:
        publish /clock; unless given, whoever has no namespace does, since a ROS domain has one clock.
        """
        self.name = name
        self._attached = False
        if ros and (reason := ros_setup.unavailable_reason()) is not None:
            log.warning("running without ROS 2: %s", reason)
            ros = False
        self._ros = ros
        self._sensors = {place.name: place.frame for place in (*description.cameras, *description.lidars)}
        self._commands: list[Command] = []
        self._figures: dict[str, Any] = {"sent": {}, "eyes": keep_pictures}
        self._moved = np.zeros(len(model.tree_first), bool)
        self._links: Any = None
        self._acknowledged, self._letters = 0, 0
        self._asked: list[tuple[int, np.ndarray]] = []
        context = multiprocessing.get_context("spawn")
        self._mailbox = LatestValue(40 * len(model.body_mass) + (4 << 20), context)
        self._pipe, theirs = context.Pipe()
        sun = scene.sun.direction
        clock = not namespace if clock is None else clock
        setup = SensorConfig(name, model, description, sun, namespace, ros, keep_pictures, sensor_hz, clock, renderer)
        self._process = context.Process(
            target=run_sensor_worker, args=(setup, self._mailbox, theirs), name=f"senses of {name}", daemon=True
        )
        self._process.start()
        theirs.close()
        self._has_news = poller(self._pipe)

    def attach(self, client: Client, robot: Robot | None = None) -> None:
        """Perceive this client's world from now on, as its first robot unless told; waits for the process."""
        self.client = client
        self.robot = robot or client.robot
        self._wait_for("ready", START_TIMEOUT)
        self._attached = True
        client.post_step.append(self._every_tick)
        if self._ros:
            client.pre_step.insert(0, RosCommandHandler(self.robot, self._take_commands))

    # ------------------------------------------------------------------ the tick

    def _every_tick(self, client: Client) -> None:
        self._listen()
        physics = client.physics
        self._moved[physics.plants.awake] = self._moved[physics.remotely_posed] = True
        looks = self._figures["eyes"] and physics.tick % SNAPSHOT_PERIOD == 0
        truth = self._figures.get("truth", False) and physics.tick % 10 == 0
        trees = bodies = body_q = link_q = poses = links = None
        if looks or truth:
            physics.update_kinematics()
            trees = np.flatnonzero(self._moved)
            bodies = physics.plants.bodies_of(trees)
            body_q = physics.state.body_q[bodies]
        if looks:
            link_q = physics.visual_q()
            poses = {name: self.robot.frame_pose(frame) for name, frame in self._sensors.items()}
            if physics.visuals() is not self._links:
                links = physics.visuals()
        letter = StepSnapshot(
            number=self._letters + 1, tick=physics.tick, time=physics.time,
            sample=self.robot.sample(physics.time, physics.contacts),
            bodies=bodies, body_q=body_q, trees=trees, attached=np.packbits(physics.state.bunch_attached),
            links=links, link_q=link_q, poses=poses, frame_score=client.frame_score(),
        )  # fmt: skip
        if self._mailbox.put(pickle.dumps(letter, pickle.HIGHEST_PROTOCOL)):
            self._letters += 1
            if trees is not None:
                self._asked.append((self._letters, trees))

    def _listen(self) -> None:
        """Take what the process says: commands, figures, and which letters it has read."""
        while self._has_news():
            try:
                kind, value = self._pipe.recv()
            except EOFError:
                self._process.join(EXIT_TIMEOUT)
                code = self._process.exitcode
                raise SensorProcessError(f"the senses of {self.name} ended with exit code {code}") from None
            if kind == "commands":
                self._commands += value
            elif kind == "figures":
                self._figures = value
            elif kind == "read":
                self._read(*value)
            elif kind == "failed":
                raise SensorProcessError(f"the senses of {self.name} failed: {value}")

    def _read(self, number: int, links_seen: bool) -> None:
        """A letter with a view was read: what moved until then, and rests since, needs no telling again."""
        if links_seen:
            self._links = self.client.physics.visuals()
        told = [trees for n, trees in self._asked if n == number]
        self._asked = [(n, trees) for n, trees in self._asked if n > number]
        if told:
            later = [trees for _, trees in self._asked]
            self._moved[told[0]] = False
            for trees in later:
                self._moved[trees] = True
            self._moved[self.client.physics.plants.awake] = True

    def _take_commands(self) -> list[Command]:
        commands, self._commands = self._commands, []
        return commands

    # ------------------------------------------------------------------ questions

    def sent_messages(self) -> dict[str, int]:
        """Messages sent so far, by topic."""
        return self._figures["sent"]

    def publish_diagnostics(self, figures: dict[str, Any]) -> None:
        """Pass the client's figures on to /diagnostics."""
        keys = ("time", "tick_hz", "tick_p99_ms", "overruns", "real_time_factor", "awake", "bytes_in", "bytes_out")
        with contextlib.suppress(OSError):
            self._pipe.send(("diagnose", {key: figures[key] for key in keys}))

    def report(self) -> dict[str, Any]:
        """What was rendered, sent and dropped."""
        return {key: self._figures[key] for key in ("frames", "frames_dropped", "ros_dropped") if key in self._figures}

    def save_picture(self, folder: pathlib.Path) -> None:
        """Write the kept picture: ``rgb``, ``depth`` (colours), ``depth_mm`` (16 bit) and ``labels`` PNGs."""
        self._pipe.send(("save", folder))
        self._wait_for("saved", SAVE_TIMEOUT)

    def _wait_for(self, answer: str, timeout: float) -> None:
        while self._pipe.poll(timeout):
            try:
                kind, value = self._pipe.recv()
            except EOFError:
                break
            if kind == "failed":
                raise SensorProcessError(f"the senses of {self.name} failed: {value}")
            if kind == "figures":
                self._figures = value
            if kind == answer:
                return
        raise SensorProcessError(f"the senses of {self.name} did not get {answer} within {timeout:.0f} s")

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(OSError):
            self._pipe.send(("stop", None))
        if self._attached:
            self._process.join(EXIT_TIMEOUT)
        if self._process.is_alive():
            if self._attached:
                log.warning("the senses of %s did not end by themselves", self.name)
            self._process.kill()
            self._process.join()
        self._pipe.close()
        self._mailbox.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: types.TracebackType | type[BaseException] | BaseException | None) -> None:
        self.close()
