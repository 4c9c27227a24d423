"""The part of a ROS process that runs in the process: it publishes the robot's state, the ground truth and diagnostics,
and takes commands.

The process renders nothing and imports neither Warp nor the renderer. So it starts quickly, needs little memory, and
keeps the rate of the topics that are published every step, whatever the sensors do.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import pathlib
import queue
import time
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from vinesim.audio.frame import to_pcm
from vinesim.audio.microphone import Microphone
from vinesim.client.processes.rigid_visual_list import VisualListReceiver
from vinesim.client.processes.shared_memory import SharedArrays, SharedQueue, SharedSnapshot
from vinesim.client.processes.step_record import StepRecords
from vinesim.client.processes.worker import POLL_PERIOD, Worker, report_ready, serve
from vinesim.client.sound.microphone_step import MicrophoneStep
from vinesim.ros.commands.types import GoalResult, SimulationRequest
from vinesim.ros.names import ros_name
from vinesim.scene.ids import Organ
from vinesim.scene.values import ControllerKind, ControllerSpec, RigidVisual

STATE_TOPICS = ("joint_states", "tf", "mobile_base_controller/odom", "vine/contacts", "vine/markers")
"""Topics of every robot that need the robot's state after a step."""
TRUTH_TOPIC = "tf_environment"
SOUND_TOPICS = ("audio", "audio_stamped")
NICENESS = 5
"""Niceness of the process. It yields to the client's loop, and takes precedence over the sensor process."""
QUEUE_CAPACITY = 100
"""Number of step records that may wait for the process. They span 1 s. When the queue is full, the loop waits
(:meth:`RosProcess.held`)."""
WAIT_PERIOD = 0.004
"""Time between two checks whether subscribers are behind [s]."""
COUNT_PERIOD = 0.05
"""Wall time between two checks which topics have subscribers [s]. The node counts subscribers half as often."""


@dataclasses.dataclass(frozen=True)
class RosConfig:
    """Data that the ROS process needs to start. All values are plain, so that the process imports nothing large."""

    name: str
    """The robot's name."""
    urdf: str
    """Text of the robot's URDF."""
    base: str
    """Link at the root of the robot's tree of links."""
    namespace: str
    """Prefix of the robot's topics."""
    clock: bool
    """Whether the node may publish /clock, and serves simulation_interfaces. Only one node of a ROS domain may."""
    static_transforms: tuple[tuple[str, str, np.ndarray], ...]
    """Parent link, child link and pose [7] of each fixed joint."""
    poles: np.ndarray
    """[pole, 7] Poses of the poles: position [m] and quaternion."""
    records: StepRecords
    """Layout of the step records."""
    bunch_count: int
    """Number of bunches of the vineyard."""
    bunch_of_body: np.ndarray
    """[body] Index of the bunch of each body, -1 for wood."""
    controllers: tuple[ControllerSpec, ...]
    imus: tuple[str, ...]
    """Names of the IMUs."""
    wrenches: tuple[str, ...]
    """Names of the force-torque sensors."""
    interest_radius: float | None = None
    """[m] Radius of the area around the robot within which the network sends it the motion of objects that others move.
    None without a server."""
    params_file: pathlib.Path | None = None
    """File with ROS parameters of the nodes."""
    parameters: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Values of the node's parameters that were set, by name. The client updates them, and each run starts with
    them."""
    cane_count: int = 0
    """Number of dormant canes, two-year wood included."""
    bud_count: int = 0
    """Number of buds of dormant canes."""

    @property
    def step_topics(self) -> tuple[str, ...]:
        """Topics that need the records of steps, or prefixes of several such topics. The first is /clock."""
        states = [one.name for one in self.controllers if one.kind is ControllerKind.JOINT_TRAJECTORY]
        elastic = [one.name for one in self.controllers if one.kind is ControllerKind.SERIES_ELASTIC]
        hardware = [one.hardware.states for one in self.controllers if one.hardware is not None]
        return ("/clock", *STATE_TOPICS, *self.imus, *self.wrenches, *states, *elastic, *hardware)


class RosChannel:
    """Shared memory of a client and its ROS process: step records, the newest true poses, and the process's demands."""

    def __init__(self, config: RosConfig, context: BaseContext) -> None:
        self.steps = SharedQueue(config.records.dtype, QUEUE_CAPACITY, context)
        self.truth = SharedSnapshot(
            {
                "time": ((1,), "f8"),
                "attached": ((config.bunch_count,), "?"),
                "bunch_q": ((config.bunch_count, 7), "f4"),
                "dormant_q": ((config.cane_count + config.bud_count, 7), "f4"),  # canes, then buds
                "version": ((1,), "i8"),  # of the list of rigid bodies
            },
            context,
        )
        self.wanted = SharedArrays(
            {
                "steps": ((len(config.step_topics),), "?"),
                "truth_period": ((1,), "f8"),
                "goals": ((1,), "?"),
                "sound": ((1,), "?"),
                "waits": ((1,), "?"),
                "turns": ((1,), "i8"),
            }
        )
        """Demands, which the process writes. ``steps``: [topic] whether each of the step topics has subscribers.
        ``truth_period``: period at which true poses are wanted [s], 0 for never. ``goals``: whether actions have goals.
        ``sound``: whether topics of sound have subscribers. ``waits``: whether the process waits for subscribers.
        ``turns``: number of times that the process has updated these values. It rises while the process is alive."""

    def close(self) -> None:
        """Release the memory."""
        for part in (self.steps, self.truth, self.wanted):
            part.close()


def run_ros_worker(config: RosConfig, channel: RosChannel, pipe: Connection) -> None:
    """Function that a ROS process runs: publish until the client sends "stop"."""
    serve("ROS process", pipe, lambda: RosWorker(config, channel, pipe).run())


class RosWorker(Worker):
    """The robot's ROS nodes, in the ROS process. Their input is the step records and the true poses."""

    def __init__(self, config: RosConfig, channel: RosChannel, pipe: Connection) -> None:
        from vinesim.ros import middleware
        from vinesim.ros.robot_node import RobotNode
        from vinesim.ros.simulation_node import SimulationNode

        super().__init__(pipe)
        middleware.configure(large_messages=False)
        self.config = config
        self.channel = channel
        self.node = RobotNode(
            ros_name(config.name),
            config.urdf,
            namespace=config.namespace,
            static_transforms=config.static_transforms,
            controllers=config.controllers,
            imus=config.imus,
            wrenches=config.wrenches,
            bunch_of_body=config.bunch_of_body,
            interest_radius=config.interest_radius,
            base=config.base,
            clock=config.clock,
            params_file=config.params_file,
            parameters=config.parameters,
        )
        self._requests: queue.SimpleQueue[SimulationRequest] = queue.SimpleQueue()
        self.simulation = None
        if config.clock:
            name = f"{ros_name(config.name)}_simulation"
            self.simulation = SimulationNode(name, config.namespace, self._requests.put, beside=self.node)
        poles = tuple(f"pole_{i:04d}" for i in range(len(config.poles)))
        self.node.publish_environment_static(poles, config.poles)
        self._bunch_names = tuple(f"bunch_{i:05d}" for i in range(config.bunch_count))
        canes = (f"cane_{i:05d}" for i in range(config.cane_count))
        self._dormant_names = (*canes, *(f"bud_{i:05d}" for i in range(config.bud_count)))
        self._rigid = VisualListReceiver()
        self._truth_names: tuple[str, ...] = ()
        self._named: tuple[int, bytes] = 0, b""
        """Version of the list of rigid bodies, and indices of the attached bunches as bytes, for which
        :attr:`_truth_names` was made."""
        self._ends: collections.deque[tuple[int, GoalResult]] = collections.deque()
        """Goals that have ended, each with the number of step records after which its result is sent."""
        self._microphone = Microphone()
        self._next_count = 0.0
        self._pace = Pace()
        self._watch_parameters(self.node)

    def run(self) -> None:
        """Publish until the client sends "stop"."""
        report_ready(self.pipe, NICENESS)
        with self.node, self.simulation or contextlib.nullcontext():
            while self._take_messages():
                record = self._next_record()
                if record is not None:
                    self.node.publish_clock(float(record["time"]))
                    if record["has_state"]:
                        self.node.publish_robot_state(self.config.records.read(record))
                while self._ends and self._ends[0][0] <= self.channel.steps.taken_count:
                    self.node.finish_goal(self._ends.popleft()[1])
                if self.channel.truth.wait(0.0):
                    self._publish_truth()
                while not self._requests.empty():
                    self.pipe.send(("simulation", self._requests.get()))
                if commands := self.node.commands():
                    self.pipe.send(("commands", commands))
                self._report()
        self._send_statistics()  # so that the last messages are counted, too

    def _next_record(self) -> Any | None:
        """Returns the next step record to publish. None if no record comes for a while, or subscribers are behind."""
        steps = self.channel.steps
        wanted = self.channel.wanted
        if not steps.wait(POLL_PERIOD):
            wanted["waits"][0] = False
            return None
        begin = time.monotonic()
        while self.node.must_wait(now := time.monotonic()):  # before each record, also if none has piled up
            wanted["waits"][0] = True
            if now - begin > POLL_PERIOD:
                return None
            time.sleep(WAIT_PERIOD)
        wanted["waits"][0] = False
        time.sleep(self._pace.delay(steps.put_count))
        if (record := steps.take(0.0)) is not None:
            self._pace.add()
        return record

    def _take(self, kind: str, value: Any) -> None:
        """Publish a value of the client, or keep it for later."""
        if kind == "diagnose":
            self.node.publish_diagnostics(*value)
        elif kind == "sound":
            self._record(value)
        elif kind == "intentions":
            self.node.publish_intentions(value)
        elif kind == "gestures":
            self.node.publish_gestures(*value)
        elif kind == "events":
            self.node.publish_events(*value)
        elif kind == "lights":
            self.node.publish_lights(value)
        elif kind == "truth":
            self._rigid.take(value)
        elif kind == "finish":
            self._ends.append(value)
        elif kind == "simulated" and self.simulation is not None:
            self.simulation.answer(value)

    def _record(self, step: MicrophoneStep) -> None:
        """Mix the sound at the robot's microphone, and publish the frames that are complete."""
        for frame in step.frames:
            self._microphone.hear(frame)
        for source, frequency, level in step.tones:
            self._microphone.sound(source, frequency, level, step.now)
        for block in self._microphone.blocks(step.now):
            self.node.publish_sound(block.time + step.to_world, to_pcm(block.samples))

    def _publish_truth(self) -> None:
        """Publish the true poses of rigid bodies, of dormant canes and buds, and of the bunches that are attached to
        their plants."""
        with self.channel.truth.reading() as truth:
            version = int(truth["version"][0])
            memory = self._rigid.memory
            if memory is None or version != self._rigid.version:  # the list has not arrived: wait for the next poses
                return
            now = float(truth["time"][0])
            attached = np.flatnonzero(truth["attached"])
            rigid_q = memory["visual_q"][: len(self._rigid.visuals)]
            poses = np.concatenate([rigid_q, truth["bunch_q"][attached], truth["dormant_q"]])
        if (named := (version, attached.tobytes())) != self._named:
            rigid = map(truth_frame, self._rigid.visuals)
            self._named = named
            self._truth_names = (*rigid, *(self._bunch_names[i] for i in attached), *self._dormant_names)
        self.node.publish_environment(now, self._truth_names, poses)

    def _report(self) -> None:
        """Write the demands of the process to the shared memory, then report to the client as every worker does."""
        wanted = self.channel.wanted
        now = time.monotonic()
        wanted["turns"][0] += 1
        wanted["goals"][0] = self.node.has_goals
        if now >= self._next_count:
            self._next_count = now + COUNT_PERIOD
            wanted["steps"][:] = [self.node.has_subscribers(name) for name in self.config.step_topics]
            wanted["sound"][0] = any(map(self.node.has_subscribers, SOUND_TOPICS))
            wanted["truth_period"][0] = self.node.has_subscribers(TRUTH_TOPIC) / self.node.environment_rate
        super()._report()

    def _statistics(self) -> dict[str, dict[str, int]]:
        losses = {"sound_lost": self._microphone.missed, "commands_refused": self.node.refused_commands}
        return {"sent": self.node.sent, "dropped": self.node.dropped, "losses": losses}


class Pace:
    """Limit on the rate at which delayed steps are published: little faster than the world steps, few steps at once.

    A subscriber with rclpy's default history keeps ten messages of a topic, and overwrites them if more arrive before
    the messages are taken. A subscriber may wait for a CPU, and does not tell the publisher.
    """

    BURST = 5
    """Number of steps that may be published at once."""
    SPEED = 1.5
    """Rate at which further steps are published, as a multiple of the world's rate."""
    LEAST = 50.0
    """Lowest rate at which further steps are published [Hz]. The world may have paused."""
    PERIOD = 0.5
    """Time between two measurements of the world's rate [s]."""

    def __init__(self) -> None:
        self._interval = 0.01
        self._due = self._since = time.monotonic()
        self._count = 0

    def delay(self, put_count: int) -> float:
        """Returns the time until the next step may be published [s]. ``put_count``: number of steps that the client has
        put into the queue so far."""
        now = time.monotonic()
        if (passed := now - self._since) > self.PERIOD:
            rate = self.SPEED * (put_count - self._count) / passed
            self._since = now
            self._count = put_count
            self._interval = 1.0 / max(rate, self.LEAST)
        return max(self._due - now, 0.0)

    def add(self) -> None:
        """Note that a step is published now."""
        earliest = time.monotonic() - (self.BURST - 1) * self._interval
        self._due = max(self._due, earliest) + self._interval


def truth_frame(visual: RigidVisual) -> str:
    """Returns the TF frame of a box, a picked bunch or a part of a person: ``box_3``, ``picked_bunch_00017``,
    ``anna/head``."""
    if visual.organ == Organ.BUNCH:
        return f"picked_bunch_{visual.index:05d}"
    return f"box_{visual.index}" if visual.organ == Organ.BOX else visual.name
