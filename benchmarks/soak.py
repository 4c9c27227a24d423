"""``python -m benchmarks soak``: memory, threads and open files of robots, people and a recorder in a long run.

All programs are processes on this machine, started as users start them: a server that keeps its state in a folder,
robots whose sensors publish to ROS listeners, people who hold and pull bunches, and a recorder.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vinesim.bench.live_client import own_processes
from vinesim.bench.process_memory import ProcessHistory, ProcessSampler, check_proc
from vinesim.client.programs import START_TIMEOUT, Program, ProgramFailed, ProgramGroup, RosListener
from vinesim.client.tasks import start_poses
from vinesim.core.frames import to_yaw
from vinesim.ros import middleware
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

MINUTES = 60.0
"""Default duration of the measurement [min]."""
SETTLING = 10.0
"""Time in which memory may grow before it is measured [min]; a third of a run that is shorter than three times this."""
SAMPLE_PERIOD = 5.0
"""Time between two samples of all processes [s]."""
POLL_PERIOD = 0.1
"""Time between two reads of the processes' output [s]."""
SENSOR_HZ = 1.0
"""Rate of pictures and scans of each robot in real time [Hz]."""
PERSON_DISTANCE = 1.5
"""Distance from a person's start to the person's bunch [m]."""
GROWTH_BUDGET = 1.0
"""Largest accepted growth of a process after settling [MB/h]: 24 MB a day."""
TOPICS = (
    "joint_states",
    "mobile_base_controller/odom",
    "head_front_camera/rgb/image_raw",
    "head_front_camera/depth/image_raw",
    "lidar/points",
)
"""Topics that the listener of a robot subscribes to, below the robot's namespace."""


@dataclasses.dataclass(frozen=True)
class Cast:
    """Programs that take part in a run in addition to the server."""

    scene: str = "demo"
    robots: int = 4
    people: int = 2
    records: bool = True
    real_time_factor: float | None = None
    """Rate of the world's time. None: as fast as all clients can follow."""


@dataclasses.dataclass(frozen=True)
class SoakResult:
    """Result of a run."""

    histories: dict[tuple[str, int], ProcessHistory]
    """History of each process after settling, by kind and process id."""
    counts: dict[str, int]
    """Numbers of malformed messages, faults and restarts, by name, of all processes together."""
    tick_hz: float
    """Mean tick rate of the slowest client [Hz]."""

    def of_kind(self, kind: str) -> list[ProcessHistory]:
        """Returns the histories of all processes of one kind."""
        return [history for (name, _), history in self.histories.items() if name == kind]


def soak(minutes: float, real_time_factor: float | None, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Run for ``minutes`` [min] and measure. ``announce`` is called with a line of text from time to time."""
    yield from measurements(run_soak(Cast(real_time_factor=real_time_factor), minutes, announce))


def measurements(result: SoakResult) -> Iterator[Measurement]:
    """Yields for each kind of process its memory, its growth, and how many more threads or open files it has in the
    second half of the run than in the first."""
    for kind in dict.fromkeys(name for name, _ in result.histories):
        histories = result.of_kind(kind)
        memory = float(np.mean([history.samples[-1].memory for history in histories]))
        case = f"{kind}, {len(histories)} of them" if len(histories) > 1 else kind
        yield Measurement("soak", f"{case}: memory at the end, mean", memory, "MB")
        growth = max(history.growth() for history in histories)
        budget = GROWTH_BUDGET
        yield Measurement("soak", f"{case}: growth, greatest", growth, "MB/h", "budget, at most", budget, None)
        for what in ("threads", "handles"):
            change = max(history.change(what) for history in histories)
            yield Measurement("soak", f"{case}: more {what} in the second half", change, "1", "budget, at most", 0.0)
    yield Measurement("soak", "least tick rate of a client", result.tick_hz, "Hz")
    for name, count in sorted(result.counts.items()):
        yield Measurement("soak", name.replace("_", " "), count, "1")


def run_soak(cast: Cast, minutes: float, announce: Callable[[str], None]) -> SoakResult:
    """Start all programs, wait until they are ready, sample them for ``minutes`` [min], and end them.

    Raises :class:`ProgramFailed` if a process ends too early, :class:`ProcUnavailable` on systems without /proc.
    """
    check_proc()
    with own_processes() as group, tempfile.TemporaryDirectory() as folder:
        run = _Run(group, cast, pathlib.Path(folder))
        run.wait_until_ready()
        announce(f"all ready: {len(run.processes)} programs; {minutes:g} minutes to go")
        start = time.monotonic()
        end = start + 60.0 * minutes
        settled = start + 60.0 * min(SETTLING, minutes / 3.0)
        due = said = start
        while (now := time.monotonic()) < end:
            run.read()
            if now >= due:
                due = now + SAMPLE_PERIOD
                run.sampler.sample(now)
            if now >= said + 60.0:
                said = now
                run.forget_messages()
                announce(f"{(now - start) / 60.0:.0f} of {minutes:g} minutes; {run.progress()}")
            time.sleep(POLL_PERIOD)
        histories, ended = settle(run.sampler.histories, start, settled, end)
        return SoakResult(histories, run.end() | ended, run.least_rate())


def settle(
    histories: dict[tuple[str, int], ProcessHistory], start: float, settled: float, end: float
) -> tuple[dict[tuple[str, int], ProcessHistory], dict[str, int]]:
    """Returns the histories after the processes have settled, and the processes that had ended a minute before ``end``
    [s].

    A process settles for ``settled`` - ``start`` [s] from its first sample. Some processes start late, such as those
    that stand by for another. A process that was renamed has a history under each name, and does not count as ended.
    """
    last: dict[int, float] = {}
    for (_, pid), history in histories.items():
        last[pid] = max(last.get(pid, -np.inf), history.times[-1])
    ended = {f"{kind} {pid} ended": 1 for kind, pid in histories if last[pid] < end - 60.0}
    later = {key: history.since(history.times[0] - start + settled) for key, history in histories.items()}
    return {key: history for key, history in later.items() if history.times}, ended


class _Run:
    """Programs of one run."""

    def __init__(self, group: ProgramGroup, cast: Cast, folder: pathlib.Path) -> None:
        """Start the programs; their files go below ``folder``."""
        self._folder = folder
        self.server = group.start(
            "server",
            "-m",
            "vinesim",
            "server",
            "--listen",
            "tcp/127.0.0.1:0",
            "--status",
            "json",
            "--state-dir",
            str(folder / "state"),
            "--real-time-factor",
            "auto" if cast.real_time_factor is None else f"{cast.real_time_factor:g}",
        )
        self._figures: dict[str, Any] = json.loads(self.server.next_line(START_TIMEOUT))
        self._endpoint = self._figures["endpoints"][0]
        self.clients: dict[str, Program] = {}
        self._newest: dict[str, dict[str, Any]] = {}
        self.listeners: list[RosListener] = []
        self.processes: list[tuple[str, Program]] = [("server", self.server)]
        self._start_clients(group, cast)
        self.recorder = None
        if cast.records:
            self.recorder = group.start(
                "recorder", "-m", "vinesim", "record", str(folder / "soak.mcap"), "--connect", self._endpoint
            )
            self.processes.append(("recorder", self.recorder))
        self.sampler = ProcessSampler([(kind, process.child.pid) for kind, process in self.processes])

    def _start_clients(self, group: ProgramGroup, cast: Cast) -> None:
        """Start robots one behind the other, of which the first pushes a bunch, and people next to bunches of their
        own."""
        scene = load_scene(cast.scene)
        model = generate(scene)
        first = start_poses.start_pose(scene, 0)
        pushed = start_poses.find_reachable_bunch(model, first)
        with_ros = middleware.unavailable_reason() is None
        sensor_hz = SENSOR_HZ / (cast.real_time_factor or 1.0)  # rate in simulated time
        for i in range(cast.robots):
            name = f"robot_{i + 1}"
            pose = start_poses.start_pose(scene, 0, queue=i)
            options = ["--namespace", name, "--sensor-hz", f"{sensor_hz:g}", *_pose_option(pose[:2], to_yaw(pose[3:]))]
            if with_ros:
                topics = [f"/{name}/{topic}" for topic in TOPICS]
                listener = RosListener(group, topics)
                self.listeners.append(listener)
                self.processes.append(("ROS listener", group.programs[-1]))
            self._start_client(group, "robot", name, cast, [*options, *(["--push", str(pushed)] if i == 0 else [])])
        centres = start_poses.bunch_centres(model)[:, :2]
        # bunches for people are far from the robots
        far = np.argsort(-np.linalg.norm(centres - first[:2], axis=1), kind="stable")
        for i in range(cast.people):
            bunch = int(far[i * len(far) // 4])
            place = centres[bunch] - (PERSON_DISTANCE, 0.0)
            self._start_client(
                group, "human", f"person_{i + 1}", cast, ["--reach", str(bunch), *_pose_option(place, 0.0)]
            )

    def _start_client(self, group: ProgramGroup, role: str, name: str, cast: Cast, options: list[str]) -> None:
        common = ["--connect", self._endpoint, "--scene", cast.scene, "--status", "json"]
        self.clients[name] = group.start(
            name,
            "-m",
            "vinesim",
            "client",
            "--role",
            role,
            "--name",
            name,
            *common,
            "--out",
            str(self._folder / name),
            *options,
        )
        self.processes.append(("robot client" if role == "robot" else "person's client", self.clients[name]))

    def read(self) -> None:
        """Read the processes' output. Raises :class:`ProgramFailed` if a process has ended."""
        for name, client in self.clients.items():
            for line in client.new_lines():
                self._newest[name] = json.loads(line)
        for line in self.server.new_lines():
            self._figures = json.loads(line)
        for listener in self.listeners:
            listener.missing()
        if self.recorder is not None:
            self.recorder.new_lines()

    def forget_messages(self) -> None:
        """Let the listeners drop the times of past messages, which they keep for statistics: 3 MB an hour."""
        for listener in self.listeners:
            listener.restart()

    def wait_until_ready(self) -> None:
        """Return when every client steps, every sensor publishes and every listener has received all its topics."""
        deadline = time.monotonic() + START_TIMEOUT
        while True:
            self.read()
            waiting = [name for name in self.clients if not self._newest.get(name, {}).get("sensors_ready")]
            waiting += [topic for listener in self.listeners for topic in listener.missing()]
            if not waiting:
                return
            if time.monotonic() > deadline:
                raise self.server.fault(f"not ready after {START_TIMEOUT:.0f} s: {', '.join(waiting)}")
            time.sleep(POLL_PERIOD)

    def progress(self) -> str:
        """Returns one line: memory of all processes, tick rates of the clients, faults so far."""
        memory = self.sampler.memory()
        rates = " ".join(f"{values['tick_hz']:.0f}" for values in self._newest.values())
        faults = {name: values["faults"] for name, values in self._newest.items() if values["faults"]}
        return f"{memory:.0f} MB in all, ticks {rates} Hz, faults {faults or 'none'}"

    def least_rate(self) -> float:
        """Returns the mean tick rate of the slowest client so far [Hz]."""
        return min((values["tick_hz"] for values in self._newest.values()), default=0.0)

    def end(self) -> dict[str, int]:
        """End the clients in order and return their counts. A client that fails now adds to the counts: the run itself
        is over."""
        counts = {"malformed, server": self._figures["malformed"], "refused, server": self._figures["refused"]}
        for client in self.clients.values():
            client.interrupt()
        reports = []
        for name, client in self.clients.items():
            try:
                client.finish()
                reports.append(json.loads((self._folder / name / "report.json").read_text()))
            except (ProgramFailed, OSError) as error:
                counts[f"{name} without a report ({error})"] = 1
                reports.append({"malformed": 0, **self._newest[name]})
        for report in reports:
            restarts = {key: report.get(key, 0) for key in ("malformed", "sensor_restarts", "ros_restarts")}
            for key, count in (report["faults"] | restarts).items():
                counts[f"{key}, clients"] = counts.get(f"{key}, clients", 0) + count
        return counts


def _pose_option(place: np.ndarray, yaw: float) -> list[str]:
    return ["--pose", *(f"{value:.4f}" for value in (*place, yaw))]
