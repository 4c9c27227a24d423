"""``python -m benchmarks soak``: five figures of robots, people and a recorder in a long run: share of delivered
messages, open files and threads, growth of memory, recovery after a killed server, and time to publish.

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

from benchmarks.support.link_probe import KINDS, LinkProbe
from vinesim.bench.live_client import own_processes
from vinesim.bench.process_memory import ProcessHistory, ProcessSampler, check_proc
from vinesim.client.programs import START_TIMEOUT, Program, ProgramFailed, ProgramGroup, RosListener, free_port
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
RECORD_PERIOD = 300.0
"""Time between two records of the figures so far [s]."""
RECOVERY_BOUND = 15.0
"""Largest accepted time from the kill of a server until all clients are served by its successor [s]."""
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
    sensor_hz: float = SENSOR_HZ
    """Rate of pictures and scans of each robot in real time [Hz]."""
    kill_every: float = 0.0
    """Time between two kills of the server, which is started again at once [min]; 0: it is never killed."""


@dataclasses.dataclass(frozen=True)
class SoakResult:
    """Result of a run."""

    histories: dict[tuple[str, int], ProcessHistory]
    """History of each process after settling, by kind and process id."""
    counts: dict[str, int]
    """Numbers of malformed messages, faults and restarts, by name, of all processes together."""
    tick_hz: float
    """Mean tick rate of the slowest client [Hz]."""
    minutes: float = 0.0
    """Time that was measured [min]."""
    link: dict[str, float] = dataclasses.field(default_factory=dict)
    """Figures of the probe of the server's link, by name with unit."""
    kills: int = 0
    """Number of times that the server was killed."""
    recoveries: list[float] = dataclasses.field(default_factory=list)
    """Time from each kill of the server until its successor served all clients [s]."""

    def of_kind(self, kind: str) -> list[ProcessHistory]:
        """Returns the histories of all processes of one kind."""
        return [history for (name, _), history in self.histories.items() if name == kind]


def soak(
    cast: Cast, minutes: float, record: pathlib.Path | None, announce: Callable[[str], None]
) -> Iterator[Measurement]:
    """Run for ``minutes`` [min] and measure. ``announce`` is called with a line of text from time to time.

    ``record``: file of the figures so far, as lines of JSON. The soak replaces the file every :data:`RECORD_PERIOD`.
    """

    def write(result: SoakResult) -> None:
        if record is not None:
            lines = [json.dumps(dataclasses.asdict(one)) for one in measurements(result)]
            part = record.with_name(record.name + ".part")
            part.write_text("\n".join(lines) + "\n")
            part.replace(record)

    result = run_soak(cast, minutes, announce, write)
    write(result)
    yield from measurements(result)


def measurements(result: SoakResult) -> Iterator[Measurement]:
    """Yields for each kind of process its memory, its growth, and how many more threads or open files it has in the
    second half of the run than in the first; then the figures of the link and of the server's kills."""
    yield Measurement("soak", "measured time", result.minutes, "min")
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
    for name, value in result.link.items():
        what, _, unit = name.rpartition(" in ")
        yield Measurement("soak", what, value, unit)
    if result.kills:
        yield Measurement("soak", "kills of the server", result.kills, "1")
        recovered = len(result.recoveries)
        yield Measurement(
            "soak", "kills after which all clients were served again", recovered, "1", "kills", result.kills
        )
    if result.recoveries:
        worst = max(result.recoveries)
        mean = float(np.mean(result.recoveries))
        yield Measurement("soak", "from a kill of the server until all are served, mean", mean, "s")
        case = "from a kill of the server until all are served, at most"
        yield Measurement("soak", case, worst, "s", "budget, at most", RECOVERY_BOUND, RECOVERY_BOUND / worst)
    for name, count in sorted(result.counts.items()):
        yield Measurement("soak", name.replace("_", " "), count, "1")


def run_soak(
    cast: Cast,
    minutes: float,
    announce: Callable[[str], None],
    record: Callable[[SoakResult], None] = lambda _: None,
) -> SoakResult:
    """Start all programs, wait until they are ready, sample them for ``minutes`` [min], and end them.

    ``record`` is called with the result so far every :data:`RECORD_PERIOD`. Raises :class:`ProgramFailed` if a
    process ends too early, :class:`ProcUnavailable` on systems without /proc.
    """
    check_proc()
    with own_processes() as group, tempfile.TemporaryDirectory() as folder:
        run = _Run(group, cast, pathlib.Path(folder))
        run.wait_until_ready()
        announce(f"all ready: {len(run.processes)} programs; {minutes:g} minutes to go")
        with LinkProbe(run.endpoint) as probe:
            _measure(run, probe, minutes, announce, record)
            ended = time.monotonic()
        return run.result(probe, ended, run.end())


def _measure(
    run: _Run,
    probe: LinkProbe,
    minutes: float,
    announce: Callable[[str], None],
    record: Callable[[SoakResult], None],
) -> None:
    """Sample all processes, and kill the server at its times, for ``minutes`` [min]."""
    run.start = start = time.monotonic()
    run.settling = 60.0 * min(SETTLING, minutes / 3.0)
    end = start + 60.0 * minutes
    due = said = recorded = start
    pause = 60.0 * run.cast.kill_every
    kill_at = start + run.settling + pause if pause else float("inf")
    while (now := time.monotonic()) < end:
        run.read()
        if now >= due:
            due = now + SAMPLE_PERIOD
            run.sampler.sample(now)
        if kill_at <= now < end - 60.0:
            kill_at = now + pause
            run.kill_server()
            announce("killed the server and started it again")
        if now >= said + 60.0:
            said = now
            run.forget_messages()
            announce(f"{(now - start) / 60.0:.0f} of {minutes:g} minutes; {run.progress()}")
        if now >= recorded + RECORD_PERIOD:
            recorded = now
            record(run.result(probe, now, run.faults()))
        time.sleep(POLL_PERIOD)


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
        self._group = group
        self.cast = cast
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.server = self._start_server()
        self._figures: dict[str, Any] = json.loads(self.server.next_line(START_TIMEOUT))
        self.clients: dict[str, Program] = {}
        self._newest: dict[str, dict[str, Any]] = {}
        self._heard: dict[str, float] = {}
        """Time of the newest status line of each client [s]."""
        self.start = 0.0
        """Time at which the measurement began [s]."""
        self.settling = 0.0
        """Time in which the memory of a process may grow before it is measured [s]."""
        self._killed_at: float | None = None
        """Time of the last kill of the server [s], until its successor serves all clients."""
        self._listed_at: float | None = None
        """Time at which the successor had all clients in its list [s]."""
        self._killed: set[int] = set()
        """Process ids of the killed servers."""
        self._refused = self._malformed = 0
        """Counts of the killed servers."""
        self._recoveries: list[float] = []
        self.listeners: list[RosListener] = []
        self.processes: list[tuple[str, Program]] = [("server", self.server)]
        self._start_clients(group, cast)
        self.recorder = None
        if cast.records:
            self.recorder = group.start(
                "recorder", "-m", "vinesim", "record", str(folder / "soak.mcap"), "--connect", self.endpoint
            )
            self.processes.append(("recorder", self.recorder))
        self.sampler = ProcessSampler([(kind, process.child.pid) for kind, process in self.processes])

    def _start_server(self) -> Program:
        factor = self.cast.real_time_factor
        return self._group.start(
            "server",
            "-m",
            "vinesim",
            "server",
            "--listen",
            self.endpoint,
            "--status",
            "json",
            "--state-dir",
            str(self._folder / "state"),
            "--real-time-factor",
            "auto" if factor is None else f"{factor:g}",
        )

    def kill_server(self) -> None:
        """Kill the server and start another one in its place."""
        self._killed_at = time.monotonic()
        self._listed_at = None
        self._refused += self._figures["refused"]
        self._malformed += self._figures["malformed"]
        self._killed.add(self.server.child.pid)
        self.server.child.kill()
        self.server.child.wait()
        self.server = self._start_server()
        self._figures = {"refused": 0, "malformed": 0, "actors": ()}
        self.processes.append(("server", self.server))
        self.sampler.add("server", self.server.child.pid)

    def _watch_recovery(self) -> None:
        """Note the recovery if the successor of a killed server has all clients in its list, and all clients say
        later that they are served and see each other."""
        if self._killed_at is None:
            return
        now = time.monotonic()
        names = {*self.clients}
        if self._listed_at is None:
            if names <= {*map(_actor, self._figures["actors"])}:
                self._listed_at = now
            return
        for name, status in self._newest.items():
            sees = {*status["others"], name}
            if self._heard[name] <= self._listed_at or status["network"] or not names <= sees:
                return
        self._recoveries.append(now - self._killed_at)
        self._killed_at = None

    def _start_clients(self, group: ProgramGroup, cast: Cast) -> None:
        """Start robots one behind the other, of which the first pushes a bunch, and people next to bunches of their
        own."""
        scene = load_scene(cast.scene)
        model = generate(scene)
        first = start_poses.start_pose(scene, 0)
        pushed = start_poses.find_reachable_bunch(model, first)
        with_ros = middleware.unavailable_reason() is None
        sensor_hz = cast.sensor_hz / (cast.real_time_factor or 1.0)  # rate in simulated time
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
        common = ["--connect", self.endpoint, "--scene", cast.scene, "--status", "json"]
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
                self._heard[name] = time.monotonic()
        for line in self.server.new_lines():
            self._figures = json.loads(line)
        for listener in self.listeners:
            listener.missing()
        if self.recorder is not None:
            self.recorder.new_lines()
        self._watch_recovery()

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
        recovered = f", recovered after {self._recoveries[-1]:.1f} s" if self._recoveries else ""
        return f"{memory:.0f} MB in all, ticks {rates} Hz, faults {faults or 'none'}{recovered}"

    def least_rate(self) -> float:
        """Returns the mean tick rate of the slowest client so far [Hz]."""
        return min((values["tick_hz"] for values in self._newest.values()), default=0.0)

    def faults(self) -> dict[str, int]:
        """Returns the counts so far: of the servers, and of the newest status lines of the clients."""
        counts = {
            "malformed, server": self._malformed + self._figures["malformed"],
            "refused, server": self._refused + self._figures["refused"],
        }
        for status in self._newest.values():
            for key, count in status["faults"].items():
                counts[f"{key}, clients"] = counts.get(f"{key}, clients", 0) + count
        return counts

    def result(self, probe: LinkProbe, end: float, counts: dict[str, int]) -> SoakResult:
        """Returns what was measured until ``end`` [s], with ``counts``."""
        histories, ended = settle(self.sampler.histories, self.start, self.start + self.settling, end)
        ended = {name: count for name, count in ended.items() if int(name.split()[-2]) not in self._killed}
        link: dict[str, float] = {}
        for kind in KINDS:
            link[f"messages of the probe, {kind}: published in 1"] = probe.sent[kind]
            link[f"messages of the probe, {kind}: not published, the server was gone in 1"] = probe.unsent[kind]
            link[f"messages of the probe, {kind}: delivered in 1"] = probe.delivered(kind)
            link[f"messages of the probe, {kind}: published to arrived, p50 in ms"] = 1e3 * probe.delay(kind, 50.0)
            link[f"messages of the probe, {kind}: published to arrived, p99 in ms"] = 1e3 * probe.delay(kind, 99.0)
        link["call that publishes, p50 in ms"] = 1e3 * probe.call(50.0)
        link["call that publishes, p99 in ms"] = 1e3 * probe.call(99.0)
        link["pictures and scans of the robots: delivered in 1"] = self._delivered_frames()
        return SoakResult(
            histories,
            counts | ended,
            self.least_rate(),
            (end - self.start) / 60.0,
            link,
            len(self._killed),
            list(self._recoveries),
        )

    def _delivered_frames(self) -> float:
        """Returns the share of due pictures and scans that were delivered; 1 without any."""
        delivered = sum(status["frames_delivered"] for status in self._newest.values())
        dropped = sum(status["frames_dropped"] for status in self._newest.values())
        return delivered / (delivered + dropped) if delivered + dropped else 1.0

    def end(self) -> dict[str, int]:
        """End the clients in order and return their counts. A client that fails now adds to the counts: the run itself
        is over."""
        counts = {
            "malformed, server": self._malformed + self._figures["malformed"],
            "refused, server": self._refused + self._figures["refused"],
        }
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


def _actor(text: str) -> str:
    """Returns the name of an actor in the server's list, which may have the world before it."""
    return text.rpartition("/")[2]
