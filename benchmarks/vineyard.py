"""Time of sleeping plants, and of a whole step of a vineyard of ten thousand bunches with twenty awake trees and one
robot."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from vinesim.bench import scenes as scenes
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement, RobotSpec
from vinesim.world import Physics

AWAKE_TREES = 20
SLEEPING_TREES = (1_000, 10_000)
MEASURED_STEPS = 1000


def sleeping_measurements(robot: RobotSpec) -> Iterator[Measurement]:
    """Measure twenty awake canes among no, a thousand and ten thousand sleeping bunches, then the scene ``tendone``."""
    worlds = []
    for sleepers in (0, *SLEEPING_TREES):
        physics = Physics(scenes.cane_row(AWAKE_TREES + sleepers))
        physics.add_robot(scenes.gripper("hand", scenes.bunch_center(0)))
        worlds.append(scenes.keep_awake(physics, np.arange(AWAKE_TREES)))

    def steps(physics: Physics) -> None:
        for _ in range(20):
            physics.rigid.command("hand", np.array([0.0, 0.05, 0.05]))
            physics.step()

    for physics in worlds:
        steps(physics)
    alone, *among = (
        1e3 * s / 20 for s in scenes.interleaved_medians(*(lambda p=p: steps(p) for p in worlds), rounds=25)
    )
    for sleepers, value in zip(SLEEPING_TREES, among, strict=True):
        case = f"{AWAKE_TREES} canes awake, 1 hand, {sleepers} bunches asleep: whole tick"
        yield Measurement("asleep", case, value, "ms/tick", f"none asleep, {AWAKE_TREES} awake", alone, alone / value)
    del worlds
    yield from _measure_tendone(robot)


def _measure_tendone(robot: RobotSpec) -> Iterator[Measurement]:
    """Measure the median and the 99th percentile of a step of the shipped scene ``tendone`` with one ``robot``."""
    model = generate(load_scene("tendone"))
    physics = Physics(model)
    physics.add_robot(robot)
    distance = np.linalg.norm(model.tree_pose[:, :2] - robot.pose[:2], axis=1)
    scenes.keep_awake(physics, np.sort(np.argsort(distance, kind="stable")[:AWAKE_TREES]))
    seconds = np.zeros(MEASURED_STEPS)
    for i in range(-100, MEASURED_STEPS):
        start = time.perf_counter()
        physics.step()
        if i >= 0:
            seconds[i] = time.perf_counter() - start
    awake = len(physics.plants.awake)
    case = f"tendone, {len(model.bunch_body)} bunches, {awake} of {len(model.tree_first)} trees awake, 1 robot"
    yield Measurement("asleep", f"{case}: median tick", 1e3 * float(np.median(seconds)), "ms")
    yield Measurement("asleep", f"{case}: p99", 1e3 * float(np.percentile(seconds, 99)), "ms")
