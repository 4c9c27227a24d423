"""``python -m benchmarks link``: delay of a contact over an emulated link, with whole clients over Zenoh, in real time.

Server and clients are processes, each in a network namespace of its own. One client, the picker, pushes a bunch again
and again; the other, the visitor, watches the same bunch in its own simulation. Both record its motion by the clock of
the host.
"""

from __future__ import annotations

import pathlib
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.poor_link import poor_link
from benchmarks.support.fake_client import FakeClientProcess
from benchmarks.support.network_emulator import Link, LinkProfile, NetworkEmulator
from benchmarks.two_pullers import two_pullers
from vinesim.client.recording.bunch_trace import Rows, remote_error
from vinesim.client.tasks.start_poses import find_reachable_bunch, spawn_pose
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

LAN = "LAN, 0.2 ms one way"
LINES = {
    LAN: Link(LinkProfile(0.0002)),
    "20 +- 4 ms one way, 1 % lost": Link(LinkProfile(0.010, 0.002, 0.005)),
    "50 +- 10 ms one way, 1 % lost": Link(LinkProfile(0.025, 0.005, 0.005)),
}
"""Profiles of the link from each client to the server, by name; from client to client delay and loss are twice that."""

BUDGETS = {LAN: 45.0}
"""Largest accepted time from a touch until the bunch moves on another client, by link [ms]."""

SECONDS = 26.0
"""Running time of the clients [s], enough for about four pushes."""

START = 150.0
"""Time limit for a client to start, and to write its trace [s]."""

SEEN = 0.002
"""Displacement from which a bunch counts as visibly moved [m]."""

TOUCHES = 40
"""Number of contacts that fake clients make."""

STILL = 0.001
"""A contact counts only if the bunch moved by less than this in the 0.3 s before [m]."""

APART = 1.0
"""A contact counts as new after this time without contact [s]."""


def touches(rows: Rows) -> list[int]:
    """Returns the rows in which a force begins after a pause, on a bunch that is still."""
    pressed = np.flatnonzero(np.linalg.norm(rows.force, axis=1) > 0.0)
    if not len(pressed):
        return []
    new = np.diff(rows.clock[pressed], prepend=-np.inf) > APART
    return [row for row in pressed[new].tolist() if np.ptp(rows.displacement[max(row - 30, 0) : row], 0).max() < STILL]


def moves(rows: Rows, since: float) -> float:
    """Returns the time from ``since`` [s, clock of the host] until the bunch visibly moves [s]; infinite if it does not
    within a second."""
    first = int(np.searchsorted(rows.clock, since))
    here = slice(first, int(np.searchsorted(rows.clock, since + 1.0)))
    if first == 0 or here.stop <= first:
        return np.inf
    away = np.linalg.norm(rows.displacement[here] - rows.displacement[first - 1], axis=1)
    return float(rows.clock[first + int(np.argmax(away > SEEN))] - since) if (away > SEEN).any() else np.inf


def run_clients(line: Link) -> tuple[Rows, Rows]:
    """Run both clients over the link ``line``; return the traces of the picker and of the visitor, of the same
    bunch."""
    scene = load_scene("demo")
    bunch = str(find_reachable_bunch(generate(scene), spawn_pose(scene, 0)))
    client = [sys.executable, "-m", "vinesim", "client", "--no-ros", "--status", "none", "--sensor-hz", "0.1"]
    roles = {"picker": ["--push", bunch, "--spawn", "0"], "visitor": ["--watch", bunch, "--spawn", "1"]}
    with tempfile.TemporaryDirectory() as folder, NetworkEmulator(dict.fromkeys(roles, line)) as net:
        net.start_server("--insecure")
        processes = []
        for name, role in roles.items():
            place = ["--connect", f"tcp/{net.hub(name)}:7377", "--name", name, "--out", f"{folder}/{name}"]
            processes.append(net.start(name, [*client, *role, *place, "--seconds", str(SECONDS)]))
        end = time.monotonic() + SECONDS + START
        for process in processes:
            if process.wait(max(end - time.monotonic(), 0.0)) != 0:
                raise RuntimeError(f"a client ended with {process.returncode}")
        picker, visitor = (Rows.load(pathlib.Path(folder) / name / "trace.npz") for name in roles)
    return picker, visitor


def measure_notification(line: Link, touches: int = TOUCHES) -> list[float]:
    """Returns times from the step of a contact to the step in which another client receives it [s], with fake clients.

    Fake clients keep the pace of their steps even on a busy machine. So this time is the share of the network, and the
    wait for two steps.
    """
    with NetworkEmulator({"ada": line, "bob": line}) as net:
        net.start_server("--insecure")

        def start_process(name: str, x: float) -> FakeClientProcess:
            fake_clients = [{"name": name, "place": [x, 0.0]}]
            return FakeClientProcess(
                f"tcp/{net.hub(name)}:7377", fake_clients, start=lambda *a, **k: net.start(name, *a, **k)
            )

        with start_process("ada", 1.0) as ada, start_process("bob", 2.0) as bob:
            end = time.monotonic() + START
            while not (bob.command()["poses"] and ada.command()["poses"]) and time.monotonic() < end:
                time.sleep(0.05)
            took = []
            for number in range(touches):
                tree = str(number % 3)
                start = ada.command(touch=[int(tree)])["now"]
                while bob.command()["heard"].get(tree, -np.inf) < start and time.monotonic() < end:
                    time.sleep(0.01)
                first = bob.command()["first"].get(tree, np.inf)
                took.append(first - start)
                ada.command(touch=[])
                while bob.command()["owner"].get(tree) is not None and time.monotonic() < end:
                    time.sleep(0.01)
                time.sleep(0.037)
    return [one for one in took if 0.0 <= one < 2.0]


def link() -> Iterator[Measurement]:
    """Measure each link with fake and whole clients, and whether a poor link keeps its clients."""
    for case, line in LINES.items():
        took = 1e3 * np.array(measure_notification(line))
        for share in (50, 95):
            yield Measurement("link", f"{case}: touch to received, p{share}", float(np.percentile(took, share)), "ms")
    yield from poor_link()
    yield from two_pullers()
    for case in LINES:
        yield from line_measurements(case)


def line_measurements(case: str) -> Iterator[Measurement]:
    """Measure whole clients over one of :data:`LINES`. The time to visible motion is compared with its budget if it has
    one."""
    picker, visitor = run_clients(LINES[case])
    known = [picker.clock[row] for row in touches(picker) if visitor.is_remote.any()]
    both = [(moves(picker, start), moves(visitor, start)) for start in known]
    both = [(1e3 * here, 1e3 * there) for here, there in both if np.isfinite(here) and np.isfinite(there)]
    yield Measurement("link", f"{case}: touches of a still bunch", float(len(both)), "")
    if both:
        here, there = np.median(both, axis=0)
        seen = f"{case}: touch to 2 mm of motion as another sees it, p50"
        if (budget := BUDGETS.get(case)) is not None:
            yield Measurement("link", seen, float(there), "ms", "budget", budget, budget / float(there))
        else:
            yield Measurement("link", seen, float(there), "ms")
        yield Measurement("link", f"{case}: the same as the one who touches sees it, p50", float(here), "ms")
    if (error := remote_error(picker, visitor)) is not None:
        yield Measurement("link", f"{case}: copy of the pushed bunch, p50", error["p50"], "mm")
        yield Measurement("link", f"{case}: copy of the pushed bunch, p95", error["p95"], "mm")
