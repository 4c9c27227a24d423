"""``vinesim client --role robot``: simulate one robot or several, with their sensors and ROS nodes."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from vinesim.cli.client_options import ClientOptions
from vinesim.cli.client_session import ClientSession, save_report
from vinesim.client.client import Client
from vinesim.client.processes.robot_processes import RobotProcesses
from vinesim.client.recording.state_digest import StateDigest
from vinesim.client.tasks.harvesting import HarvestOptions
from vinesim.client.tasks.motions import DriveTo, LookAt
from vinesim.client.tasks.registry import plan_task, validate_sight, validate_task_name
from vinesim.client.tasks.start_poses import start_pose, validate_bunch
from vinesim.core import frames
from vinesim.core.errors import UsageError, writing
from vinesim.net.transport.bus import Bus
from vinesim.robot.description.controllers import only_hardware
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.push import PushBunch
from vinesim.robot.tasks.sight import RobotSight
from vinesim.robot.tasks.task import Task
from vinesim.ros.names import ros_name, ros_namespace
from vinesim.scene.model import Model
from vinesim.scene.values import SensorMode, SensorPacing
from vinesim.world import Physics


def run(options: ClientOptions) -> int:
    """Build the client from its options, step until the end, then write the requested files. Returns the exit code: 1
    if the task of ``--policy`` has failed."""
    validate_task_name(options.job)
    validate_sight(options.job, options.see)
    harvest = HarvestOptions.named(options.bunches, options.order)
    learned = None if options.policy is None else _learned_task(options)
    if learned is None:
        descriptions = [
            load_description(robot, srdf=options.srdf, xacro_args=options.xacro_args or (), base=options.base)
            for robot in options.robot or ["vinebot"]
        ]
    else:
        descriptions = [learned.description]
    _check_driven(options, descriptions)
    if options.controllers == "none":
        descriptions = [only_hardware(description) for description in descriptions]
    with ClientSession(options, None if learned is None else learned.model) as session:
        begin = start = None
        if learned is not None:
            begin, start = learned.begin, learned.start
        if options.job is not None:
            near = start_pose(session.scene, session.spawn or 0)
            begin, start = plan_task(options.job, session.model, near, harvest, _eyes(session) if options.see else None)
        for bunch in (options.push, options.watch):
            validate_bunch(session.model, bunch)
        if options.out is not None:
            with writing(options.out):
                options.out.mkdir(parents=True, exist_ok=True)
        names = [session.name]
        if len(descriptions) > 1:
            names = [f"{session.name}_{i + 1}" for i in range(len(descriptions))]
        sensors = _start_sensors(session, names, descriptions)
        if options.connect is not None:  # it may take a minute, in which another actor could take the chosen place
            for process in sensors:
                process.wait_for_ros()
        bus = session.bus(names[0])
        # a robot with a task starts where the task requires it
        places = [*range(len(names))] if start is not None else session.choose_places(bus, len(names))
        approach = 0.0 if start is not None else options.approach
        starts = [start_pose(session.scene, session.spawn or 0, approach, place) for place in places]
        goals = [start_pose(session.scene, session.spawn or 0, queue=place) for place in places]
        client = _build_client(session, bus, names, descriptions, starts if start is None else [start, *starts[1:]])
        for name, process in zip(names, sensors, strict=True):
            # a run of given length waits for its sensors, so that they record its beginning; other runs begin at once
            process.attach(client, client.robots[name], wait_for_sensors=options.seconds is not None)
        task = None if begin is None else begin(client.physics, client.robot)
        _add_behaviour(session, client, task, goals if approach > 0.0 else [])
        digest = StateDigest() if sensors[0].sensors.is_lockstep else None
        if digest is not None:
            client.post_step.append(digest)
        session.show_page(client)
        if learned is not None:
            session.wait_for_viewer()
        status = session.run(
            client,
            task=task,
            sent=sensors[0].sent_messages,
            sensors=lambda: _sensor_status(sensors),
            publish=lambda values: [one.publish_diagnostics(values) for one in sensors],
        )
        if task is not None and task.succeeded:  # a failure has been logged
            seconds = sum(task.durations.values())
            print(f"{session.name}: {options.job or options.policy} done after {seconds:.1f} s", file=sys.stderr)
        if options.out is not None:
            for process in sensors:
                process.sensors.complete_counts()
                process.close_ros()
            report = complete_report(status.report(), dict(zip(names, sensors, strict=True)))
            if task is not None:
                report["job"] = task.report()
            if digest is not None:
                report["state_digest"] = digest.hexdigest()
            save_report(options.out, report)
            sensors[0].save_picture(options.out)
            if client.trace is not None:
                with writing(options.out / "trace.npz"):
                    client.trace.rows().save(options.out / "trace.npz")
    return int(learned is not None and task is not None and bool(task.reason))


class _LearnedTask(NamedTuple):
    """What a policy needs instead of a vineyard and a robot of the user."""

    model: Model
    description: RobotDescription
    start: np.ndarray
    """[7] Pose of the robot."""
    begin: Callable[[Physics, Robot], Task]


def _learned_task(options: ClientOptions) -> _LearnedTask:
    """Load the policy of ``--policy`` and draw its task. Raises :class:`UsageError` for options that do not fit."""
    unfit = {
        "--robot": options.robot,
        "--connect": options.connect,
        "--job": options.job,
        "--push": options.push,
        "--approach": options.approach or None,
        "--pose": options.pose,
        "--controllers none": options.controllers == "none" or None,
    }
    given = next((flag for flag, value in unfit.items() if value is not None), None)
    if given is not None:
        raise UsageError(f"{given} with --policy {options.policy}: the task has its own robot and plants; leave it out")
    from vinesim.learn.arm_task import BASE
    from vinesim.learn.evaluate import DEFAULT_SEED, task_of, unseen_plants, wanted_bunches
    from vinesim.learn.pilot import PolicyTask, task_description
    from vinesim.learn.policy import load_policy

    policy = load_policy(str(options.policy))
    task = task_of(policy)
    seed = DEFAULT_SEED if options.seed is None else options.seed
    if seed < 0:
        raise UsageError(f"--seed {seed} with --policy {options.policy}: give 0 or more")
    (wanted,) = wanted_bunches(task, 1, seed)
    return _LearnedTask(
        unseen_plants(task, 0, seed),
        task_description(task),
        frames.pose(np.array(BASE)),
        functools.partial(PolicyTask, policy=policy, task=task, wanted=int(wanted)),
    )


def _eyes(session: ClientSession) -> Callable[[Physics, Robot], RobotSight]:
    """Returns a function that makes the eyes of a robot; the picture is rendered between two steps."""
    from vinesim.perception.robot_eyes import RobotEyes

    return functools.partial(RobotEyes, sun=session.scene.sun.direction(), device=session.options.device)


def _check_driven(options: ClientOptions, descriptions: list[RobotDescription]) -> None:
    """Raise :class:`UsageError` if an option drives the base of a robot on legs."""
    driving = {"--job": options.job, "--push": options.push, "--approach": options.approach or None}
    given = next((f"{flag} {value}" for flag, value in driving.items() if value is not None), None)
    standing = next((one.name for one in descriptions if one.base_limits.kind == "free"), None)
    if given is not None and standing is not None:
        raise UsageError(f"{given} drives the base, but {standing} stands on its legs; give --base planar, too")


def _start_sensors(
    session: ClientSession, names: list[str], descriptions: list[RobotDescription]
) -> list[RobotProcesses]:
    """Start the sensor processes of each robot. If there are several robots, each publishes in its own namespace."""
    options = session.options
    space = ros_namespace(options.namespace)
    processes = []
    for i, (name, description) in enumerate(zip(names, descriptions, strict=True)):
        parts = (space,) if len(names) == 1 else (space, ros_name(name))
        process = RobotProcesses(
            name,
            session.scene,
            session.model,
            description,
            namespace="/".join(filter(None, parts)),
            ros=options.ros,
            keep_pictures=options.out is not None and i == 0,
            sensor_hz=options.sensor_hz,
            params_file=options.params_file,
            clock=i == 0,
            device=options.device,
            pacing=_pacing(options, description),
            standby=options.standby,
            interest_radius=None if options.connect is None else options.interest_radius,
        )
        processes.append(session.enter(process))
    return processes


def _pacing(options: ClientOptions, description: RobotDescription) -> SensorPacing:
    """Returns the settings of sensors and simulated time: from the command line, and from the robot's file where the
    command line has none."""
    pacing = description.sensor_pacing
    if options.sensors is not None:
        pacing = dataclasses.replace(pacing, mode=SensorMode(options.sensors))
    if options.least_sensor_hz is not None:
        pacing = dataclasses.replace(pacing, least_rate=options.least_sensor_hz)
    return pacing


def complete_report(report: dict[str, Any], processes: Mapping[str, RobotProcesses]) -> dict[str, Any]:
    """Returns a client's report together with the report of the first robot's processes. If there are several robots,
    the reports of all their processes are listed by robot name too."""
    reports = {name: one.report() for name, one in processes.items()}
    complete = report | next(iter(reports.values()))
    if len(reports) > 1:
        complete["robots"] = reports
        for key in ("sensor_restarts", "ros_restarts"):
            complete[key] = sum(one[key] for one in reports.values())
    return complete


def _sensor_status(processes: list[RobotProcesses]) -> dict[str, Any]:
    """Returns the status of the processes of all robots together."""
    statuses = [one.status() for one in processes]
    awaited = [part for status in statuses for part in status["sensors_awaited"]]
    counts = {
        key: sum(status[key] for status in statuses)
        for key in (
            "frames_delivered",
            "frames_dropped",
            "messages_dropped",
            "sound_lost",
            "sensor_restarts",
            "ros_restarts",
        )
    }
    return {
        "sensors_ready": not awaited,
        "sensors_awaited": awaited,
        **counts,
        "sensor_restart_s": max(status["sensor_restart_s"] for status in statuses),
        "processes": {what: pid for status in statuses for what, pid in status["processes"].items()},
    }


def _build_client(
    session: ClientSession, bus: Bus, names: list[str], descriptions: list[RobotDescription], starts: list[np.ndarray]
) -> Client:
    """Returns a client that simulates all robots at ``starts`` [7]. ``bus``: of the first robot."""
    client = Client(
        session.scene,
        session.model,
        descriptions[0],
        bus,
        pose=starts[0],
        **session.client_options(names[0]),
    )
    for i in range(1, len(names)):
        client.add_robot(descriptions[i], names[i], starts[i], session.bus(names[i]))
    session.leave_at_end(client)
    return client


def _add_behaviour(session: ClientSession, client: Client, task: Task | None, goals: list[np.ndarray]) -> None:
    """Let the robots drive to ``goals`` [7] (none: they stay), push the bunch of ``--push``, do the ``task``, and look
    at their work."""
    options = session.options
    given = {
        "--policy": options.policy,
        "--job": options.job,
        "--push": options.push,
        "--watch": options.watch,
        "--approach": goals or None,
    }
    client.script = next((name for name, value in given.items() if value is not None), "")
    watched = options.watch if options.watch is not None else options.push
    if watched is not None:
        session.trace(client, watched)
    may_start = (lambda: client.remote_actors or client.far_actors()) if options.connect else (lambda: True)
    for robot, goal in zip(client.robots.values(), goals, strict=False):
        client.pre_step.append(DriveTo(robot, goal, may_start=may_start))
    if options.push is not None and client.trace is not None:
        side = client.side_of(client.trace.centre())
        client.pre_step.append(PushBunch(client.robot, side, client.trace.centre).control)
    if task is not None:
        client.pre_step.append(task.control)
        client.frame_score = task.frame_score
        client.pre_step.append(LookAt(client.robot, task.focus))
    elif client.trace is not None:
        client.pre_step.append(LookAt(client.robot, client.trace.centre))
