"""Pushes between clients: said while somebody touches, believed for a tenth of a second, and silence otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.net.replication.hand_forces import MAX_AGE, WrenchSync
from vinesim.net.transport.memory_bus import MemoryBus, MemoryHub

PUSH = np.array([10.0, 0.0, -5.0, 0.1, 0.2, 0.3])
TICK = 0.01


class Pair:
    """A person who touches a robot."""

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


def test_a_touch_is_told_sixty_times_a_second_and_its_end_once():
    pair = Pair()
    for _ in range(100):
        assert pair.tick() == {}
    assert pair.person_bus.bytes_out == 0
    for _ in range(100):
        felt = pair.tick({"arm": PUSH})
    np.testing.assert_allclose(felt["arm"], PUSH, rtol=1e-6)
    assert len(pair.left) == pytest.approx(60, abs=2)
    before = len(pair.left)
    for _ in range(10):
        felt = pair.tick()
    assert felt == {}
    assert len(pair.left) == before + 1 or len(pair.left) == before + 2  # what the last ticks still felt, and the end
    told = pair.person_bus.bytes_out
    for _ in range(100):
        pair.tick()
    assert pair.person_bus.bytes_out == told, "silence"


def test_the_impulse_arrives_whole():
    """Messages hold means: a push that changes every tick gives the robot the same impulse."""
    pair, given, felt = Pair(), 0.0, 0.0
    rng = np.random.default_rng(1)
    for tick in range(600):
        force = float(rng.uniform(0.0, 100.0)) if tick < 500 else 0.0
        given += force
        arrived = pair.tick({"arm": np.array([force, 0, 0, 0, 0, 0.0])} if force else None)
        felt += float(arrived["arm"][0]) if arrived else 0.0
    assert felt == pytest.approx(given, rel=0.03)


def test_who_falls_silent_pushes_no_more():
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


def test_two_people_add_up_and_an_old_message_counts_for_nothing():
    pair = Pair()
    other = WrenchSync(pair.hub.bus("ida"), "ida")
    first = other.publish({"anna": {"arm": PUSH, "base": PUSH}}, 0.0, 5.0)
    assert first, "somebody listens"
    pair.robot.receive(first[0], "ida", 0.0)
    pair.robot.receive(first[0], "eva", 0.0)
    assert not pair.robot.receive(first[0], "eva", 0.0)
    felt = pair.robot.net_wrenches(0.0)
    np.testing.assert_allclose(felt["arm"], 2.0 * PUSH, rtol=1e-6)
    assert set(felt) == {"arm", "base"}
    pair.robot.remove_peer("ida")
    np.testing.assert_allclose(pair.robot.net_wrenches(0.0)["base"], PUSH, rtol=1e-6)
