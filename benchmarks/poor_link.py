"""A slow link that loses packets must not count as a dead one: how often clients lose each other, and for how long
states fail to arrive.

Two clients without physics are each joined to the server by an emulated link of 50 +- 20 ms that loses 2 % of the
packets in either direction; from client to client delay and loss are twice that. One client touches a tree, the other
receives the tree's states.
"""

from __future__ import annotations

import pathlib
import tempfile
import time
from collections.abc import Iterator

from benchmarks.support.fake_client import FakeClientProcess
from benchmarks.support.network_emulator import Link, LinkProfile, NetworkEmulator
from vinesim.net.transport.access_control import Role
from vinesim.net.transport.certificates import create
from vinesim.scene.values import Measurement

POOR = Link(LinkProfile(0.05, 0.02, 0.02))
"""Emulated link between each client and the server, equal in both directions."""

PROTOCOLS = ("tcp", "udp", "tls", "quic")
"""Transports that are measured. ``udp`` and ``quic`` carry poses and states as datagrams; everything else goes over
``tcp`` and ``tls``, respectively."""

SECONDS = 60.0
"""Time for which the clients stay [s]."""

START = 120.0
"""Time limit for the clients to meet [s]."""

POLL_PERIOD = 0.1
"""Time between two queries of both clients [s]."""


def poor_link(protocols: tuple[str, ...] = PROTOCOLS, seconds: float = SECONDS) -> Iterator[Measurement]:
    """Measure each protocol for ``seconds`` [s]. Raises RuntimeError if the clients do not meet."""
    for protocol in protocols:
        lost, left, gap = run_poor_link(protocol, seconds)
        case = f"50 +- 20 ms to the server, 2 % lost each way, {protocol}, {seconds:.0f} s"
        yield Measurement("link", f"{case}: looks that found the server lost", float(lost), "")
        yield Measurement("link", f"{case}: times a client left", float(left), "")
        yield Measurement("link", f"{case}: longest time without a state of a touched tree", 1e3 * gap, "ms")


def run_poor_link(protocol: str, seconds: float) -> tuple[int, int, float]:
    """Returns the number of polls that found a client without its server, the number of times that a client considered
    the other one gone, and the longest time without a state of the tree [s]."""
    secured = protocol in ("tls", "quic")
    with tempfile.TemporaryDirectory() as folder, NetworkEmulator({"ada": POOR, "bob": POOR}) as net:
        certificates = pathlib.Path(folder) / "certs"
        if secured:
            create(certificates, "server", Role.SERVER, [net.hub("ada"), net.hub("bob")])
            for name in ("ada", "bob"):
                create(certificates, name)
        options = ["--tls", str(certificates)] if secured else ["--insecure"]
        net.start_server(*options)

        def start_process(name: str, x: float) -> FakeClientProcess:
            return FakeClientProcess(
                f"{protocol}/{net.hub(name)}:7377",
                [{"name": name, "place": [x, 0.0]}],
                start=lambda *a, **k: net.start(name, *a, **k),
                certificates=str(certificates) if secured else "",
            )

        with start_process("ada", 1.0) as ada, start_process("bob", 2.0) as bob:
            return _watch(ada, bob, seconds)


def _watch(ada: FakeClientProcess, bob: FakeClientProcess, seconds: float) -> tuple[int, int, float]:
    end = time.monotonic() + START
    while not (bob.command()["poses"] and ada.command()["poses"]):
        if time.monotonic() > end:
            raise RuntimeError(f"the clients do not meet within {START:.0f} s")
        time.sleep(POLL_PERIOD)
    ada.command(touch=[0])
    while "0" not in bob.command()["heard"] and time.monotonic() < end:
        time.sleep(POLL_PERIOD)
    lost = 0
    gap = 0.0
    reports = [ada.command(), bob.command()]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        reports = [ada.command(), bob.command()]
        lost += sum(bool(report["trouble"]) for report in reports)
        gap = max(gap, reports[1]["now"] - reports[1]["heard"].get("0", -START))
        time.sleep(POLL_PERIOD)
    return lost, sum(len(report["left_at"]) for report in reports), gap
