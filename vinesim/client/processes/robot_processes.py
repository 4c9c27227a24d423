"""The processes of one robot of a client: the sensor process and, if ROS 2 can be used, the ROS process."""

from __future__ import annotations

import collections
import contextlib
import logging
import pathlib
from collections.abc import Sequence
from typing import Any, Self

from vinesim.client.client import Client
from vinesim.client.faults import RecentCounts
from vinesim.client.processes.ros_process import RosProcess
from vinesim.client.processes.sensor_process import SensorProcess
from vinesim.net.pace import describe
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import ComponentStatus, SensorPacing

log = logging.getLogger(__name__)

BEHIND = 0.95
"""Share of the steps that were due since the last status. A loop that has done less than this share is behind."""
_LOOP_VALUES = (
    "tick_hz",
    "tick_p99_ms",
    "overruns",
    "steps_skipped",
    "real_time_factor",
    "target_real_time_factor",
    "pace_cause",
    "awake",
    "unfinished_solves",
    "sound_dropped",
)
"""Values of a client's status that /diagnostics shows with the loop."""
_NETWORK_VALUES = ("others", "round_trip_ms", "bytes_in", "bytes_out")
"""Values of a client's status that /diagnostics shows with the network."""


class RobotProcesses:
    """The sensor process and the ROS process of one robot. A context manager: the processes end with the context."""

    def __init__(
        self,
        name: str,
        scene: Scene,
        model: Model,
        description: RobotDescription,
        *,
        namespace: str = "",
        params_file: pathlib.Path | None = None,
        interest_radius: float | None = None,
        ros: bool = True,
        clock: bool = True,
        keep_pictures: bool = False,
        sensor_hz: float | None = None,
        device: str = "cpu",
        pacing: SensorPacing | None = None,
        standby: bool = False,
    ) -> None:
        """Starts the processes. For the arguments see :class:`SensorProcess` and :class:`RosProcess`."""
        if ros and (reason := middleware.unavailable_reason()) is not None:
            log.warning("running without ROS 2: %s", reason)
            ros = False
        if ros:
            # Built here, once for both processes, with a message to the user and without a limit on the time.
            message_packages.build(message_packages.unbuilt_packages())
        with contextlib.ExitStack() as stack:
            self.sensors = stack.enter_context(
                SensorProcess(
                    name,
                    scene,
                    model,
                    description,
                    namespace=namespace,
                    params_file=params_file,
                    ros=ros,
                    keep_pictures=keep_pictures,
                    sensor_hz=sensor_hz,
                    device=device,
                    pacing=pacing,
                    standby=standby,
                )
            )
            self.ros = None
            if ros:
                process = RosProcess(
                    name,
                    model,
                    description,
                    namespace=namespace,
                    params_file=params_file,
                    clock=clock,
                    interest_radius=interest_radius,
                )
                self.ros = stack.enter_context(process)
            self._stack = stack.pop_all()
        self._restarts = RecentCounts()

    def attach(self, client: Client, robot: Robot | None = None, *, wait_for_sensors: bool = True) -> None:
        """Connect the processes with ``robot``, by default the first robot of the client.

        Waits until the ROS process is ready and, if ``wait_for_sensors``, until the sensor process is ready. See
        :meth:`SensorProcess.attach`.
        """
        self.sensors.attach(client, robot, wait=wait_for_sensors)
        if self.ros is not None:
            self.ros.attach(client, robot)

    def wait_for_ros(self) -> None:
        """Wait until the ROS process is ready, if there is one. Raises :class:`WorkerError` if the process fails."""
        if self.ros is not None:
            self.ros.wait_until_ready()

    def sent_messages(self) -> dict[str, int]:
        """Returns the number of ROS messages sent so far, by topic."""
        return self.sensors.sent_messages() | ({} if self.ros is None else self.ros.sent_messages())

    def dropped_messages(self) -> dict[str, int]:
        """Returns the number of ROS messages that had subscribers and were not sent, by topic. Topics without such
        messages are left out."""
        dropped = collections.Counter(self.sensors.dropped_messages())
        if self.ros is not None:
            dropped.update(self.ros.dropped_messages())
        return {topic: count for topic, count in sorted(dropped.items()) if count}

    def awaited(self) -> list[str]:
        """Returns the names of the steps of preparation that are still needed before pictures and messages are sent."""
        ros = [] if self.ros is None or self.ros.worker.is_ready else [f"{self.sensors.name}: ROS node"]
        return self.sensors.awaited() + ros

    def status(self) -> dict[str, Any]:
        """Returns values for a client's status: whether the sensors are ready, counts of losses, and process ids."""
        report = self.sensors.report()
        awaited = self.awaited()
        pids = {f"sensors of {self.sensors.name}": self.sensors.worker.pid}
        if (standby := self.sensors.worker.standby_pid) is not None:
            pids[f"standby of {self.sensors.name}"] = standby
        if self.ros is not None:
            pids[f"ROS node of {self.sensors.name}"] = self.ros.worker.pid
        return {
            "sensors_ready": not awaited,
            "sensors_awaited": awaited,
            "frames_delivered": sum(report["frames"].values()),
            "frames_dropped": sum(report["frames_dropped"].values()),
            "messages_dropped": sum(self.dropped_messages().values()),
            "sound_lost": 0 if self.ros is None else self.ros.sound_lost,
            "sensor_restarts": report["sensor_restarts"],
            "ros_restarts": 0 if self.ros is None else self.ros.worker.restarts,
            "sensor_restart_s": self.sensors.worker.restart_time,
            "processes": pids,
        }

    def report(self) -> dict[str, Any]:
        """Returns all counts, by sensor and topic."""
        restarts = 0 if self.ros is None else self.ros.worker.restarts
        return self.sensors.report() | {"ros_dropped": self.dropped_messages(), "ros_restarts": restarts}

    def publish_diagnostics(self, status: dict[str, Any]) -> None:
        """Publish the ``status`` of the client and the state of the sensors on /diagnostics."""
        if self.ros is None:
            return
        report = self.report() | {"sound_lost": self.ros.sound_lost}
        awaited = self.sensors.awaited()
        restarts = {"sensor process": report["sensor_restarts"], "ROS node": report["ros_restarts"]}
        restarted = self._restarts.update(restarts, status["time"])
        self.ros.publish_diagnostics(
            status["world_time"],
            [loop_status(status), network_status(status), sensors_status(awaited, restarted, report)],
        )

    def close_ros(self) -> None:
        """End the ROS process. The counts of its messages are complete after that."""
        if self.ros is not None:
            self.ros.close()

    def save_picture(self, folder: pathlib.Path) -> None:
        """Write the kept picture to a ``folder``. See :meth:`SensorProcess.save_picture`."""
        self.sensors.save_picture(folder)

    def close(self) -> None:
        """End the processes."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._stack.__exit__(*exception)


def loop_status(status: dict[str, Any]) -> ComponentStatus:
    """Returns the state of a client's loop for /diagnostics: a warning while it is behind and after recent faults.

    The values include the counts of all faults. ``status``: status of the client.
    """
    trouble = ["behind"] * (status["recent_real_time_factor"] < BEHIND * status["target_real_time_factor"])
    trouble += [name.replace("_", " ") for name in status["recent_faults"]]
    values = {key: status[key] for key in _LOOP_VALUES} | status["faults"]
    pace = describe(status["target_real_time_factor"], status["pace_cause"])
    text = ", ".join(trouble + [pace] * bool(pace)) or "well"
    return ComponentStatus("simulation", "warning" if trouble else "ok", text, values)


def network_status(status: dict[str, Any]) -> ComponentStatus:
    """Returns the state of a client's network for /diagnostics: a warning if the server is gone or rejects the client.

    ``status``: status of the client.
    """
    trouble = status["network"]
    values = {key: status[key] for key in _NETWORK_VALUES}
    return ComponentStatus("network", "warning" if trouble else "ok", trouble or "well", values)


def sensors_status(awaited: Sequence[str], restarted: Sequence[str], report: dict[str, Any]) -> ComponentStatus:
    """Returns the state of a robot's sensors for /diagnostics, with the counts of ``report``.

    It is an error while steps of preparation are ``awaited``. It is a warning after processes were ``restarted``,
    because a restart can be shorter than the time between two messages.
    """
    if awaited:
        return ComponentStatus("sensors", "error", f"not ready: {awaited[0]}", report)
    trouble = [f"{process} restarted" for process in restarted]
    return ComponentStatus("sensors", "warning" if trouble else "ok", ", ".join(trouble) or "well", report)
