"""Resets of a real robot client by simulation_interfaces from another process: checks the world after each reset, and
that no threads, files or memory accumulate."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vinesim.bench.process_memory import ProcessHistory, ProcessSampler
from vinesim.client.programs import START_TIMEOUT, ProgramGroup
from vinesim.scene.values import Measurement

RESETS = 20
RESET_TIMEOUT = 300.0
"""Time limit of one reset, with all that happens before and after it [s]."""
GROWTH = 0.5
"""Largest accepted growth of a process by one reset [MB]. A leaked physics would be 20 MB or more."""
GRAPH = ("nodes", "publishers", "services")


def measure_resets(group: ProgramGroup, resets: int = RESETS, *options: str) -> Iterator[Measurement]:
    """Measure ``resets`` resets of a client that is started with ``options``."""
    client = group.start("client", "-m", "vinesim", "client", "--role", "robot", "--status", "json", *options)
    caller = group.start("reset caller", "-m", "vinesim.bench.reset_caller", "--resets", str(resets))
    sampler = ProcessSampler([("client", client.child.pid)])
    rows: list[dict[str, Any]] = []
    for number in range(resets):
        rows.append(json.loads(caller.next_line(START_TIMEOUT if not rows else RESET_TIMEOUT)))
        sampler.sample(float(number))
        client.new_lines()
        caller.write_line("")
    caller.wait_or_kill(START_TIMEOUT)
    client.finish()
    histories = {kind: one for (kind, _), one in sampler.histories.items() if len(one.times) == resets}
    yield from reset_rows(rows, histories)


def reset_rows(rows: Sequence[dict[str, Any]], histories: dict[str, ProcessHistory]) -> Iterator[Measurement]:
    """Yields the rows for the output of :mod:`vinesim.bench.reset_caller`, and for samples of processes after each
    reset."""
    count = len(rows)
    right = sum(row["right"] for row in rows)
    yield Measurement(
        "ros",
        "resets: world as in the beginning, goal aborted",
        right,
        f"of {count}",
        "bar, at least",
        count,
        right / count,
    )
    yield at_most_none("resets: stamps that went back", rows[-1]["stamps_back"], "messages")
    for what in GRAPH:
        more = max(row[what] for row in rows[count // 2 :]) - max(row[what] for row in rows[: max(count // 2, 1)])
        yield at_most_none(f"resets: {what} in the ROS graph, more in the second half", more, what)
    for name, key in (("answered after", "s"), ("all sensors back after", "sensors_s")):
        yield Measurement("ros", f"resets: {name}, median", float(np.median([row[key] for row in rows])), "s")
    for kind, history in histories.items():
        for what in ("threads", "handles"):
            yield at_most_none(f"resets: {what} of {kind}, more in the second half", history.change(what), what)
        growth = growth_by_reset(history)
        yield Measurement(
            "ros",
            f"resets: memory of {kind}, growth by a reset",
            growth,
            "MB",
            "bar, at most",
            GROWTH,
            GROWTH / growth if growth > 0.0 else None,
        )


def growth_by_reset(history: ProcessHistory) -> float:
    """Returns the slope of the process's own memory by least squares, over all resets but the first quarter [MB a
    reset]."""
    later = history.since(0.25 * len(history.times))
    # the history's times are numbers of resets, not seconds
    return 0.0 if len(later.times) < 2 else later.growth() / 3600.0


def at_most_none(case: str, value: float, unit: str) -> Measurement:
    """Returns a row for a count that must be 0."""
    return Measurement("ros", case, value, unit, "bar, at most", 0.0, None)
