"""Touched plants beside MuJoCo C: the same canes, hands and bar, contacts on for both, in one process, taking turns.

And the whole tick of a vineyard, one robot or ten, twenty trees awake, ten thousand bunches: whose time it takes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Iterator

import mujoco
import numpy as np

from vinesim import frames
from vinesim.bench import scenes as scenes
from vinesim.bench.mujoco_reference import MujocoScene
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.step import Physics
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement, RobotSpec

CANE_COUNTS = (64, 256)
LIFTED_CANES = 12
HELD_CANES = (14, 20, 26, 32)
SCENE = "tendone"
ROBOT_COUNTS = (1, 10)
ROBOT_POSITION = (15.5, 17.2)
"""Of the robot in the block: its arms reach into the row behind it [m]."""
AWAKE_TREES = 20
MEASURED_STEPS, WARM_UP_STEPS = 1000, 100


def contact_measurements() -> Iterator[Measurement]:
    """Canes with their bunches, all awake: a bar lifts twelve, four hands hold a bunch each."""
    robots = [
        scenes.bar("bar", 0, LIFTED_CANES),
        *(scenes.gripper(f"hand{i}", scenes.bunch_center(i)) for i in HELD_CANES),
    ]
    for canes, ticks in zip(CANE_COUNTS, (20, 5), strict=True):
        case = f"{canes} canes and bunches, {LIFTED_CANES} lifted, {len(HELD_CANES)} held"
        yield from _compare_with_mujoco(case, "contact", scenes.cane_row(canes), robots, ticks)


def step_measurements(robot: RobotSpec, raised: np.ndarray) -> Iterator[Measurement]:
    """One hand and the vine it holds, beside the peer; then the shipped block with one ``robot`` and with ten.

    The first stands facing a row, its arms among the vines (drives at ``raised`` [joint]); the others drive in circles
    on the headland. All swing their joints.
    """
    yield from _compare_with_mujoco(
        "1 hand, 1 held vine", "tick", scenes.cane_row(1), [scenes.gripper("hand", scenes.bunch_center(0))], 100
    )
    model = generate(load_scene(SCENE))
    with _one_core():
        for count in ROBOT_COUNTS:
            yield from _measure_vineyard(model, robot, raised, count)


def _measure_vineyard(model: Model, robot: RobotSpec, raised: np.ndarray, count: int) -> Iterator[Measurement]:
    """Tick by tick, and stage by stage, each with its own clock."""
    physics = Physics(model)
    for i in range(count):
        pose = (
            frames.pose([*ROBOT_POSITION, 0.0], frames.from_yaw(0.5 * np.pi))
            if i == 0
            else frames.pose([4.0 * i, -6.0, 0.0])
        )
        home = robot.home if i else raised
        physics.add_robot(dataclasses.replace(robot, name=f"robot_{i}", index=i, pose=pose, home=home))
        physics.rigid.command_base(f"robot_{i}", (0.3, 0.0, 0.3) if i else (0.0, 0.0, 0.0))
    _swing_joints(physics, robot, raised, 0)
    physics.step()
    reached = physics.contact_solver.near_trees
    away = np.linalg.norm(model.tree_pose[:, :2] - ROBOT_POSITION, axis=1)
    away[reached] = -1.0
    scenes.keep_awake(physics, np.sort(np.argsort(away, kind="stable")[:AWAKE_TREES]))
    seconds, contacts = np.zeros((MEASURED_STEPS, len(physics.stages) + 1)), 0
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
    whose = np.array([_share_of(name) for name, _ in physics.stages])
    awake, bunches = len(physics.plants.awake), len(model.bunch_body)
    case = f"{count} robot{'s' * (count > 1)}, {awake} trees awake, {bunches} bunches, {contacts / MEASURED_STEPS:.0f} contacts"
    for share, text in (("", "tick"), ("MuJoCo", "MuJoCo's share"), ("ours", "ours"), ("rest", "the rest")):
        of = milliseconds[:, :-1][:, whose == share].sum(1) if share else milliseconds[:, -1]
        for name, percent in (("p50", 50), ("p99", 99)):
            yield Measurement("tick", f"{case}: {text}, {name}", float(np.percentile(of, percent)), "ms/tick")


def _share_of(stage: str) -> str:
    """Rigid stages call MuJoCo and do little else; plants, wind and contacts are ours; the rest hands over."""
    room = stage.split(":")[0]
    return {"rigid": "MuJoCo", "plants": "ours", "contacts": "ours", "wind": "ours"}.get(room, "rest")


def _swing_joints(physics: Physics, robot: RobotSpec, raised: np.ndarray, tick: int) -> None:
    for i, name in enumerate(physics.rigid.robots):
        wave = 0.05 * np.sin(0.05 * tick + i)
        physics.rigid.command(name, (robot.home if i else raised) + wave)


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Keep this process on one core, where the system lets it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _compare_with_mujoco(case: str, bench: str, model, robots: list[RobotSpec], ticks: int) -> Iterator[Measurement]:
    theirs = MujocoScene(model, robots)
    ours = [Physics(model)]
    if len(model.tree_first) > 1:
        ours.append(Physics(model, threads=2))
    for physics in ours:
        for robot in robots:
            physics.add_robot(robot)
        scenes.keep_awake(physics, np.arange(len(model.tree_first)))
    for world in (*ours, theirs):
        for i in range(150):  # grasp, and lift
            _command(world.rigid, robots, i)
            world.step()
    clock = [150] * (len(ours) + 1)
    met = np.zeros((len(clock), 2))

    def steps(which: int) -> None:
        world = (*ours, theirs)[which]
        for _ in range(ticks):
            _command(world.rigid, robots, clock[which])
            world.step()
            clock[which] += 1
        met[which] += 1, (world.plant_contact_count() if isinstance(world, MujocoScene) else len(world.contacts))

    seconds = scenes.interleaved_medians(*(lambda i=i: steps(i) for i in range(len(clock))))
    counts = met[:, 1] / met[:, 0]
    peer = 1e3 * seconds[-1] / ticks
    for i, threads in enumerate(("one thread", "two threads")[: len(ours)]):
        value = 1e3 * seconds[i] / ticks
        text = f"{case}; {counts[i]:.0f} contacts, peer {counts[-1]:.0f}; {threads}"
        yield Measurement(
            bench, text, value, "ms/tick", f"MuJoCo {mujoco.mj_versionString()} discrete", peer, peer / value
        )


def _command(rigid: RigidWorld, robots: list[RobotSpec], tick: int) -> None:
    """The bar, 4 cm above its start, and the hands, closed and lifted by 2 cm, go up and down by a centimetre."""
    wave = 0.01 * np.sin(0.06 * tick)
    for robot in robots:
        if len(robot.drives) == 1:
            rigid.command(robot.name, np.array([0.04 * min(1.0, tick / 100) + wave]))
        else:
            grip = 0.05 * min(1.0, tick / 60)
            rigid.command(robot.name, np.array([0.02 * min(1.0, tick / 100) + wave, grip, grip]))
