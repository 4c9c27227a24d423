"""``python -m benchmarks load``: many clients on one router, and on two linked ones; processes over Zenoh on loopback.

The clients are fake: real sessions and replicators at 60 Hz without physics, several to a process. They stand on a
plain so wide that each has as many neighbours as in a vineyard. A probe, which is two bare sessions of another process,
sends poses through the same routers and measures delay and loss. If the clients need the whole machine, the figures
describe the machine and not the router; therefore the processor shares of both are reported.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.support.fake_client import ROBOT_JOINTS as JOINTS
from benchmarks.support.fake_client import FakeClientProcess
from vinesim.core import frames
from vinesim.net.codec.human import encode_pose
from vinesim.scene.values import Measurement, RobotUpdate

COUNTS = (10, 30, 100)
PER_PROCESS = 10
PER_CORE = 15
"""Number of fake clients that one core can run at 60 Hz; with more of them, the cores would be the limit."""

SECONDS = 6.0
MEETING = 30.0
"""Time limit for all clients to meet [s]."""

APART = 8.0
"""Distance between neighbours on the plain [m]: each client receives four others at the full rate."""

PROBE = """
import json, struct, sys, threading, time
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.bus import KEEP_ALL

here, there, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
with ZenohBus("probe_a", connect=here, world="probe") as a, ZenohBus("probe_b", connect=there, world="probe") as b:
    b.subscribe("a/probe_a", KEEP_ALL)
    publisher = a.publisher("a/probe_a")
    end = time.monotonic() + 10.0
    while not publisher.matching and time.monotonic() < end:
        time.sleep(0.01)
    ages, sent = [], 0

    def listen():
        while not over.is_set():
            now = time.monotonic()
            ages.extend(now - struct.unpack_from("d", payload)[0] for _, payload in b.poll())
            time.sleep(0.0005)

    over = threading.Event()
    listener = threading.Thread(target=listen)
    listener.start()
    start = time.monotonic()
    while time.monotonic() < start + seconds:
        publisher.put(struct.pack("d", time.monotonic()) + bytes(200))
        sent += 1
        time.sleep(max(0.0, start + sent / 60.0 - time.monotonic()))
    time.sleep(1.0)
    over.set()
    listener.join()
    print(json.dumps([sent, ages]))
"""


@contextlib.contextmanager
def router(*options: str) -> Iterator[tuple[str, subprocess.Popen]]:
    """Start a server in a process of its own with these ``options``; yields its endpoint and the process."""
    command = [
        sys.executable,
        "-m",
        "vinesim",
        "server",
        "--status",
        "none",
        "--listen",
        "tcp/127.0.0.1:0",
        *options,
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        if not line.startswith("listening on "):
            raise RuntimeError(f"the server did not start: {line!r}")
        yield line.split()[2], process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def cpu(process: subprocess.Popen) -> float:
    """Returns the processor time of a process and its threads so far [s]."""
    with open(f"/proc/{process.pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(count: int, ends: list[tuple[str, subprocess.Popen]]) -> Iterator[Measurement]:
    """Measure ``count`` clients that are distributed over the routers ``ends``: endpoint and process of each."""
    side = math.ceil(math.sqrt(count))
    fake_clients = [{"name": f"p{i}", "place": [APART * (i % side), APART * (i // side)]} for i in range(count)]
    groups = [fake_clients[i : i + PER_PROCESS] for i in range(0, count, PER_PROCESS)]
    with contextlib.ExitStack() as stack:
        processes = [
            stack.enter_context(FakeClientProcess(ends[i % len(ends)][0], group, trees=1, tick=1.0 / 60.0))
            for i, group in enumerate(groups)
        ]
        start = time.monotonic()
        while any(len(process.command()["others"]) < count - 1 for process in processes):
            if time.monotonic() > start + MEETING:
                break
            time.sleep(0.2)
        met = min(len(process.command()["others"]) for process in processes) + 1
        took = time.monotonic() - start
        before = [cpu(process) for _, process in ends], [process.command() for process in processes], time.monotonic()
        arguments = [ends[0][0], ends[-1][0], str(SECONDS)]
        probe = subprocess.run([sys.executable, "-c", PROBE, *arguments], capture_output=True, text=True)
        after = [cpu(process) for _, process in ends], [process.command() for process in processes], time.monotonic()
    wall = after[2] - before[2]
    routers = sum(b - a for a, b in zip(before[0], after[0], strict=True)) / wall
    clients = sum(b["cpu"] - a["cpu"] for a, b in zip(before[1], after[1], strict=True)) / wall
    joints = np.zeros(JOINTS)
    size = len(encode_pose(RobotUpdate("", 0.0, frames.pose([0.0, 0.0, 0.0]), np.zeros(6), joints, joints)))
    spans = [(a, b, b["now"] - a["now"]) for a, b in zip(before[1], after[1], strict=True)]
    ticks = np.mean([(b["ticks"] - a["ticks"]) / seconds for a, b, seconds in spans])
    # count messages that arrived, not messages that a late tick still found: the client keeps only the newest pose
    heard = np.mean([(b["bytes_in"] - a["bytes_in"]) / size / seconds for a, b, seconds in spans])
    case = f"{count} clients, {len(ends)} router{'s' * (len(ends) > 1)}"

    def line(what: str, value: float, unit: str) -> Measurement:
        return Measurement("load", f"{case}: {what}", float(value), unit)

    yield line("clients that all others met", met, "")
    yield line("until all had met", took, "s")
    yield line("routers' CPU", routers, "cores")
    yield line("clients' CPU", clients, "cores")
    yield line("cores of the machine", len(os.sched_getaffinity(0)), "")
    yield line("rate of a client's tick, 60 wanted", float(ticks), "Hz")
    yield line("poses that reach a client", float(heard), "1/s")
    yield line("routers' CPU for a pose delivered", float(1e6 * routers / (heard * count)), "us")
    if probe.returncode != 0:
        raise RuntimeError(f"the probe failed: {probe.stderr[-300:]}")
    sent, ages = json.loads(probe.stdout)
    if ages:
        yield line("pose under way, p50", 1e3 * np.percentile(ages, 50), "ms")
        yield line("pose under way, p99", 1e3 * np.percentile(ages, 99), "ms")
    yield line("poses lost", 100.0 * (1.0 - len(ages) / sent), "%")


def load() -> Iterator[Measurement]:
    """Measure 10, 30 and 100 clients on one router, then on two linked ones, as far as the machine has cores for
    them."""
    most = PER_CORE * len(os.sched_getaffinity(0))
    yield Measurement("load", "clients that the cores of this machine can play", float(most), "")
    with router() as first:
        for count in COUNTS:
            if count <= most:
                yield from run(count, [first])
    with router() as first, router("--connect", first[0]) as second:
        for count in COUNTS:
            if count <= most:
                yield from run(count, [first, second])
