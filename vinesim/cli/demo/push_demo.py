"""``vinesim demo``: one robot pushes a bunch, another approaches and sees it move, a stock ROS node counts messages."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Mapping

from rich.console import Console

from vinesim.cli.demo.placement import APPROACH_DISTANCE, check_device, choose_poses
from vinesim.cli.demo.progress import PICKER, VISITOR, Statuses, show_progress
from vinesim.cli.demo.readiness import wait_until_ready
from vinesim.cli.demo.summary import Window, push_summary, push_table, write_summary
from vinesim.client.programs import START_TIMEOUT, Program, ProgramGroup, RosListener, free_port, program_group
from vinesim.core.errors import writing
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.source import kept_robot_file
from vinesim.ros import middleware
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.values import SENSOR_KINDS
from vinesim.web import page_files
from vinesim.web.page_token import lasting_address

VISITOR_SENSOR_HZ = "1"
"""Rate of the visitor's sensors [Hz], low because the demo only needs them to exist."""


@dataclasses.dataclass(frozen=True)
class ListenedTopics:
    """Topics to which the ROS listener of a demo subscribes."""

    always: tuple[str, ...]
    once: tuple[str, ...]
    """Topics that are unsubscribed after their first message."""
    events: tuple[str, ...]
    """Topics that may stay silent, so that the start does not wait for them."""
    owners: Mapping[str, str]
    """Text that names the sensor which publishes a topic, by topic."""

    def describe(self, topic: str) -> str:
        """Returns a text for the progress display: what is missing while a topic has had no message."""
        return self.owners.get(topic, topic)


def run_push(
    *,
    seconds: float,
    seed: int | None,
    scene: str,
    robot: str,
    device: str,
    real_time_factor: float | None,
    headless: bool,
    out: pathlib.Path,
) -> int:
    """Run the demo for ``seconds`` of simulated time after all is ready, and write ``out``. Returns the exit code."""
    console = Console(stderr=True, markup=False)
    begin = time.time()
    check_device(device)
    plan = with_seed(load_scene(scene), seed)
    description = load_description(robot)  # raise errors before any process starts
    for folder in (out, out / PICKER, out / VISITOR):
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    with writing(out):
        robot = kept_robot_file(robot, description, out)
    (out / "summary.json").unlink(missing_ok=True)
    no_ros = middleware.unavailable_reason()
    if no_ros:
        console.print(f"ROS 2 is not usable here, the demo runs without it: {no_ros}")
    with program_group() as group:
        topics = listened_topics(description)
        listener = None if no_ros else RosListener(group, topics.always, topics.once, topics.events)
        server, endpoint = group.start_server(real_time_factor)
        bunch, poses = choose_poses(plan, generate(plan))
        console.print(f"server on {endpoint}; {PICKER} will push bunch {bunch} for {seconds:.0f} s")
        common = ["--connect", endpoint, "--scene", scene, "--robot", robot, "--device", device]
        common += [] if seed is None else ["--seed", str(seed)]
        port = free_port()
        address = lasting_address(port)
        no_page = page_files.missing() or (None if address else "the folder for caches cannot be written")
        clients = _start_clients(group, common, bunch, poses, None if no_page else port, out)
        newest = Statuses()
        ready = wait_until_ready(clients, [server], listener, newest, topics.describe, console, START_TIMEOUT)
        took = time.time() - begin
        console.print(f"all ready after {took:.1f} s; {seconds:.0f} s to go", highlight=False)
        if no_page:
            console.print(f"nothing to watch in a browser: {no_page}")
        else:
            console.print(f"watch it in a browser: {address}", highlight=False, soft_wrap=True)
        timer = _RunTimer(newest[PICKER]["time"] + seconds, listener)
        show_progress(clients[PICKER], clients[VISITOR], server, newest, console, headless, timer.is_over)
        received = {} if listener is None else listener.report()
        clients[VISITOR].finish()
    starts = {"ready": took} | {name: moment - begin for name, moment in ready.items()}
    summary = push_summary(
        out,
        bunch,
        received,
        no_ros=no_ros,
        scene=scene,
        seed=plan.seed,
        seconds=seconds,
        window=timer.window,
        starts=starts,
    )
    write_summary(out, summary)
    console.print(push_table(summary))
    console.print(f"pictures, plot and summary.json are in {out}/")
    return 0


class _RunTimer:
    """Measures a run from its creation until the picker's simulated time ``end`` [s], at which the demo ends."""

    def __init__(self, end: float, listener: RosListener | None) -> None:
        self._end = end
        self._listener = listener
        self.window = Window.begin()
        if listener is not None:
            listener.restart()

    def is_over(self, newest: Statuses) -> bool:
        """Returns whether the run has reached its end, according to the newest statuses. If so, the measurement ends
        too."""
        if newest[PICKER]["time"] < self._end:
            return False
        if self.window.is_open:
            self.window = self.window.end()
            if self._listener is not None:
                self._listener.stop()
        return True


def _start_clients(
    group: ProgramGroup,
    common: list[str],
    bunch: int,
    poses: tuple[list[str], list[str]],
    page: int | None,
    out: pathlib.Path,
) -> dict[str, Program]:
    """Start both clients with the ``common`` options and return them by name.

    One pushes the ``bunch``; the other drives up to it and serves a page on the port ``page``.
    """
    common = ["-m", "vinesim", "client", "--role", "robot", *common, "--status", "json", "--watch", str(bunch)]
    own = {
        PICKER: [*poses[0], "--push", str(bunch)],
        VISITOR: [
            *poses[1],
            "--approach",
            str(APPROACH_DISTANCE),
            "--namespace",
            VISITOR,
            "--sensor-hz",
            VISITOR_SENSOR_HZ,
            *([] if page is None else ["--page", str(page)]),
        ],
    }
    clients = {}
    for name, options in own.items():
        files = ["--out", str(out / name), "--tick-log", str(out / name / "ticks.npz")]
        clients[name] = group.start(name, *common, "--name", name, *options, *files)
    return clients


def listened_topics(robot: RobotDescription) -> ListenedTopics:
    """Returns the topics that the listener subscribes to: all topics of the picker, and of the visitor the joints and
    the first frame of each sensor."""
    always = [
        "/clock",
        "/robot_description",
        "/joint_states",
        "/tf",
        "/tf_static",
        "/tf_environment",
        "/tf_environment_static",
        "/mobile_base_controller/odom",
        "/diagnostics",
        f"/{VISITOR}/joint_states",
    ]
    once = []
    owners = {f"/{VISITOR}/joint_states": VISITOR}
    for sensor in robot.sensors:
        kind = SENSOR_KINDS[sensor.kind]
        always += [f"/{sensor.name}/{topic}" for topic in kind.topics]
        costly = [f"/{sensor.name}/{topic}" for topic in kind.costly_topics]
        visited = f"/{VISITOR}/{sensor.name}/{kind.topics[0]}"
        once += [*costly, visited]
        owners |= dict.fromkeys((*always[-len(kind.topics) :], *costly), f"{sensor.name} of {PICKER}")
        owners[visited] = f"{sensor.name} of {VISITOR}"
    return ListenedTopics(tuple(always), tuple(once), ("/vine/contacts",), owners)
