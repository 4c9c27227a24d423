"""``vinesim demo``: one robot pushes a bunch, another drives up and sees it move, a stock ROS node counts messages."""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Sequence

from rich.console import Console

from vinesim.cli.demo.placement import APPROACH_DISTANCE, choose_poses
from vinesim.cli.demo.processes import REPORT_TIMEOUT, START_TIMEOUT, process_group
from vinesim.cli.demo.progress import PICKER, VISITOR, Statuses, show_progress
from vinesim.cli.demo.summary import push_summary, push_table, write_summary
from vinesim.kernels.compilation import compile_kernels
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.ros import middleware
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene, with_seed

READY_TIMEOUT = 120.0
"""Longest wait for the first message of every sensor topic [s of wall time]; then the demo measures without them."""

CAMERA_TOPICS = ("rgb/image_raw", "rgb/camera_info", "depth/image_raw", "depth/camera_info", "depth/points", "labels")


def run_push(*, seconds: float, seed: int | None, scene: str, robot: str, headless: bool, out: pathlib.Path) -> int:
    """Run the demo for ``seconds`` of simulated time after all sensors publish, and write ``out``; the exit code."""
    console = Console(stderr=True)
    plan = with_seed(load_scene(scene), seed)
    compile_kernels()
    description = load_description(robot)  # refused once, and before any process starts
    bunch, poses = choose_poses(plan, generate(plan))
    for folder in (out, out / PICKER, out / VISITOR):
        folder.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").unlink(missing_ok=True)
    no_ros = middleware.unavailable_reason()
    if no_ros:
        console.print(f"ROS 2 is not usable here, the demo runs without it: {no_ros}")

    common = ["-m", "vinesim.cli", "client", "--role", "robot", "--scene", scene, "--robot", robot, "--status", "json"]
    common += ["--watch", str(bunch)] + ([] if seed is None else ["--seed", str(seed)])
    received = {}
    with process_group() as group:
        server, endpoint = group.start_server()
        monitor = None
        if not no_ros:
            topics = [word for topic in monitored_topics(description) for word in ("--topic", topic)]
            monitor = group.start("topic monitor", "-m", "vinesim.ros.tools.topic_monitor", *topics)
        console.print(
            f"server on {endpoint}; {PICKER} will push bunch {bunch} for {seconds:.0f} s (a first run compiles kernels)"
        )
        picker = group.start(
            PICKER, *common, "--name", PICKER, "--connect", endpoint, *poses[0], "--push", str(bunch),
            "--out", str(out / PICKER), "--sensor-hz", "1",
        )  # fmt: skip
        visitor = group.start(
            VISITOR, *common, "--name", VISITOR, "--connect", endpoint, *poses[1], "--approach", str(APPROACH_DISTANCE),
            "--namespace", VISITOR, "--out", str(out / VISITOR), "--sensor-hz", "0.5",
        )  # fmt: skip
        newest = {process.name: json.loads(process.next_line(START_TIMEOUT)) for process in (picker, visitor)}
        timer = _RunTimer(seconds, [] if no_ros else sensor_topics(description), console)
        show_progress(picker, visitor, server, newest, console, headless, timer.is_over)
        visitor.finish()
        if monitor is not None:
            received = json.loads(monitor.remaining_output(REPORT_TIMEOUT))
    summary = push_summary(out, bunch, received, no_ros, scene, plan.seed, seconds)
    write_summary(out, summary)
    console.print(push_table(summary))
    console.print(f"pictures, plot and summary.json are in {out}/")
    return 0


def sensor_topics(robot: RobotDescription) -> list[str]:
    """Topics of a robot's sensors, relative to its namespace."""
    points = [f"{lidar.name}/points" for lidar in robot.lidars]
    return points + [f"{camera.name}/{topic}" for camera in robot.cameras for topic in CAMERA_TOPICS]


def monitored_topics(robot: RobotDescription) -> list[str]:
    """The topics that the monitor counts: all of the picker's, of the visitor's its joints and first picture."""
    topics = [
        "/clock", "/robot_description", "/joint_states", "/tf", "/tf_static", "/tf_environment",
        "/tf_environment_static", "/vine/contacts", "/mobile_base_controller/odom", "/diagnostics",
        f"/{VISITOR}/joint_states",
    ]  # fmt: skip
    topics += [f"/{topic}" for topic in sensor_topics(robot)]
    topics += [f"/{VISITOR}/{camera.name}/rgb/image_raw" for camera in robot.cameras[:1]]
    return topics


class _RunTimer:
    """Ends the demo when ``seconds`` of simulated time have passed since every topic had its first message."""

    def __init__(self, seconds: float, topics: Sequence[str], console: Console) -> None:
        self._seconds, self._awaited, self._console = seconds, set(topics), console
        self._deadline = time.monotonic() + READY_TIMEOUT
        self._end: float | None = None

    def is_over(self, newest: Statuses) -> bool:
        """Whether the run has lasted long enough, by the newest statuses."""
        status = newest[PICKER]
        if self._end is None:
            self._awaited -= status["topics"].keys()
            if self._awaited and time.monotonic() < self._deadline:
                return False
            self._end = status["time"] + self._seconds
            state = f"no message yet of {', '.join(sorted(self._awaited))}" if self._awaited else "all sensors publish"
            self._console.print(f"{state} after {status['time']:.1f} s; {self._seconds:.0f} s to go")
        return status["time"] >= self._end
