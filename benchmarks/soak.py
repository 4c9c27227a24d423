"""``python -m benchmarks soak``: memory, threads and open files of robots, people and a recorder in a long run.

All are processes as their users start them, on this machine: a server that keeps its state in a folder, robots whose
sensors publish to ROS listeners, people who hold and pull bunches, and a recorder.
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
"""Measured time unless another one is asked for [min]."""
SETTLING = 10.0
"""Memory may grow for so long [min]; a third of shorter runs."""
SAMPLE_PERIOD = 5.0
"""Between two samples of all processes [s]."""
POLL_PERIOD = 0.1
"""Between two looks at what the processes print [s]."""
SENSOR_HZ = 1.0
"""Pictures and scans of each robot in a second of real time [Hz]."""
PERSON_DISTANCE = 1.5
"""From where a person starts to its bunch [m]."""
GROWTH_BUDGET = 1.0
"""Growth of a process after settling [MB/h]: 24 MB a day."""
TOPICS = (
    "joint_states",
    "mobile_base_controller/odom",
    "head_front_camera/rgb/image_raw",
    "head_front_camera/depth/image_raw",
    "lidar/points",
)
"""What the listener of a robot subscribes to, below the robot's namespace."""


@dataclasses.dataclass(frozen=True)
class Cast:
    """Who takes part beside the server."""

    scene: str = "demo"
    robots: int = 4
    people: int = 2
    records: bool = True
    real_time_factor: float | None = None
    """Of the world; as fast as all can follow unless given."""


@dataclasses.dataclass(frozen=True)
class SoakResult:
    """What a run has shown."""

    histories: dict[tuple[str, int], ProcessHistory]
    """Of each process after settling, by kind and process id."""
    counts: dict[str, int]
    """Malformed messages, faults and restarts by name, of all processes together."""
    tick_hz: float
    """Least mean rate of any client."""

    def of_kind(self, kind: str) -> list[ProcessHistory]:
        """The processes of one kind."""
        return [history for (name, _), history in self.histories.items() if name == kind]


def soak(minutes: float, real_time_factor: float | None, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Run for ``minutes`` [min] and measure; ``announce`` takes a line now and then."""
    yield from measurements(run_soak(Cast(real_time_factor=real_time_factor), minutes, announce))


def measurements(result: SoakResult) -> Iterator[Measurement]:
    """Of each kind of process: memory, growth, and more threads or open files in the second half than in the first."""
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
    """Start all, wait until they are ready, sample them for ``minutes`` [min], end them.

    Raises :class:`ProgramFailed` if a process ends before, :class:`ProcUnavailable` where there is no /proc.
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
    """Histories from the time ``settled`` [s] on, and which processes had ended a minute before the ``end`` [s].

    A process that was started later, as one that stands by for another, settles for as long from its own start. One
    that has got another name meanwhile is there under both, and has not ended.
    """
    last: dict[int, float] = {}
    for (_, pid), history in histories.items():
        last[pid] = max(last.get(pid, -np.inf), history.times[-1])
    ended = {f"{kind} {pid} ended": 1 for kind, pid in histories if last[pid] < end - 60.0}
    later = {key: history.since(history.times[0] - start + settled) for key, history in histories.items()}
    return {key: history for key, history in later.items() if history.times}, ended


class _Run:
    """The programs of one run."""

    def __init__(self, group: ProgramGroup, cast: Cast, folder: pathlib.Path) -> None:
        """Start them; what they write goes below ``folder``."""
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
        """Robots one behind the other, the first of which pushes a bunch; people beside bunches of their own."""
        scene = load_scene(cast.scene)
        model = generate(scene)
        first = start_poses.start_pose(scene, 0)
        pushed = start_poses.find_reachable_bunch(model, first)
        with_ros = middleware.unavailable_reason() is None
        sensor_hz = SENSOR_HZ / (cast.real_time_factor or 1.0)  # of simulated time
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
        # a person's bunch lies apart from the robots
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
        """Take what the processes have printed; :class:`ProgramFailed` if one has ended."""
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
        """Let the listeners drop the times of the messages so far, which they keep for statistics: 3 MB an hour."""
        for listener in self.listeners:
            listener.restart()

    def wait_until_ready(self) -> None:
        """Return when every client steps, every sensor publishes and every listener has heard all its topics."""
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
        """One line: memory of all, rates of the clients, faults so far."""
        memory = self.sampler.memory()
        rates = " ".join(f"{values['tick_hz']:.0f}" for values in self._newest.values())
        faults = {name: values["faults"] for name, values in self._newest.items() if values["faults"]}
        return f"{memory:.0f} MB in all, ticks {rates} Hz, faults {faults or 'none'}"

    def least_rate(self) -> float:
        """The least mean rate of a client's ticks so far [Hz]."""
        return min((values["tick_hz"] for values in self._newest.values()), default=0.0)

    def end(self) -> dict[str, int]:
        """End the clients in order; what they counted. One that fails now is counted: the run itself is over."""
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
