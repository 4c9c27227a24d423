"""``vinesim bench kill``: programs of a shared vineyard are killed at random moments, and all others must go on."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from vinesim.bench.killed_programs import ROBOTS, Vineyard
from vinesim.bench.live_client import own_processes
from vinesim.client.processes.child_process import START_TIMEOUT, ProcessFailed
from vinesim.scene.values import Measurement

KINDS = ("server", "router", "client", "sensors", "ROS node", "ROS listener")
"""What is killed: a program, or a worker of a robot client."""
ROS_KINDS = ("ROS node", "ROS listener")
"""These are there only where ROS 2 is."""
LONGEST_PAUSE = 1.5
"""A kill comes at a random moment within this time after a bunch was picked [s]."""
GO_ON_TIMEOUT = 180.0
"""All must go on within this time after a kill [s]; a client that is started again takes most of it."""
RESTART_BOUND = 3.0
"""The sensors of a robot are back within this time [s]."""


@dataclasses.dataclass
class Kill:
    """One kill and its effect."""

    kind: str
    victim: str
    took: float
    """Until all went on, with what was killed among them [s]."""
    missing: list[str]
    """What did not go on in time."""
    sensor_restart: float | None = None
    """From the start of a new sensor process until it was ready [s]."""


def kill(
    times: int, seed: int, announce: Callable[[str], None] = lambda _: None, *, ros: bool = True,
    kinds: Sequence[str] = KINDS,
) -> Iterator[Measurement]:  # fmt: skip
    """Kill ``times`` programs of the ``kinds`` in random order, as evenly as possible, with SIGKILL.

    Before each kill a bunch is picked. ``announce`` takes a line for each kill. :class:`ProcessFailed` if a program
    ends that was not killed.
    """
    random = np.random.default_rng(seed)
    with (
        own_processes() as group,
        tempfile.TemporaryDirectory() as folder,
        Vineyard(group, pathlib.Path(folder), ros=ros, seed=seed) as vineyard,
    ):
        possible = [kind for kind in kinds if vineyard.ros or kind not in ROS_KINDS]
        missing = _wait_until_all_go_on(vineyard, START_TIMEOUT)[1]
        if missing:
            raise ProcessFailed(f"not ready after {START_TIMEOUT:.0f} s: {', '.join(missing)}")
        order = random.permutation([possible[i % len(possible)] for i in range(times)])
        kills = []
        for number, kind in enumerate(order, 1):
            kills.append(_kill_one(vineyard, str(kind), random))
            last = kills[-1]
            effect = f"MISSING {', '.join(last.missing)}" if last.missing else f"all go on after {last.took:.1f} s"
            announce(f"{number} of {times}: {last.victim} killed; {effect}")
        picked = len(vineyard.picked)
    yield from _rows(kills, possible, picked)


def _kill_one(vineyard: Vineyard, kind: str, random: np.random.Generator) -> Kill:
    vineyard.pick()
    end = time.monotonic() + random.uniform(0.0, LONGEST_PAUSE)
    while time.monotonic() < end:
        vineyard.step()
    robot = str(random.choice(ROBOTS))
    is_worker = kind in ("sensors", "ROS node")
    name, worker = robot if is_worker or kind == "client" else kind, kind if is_worker else ""
    ended = [vineyard.workers(robot)[worker]] if is_worker else []
    if kind == "client":
        ended = list(vineyard.workers(robot).values())
    moment = vineyard.kill(name, worker)
    took, missing = _wait_until_all_go_on(vineyard, GO_ON_TIMEOUT, moment, ended)
    result = Kill(kind, f"{kind} of {robot}" if is_worker else name, took, missing)
    if kind == "sensors" and not missing:
        result.sensor_restart = vineyard.programs[robot].lines[-1][1]["sensor_restart_s"]
    return result


def _wait_until_all_go_on(
    vineyard: Vineyard, timeout: float, moment: float | None = None, ended: Sequence[int] = ()
) -> tuple[float, list[str]]:
    """How long it took since the kill at a ``moment`` [s], and what does not go on after the ``timeout`` [s].

    Processes ``ended`` must be gone, too.
    """
    moment = time.monotonic() if moment is None else moment
    while True:
        vineyard.step()
        if vineyard.witness.physics.tick % 10:
            continue
        missing = vineyard.missing(moment)
        missing += [f"end of process {pid}" for pid in ended if os.path.exists(f"/proc/{pid}")]
        took = time.monotonic() - moment
        if not missing or took > timeout:
            return took, missing


def _rows(kills: Sequence[Kill], kinds: Sequence[str], picked: int) -> Iterator[Measurement]:
    for kind in kinds:
        mine = [one for one in kills if one.kind == kind]
        if not mine:
            continue
        good = [one.took for one in mine if not one.missing]
        yield Measurement(
            "kill", f"{kind}: kills after which all went on", len(good), "1", "kills", len(mine), len(good) / len(mine)
        )
        if good:
            yield Measurement("kill", f"{kind}: until all went on, p50", statistics.median(good), "s")
            yield Measurement("kill", f"{kind}: until all went on, at most", max(good), "s")
    restarts = [one.sensor_restart for one in kills if one.sensor_restart is not None]
    if restarts:
        yield Measurement("kill", "sensors: from the new start to ready, p50", statistics.median(restarts), "s")
        worst = max(restarts)
        yield Measurement(
            "kill", "sensors: from the new start to ready, at most", worst, "s", "budget, at most", RESTART_BOUND,
            RESTART_BOUND / worst,
        )  # fmt: skip
    yield Measurement("kill", "bunches picked, and so on all clients after every kill", picked, "1")
