"""``python -m benchmarks picking``: picks every bunch within reach of a start place, in simulated time; success by
clearance.

Each attempt has a vineyard of its own, and the robot's base stands where the hand has most room around the bunch. An
attempt succeeds when the bunch has been cut, is in the hand and has been drawn back to the robot.

``--by truth``: planning and control use poses read from the simulation. Arm, hand, blade and canopy are tested,
perception is not. ``--by cameras``: the robot looks around from places within reach with its head camera (the
pictures are taken there without driving), finds bunches, chooses where to stand, looks again from there, picks, and
checks by the camera whether the bunch is in its hand. It knows its base and joints, its forces, and the trellis.
Whether it has picked is counted by the truth.

``--record FILE`` keeps a line of JSON for each seed, so that a long run can be continued. ``--jobs N`` runs seeds in N
processes.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.support.seed_runs import SeedRuns
from vinesim.api.picking import ROBOT, Grasp, PickAttempt, attempt_pick
from vinesim.api.sensors import look_at
from vinesim.client.tasks import planning
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.seen_harvest import GAZE_DISTANCE, Memory, gaze_points, survey_places
from vinesim.client.tasks.start_poses import bunch_centres, spawn_pose
from vinesim.client.vine_events import fruit_report
from vinesim.core import frames
from vinesim.perception.robot_eyes import RobotEyes
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickPlan
from vinesim.robot.tasks.pick_seen import PickSeenBunch
from vinesim.robot.tasks.sight import SeenBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.values import Measurement
from vinesim.world import Physics

SCENE = "demo"
REACH = 3.0
"""Bunches within this distance of the start place are tried [m]; the base may move."""
CLASSES = (-np.inf, 0.0, 0.005, 0.015, planning.FULL_CLEARANCE, np.inf)
"""Bounds of the classes of clearance [m]. Planned picks have a clearance of at least 5 mm."""
ROOMY = 0.015
"""[m] Clearance of the bunches whose share is reported apart."""
EYE = (0.123, 1.69)
"""[m] Distance of the camera ahead of the neck's axis, and its height with the lift up."""
HELD = 0.2
"""[m] Distance from the hand within which a bunch's middle is in it."""


def class_name(clearance: float) -> str:
    """Returns the name of the class that contains a clearance [m]."""
    number = int(np.searchsorted(CLASSES, clearance, side="right")) - 1
    low = 1e3 * CLASSES[number]
    high = 1e3 * CLASSES[number + 1]
    if low < 0.0:
        return "hand overlaps its neighbours"
    return f"{low:g} mm or more" if np.isinf(high) else f"{low:g} to {high:g} mm"


def picking(
    by: str, seeds: Sequence[int], record: pathlib.Path | None, jobs: int, announce: Callable[[str], None]
) -> Iterator[Measurement]:
    """Measure success over all bunches in reach, by clearance; seconds of a pick; berries; causes of failures; other
    bunches that came off. ``jobs``: number of processes."""
    work = _by_truth if by == "truth" else _by_cameras
    runs = SeedRuns(work, {"benchmark": "picking", "by": by}, _summary, announce, record)
    yield from all_measurements(runs.lines(seeds, jobs))


def _summary(line: dict[str, Any]) -> str:
    return f"{len(picked_bunches(line))} of {line['in_reach']} bunches picked in {len(line['tries'])} attempts"


def picked_bunches(line: dict[str, Any]) -> set[int]:
    """Returns the bunches within reach that at least one attempt of a vineyard has picked."""
    return {one["bunch"] for one in line["tries"] if one["picked"] and str(one["bunch"]) in line["clearance"]}


def _vineyard(seed: int) -> tuple[Model, np.ndarray, dict[str, Any]]:
    """Returns the vineyard, its start place [2] m, and the clearance of each bunch in reach (None: no base or hand
    reaches it), by its number as a text."""
    scene = with_seed(load_scene(SCENE), seed)
    model = generate(scene)
    near = spawn_pose(scene, 0)[:2]
    around = np.flatnonzero(np.linalg.norm(bunch_centres(model)[:, :2] - near, axis=1) < REACH)
    grasps = {one[0]: float(one[3]) for one in planning.freest_bases(model, near, REACH)}
    return model, near, {str(bunch): grasps.get(bunch) for bunch in around.tolist()}


def _by_truth(seed: int) -> dict[str, Any]:
    model, near, clearance = _vineyard(seed)
    tries = [attempt_pick(model, Grasp(*one)) for one in planning.freest_bases(model, near, REACH)]
    return {"in_reach": len(clearance), "clearance": clearance, "tries": [dataclasses.asdict(one) for one in tries]}


def _by_cameras(seed: int) -> dict[str, Any]:
    model, near, clearance = _vineyard(seed)
    memory, pictures = survey(model, near, seed)
    tries = []
    seen: set[int] = set()
    for number, side, base, room in memory.grasps(model, near):
        bunch = memory.bunches[number].best
        if number not in seen and np.linalg.norm(bunch.centre[:2] - near) < REACH:
            seen.add(number)
            tries.append(dataclasses.asdict(attempt_seen(model, number, bunch, side, base, room, seed)))
    return {
        "in_reach": len(clearance),
        "clearance": clearance,
        "pictures": pictures,
        "remembered": len(memory.bunches),
        "tries": tries,
    }


def survey(model: Model, near: np.ndarray, seed: int) -> tuple[Memory, int]:
    """Look around from all places of a survey. Returns what a robot remembers of it, and the number of pictures."""
    physics = Physics(model)
    robot = Robot(physics.rigid, load_description(ROBOT), "picker", pose=frames.pose([1000.0, 1000.0, 0.0]))
    eyes = RobotEyes(physics, robot, seed=seed)
    memory = Memory()
    for place in survey_places(model, near):
        for heading in (0.0, math.pi):
            for point in gaze_points(place, heading):
                eye = np.append(place + EYE[0] * (point[:2] - place) / GAZE_DISTANCE, EYE[1])
                memory.add(eyes(look_at(eye, point)))
    return memory, eyes.pictures


def attempt_seen(
    model: Model, number: int, seen: SeenBunch, side: str, base: np.ndarray, clearance: float, seed: int
) -> PickAttempt:
    """Pick one bunch that was seen, in a separate vineyard at rest. The result names the true bunch that is in the hand
    at the end, otherwise the one that hangs nearest to the sight, and -1 if there is none within 0.1 m."""
    physics = Physics(model)
    robot = Robot(physics.rigid, load_description(ROBOT), "picker", pose=base)
    robot.fit_cutters(physics)
    # dummy values: the phases that use the box and the path of the plan are not reached
    plan = PickPlan(number, side, base, 0, base[None, :2], 0.0)
    task = PickSeenBunch(physics, robot, plan, seen, RobotEyes(physics, robot, seed=seed))
    turn_head = LookAt(robot, task.focus)
    while not task.is_done and task.phase != "drive":
        task.control(physics.time)
        turn_head(physics.time)
        robot.control(physics.time)
        physics.step()
    off = np.flatnonzero(~physics.state.bunch_attached).tolist()
    held = [one for one in off if _is_held(physics, one, task.arm.tip_position)]
    away = np.linalg.norm((bunch_centres(model) - seen.centre)[:, :2], axis=1)
    nearest = int(np.argmin(away)) if away.min() < 0.1 else -1
    picked = not task.is_done and len(held) > 0
    reason = task.reason or ("" if picked else "drive: the robot believes that it holds a bunch")
    fruit = fruit_report(physics)
    return PickAttempt(
        held[0] if held else nearest,
        clearance,
        picked,
        reason,
        len(off) - len(held),
        physics.time,
        fruit["berries_burst"],
        fruit["berries_lost"],
        physics.fruit_monitor.history(held[0]).damage if picked else None,
    )


def _is_held(physics: Physics, bunch: int, tip: np.ndarray) -> bool:
    half = frames.pose([0.5 * float(physics.model.bunch_length[bunch]), 0.0, 0.0])
    middle = frames.compose(physics.rigid.bunch_pose(bunch), half)[:3]
    return bool(np.linalg.norm(middle - tip) < HELD)


def all_measurements(lines: list[dict[str, Any]]) -> Iterator[Measurement]:
    """Yields the results of one or several vineyards."""
    by = lines[0]["by"]
    case = f"{SCENE}, bunches within {REACH:g} m of start place 0, by {by}"
    total = sum(line["in_reach"] for line in lines)
    picked = sum(len(picked_bunches(line)) for line in lines)
    yield Measurement("picking", f"{case}, vineyards", float(len(lines)), "1")
    yield Measurement("picking", f"{case}", float(total), "bunches")
    yield Measurement("picking", f"{case}: picked", 100.0 * picked / max(total, 1), "%")
    roomy = [
        (line, int(bunch))
        for line in lines
        for bunch, room in line["clearance"].items()
        if room is not None and room >= ROOMY
    ]
    share = 100.0 * sum(bunch in picked_bunches(line) for line, bunch in roomy) / max(len(roomy), 1)
    yield Measurement("picking", f"{case}: picked of {len(roomy)} with {1e3 * ROOMY:g} mm of room", share, "%")
    groups: dict[str, list[bool]] = collections.defaultdict(list)
    for line in lines:
        for bunch, room in line["clearance"].items():
            name = "no hand or base reaches it" if room is None else class_name(room)
            groups[name].append(int(bunch) in picked_bunches(line))
    for name, group in sorted(groups.items()):
        yield Measurement("picking", f"true clearance: {name} ({len(group)})", 100.0 * float(np.mean(group)), "%")
    tries = [PickAttempt(**one) for line in lines for one in line["tries"]]
    yield from success_measurements(tries)
    if by == "cameras":
        known = sum(len({one["bunch"] for one in line["tries"]} & {*map(int, line["clearance"])}) for line in lines)
        yield Measurement("picking", "bunches that the survey found and a hand reaches", 100.0 * known / total, "%")
        false = sum(one.bunch < 0 for one in tries)
        yield Measurement("picking", "attempts where no bunch hangs", float(false), "1")
        yield Measurement("picking", "pictures of a survey", float(np.mean([line["pictures"] for line in lines])), "1")


def success_measurements(tries: list[PickAttempt]) -> Iterator[Measurement]:
    """Yields the success of all attempts, of each class and of the attempt with most clearance; seconds; causes of
    failures; and the number of other bunches that came off."""
    by_class = collections.defaultdict(list)
    for one in sorted(tries, key=lambda one: one.clearance):
        by_class[class_name(one.clearance)].append(one)
    groups = {"all in reach": tries} | {f"clearance: {name}": group for name, group in by_class.items()}
    for name, group in groups.items():
        share = 100.0 * sum(one.picked for one in group) / max(len(group), 1)
        yield Measurement("picking", f"{name} ({len(group)} tried)", share, "%")
    freest = [one for one in tries if one.clearance >= planning.MIN_HAND_CLEARANCE][:1]
    yield Measurement("picking", "the one a job would take", 100.0 * sum(one.picked for one in freest), "%")
    if seconds := [one.seconds for one in tries if one.picked]:
        yield Measurement("picking", "until the bunch is drawn back, median", float(np.median(seconds)), "s")
    count = max(len(tries), 1)
    lost = sum(one.berries_lost for one in tries)
    burst = sum(one.berries_burst for one in tries)
    yield Measurement("picking", "berries that fell off, of any bunch", lost / count, "berries/attempt")
    yield Measurement("picking", "berries that burst, of any bunch", burst / count, "berries/attempt")
    if damage := [100.0 * one.damage for one in tries if one.damage is not None]:
        yield Measurement("picking", "damaged berries of a picked bunch, mean", float(np.mean(damage)), "%")
        yield Measurement("picking", "damaged berries of a picked bunch, largest", max(damage), "%")
    for phase, count in collections.Counter(one.reason.split(":")[0] for one in tries if one.reason).most_common():
        yield Measurement("picking", f"failed in phase {phase}", float(count), "bunches")
    yield Measurement("picking", "other bunches that came off", float(sum(one.others for one in tries)), "bunches")
