"""``vinesim demo --job``: one robot does a task, and a visitor watches or a person takes part."""

from __future__ import annotations

import json
import math
import pathlib

from rich.console import Console

from vinesim.cli.demo.placement import check_device, visitor_pose
from vinesim.cli.demo.progress import PICKER, VISITOR, Statuses, show_progress
from vinesim.cli.demo.summary import job_summary, write_summary
from vinesim.client.programs import START_TIMEOUT, program_group
from vinesim.client.tasks.harvesting import HarvestOptions
from vinesim.client.tasks.planning import plan_meeting
from vinesim.client.tasks.pruning import PruningRule, prune
from vinesim.client.tasks.registry import UnknownTask, validate_sight
from vinesim.client.tasks.seen_harvest import SURVEY_TIME
from vinesim.client.tasks.start_poses import bunch_centres, start_pose
from vinesim.core.errors import writing
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.source import kept_robot_file
from vinesim.ros import middleware
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import Scene, load_scene, with_seed

JOBS = {
    "pick": ("vinebot", "picked"),
    "exchange": ("logistic", "exchanged"),
    "meet": ("logistic", "handed_over"),
    "prune": ("vinebot", "pruned"),
}
"""Default robot, and the key in ``summary.json`` that tells whether the task was done, by task."""
TIME_LIMIT = 120.0
"""Default limit of the simulated time of a task [s]."""


PRUNING_TIME = 400.0
"""Default limit of the simulated time of pruning one vine [s]."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
SEEN_PRUNING_TIME = 600.0
"""As :data:`PRUNING_TIME`, by sight: with the time for looking around and for second tries [s]."""
SETTLE_TIME = 2.0
"""Time after the time-out of a task itself [s], so that its own reason is reported."""


def run_job(
    job: str,
    *,
    harvest: HarvestOptions,
    see: bool,
    seconds: float | None,
    seed: int | None,
    scene: str | None,
    robot: str | None,
    device: str,
    real_time_factor: float | None,
    headless: bool,
    out: pathlib.Path,
) -> int:
    """Let one robot do a task, and write the results into ``out``. Returns 0 if the task was done, :data:`INTERRUPTED`
    after Ctrl-C, 5 otherwise."""
    if job not in JOBS:
        raise UnknownTask(f"no job {job!r}; give push, {', '.join(list(JOBS)[:-1])} or {list(JOBS)[-1]}")
    validate_sight(job, see)
    console = Console(stderr=True, markup=False)
    check_device(device)
    default_robot, done_key = JOBS[job]
    robot = robot or default_robot
    scene = scene or ("winter_spur" if job == "prune" else "harvest")
    plan = with_seed(load_scene(scene), seed)
    description = load_description(robot)  # raise errors before any process starts
    if job == "prune":
        model = generate(plan)
        prune(model.nodes, model.canes, PruningRule())
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        robot = kept_robot_file(robot, description, out)
    (out / "summary.json").unlink(missing_ok=True)
    with program_group() as group:
        server, endpoint = group.start_server(real_time_factor)
        console.print(f"server on {endpoint}; {robot} is to {job} (a first run compiles kernels)")
        client = ["-m", "vinesim", "client", "--connect", endpoint, "--scene", scene, "--seed", str(plan.seed)]
        client += ["--device", device, "--status", "json"]
        common = [*client, "--role", "robot", "--robot", robot]
        visitor = None
        newest = Statuses()
        if job == "meet":
            person = [*client, "--role", "human", *_person_options(plan), "--out", str(out / VISITOR)]
            visitor = group.start(VISITOR, *person, "--name", VISITOR)
        elif (place := visitor_pose(plan)) is not None:
            visitor = group.start(
                VISITOR,
                *common,
                "--name",
                VISITOR,
                *place,
                "--namespace",
                VISITOR,
                "--out",
                str(out / VISITOR),
                "--sensor-hz",
                "0.5",
            )
        if visitor is not None:
            newest[VISITOR] = json.loads(visitor.next_line(START_TIMEOUT))
        picker = group.start(
            PICKER,
            *common,
            "--name",
            PICKER,
            "--job",
            job,
            "--bunches",
            str(harvest.bunches),
            "--order",
            str(harvest.order),
            *(["--see"] if see else []),
            "--seconds",
            str(seconds or time_limit(job, harvest, see)),
            "--out",
            str(out / PICKER),
            "--sensor-hz",
            "1",
        )
        newest[PICKER] = json.loads(picker.next_line(START_TIMEOUT))
        is_stopped = False
        try:
            show_progress(picker, visitor, server, newest, console, headless)
        except KeyboardInterrupt:  # the programs end in order, and the summary tells how far the task came
            is_stopped = True
            picker.finish()
        if visitor is not None:
            visitor.finish()
    summary = job_summary(
        out,
        job,
        done_key,
        scene=scene,
        seed=plan.seed,
        robot=robot,
        no_ros=middleware.unavailable_reason(),
        with_visitor=visitor is not None,
        is_stopped=is_stopped,
    )
    write_summary(out, summary)
    done = summary[done_key]
    console.print(f"{done_key} after {summary['seconds']:.1f} s" if done else f"not {done_key}: {summary['reason']}")
    if job == "prune" and summary["detail"]["cuts_wanted"]:  # by sight only after the robot has looked around
        console.print(f"{summary['detail']['cuts_made']} of {summary['detail']['cuts_wanted']} cuts were made")
    if visitor is not None:
        sent = summary["told_visitor"]
        received = f"{VISITOR} received {sum(sent['bytes'].values())} B of it, {sent['bytes_per_s']:.0f} B/s"
        off = f"{summary['visitor']['bunches_picked']} of {summary['bunches_picked']} bunches off their vines"
        console.print(received if job == "prune" else f"{received}, and has {off}")
    console.print(f"pictures and summary.json are in {out}/")
    return INTERRUPTED if is_stopped else 0 if done else 5


def time_limit(job: str, harvest: HarvestOptions, see: bool) -> float:
    """Returns the default limit of the simulated time of a task [s]: a harvest by sight needs time to look around."""
    if job == "prune":
        return SEEN_PRUNING_TIME if see else PRUNING_TIME
    if job != "pick":
        return TIME_LIMIT
    return max(TIME_LIMIT, harvest.timeout + (SURVEY_TIME if see else 0.0)) + SETTLE_TIME


def _person_options(scene: Scene) -> list[str]:
    """Returns the options of the person in a meeting: its start, the bunch that it picks, and the box into which it
    puts the bunch."""
    model = generate(scene)
    meeting = plan_meeting(model, start_pose(scene, 0))
    bunch = bunch_centres(model)[meeting.bunch]
    x, y = meeting.stand
    yaw = math.atan2(bunch[1] - y, bunch[0] - x)
    return ["--pose", f"{x:.4f}", f"{y:.4f}", f"{yaw:.4f}", "--reach", str(meeting.bunch), "--into", str(meeting.box)]
