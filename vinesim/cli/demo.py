"""``vinesim demo``: a server, two robot clients and a listening stranger, each a process of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import pathlib
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table

from vinesim.client.recording import touch_plot
from vinesim.client.recording.trace import Rows, remote_error
from vinesim.robot.description.sidecar import SensorMount
from vinesim.ros import ros_setup
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene

PUSHER, VISITOR = "picker", "visitor"
EXIT_TIMEOUT = 1.6
"""How long a process may take to end after SIGINT before it is killed [s]."""


START_TIMEOUT = 300.0
"""How long a client may take to start; a first run compiles kernels [s]."""
APPROACH_DISTANCE = 14
"""The visitor comes from so far [m]."""
VISITOR_DISTANCE = 3.0
"""A visitor watches a job from so far [m]."""
REPORT_TIMEOUT = 10.0
"""How long the visitor may take to write what it saw [s]."""


class DemoFailed(RuntimeError):
    """A process of the demo ended before its time; the text says which, and what it said."""

    exit_code = 4


@dataclasses.dataclass
class Process:
    """A child, its last words and its newest status."""

    name: str
    child: subprocess.Popen[str]
    stdout_lines: queue.Queue[str]
    stderr_tail: list[str]

    @classmethod
    def start(cls, name: str, *arguments: str, **environ: str) -> Process:
        """Run ``python ARGUMENTS`` in a session of its own, so that Ctrl-C reaches it only through us."""
        child = subprocess.Popen(
            [sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, start_new_session=True, env={**os.environ, **environ},
        )  # fmt: skip
        process = cls(name, child, queue.Queue(), [])
        threading.Thread(target=process._read_stdout, daemon=True).start()
        threading.Thread(target=process._read_stderr, daemon=True).start()
        return process

    def _read_stdout(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.stdout_lines.put(line.rstrip("\n"))
        self.stdout_lines.put("")

    def _read_stderr(self) -> None:
        assert self.child.stderr is not None
        for line in self.child.stderr:
            self.stderr_tail = [*self.stderr_tail[-40:], line.rstrip("\n")]

    def next_line(self, timeout: float) -> str:
        """The next line of output; :class:`DemoFailed` if it ended or stayed silent."""
        try:
            line = self.stdout_lines.get(timeout=timeout)
        except queue.Empty:
            raise DemoFailed(f"{self.name} said nothing for {timeout:.0f} s; {self._stderr_summary()}") from None
        if not line:
            raise self.failure()
        return line

    def remaining_output(self, timeout: float) -> str:
        """Close its input, and all that it prints until its end."""
        assert self.child.stdin is not None
        self.child.stdin.close()
        words = []
        while line := self.stdout_lines.get(timeout=timeout):
            words.append(line)
        return "\n".join(words)

    def failure(self) -> DemoFailed:
        """Why it ended too early."""
        self.child.wait(EXIT_TIMEOUT)
        return DemoFailed(f"{self.name} ended with exit code {self.child.returncode}; {self._stderr_summary()}")

    def _stderr_summary(self) -> str:
        last = [word for word in self.stderr_tail if word.strip()]
        return f"it said: {last[-1]}" if last else "it said nothing"

    def stop(self) -> None:
        """Ask it to end; :meth:`reap` waits."""
        if self.child.poll() is None:
            self.child.send_signal(signal.SIGINT)

    def wait_or_kill(self, timeout: float) -> None:
        """Wait for its end, or end it."""
        try:
            self.child.wait(max(timeout, 0.0))
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


@contextlib.contextmanager
def process_group() -> Iterator[list[Process]]:
    """Processes that end with the block, all within :data:`GRACE`, however it is left."""
    processes: list[Process] = []
    try:
        yield processes
    finally:
        deadline = time.monotonic() + EXIT_TIMEOUT
        for process in processes:
            process.stop()
        for process in processes:
            process.wait_or_kill(deadline - time.monotonic())


def run(*, seconds: float, seed: int | None, scene: str, robot: str, headless: bool, out: pathlib.Path) -> int:
    """Run the demo and write ``out``; 0 if all went well."""
    from vinesim.robot.description.loader import load_description as load_robot
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed

    console = Console(stderr=True)
    plan = with_seed(load_scene(scene), seed)
    robot_named = load_robot(robot)  # say now, and once, what is wrong with it
    model = generate(plan)
    bunch, places = choose_poses(plan, model)
    for folder in (out, out / PUSHER, out / VISITOR):
        folder.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").unlink(missing_ok=True)
    no_ros = ros_setup.unavailable_reason()
    if no_ros:
        console.print(f"ROS 2 is not usable here, the demo runs without it: {no_ros}")

    common = ["-m", "vinesim.cli", "client", "--role", "robot", "--scene", scene, "--robot", robot, "--status", "json"]
    common += ["--watch", str(bunch)] + ([] if seed is None else ["--seed", str(seed)])
    quiet_ros = {} if "ROS_AUTOMATIC_DISCOVERY_RANGE" in os.environ else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with process_group() as processes:

        def start(name: str, *arguments: str) -> Process:
            processes.append(Process.start(name, *arguments, **quiet_ros))
            return processes[-1]

        server = start("server", "-m", "vinesim.cli", "server", "--listen", "tcp/127.0.0.1:0")
        endpoint = server.next_line(20.0).removeprefix("listening on ")
        stranger = (
            None
            if no_ros
            else start("stranger", "-m", "vinesim.ros.tools.topic_monitor", *monitored_topics(robot_named.cameras))
        )
        console.print(
            f"server on {endpoint}; {PUSHER} will push bunch {bunch} for {seconds:.0f} s (a first run compiles kernels)"
        )
        pusher = start(
            PUSHER, *common, "--name", PUSHER, "--connect", endpoint, *places[0], "--push", str(bunch),
            "--seconds", str(seconds), "--out", str(out / PUSHER), "--sensor-hz", "1",
        )  # fmt: skip
        visitor = start(
            VISITOR, *common, "--name", VISITOR, "--connect", endpoint, *places[1], "--back", str(APPROACH_DISTANCE),
            "--namespace", VISITOR, "--out", str(out / VISITOR), "--sensor-hz", "0.5",
        )  # fmt: skip
        newest = {process.name: json.loads(process.next_line(START_TIMEOUT)) for process in (pusher, visitor)}
        show_progress(pusher, visitor, server, newest, console, headless)
        visitor.stop()
        visitor.wait_or_kill(REPORT_TIMEOUT)
        if visitor.child.returncode:
            raise visitor.failure()
        heard = {}
        if stranger is not None:
            heard = json.loads(stranger.remaining_output(10.0))
    summary = write_summary(out, bunch, heard, no_ros, scene, plan.seed, seconds)
    console.print(_result(summary))
    console.print(f"pictures, plot and summary.json are in {out}/")
    return 0


JOBS = {"pick": ("vinebot", "picked"), "exchange": ("logistic", "exchanged")}
"""Jobs: the robot that does them unless another is named, and the word for that it was done."""


def run_job(
    job: str, *, seconds: float | None, seed: int | None, scene: str | None, robot: str | None, headless: bool,
    out: pathlib.Path,
) -> int:  # fmt: skip
    """Let one robot do a job and write ``out``; 0 if it was done, 5 if not."""
    from vinesim.client.tasks.tasks import UnknownTask
    from vinesim.robot.description.loader import load_description as load_robot
    from vinesim.scene.spec import load_scene, with_seed

    if job not in JOBS:
        raise UnknownTask(f"no job {job!r}; give push, {' or '.join(JOBS)}")
    console = Console(stderr=True)
    robot, scene = robot or JOBS[job][0], scene or "harvest"
    plan = with_seed(load_scene(scene), seed)
    load_robot(robot)  # say now, and once, what is wrong with it
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").unlink(missing_ok=True)
    no_ros = ros_setup.unavailable_reason()
    quiet_ros = {} if "ROS_AUTOMATIC_DISCOVERY_RANGE" in os.environ else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with process_group() as processes:
        server = Process.start("server", "-m", "vinesim.cli", "server", "--listen", "tcp/127.0.0.1:0", **quiet_ros)
        processes.append(server)
        endpoint = server.next_line(20.0).removeprefix("listening on ")
        console.print(f"server on {endpoint}; {robot} is to {job} (a first run compiles kernels)")
        common = ["-m", "vinesim.cli", "client", "--role", "robot", "--connect", endpoint, "--scene", scene]
        common += ["--seed", str(plan.seed), "--robot", robot, "--status", "json"]
        visitor, newest = None, {}
        if (place := visitor_pose(plan)) is not None:
            visitor = Process.start(
                VISITOR, *common, "--name", VISITOR, *place, "--namespace", VISITOR, "--out", str(out / VISITOR),
                "--sensor-hz", "0.5", **quiet_ros,
            )  # fmt: skip
            processes.append(visitor)
            newest[VISITOR] = json.loads(visitor.next_line(START_TIMEOUT))
        worker = Process.start(
            PUSHER, *common, "--name", PUSHER, "--job", job, "--seconds", str(seconds or 120.0),
            "--out", str(out / PUSHER), "--sensor-hz", "1", **quiet_ros,
        )  # fmt: skip
        processes.append(worker)
        newest[PUSHER] = json.loads(worker.next_line(START_TIMEOUT))
        show_progress(worker, visitor, server, newest, console, headless)
        if visitor is not None:
            visitor.stop()
            visitor.wait_or_kill(REPORT_TIMEOUT)
            if visitor.child.returncode:
                raise visitor.failure()
    report = json.loads((out / PUSHER / "report.json").read_text())
    done = bool(report["job"]["succeeded"])
    reason = report["job"]["reason"] or ("" if done else f"stopped at {report['job']['phase']!r} before the end")
    summary = {
        "scene": scene, "seed": plan.seed, "robot": robot, "job": job, JOBS[job][1]: done, "reason": reason,
        "seconds": report["time"], "ros": no_ros or "used", "detail": report["job"],
        **{key: report[key] for key in ("tick_hz", "tick_p50_ms", "tick_p99_ms", "overruns", "real_time_factor")},
        "bunches_picked": report["bunches_picked"],
    }  # fmt: skip
    if visitor is not None:
        seen = json.loads((out / VISITOR / "report.json").read_text())
        told = {family: report["network"][family]["bytes_out"] for family in ("environment", "event", "fact")}
        summary["told_visitor"] = {"bytes": told, "bytes_per_s": sum(told.values()) / max(report["time"], 1e-9)}
        summary["visitor"] = {key: seen[key] for key in ("bunches_picked", "tick_hz", "tick_p99_ms", "network")}
    for picture in (out / PUSHER).glob("*.png"):
        shutil.copyfile(picture, out / picture.name)
    partial = out / "summary.json.part"
    partial.write_text(json.dumps(summary, indent=2) + "\n")
    partial.replace(out / "summary.json")
    console.print(f"{JOBS[job][1]} after {report['time']:.1f} s" if done else f"not {JOBS[job][1]}: {reason}")
    if visitor is not None:
        console.print(
            f"{VISITOR} was told of it with {sum(told.values())} B, {summary['told_visitor']['bytes_per_s']:.0f} B/s, "
            f"and has {seen['bunches_picked']} of {report['bunches_picked']} bunches off their vines"
        )
    console.print(f"pictures and summary.json are in {out}/")
    return 0 if done else 5


def visitor_pose(plan: Scene) -> list[str] | None:
    """Where a visitor watches a job, as options: aside from where it starts, on the way to the second start place."""
    from vinesim.client.tasks import start_poses

    if len(plan.spawns) < 2:
        return None
    here, there = (start_poses.spawn_pose(plan, i)[:2] for i in (0, 1))
    way = (there - here) / max(float(np.linalg.norm(there - here)), 1e-9)
    place = here + VISITOR_DISTANCE * way
    return ["--place", f"{place[0]:.4f}", f"{place[1]:.4f}", f"{math.atan2(-way[1], -way[0]):.4f}"]


def choose_poses(plan: Scene, model: Model) -> tuple[int, tuple[list[str], list[str]]]:
    """The bunch to push, and where both robots start, as options: the scene's places if a bunch is in reach there."""
    from vinesim.client.tasks import start_poses

    try:
        return start_poses.find_reachable_bunch(model, start_poses.spawn_pose(plan, 0)), (
            ["--spawn", "0"],
            ["--spawn", "1"],
        )
    except start_poses.PlacementError:
        bunch, pusher = start_poses.find_push_pose(model, start_poses.spawn_pose(plan, 0)[:2])
    poses = (pusher, start_poses.find_approach_pose(model, pusher, APPROACH_DISTANCE))
    pusher_at, visitor_at = (
        ["--place", *(f"{v:.4f}" for v in (p[0], p[1], 2.0 * math.atan2(p[5], p[6])))] for p in poses
    )
    return bunch, (pusher_at, visitor_at)


def monitored_topics(cameras: Sequence[SensorMount]) -> list[str]:
    """What the stranger subscribes to: all of the pusher's topics, of the visitor's its joints and first picture."""
    topics = [
        "/clock", "/robot_description", "/joint_states", "/tf", "/tf_static", "/tf_environment",
        "/tf_environment_static", "/lidar/points", "/vine/contacts", "/mobile_base_controller/odom", "/diagnostics",
        f"/{VISITOR}/joint_states",
    ]  # fmt: skip
    pictures = ("rgb/image_raw", "rgb/camera_info", "depth/image_raw", "depth/camera_info", "depth/points", "labels")
    topics += [f"/{camera.name}/{picture}" for camera in cameras for picture in pictures]
    topics += [f"/{VISITOR}/{camera.name}/rgb/image_raw" for camera in cameras[:1]]
    return [word for topic in topics for word in ("--topic", topic)]


def show_progress(
    pusher: Process, visitor: Process | None, server: Process, newest: dict[str, Any], console: Console, headless: bool
) -> None:
    """Show what both clients report until the pusher is done."""
    live = contextlib.nullcontext() if headless or not console.is_terminal else Live(console=console, transient=True)
    with live as view:
        while True:
            with contextlib.suppress(queue.Empty):
                while visitor is not None and (line := visitor.stdout_lines.get_nowait()):
                    newest[VISITOR] = json.loads(line)
            try:
                line = pusher.stdout_lines.get(timeout=0.5)
            except queue.Empty:
                line = None
            if line == "":
                if pusher.child.wait(EXIT_TIMEOUT):
                    raise pusher.failure()
                return
            for process in (visitor, server):
                if process is not None and process.child.poll() is not None:
                    raise process.failure()
            if line is not None:
                newest[PUSHER] = json.loads(line)
                if view is not None:
                    view.update(_table(newest))
                else:
                    console.print(_line(newest[PUSHER]), highlight=False, soft_wrap=True)


def _line(status: dict[str, Any]) -> str:
    how = (
        f"{status['time']:6.1f} s  {status['tick_hz']:6.2f} Hz  p99 {status['tick_p99_ms']:5.2f} ms  "
        f"awake {status['awake']:3d}  force {status['force']:6.2f} N  "
    )
    if status["phase"]:
        return how + status["phase"]
    return how + (
        f"moved {status['displacement_mm']:6.1f} mm  out {status['bytes_out']:7d} B  "
        f"env {status['environment_bytes_out']:6d} B"
    )


def _table(newest: dict[str, dict[str, Any]]) -> Table:
    table = Table(title="vinesim demo", title_justify="left")
    table.add_column("")
    for name in newest:
        table.add_column(name, justify="right", min_width=14)
    rows = (
        ("time [s]", "time", ".1f"), ("tick rate [Hz]", "tick_hz", ".2f"), ("tick p99 [ms]", "tick_p99_ms", ".2f"),
        ("real-time factor", "real_time_factor", ".4f"), ("awake plants", "awake", "d"),
        ("contact force [N]", "force", ".2f"), ("bunch moved [mm]", "displacement_mm", ".1f"),
        ("bytes in", "bytes_in", "d"), ("bytes out", "bytes_out", "d"),
        ("of these environment", "environment_bytes_out", "d"),
    )  # fmt: skip
    for label, key, form in rows:
        table.add_row(label, *(format(status[key], form) for status in newest.values()))
    if any(status["phase"] for status in newest.values()):
        table.add_row("job", *(status["phase"] for status in newest.values()))
    for topic in sorted({topic for status in newest.values() for topic in status["topics"]}):
        table.add_row(topic, *(f"{status['topics'].get(topic, 0.0):.1f} Hz" for status in newest.values()))
    return table


def write_summary(
    out: pathlib.Path, bunch: int, heard: dict[str, Any], no_ros: str | None, scene: str, seed: int, seconds: float
) -> dict[str, Any]:
    """Put the clients' reports together; ``summary.json``, ``touch.png`` and the pusher's pictures go to ``out``."""
    report = {name: json.loads((out / name / "report.json").read_text()) for name in (PUSHER, VISITOR)}
    traces = {name: Rows.load(out / name / "trace.npz") for name in (PUSHER, VISITOR)}
    touch_plot.touch(out / "touch.png", traces, f"bunch {bunch}, pushed by {PUSHER}, seen by {VISITOR}")
    for picture in (out / PUSHER).glob("*.png"):
        shutil.copyfile(picture, out / picture.name)
    mine, other = report[PUSHER], report[VISITOR]
    summary = {
        "scene": scene, "seed": seed, "seconds": seconds, "bunch": bunch,
        **{key: mine[key] for key in (
            "tick_hz", "tick_p50_ms", "tick_p99_ms", "overruns", "real_time_factor", "touch_to_motion_ticks",
            "force_peak_n", "environment_bytes_when_far", "ticks_touching_when_far", "environment_bytes_out",
        )},
        "remote_displacement_error_mm": remote_error(traces[PUSHER], traces[VISITOR]),
        "ros": no_ros or "used",
        "ros_received": {topic: entry["count"] for topic, entry in sorted(heard.items())},
        "ros_detail": heard,
        "clients": {PUSHER: mine, VISITOR: other},
    }  # fmt: skip
    partial = out / "summary.json.part"
    partial.write_text(json.dumps(summary, indent=2) + "\n")
    partial.replace(out / "summary.json")
    return summary


def _result(summary: dict[str, Any]) -> Table:
    error = summary["remote_displacement_error_mm"]
    table = Table(title="what was measured", title_justify="left", show_header=False)
    for label, text in (
        ("tick rate", f"{summary['tick_hz']:.2f} Hz, p99 {summary['tick_p99_ms']:.2f} ms of 10"),
        ("real-time factor", f"{summary['real_time_factor']:.4f}"),
        ("touch to motion", f"{summary['touch_to_motion_ticks']} ticks"),
        ("largest force", f"{summary['force_peak_n']:.1f} N"),
        (
            "remote copy off by",
            "never in company" if error is None else f"{error['p50']:.1f} mm median, {error['p95']:.1f} p95",
        ),
        ("bytes of touched plants, nobody near", f"{summary['environment_bytes_when_far']}"),
        ("ROS messages heard by a stranger", f"{sum(summary['ros_received'].values())}"),
    ):
        table.add_row(label, text)
    return table
