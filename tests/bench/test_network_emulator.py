"""Emulated links: what they delay, lose and count, and that nothing of them stays behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.support.live_server import require_network_emulation, wait
from vinesim.bench.support import network_emulator
from vinesim.bench.support.network_emulator import Count, Link, LinkProfile, NetworkEmulator

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
    trips, answered = json.loads(process.communicate(timeout=120)[0])
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


def test_links_lose_their_share_and_can_be_cut_and_mended():
    with NetworkEmulator({"bad": Link(LinkProfile(loss=0.2), LinkProfile())}, seed=3) as net:
        echo(net)
        _, answered = probe(net, "bad", 200, "flood")
        there, back = net.counts("bad")
        assert 20 <= there.lost <= 65
        assert answered == there.packets - there.lost == back.packets
        net.disconnect("bad")
        assert probe(net, "bad", 10, "flood")[1] == 0
        net.shape("bad", Link())
        assert probe(net, "bad", 10, "flood")[1] == 10


def test_nothing_stays_behind_even_of_one_that_is_killed():
    code = (
        "import sys, time\nfrom vinesim.bench.support.network_emulator import Link, NetworkEmulator\n"
        "net = NetworkEmulator({'a': Link()})\nprint('ready', flush=True)\ntime.sleep(60)"
    )
    victim = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert victim.stdout is not None
    assert victim.stdout.readline() == "ready\n"
    mine = [space for space in network_emulator._list_namespaces() if f"-{victim.pid}-" in space]
    assert len(mine) == 2
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    victim.stdout.close()
    wait(
        lambda: not [s for s in network_emulator._list_namespaces() if f"-{victim.pid}-" in s],
        "the carrier to take them away",
    )

    # and what a carrier that was killed as well left is swept by the next
    gone = subprocess.Popen([sys.executable, "-c", "pass"])
    gone.wait()
    left = f"{network_emulator._PREFIX}-{gone.pid}-1-hub"
    subprocess.run(["ip", "netns", "add", left], check=True)
    start = time.monotonic()
    with NetworkEmulator({"a": Link()}):
        assert left not in network_emulator._list_namespaces()
    assert not [s for s in network_emulator._list_namespaces() if f"-{os.getpid()}-" in s]
    assert time.monotonic() - start < 20.0


def test_what_cannot_be_is_refused_in_words():
    with pytest.raises(ValueError, match="loss from 0 to 1"):
        LinkProfile(loss=2.0)
    with pytest.raises(ValueError, match="end 'hub'"):
        NetworkEmulator({"hub": Link()})
