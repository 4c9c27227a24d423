"""The part of a ROS process that runs in the client: it passes the robot's state after every step to the process, and
applies the commands that the process receives."""

from __future__ import annotations

import collections
import dataclasses
import logging
import pathlib
import time
import types
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from vinesim.audio import opus
from vinesim.avatar.local_human import LocalHuman
from vinesim.client.client import Client
from vinesim.client.pace import Limit
from vinesim.client.processes.rigid_visual_list import VisualListSender
from vinesim.client.processes.ros_worker import RosChannel, RosConfig, run_ros_worker
from vinesim.client.processes.step_record import StepRecords
from vinesim.client.processes.worker_process import ROS_MODULES, Hold, Run, WorkerProcess
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.signals import GestureLog, IntentionLog
from vinesim.client.sound.exchange import SoundStep
from vinesim.client.sound.microphone_step import at_place
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.client.tasks.simulation_control import SimulationControl
from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import series_stiffness
from vinesim.ros.commands.types import Command, GoalResult
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import ComponentStatus, JointReference, RigidVisual
from vinesim.scene.values.signals import Color

log = logging.getLogger(__name__)

START_TIMEOUT = 120.0
"""Longest time in which the process starts [s]. Message packages are built before
(:class:`.RobotProcesses`)."""
FREE_BACKLOG = 0.2
"""Share of the queue of step records that may be occupied before the world slows down."""
RATE_PERIOD = 0.5
"""Time over which the rate is measured at which the process takes step records [s]."""
TRUTH_ORGANS = (Organ.BOX, Organ.BUNCH, Organ.HUMAN)
"""Organs of the rigid bodies whose true poses are published. Robots publish their own transforms."""


class RosProcess:
    """The ROS node of one robot of a client, in a process. A context manager: the process ends with the context."""

    def __init__(
        self,
        name: str,
        model: Model,
        description: RobotDescription,
        *,
        namespace: str = "",
        params_file: pathlib.Path | None = None,
        clock: bool = True,
        interest_radius: float | None = None,
    ) -> None:
        """Starts the process. :meth:`attach` connects it with a client.

        ``name``: name of the robot. ``namespace``: prefix of the robot's topics. ``params_file``: file with ROS
        parameters of the node. ``clock``: whether the process publishes /clock and serves simulation_interfaces; only
        one process of a ROS domain may. ``interest_radius``: interest radius of the client [m], which a marker shows;
        None without a server.
        """
        self._model = model
        self._commands: collections.deque[Command] = collections.deque()
        self._contacts_left_out = 0
        self._is_restarted = False
        self._leads = clock
        self._simulation: SimulationControl | None = None
        self._missed_truth = 0
        self._intentions = IntentionLog()
        self._gestures = GestureLog()
        self._had_people = False
        """Whether there were people after the last step."""
        self._told_run: Run[RosChannel] | None = None
        """Run of the process that received the present intentions, gestures and lights."""
        self._told_lights: Color | None = None
        """Colour of the indicator lights that was sent to this run."""
        poles = np.flatnonzero(model.fixed_organ == Organ.POLE)
        fixed = zip(description.fixed_frames, description.fixed_poses, strict=True)
        self._records = StepRecords(name, description, series_stiffness(description.drives))
        config = RosConfig(
            name,
            description.ros_urdf or description.urdf,
            description.base,
            namespace,
            clock,
            tuple((p, c, q) for (p, c), q in fixed),
            frames.pose(model.fixed_start[poles]),
            self._records,
            len(model.bunch_body),
            model.bunch_of_body(),
            description.controllers,
            tuple(mount.name for mount in description.imus),
            tuple(mount.name for mount in description.wrenches),
            interest_radius,
            params_file,
            cane_count=len(model.canes.body),
            bud_count=int(model.nodes.bud.max(initial=-1)) + 1,
        )
        self._visuals: tuple[RigidVisual, ...] | None = None
        """All rigid bodies of the world when the list of bodies in the ground truth was made."""
        self._truth_rows = np.zeros(0, np.intp)
        self._truth_visuals: tuple[RigidVisual, ...] = ()
        self._truth_list = VisualListSender()
        self._run: Run[RosChannel] | None = None
        """Run of the process that :attr:`_truth_list` belongs to."""
        self._step_topics = config.step_topics
        self._lost = np.zeros(len(self._step_topics), np.int64)
        """[topic] Number of messages that were lost because the queue of step records was full."""
        body_sensors = {*config.imus, *config.wrenches}
        self._reads_body_sensors = np.array([topic in body_sensors for topic in self._step_topics])
        title = f"the ROS process of {name}"
        self._hold = Hold(title, "its messages are lost, and counted", lambda run: int(run.shared.wanted["turns"][0]))
        self._taken = 0.0, 0, np.inf
        """Time of the last measurement of the process's rate [s], number of step records that the process had taken
        then, and the rate as a factor of real time."""
        self.worker = WorkerProcess(
            title,
            ROS_MODULES,
            run_ros_worker,
            config,
            lambda context: RosChannel(config, context),
            self._receive,
        )

    def attach(self, client: Client, robot: Robot | None = None) -> None:
        """Publish the state of ``robot``, by default the first robot of the client, and execute its commands.

        Waits until the process is ready. Raises :class:`WorkerError` if the process fails.
        """
        self.client = client
        self.robot = robot or client.robot
        self.wait_until_ready()
        client.post_step.append(self._after_step)
        client.wake_readers.append(self._wake)
        client.holds.append(self.held)
        client.pace_limits.append(self.limit)
        self.handler = RosCommandHandler(
            self.robot,
            self._take_commands,
            self._finish,
            client.world_time,
            lambda pcm: client.sound.play(self.robot.name, pcm),
        )
        client.other_faults.append(lambda: {"commands_refused": self.commands_refused})
        client.sound.listen(self.robot.name, _Microphone(self))
        client.pre_step.insert(0, self._control)
        client.after_reset.append(self._begin_anew)
        if self._leads:
            self._simulation = SimulationControl(client, lambda reply: self.worker.send("simulated", reply))
            client.between_steps.append(self._simulation)

    def wait_until_ready(self) -> None:
        """Wait until the process is ready. Raises :class:`WorkerError` if the process fails."""
        self.worker.wait_until_ready(START_TIMEOUT)

    # ------------------------------------------------------------------ in the loop

    def held(self) -> str:
        """Returns the reason why the next step must wait, or "" if the step may run.

        A step waits while the queue of step records is full. The reason is "ROS subscribers" if the process waits for
        subscribers that are behind, otherwise "ROS messages". So no message of a step is lost on the way. A process
        that is not ready, or has done nothing for
        :data:`~vinesim.client.processes.worker_process.HOLD_TIMEOUT`, holds no step. Messages that find no room are
        lost then, and counted.
        """
        run = self.worker.current()
        cause = _cause_to_wait(run.shared) if self.worker.is_ready else ""
        if not cause:
            self._hold.end()
            return ""
        return "" if self._hold.is_over(run) else cause

    @property
    def backlog(self) -> float:
        """Share of the queue of step records that is occupied, 0 to 1."""
        steps = self.worker.current().shared.steps
        return steps.waiting_count / steps.capacity

    def limit(self) -> Limit:
        """Returns the largest real-time factor at which the process takes every step record. Infinite unless records
        pile up."""
        now = time.monotonic()
        steps = self.worker.current().shared.steps
        since, before, factor = self._taken
        if now - since >= RATE_PERIOD:
            taken = steps.put_count - steps.waiting_count
            factor = max(taken - before, 0) * self.client.physics.dt / (now - since)
            self._taken = now, taken, factor
        return Limit(factor if self.backlog > FREE_BACKLOG else np.inf, "ROS messages")

    def _control(self, time: float) -> None:
        """Apply the received commands. If the process was started again, cancel the goals of the run before."""
        if self._is_restarted:
            self._is_restarted = False
            self.handler.cancel_all(time)
            if self._simulation is not None:
                self._simulation.end_steps("the process that asked for them failed")
        self.handler(time)

    def _finish(self, result: GoalResult) -> None:
        """Send the result of a goal to the process. The action client receives the result after the steps that led to
        it."""
        run = self.worker.current()
        run.send("finish", (run.shared.steps.put_count, result))

    def _begin_anew(self) -> None:
        """After a reset of the client: drop earlier commands, and publish the new robot."""
        self._take_commands()
        self.robot = self.client.robots[self.robot.name]
        self.handler.begin_anew(self.robot)

    def _after_step(self, client: Client) -> None:
        """Pass the parts of the robot's state that have subscribers to the process."""
        physics = client.physics
        channel = self.worker.current().shared
        wanted = channel.wanted["steps"]
        has_goals = channel.wanted["goals"][0]
        if has_goals or wanted.any():
            sample = None
            if has_goals or wanted[1:].any():
                body_sensors = bool((wanted & self._reads_body_sensors).any())
                controllers = self.handler.controllers
                reference = JointReference(controllers.desired, controllers.desired_velocity)
                sample = self.robot.measure(
                    physics.time, physics.contacts, body_sensors=body_sensors, reference=reference
                )
            with channel.steps.put() as record:
                if record is None:
                    self._lost += wanted
                else:
                    now = physics.time + client.world_time.offset
                    self._contacts_left_out += self._records.write(record, now, sample)
        run = self.worker.current()
        is_new = run is not self._told_run
        self._told_run = run
        self._tell_of_people(client, run, is_new)
        self._tell_lights(run, is_new)
        truth_period = float(channel.wanted["truth_period"][0])
        if truth_period and physics.tick % max(round(truth_period / physics.dt), 1) == 0:
            self._write_truth(client)

    def _tell_of_people(self, client: Client, run: Run[RosChannel], is_new: bool) -> None:
        """Send people's intentions and hand gestures to the process when they change, and to a run that is new."""
        people: dict[str, LocalHuman | RemoteHuman] = dict(client.humans)
        people |= {name: one for name, one in client.remote_actors.items() if isinstance(one, RemoteHuman)}
        had_people = self._had_people
        self._had_people = bool(people)
        if not (is_new or people or had_people):
            return
        now = client.physics.time + client.world_time.offset
        if self._intentions.update({name: one.intention for name, one in people.items()}, now) or is_new:
            run.send("intentions", self._intentions.intentions)
        if self._gestures.update({name: one.pose for name, one in people.items() if one.pose is not None}) or is_new:
            run.send("gestures", (now, self._gestures.gestures))

    def _tell_lights(self, run: Run[RosChannel], is_new: bool) -> None:
        """Send the colour of the indicator lights to the process when it changes, and to a run that is new."""
        lights = self.robot.shown_lights
        if is_new or lights != self._told_lights:
            self._told_lights = lights
            run.send("lights", lights)

    def _write_truth(self, client: Client) -> None:
        """Write the true poses of bunches, boxes and people, unless the process is reading now."""
        physics = client.physics
        run = self.worker.current()
        if run is not self._run:  # a new run knows nothing yet
            self._run = run
            self._visuals = None
            self._truth_list.close()
            self._truth_list = VisualListSender()
        physics.update_kinematics()
        visuals = physics.visuals()
        if visuals is not self._visuals:
            self._visuals = visuals
            self._truth_rows = np.array([i for i, one in enumerate(visuals) if one.organ in TRUTH_ORGANS], np.intp)
            self._truth_visuals = tuple(dataclasses.replace(visuals[i], shapes=()) for i in self._truth_rows)
        if (message := self._truth_list.update(self._truth_visuals)) is not None:
            run.send("truth", message)
        with run.shared.truth.writing() as truth:
            if truth is None:
                self._missed_truth += 1
                return
            truth["time"][0] = physics.time + client.world_time.offset
            truth["attached"][:] = physics.state.bunch_attached
            truth["bunch_q"][:] = physics.state.body_q[self._model.bunch_body]
            canes = self._model.canes.body
            truth["dormant_q"][: len(canes)] = physics.state.body_q[canes]
            nodes = self._model.nodes
            state = physics.state
            carrier = nodes.carriers(state.stump_of, state.stump_end)
            truth["dormant_q"][len(canes) :] = nodes.bud_poses(state.body_q, carrier)
            truth["version"][0] = self._truth_list.version
            self._truth_list.memory["visual_q"][: len(self._truth_rows)] = physics.visual_q()[self._truth_rows]

    def hear(self, step: SoundStep) -> None:
        """Send the sound at the robot's microphone in this ``step`` to the process."""
        self.worker.send("sound", at_place(step, self.client.sound.place_of(self.robot.name)))

    def _wake(self) -> None:
        channel = self.worker.current().shared
        channel.steps.wake()
        channel.truth.wake()

    def _take_commands(self) -> list[Command]:
        return [self._commands.popleft() for _ in range(len(self._commands))]

    # ------------------------------------------------------------------ outside the loop

    def _receive(self, kind: str, value: Any) -> None:
        """Take a message of the process. This method is called in a thread."""
        if kind == "commands":
            self._commands.extend(value)
        elif kind == "simulation" and self._simulation is not None:
            self._simulation.put(value)
        elif kind == "restarted":
            self._is_restarted = True

    def sent_messages(self) -> dict[str, int]:
        """Returns the number of messages sent so far, by topic."""
        return self.worker.total("sent")

    def dropped_messages(self) -> dict[str, int]:
        """Returns the number of messages that had subscribers and were not sent, by topic."""
        dropped = collections.Counter(self.worker.total("dropped"))
        dropped.update(dict(zip(self._step_topics, self._lost.tolist(), strict=True)))
        dropped["vine/contacts"] += self._contacts_left_out
        dropped["tf_environment"] += self._missed_truth
        return dict(dropped)

    @property
    def sound_lost(self) -> int:
        """Number of frames of voices that the microphone missed. They were lost on the network, too late, or not
        decoded."""
        return self.worker.total("losses").get("sound_lost", 0)

    @property
    def commands_refused(self) -> int:
        """Number of commands that were refused, because they contradict themselves or do not fit the robot."""
        return self.worker.total("losses").get("commands_refused", 0) + self.handler.rejected_count

    def publish_diagnostics(self, time: float, components: Sequence[ComponentStatus]) -> None:
        """Publish states of parts of the client on /diagnostics, with the stamp ``time`` [s]."""
        self.worker.send("diagnose", (time, list(components)))

    def close(self) -> None:
        """End the process. The counts are complete after that. A second call does nothing."""
        self.worker.close()
        self._truth_list.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: types.TracebackType | type[BaseException] | BaseException | None) -> None:
        self.close()


def _cause_to_wait(channel: RosChannel) -> str:
    if channel.steps.waiting_count < channel.steps.capacity:
        return ""
    return "ROS subscribers" if channel.wanted["waits"][0] else "ROS messages"


class _Microphone:
    """Microphone of a robot. It is open while the robot's topics of sound have subscribers."""

    decodes_opus = opus.is_available()

    def __init__(self, process: RosProcess) -> None:
        self._process = process

    @property
    def is_open(self) -> bool:
        return bool(self._process.worker.current().shared.wanted["sound"][0])

    def hear(self, step: SoundStep) -> None:
        self._process.hear(step)
