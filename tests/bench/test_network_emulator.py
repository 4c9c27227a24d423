"""Emulated links: delay, loss, counters, and clean-up of namespaces."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from benchmarks.support import network_emulator
from benchmarks.support.network_emulator import Count, Link, LinkProfile, NetworkEmulator
from tests.support.live_server import require_network_emulation, wait
from tests.support.waiting import deadline

ECHO = """
import socket, sys
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("0.0.0.0", 9000))
print("ready", flush=True)
while True:
    data, who = s.recvfrom(2000)
    s.sendto(data, who)
"""
PROBE = """
import json, socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.settimeout(1.0)
trips, answered = [], 0
for i in range(int(sys.argv[2])):
    start = time.monotonic()
    s.sendto(bytes(72), (sys.argv[1], 9000))
    if len(sys.argv) > 3:
        continue
    s.recvfrom(2000)
    trips.append(time.monotonic() - start)
while len(sys.argv) > 3:
    try:
        s.recvfrom(2000)
        answered += 1
    except TimeoutError:
        break
print(json.dumps([trips, answered]))
"""


@pytest.fixture(autouse=True)
def _links():
    require_network_emulation()


def probe(net: NetworkEmulator, end: str, count: int, *flood: str) -> tuple[list[float], int]:
    command = [sys.executable, "-c", PROBE, net.hub(end), str(count), *flood]
    process = net.start(end, command, stdout=subprocess.PIPE, text=True)
    trips, answered = json.loads(process.communicate(timeout=deadline())[0])
    return trips, answered


def echo(net: NetworkEmulator) -> None:
    server = net.start("hub", [sys.executable, "-c", ECHO], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    assert server.stdout.readline() == "ready\n"


def test_links_delay_each_way_and_count_every_byte():
    with NetworkEmulator({"near": Link(), "far": Link(LinkProfile(0.03), LinkProfile(0.02, 0.005))}) as net:
        echo(net)
        near, _ = probe(net, "near", 20)
        far, _ = probe(net, "far", 20)
        assert sorted(near)[10] < 0.01
        assert min(far) >= 0.044
        assert sorted(far)[10] < 0.065
        # 72 B of payload, 8 of UDP, 20 of IP
        assert net.counts("far") == (Count(20, 2000, 0), Count(20, 2000, 0))
        assert net.counts("near") == (Count(20, 2000, 0), Count(20, 2000, 0))


def test_links_lose_packets_and_can_be_cut_and_restored():
    with NetworkEmulator({"bad": Link(LinkProfile(loss=0.2), LinkProfile())}, seed=3) as net:
        echo(net)
        _, answered = probe(net, "bad", 200, "flood")
        forth, back = net.counts("bad")
        assert 20 <= forth.lost <= 65
        assert answered == forth.packets - forth.lost == back.packets
        net.disconnect("bad")
        assert probe(net, "bad", 10, "flood")[1] == 0
        net.shape("bad", Link())
        assert probe(net, "bad", 10, "flood")[1] == 10


def test_namespaces_are_removed_also_after_a_kill():
    code = (
        "import sys, time\nfrom benchmarks.support.network_emulator import Link, NetworkEmulator\n"
        "net = NetworkEmulator({'a': Link()})\nprint('ready', flush=True)\ntime.sleep(60)"
    )
    owner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    assert owner.stdout.readline() == "ready\n"
    namespaces = [space for space in network_emulator._list_namespaces() if f"-{owner.pid}-" in space]
    assert len(namespaces) == 2
    owner.send_signal(signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    wait(
        lambda: not [s for s in network_emulator._list_namespaces() if f"-{owner.pid}-" in s],
        "the helper process to remove them",
    )

    # the next emulator removes what a killed helper process left
    ended = subprocess.Popen([sys.executable, "-c", "pass"])
    ended.wait()
    left = f"{network_emulator._PREFIX}-{ended.pid}-1-hub"
    subprocess.run(["ip", "netns", "add", left], check=True)
    start = time.monotonic()
    with NetworkEmulator({"a": Link()}):
        assert left not in network_emulator._list_namespaces()
    assert not [s for s in network_emulator._list_namespaces() if f"-{os.getpid()}-" in s]
    assert time.monotonic() - start < 20.0


def test_invalid_links_are_refused_with_the_reason():
    with pytest.raises(ValueError, match="loss from 0 to 1"):
        LinkProfile(loss=2.0)
    with pytest.raises(ValueError, match="end 'hub'"):
        NetworkEmulator({"hub": Link()})
