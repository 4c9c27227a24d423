"""Wrenches between clients: sent during contact, valid for a tenth of a second, and no traffic otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.net.replication.hand_forces import MAX_AGE, WrenchSync
from vinesim.net.transport.memory_bus import MemoryBus, MemoryHub

PUSH = np.array([10.0, 0.0, -5.0, 0.1, 0.2, 0.3])
TICK = 0.01


class Pair:
    """A human and a robot of two clients."""

    def __init__(self, delay: float = 0.02) -> None:
        self.hub = MemoryHub(delay=delay)
        self.person_bus, self.robot_bus = self.hub.bus("eva"), self.hub.bus("anna")
        self.person, self.robot = WrenchSync(self.person_bus, "eva"), WrenchSync(self.robot_bus, "anna")
        self.left: list[bytes] = []

    def tick(self, wrenches: dict | None = None) -> dict[str, np.ndarray]:
        now = self.hub.time
        for key, payload in self.robot_bus.poll():
            assert key == "force/anna/eva"
            self.robot.receive(payload, "eva", now)
        self.left += self.person.publish({"anna": wrenches} if wrenches else {}, now, now)
        self.hub.advance(TICK)
        return self.robot.net_wrenches(now)


def test_a_contact_wrench_is_sent_at_60_hz_and_its_end_once():
    pair = Pair()
    for _ in range(100):
        assert pair.tick() == {}
    assert pair.person_bus.bytes_out == 0
    for _ in range(100):
        received = pair.tick({"arm": PUSH})
    np.testing.assert_allclose(received["arm"], PUSH, rtol=1e-6)
    assert len(pair.left) == pytest.approx(60, abs=2)
    before = len(pair.left)
    for _ in range(10):
        received = pair.tick()
    assert received == {}
    assert (
        len(pair.left) == before + 1 or len(pair.left) == before + 2
    )  # the mean of the last ticks in contact, and the end
    sent = pair.person_bus.bytes_out
    for _ in range(100):
        pair.tick()
    assert pair.person_bus.bytes_out == sent, "no traffic without contact"


def test_the_received_impulse_equals_the_applied_one():
    """Messages hold mean wrenches: a force that changes every tick gives the robot the same impulse."""
    pair, applied, received = Pair(), 0.0, 0.0
    rng = np.random.default_rng(1)
    for tick in range(600):
        force = float(rng.uniform(0.0, 100.0)) if tick < 500 else 0.0
        applied += force
        net = pair.tick({"arm": np.array([force, 0, 0, 0, 0, 0.0])} if force else None)
        received += float(net["arm"][0]) if net else 0.0
    assert received == pytest.approx(applied, rel=0.03)


def test_a_wrench_expires_when_its_sender_disconnects():
    pair = Pair()
    for _ in range(20):
        pair.tick({"arm": PUSH})
    bus: MemoryBus = pair.person_bus
    bus.close()
    stale = 0
    for _ in range(30):
        now = pair.hub.time
        for _, payload in pair.robot_bus.poll():
            pair.robot.receive(payload, "eva", now)
        pair.hub.advance(TICK)
        stale += bool(pair.robot.net_wrenches(now))
    assert stale * TICK <= MAX_AGE + 0.04


def test_wrenches_of_two_humans_add_up_and_repeated_messages_are_ignored():
    pair = Pair()
    other = WrenchSync(pair.hub.bus("ida"), "ida")
    first = other.publish({"anna": {"arm": PUSH, "base": PUSH}}, 0.0, 5.0)
    assert first, "the robot subscribes"
    pair.robot.receive(first[0], "ida", 0.0)
    pair.robot.receive(first[0], "eva", 0.0)
    assert not pair.robot.receive(first[0], "eva", 0.0)
    received = pair.robot.net_wrenches(0.0)
    np.testing.assert_allclose(received["arm"], 2.0 * PUSH, rtol=1e-6)
    assert set(received) == {"arm", "base"}
    pair.robot.remove_peer("ida")
    np.testing.assert_allclose(pair.robot.net_wrenches(0.0)["base"], PUSH, rtol=1e-6)
