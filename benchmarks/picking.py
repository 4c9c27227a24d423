"""``python -m benchmarks picking``: picks every bunch within reach of a start place, in simulated time; success by
clearance.

Each attempt has a vineyard of its own, and the robot's base stands where the hand has most room around the bunch. An
attempt succeeds when the bunch has been cut, is in the hand and has been drawn back to the robot. Planning and control
use poses read from the simulation: arm, hand, blade and canopy are tested, perception is not. Robot tasks and the demo
pick the bunch with the most clearance.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator

import numpy as np

from vinesim.api.picking import Grasp, PickAttempt, attempt_pick
from vinesim.client.tasks import planning
from vinesim.client.tasks.start_poses import bunch_centres, spawn_pose
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

SCENE = "demo"
REACH = 3.0
"""Bunches within this distance of the start place are tried [m]; the base may move."""
CLASSES = (-np.inf, 0.0, 0.005, 0.015, planning.FULL_CLEARANCE, np.inf)
"""Bounds of the classes of clearance [m]. Planned picks have a clearance of at least 5 mm."""


def class_name(clearance: float) -> str:
    """Returns the name of the class that contains a clearance [m]."""
    number = int(np.searchsorted(CLASSES, clearance, side="right")) - 1
    low = 1e3 * CLASSES[number]
    high = 1e3 * CLASSES[number + 1]
    if low < 0.0:
        return "hand overlaps its neighbours"
    return f"{low:g} mm or more" if np.isinf(high) else f"{low:g} to {high:g} mm"


def picking() -> Iterator[Measurement]:
    """Measure success over all bunches in reach, by clearance, and for the bunch with most clearance; and count the
    bunches that cannot be tried."""
    scene = load_scene(SCENE)
    model = generate(scene)
    near = spawn_pose(scene, 0)[:2]
    around = int((np.linalg.norm(bunch_centres(model)[:, :2] - near, axis=1) < REACH).sum())
    tries = [attempt_pick(model, Grasp(*one)) for one in planning.freest_bases(model, near, REACH)]
    case = f"{SCENE}, bunches within {REACH:g} m of start place 0"
    yield Measurement("picking", case, float(around), "bunches")
    yield Measurement("picking", f"{case}, that a base can stand before and a hand fits", float(len(tries)), "bunches")
    yield from success_measurements(tries)


def success_measurements(tries: list[PickAttempt]) -> Iterator[Measurement]:
    """Yields the success of all attempts, of each class and of the attempt with most clearance; causes of failures; and
    the number of other bunches that came off."""
    by_class = collections.defaultdict(list)
    for one in sorted(tries, key=lambda one: one.clearance):
        by_class[class_name(one.clearance)].append(one)
    groups = {"all in reach": tries} | {f"clearance: {name}": group for name, group in by_class.items()}
    for name, group in groups.items():
        share = 100.0 * sum(one.picked for one in group) / max(len(group), 1)
        yield Measurement("picking", f"{name} ({len(group)} tried)", share, "%")
    freest = [one for one in tries if one.clearance >= planning.MIN_HAND_CLEARANCE][:1]
    yield Measurement("picking", "the one a job would take", 100.0 * sum(one.picked for one in freest), "%")
    for phase, count in collections.Counter(one.reason.split(":")[0] for one in tries if one.reason).most_common():
        yield Measurement("picking", f"failed in phase {phase}", float(count), "bunches")
    yield Measurement("picking", "other bunches that came off", float(sum(one.others for one in tries)), "bunches")
