"""Touched plants beside MuJoCo C: the same canes, hands and bar, contacts on for both, in one process, taking turns."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from vinesim.physics import bench_scenes as scenes
from vinesim.physics.oracle import Whole
from vinesim.physics.rigid import Rigid
from vinesim.physics.step import Physics
from vinesim.world.values import Measurement, RobotSpec

CANES = (64, 256)
LIFTED = 12
HELD = (14, 20, 26, 32)


def contact() -> Iterator[Measurement]:
    """Canes with their bunches, all awake: a bar lifts twelve, four hands hold a bunch each."""
    robots = [scenes.bar("bar", 0, LIFTED), *(scenes.hand(f"hand{i}", scenes.bunch_at(i)) for i in HELD)]
    for canes, ticks in zip(CANES, (20, 5), strict=True):
        case = f"{canes} canes and bunches, {LIFTED} lifted, {len(HELD)} held"
        yield from _beside(case, "contact", scenes.row(canes), robots, ticks)


def tick() -> Iterator[Measurement]:
    """One robot and the vine it holds: the whole tick."""
    yield from _beside("1 robot, 1 held vine", "tick", scenes.row(1), [scenes.hand("hand", scenes.bunch_at(0))], 100)


def _beside(case: str, bench: str, model, robots: list[RobotSpec], ticks: int) -> Iterator[Measurement]:
    theirs = Whole(model, robots)
    ours = [Physics(model)]
    if len(model.tree_first) > 1:
        ours.append(Physics(model, threads=2))
    for physics in ours:
        for robot in robots:
            physics.add_robot(robot)
        scenes.sleepless(physics, np.arange(len(model.tree_first)))
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
        met[which] += 1, (world.touching() if isinstance(world, Whole) else len(world.contacts))

    seconds = scenes.interleaved(*(lambda i=i: steps(i) for i in range(len(clock))))
    counts = met[:, 1] / met[:, 0]
    peer = 1e3 * seconds[-1] / ticks
    for i, threads in enumerate(("one thread", "two threads")[: len(ours)]):
        value = 1e3 * seconds[i] / ticks
        text = f"{case}; {counts[i]:.0f} contacts, peer {counts[-1]:.0f}; {threads}"
        yield Measurement(
            bench, text, value, "ms/tick", f"MuJoCo {mujoco.mj_versionString()} discrete", peer, peer / value
        )


def _command(rigid: Rigid, robots: list[RobotSpec], tick: int) -> None:
    """The bar, 4 cm above its start, and the hands, closed and lifted by 2 cm, go up and down by a centimetre."""
    wave = 0.01 * np.sin(0.06 * tick)
    for robot in robots:
        if len(robot.drives) == 1:
            rigid.command(robot.name, np.array([0.04 * min(1.0, tick / 100) + wave]))
        else:
            grip = 0.05 * min(1.0, tick / 60)
            rigid.command(robot.name, np.array([0.02 * min(1.0, tick / 100) + wave, grip, grip]))
