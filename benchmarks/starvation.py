"""``python -m benchmarks starvation``: clients that get no processor time for a while; whether all are served again.

Two people with physics and a server are programs. In turns one of the clients, or the server, is stopped (SIGSTOP),
busy loops take the processor from all, or the server is killed and another one is started at once.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.support.small_world import SmallWorld
from vinesim.bench.live_client import own_processes
from vinesim.scene.values import Measurement

LONGEST = 6.0
"""Longest starvation [s]: three times the lease of Zenoh's links."""
LOOPS_PER_CORE = 8
"""Number of busy loops for each core."""
BOUND = 15.0
"""Largest accepted time from the end of a starvation until all are served [s]."""
PATIENCE = 120.0
"""Time after which a round counts as failed [s]."""
KINDS = ("a client is stopped", "the server is stopped", "busy loops", "the server is killed")


def starvation(times: int, seed: int, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Starve ``times`` times, and measure. ``announce`` is called with a line of text after each time."""
    random = np.random.default_rng(seed)
    took: dict[str, list[float]] = {kind: [] for kind in KINDS}
    with own_processes() as group:
        world = SmallWorld(group, 2)
        world.wait_until_ready()
        for number in range(times):
            kind = KINDS[number % len(KINDS)]
            duration = float(random.uniform(0.5, LONGEST))
            names = list(world.clients)
            if kind == KINDS[0]:
                _stop(world, world.clients[names[int(random.integers(len(names)))]].child.pid, duration)
            elif kind == KINDS[1]:
                _stop(world, world.server.child.pid, duration)
            elif kind == KINDS[2]:
                _run_loops(world, duration)
            end = time.monotonic()
            if kind == KINDS[3]:
                duration = 0.0
                world.kill_server()
            world.wait_until_served(time.monotonic(), len(names) - 1, PATIENCE)
            after = time.monotonic() - end
            took[kind].append(after)
            what = kind + (f" for {duration:.1f} s" if duration else "")
            announce(f"{number + 1} of {times}, {what}: all are served after {after:.1f} s")
    for kind, found in took.items():
        if not found:
            continue
        good = sum(one <= BOUND for one in found)
        yield Measurement(
            "starvation", f"{kind}: all served within {BOUND:g} s", good, "1", "times", len(found), good / len(found)
        )
        yield Measurement("starvation", f"{kind}: until all are served, mean", float(np.mean(found)), "s")
        worst = max(found)
        case = f"{kind}: until all are served, at most"
        yield Measurement("starvation", case, worst, "s", "budget, at most", BOUND, BOUND / worst)


def _stop(world: SmallWorld, pid: int, duration: float) -> None:
    """Stop a process for a ``duration`` [s], and let it go on."""
    os.kill(pid, signal.SIGSTOP)
    try:
        _pass(world, duration)
    finally:
        os.kill(pid, signal.SIGCONT)


def _run_loops(world: SmallWorld, duration: float) -> None:
    """Let busy loops run for a ``duration`` [s]."""
    count = LOOPS_PER_CORE * len(os.sched_getaffinity(0))
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        _pass(world, duration)
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def _pass(world: SmallWorld, duration: float) -> None:
    end = time.monotonic() + duration
    while time.monotonic() < end:
        world.read()
        time.sleep(0.05)
