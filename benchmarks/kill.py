"""``python -m benchmarks kill``: kills programs of a shared vineyard at random moments, and checks that all others go
on.

Kills come in rounds. In each round one program of every kind is killed, at random moments in random order, whether or
not the others have recovered from the kill before. After the round, all programs must work, the killed ones included.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.support.killed_programs import ROBOTS, Vineyard
from vinesim.bench.live_client import own_processes
from vinesim.client.programs import START_TIMEOUT, ProgramFailed
from vinesim.scene.values import Measurement

KINDS = ("server", "router", "client", "sensors", "ROS node", "ROS listener")
"""Kinds of programs that are killed, and of worker processes of a robot client."""
ROS_KINDS = ("ROS node", "ROS listener")
"""Kinds that exist only where ROS 2 is installed."""
WORKERS = ("sensors", "ROS node")
"""Kinds that are worker processes of a robot client."""
MEAN_PAUSE = 0.75
"""Kills of a round come at random moments within this time for each kill [s]."""
GO_ON_TIMEOUT = 180.0
"""All programs must work within this time after a round [s]; a client that is restarted takes most of it."""
RESTART_BOUND = 3.0
"""Largest accepted time until the sensors of a robot work again [s]."""


@dataclasses.dataclass
class Round:
    """The kills of one round, and what followed."""

    kinds: tuple[str, ...]
    """Kinds of the killed programs, in the order of the kills."""
    took: float
    """Time from the last kill until all programs worked, the killed ones included [s]."""
    missing: list[str]
    """One text for each program or function that did not work again in time, such as "ada: steps"."""
    sensor_restart: float | None = None
    """Time from the start of a new sensor process until it was ready [s]."""


def kill(
    times: int,
    seed: int,
    announce: Callable[[str], None] = lambda _: None,
    *,
    ros: bool = True,
    kinds: Sequence[str] = KINDS,
) -> Iterator[Measurement]:
    """Kill about ``times`` programs with SIGKILL, equally many of each of the ``kinds``, and yield the measurements.

    Before each round a bunch is picked. ``announce`` is called with a line of text after each round. ``ros``: kill
    programs of ROS, too. Raises :class:`ProgramFailed` if a program ends that was not killed.
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
            raise ProgramFailed(f"not ready after {START_TIMEOUT:.0f} s: {', '.join(missing)}")
        rounds: list[Round] = []
        count = -(-times // len(possible))
        for number in range(1, count + 1):
            rounds.append(last := _run_round(vineyard, possible, random))
            effect = f"MISSING {', '.join(last.missing)}" if last.missing else f"all go on after {last.took:.1f} s"
            announce(f"round {number} of {count}: {', '.join(last.kinds)} killed; {effect}")
        picked = len(vineyard.picked)
    yield from _rows(rounds, possible, picked)


def _run_round(vineyard: Vineyard, kinds: Sequence[str], random: np.random.Generator) -> Round:
    """Kill one program of each kind, in random order. A killed worker belongs to the robot whose client is not
    killed."""
    vineyard.pick()
    killed, other = (str(name) for name in random.permutation(ROBOTS))
    order = [str(kind) for kind in random.permutation(list(kinds))]
    start = time.monotonic()
    moments = np.sort(random.uniform(0.0, MEAN_PAUSE * len(kinds), len(kinds)))
    ended: list[int] = []
    restarts = vineyard.sensor_restarts(other)
    moment = start
    for kind, after in zip(order, moments, strict=True):
        while time.monotonic() < start + after:
            vineyard.step()
        if kind in WORKERS:
            ended.append(vineyard.workers(other)[kind])
            moment = vineyard.kill(other, kind)
        else:
            if kind == "client":
                ended += vineyard.workers(killed).values()
            moment = vineyard.kill(killed if kind == "client" else kind)
    took, missing = _wait_until_all_go_on(vineyard, GO_ON_TIMEOUT, moment, ended)
    result = Round(tuple(order), took, missing)
    if "sensors" in kinds and not missing:
        assert vineyard.sensor_restarts(other) > restarts
        result.sensor_restart = vineyard.programs[other].lines[-1][1]["sensor_restart_s"]
    return result


def _wait_until_all_go_on(
    vineyard: Vineyard, timeout: float, moment: float | None = None, ended: Sequence[int] = ()
) -> tuple[float, list[str]]:
    """Wait until all programs work after a kill at a ``moment`` [s]. Returns the time since the kill [s], and what does
    not work after the ``timeout`` [s].

    Processes with the ids ``ended`` must be gone, too.
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


def _rows(rounds: Sequence[Round], kinds: Sequence[str], picked: int) -> Iterator[Measurement]:
    good = [one.took for one in rounds if not one.missing]
    for kind in kinds:
        yield Measurement(
            "kill",
            f"{kind}: kills after which all went on",
            len(good),
            "1",
            "kills",
            len(rounds),
            len(good) / len(rounds),
        )
    if good:
        yield Measurement("kill", "from the last kill of a round until all went on, p50", statistics.median(good), "s")
        yield Measurement("kill", "from the last kill of a round until all went on, at most", max(good), "s")
    restarts = [one.sensor_restart for one in rounds if one.sensor_restart is not None]
    if restarts:
        yield Measurement("kill", "sensors: from the new start to ready, p50", statistics.median(restarts), "s")
        worst = max(restarts)
        yield Measurement(
            "kill",
            "sensors: from the new start to ready, at most",
            worst,
            "s",
            "budget, at most",
            RESTART_BOUND,
            RESTART_BOUND / worst,
        )
    yield Measurement("kill", "bunches picked, and so on all clients after every round", picked, "1")
