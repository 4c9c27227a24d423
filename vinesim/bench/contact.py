"""Time of contacts, compared with MuJoCo. Both simulate equal canes, grippers and a bar, in one process, in turns.

The module also measures whole steps of a vineyard with ten thousand bunches and twenty awake trees, by stages, with one
robot and with ten.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Iterator

import mujoco
import numpy as np

from vinesim.bench import scenes as scenes
from vinesim.bench.mujoco_reference import MujocoScene
from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement, RobotSpec
from vinesim.world import Physics

CANE_COUNTS = (64, 256)
STEPS_PER_ROUND = (20, 5)
"""Number of steps that a simulator makes before the other one continues, for each number of canes. They take MuJoCo
about 50 ms, because each turn begins with cold caches."""
LIFTED_CANES = 12
HELD_CANES = (14, 20, 26, 32)
"""Indices of the canes whose bunch a gripper holds."""
COMBS = ((2, 10, 50), (4, 32, 12), (8, 64, 5))
"""Cases with two combs: number of bars, number of canes between the bars, and number of steps that a simulator makes
before the other one continues. All contacts form one island; their number is bars times canes."""
SETTLE_STEPS = 150
"""Number of steps before the measurement, in which the grippers close, and bar and grippers lift."""
SCENE = "tendone"
ROBOT_COUNTS = (1, 10)
ROBOT_POSITION = (15.5, 17.2)
"""Position x, y of the first robot in the block [m]: its arms reach into the row behind it."""
AWAKE_TREES = 20
MEASURED_STEPS = 1000
WARM_UP_STEPS = 100


def contact_measurements() -> Iterator[Measurement]:
    """Measure steps of awake canes with bunches: a bar lifts twelve canes, and four grippers hold one bunch each. Then
    measure steps of canes between two combs."""
    robots = [
        scenes.bar("bar", 0, LIFTED_CANES),
        *(scenes.gripper(f"hand{i}", scenes.bunch_center(i)) for i in HELD_CANES),
    ]
    for canes, steps in zip(CANE_COUNTS, STEPS_PER_ROUND, strict=True):
        case = f"{canes} canes and bunches, {LIFTED_CANES} lifted, {len(HELD_CANES)} held"
        yield from _compare_with_mujoco(case, "contact", scenes.cane_row(canes), robots, steps)
    for bars, canes, steps in COMBS:
        case = f"{canes} canes and bunches between {bars} bars of two combs"
        yield from _compare_with_mujoco(
            case, "contact", scenes.cane_row(canes), [scenes.combs("combs", bars, canes)], steps
        )


def step_measurements(robot: RobotSpec, raised: np.ndarray) -> Iterator[Measurement]:
    """Measure steps of one gripper and the vine that it holds, compared with MuJoCo; then whole steps of a shipped
    vineyard with one ``robot`` and with ten.

    The first robot faces a row, with its arms among the vines (positions ``raised`` [joint] of the drives). All other
    robots drive in circles on the headland. All robots swing their joints.
    """
    yield from _compare_with_mujoco(
        "1 hand, 1 held vine", "tick", scenes.cane_row(1), [scenes.gripper("hand", scenes.bunch_center(0))], 100
    )
    model = generate(load_scene(SCENE))
    with _one_core():
        for count in ROBOT_COUNTS:
            yield from _measure_vineyard(model, robot, raised, count)


def _measure_vineyard(model: Model, robot: RobotSpec, raised: np.ndarray, count: int) -> Iterator[Measurement]:
    """Yields the times of whole steps with ``count`` robots, and the times of their stages, summed for MuJoCo, for
    vinesim's own code and for the rest."""
    physics = Physics(model)
    for i in range(count):
        position = [4.0 * i, -6.0, 0.0] if i else [*ROBOT_POSITION, 0.0]
        pose = frames.pose(np.array(position), frames.from_yaw(0.0 if i else 0.5 * np.pi))
        home = robot.home if i else raised
        physics.add_robot(dataclasses.replace(robot, name=f"robot_{i}", index=i, pose=pose, home=home))
        physics.rigid.command_base(f"robot_{i}", (0.3, 0.0, 0.3) if i else (0.0, 0.0, 0.0))
    _swing_joints(physics, robot, raised, 0)
    physics.step()
    reached = physics.contact_solver.near_trees
    away = np.linalg.norm(model.tree_pose[:, :2] - ROBOT_POSITION, axis=1)
    away[reached] = -1.0
    scenes.keep_awake(physics, np.sort(np.argsort(away, kind="stable")[:AWAKE_TREES]))
    seconds = np.zeros((MEASURED_STEPS, len(physics.stages) + 1))
    contacts = 0
    for i in range(-WARM_UP_STEPS, MEASURED_STEPS):
        _swing_joints(physics, robot, raised, i + WARM_UP_STEPS)
        marks = [time.perf_counter()]
        for _, stage in physics.stages:
            stage()
            marks.append(time.perf_counter())
        physics.tick += 1
        if i >= 0:
            seconds[i, :-1], seconds[i, -1] = np.diff(marks), marks[-1] - marks[0]
            contacts += len(physics.contacts)
    milliseconds = 1e3 * seconds
    owner = np.array([_stage_owner(name) for name, _ in physics.stages])
    awake = len(physics.plants.awake)
    bunches = len(model.bunch_body)
    robots = f"{count} robot{'s' * (count > 1)}"
    case = f"{robots}, {awake} trees awake, {bunches} bunches, {contacts / MEASURED_STEPS:.0f} contacts"
    for share, text in (("", "tick"), ("MuJoCo", "MuJoCo's share"), ("ours", "ours"), ("rest", "the rest")):
        of = milliseconds[:, :-1][:, owner == share].sum(1) if share else milliseconds[:, -1]
        for name, percent in (("p50", 50), ("p99", 99)):
            yield Measurement("tick", f"{case}: {text}, {name}", float(np.percentile(of, percent)), "ms/tick")


def _stage_owner(stage: str) -> str:
    """Returns ``MuJoCo`` for stages that mainly call MuJoCo, ``ours`` for plants, wind and contacts, ``rest`` for
    others."""
    part = stage.split(":")[0]
    return {"rigid": "MuJoCo", "plants": "ours", "contacts": "ours", "wind": "ours"}.get(part, "rest")


def _swing_joints(physics: Physics, robot: RobotSpec, raised: np.ndarray, tick: int) -> None:
    """Command all joints of all robots to swing by 0.05 rad."""
    for i, name in enumerate(physics.rigid.robots):
        wave = 0.05 * np.sin(0.05 * tick + i)
        physics.rigid.command(name, (robot.home if i else raised) + wave)


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Keep this process on one core while the context lasts, where the system permits it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _compare_with_mujoco(
    case: str, bench: str, model: Model, robots: list[RobotSpec], steps: int
) -> Iterator[Measurement]:
    """Step a scene in vinesim and in MuJoCo, in turns of ``steps`` steps, and compare processor times.

    Contacts are counted after all turns: counting takes longer than a step.
    """
    reference = MujocoScene(model, robots)
    physics = Physics(model)
    for robot in robots:
        physics.add_robot(robot)
    scenes.keep_awake(physics, np.arange(len(model.tree_first)))
    worlds = (physics, reference)
    for world in worlds:
        for i in range(SETTLE_STEPS):
            _command(world.rigid, robots, i)
            world.step()
    tick = [SETTLE_STEPS] * 2

    def run(which: int) -> None:
        world = worlds[which]
        for _ in range(steps):
            _command(world.rigid, robots, tick[which])
            world.step()
            tick[which] += 1

    times = scenes.interleaved_times(lambda: run(0), lambda: run(1))
    value, peer = (1e3 / steps * times[1]).tolist()
    count = f"{_pressing(physics)} contacts, peer {reference.plant_contact_count()}"
    name = f"MuJoCo {mujoco.mj_versionString()} discrete"
    yield Measurement(bench, f"{case}; {count}; one thread, processor time", value, "ms/tick", name, peer, peer / value)


def _pressing(physics: Physics) -> int:
    """Returns the number of contacts with plants whose force is not zero."""
    solver = physics.contact_solver
    return int(np.count_nonzero(solver.impulses.rows.impulse[: 3 * solver.count : 3]))


def _command(rigid: RigidWorld, robots: list[RobotSpec], tick: int) -> None:
    """Move the bar 4 cm up, the closed grippers 2 cm, and the combs 5 mm together, then all up and down."""
    wave = 0.01 * np.sin(0.06 * tick)
    for robot in robots:
        if robot.drives[-1].joint == "sink":
            rigid.command(robot.name, np.full(2, 0.005 * min(1.0, tick / 100)) + 0.1 * wave)
        elif len(robot.drives) == 1:
            rigid.command(robot.name, np.array([0.04 * min(1.0, tick / 100) + wave]))
        else:
            grip = 0.05 * min(1.0, tick / 60)
            rigid.command(robot.name, np.array([0.02 * min(1.0, tick / 100) + wave, grip, grip]))
