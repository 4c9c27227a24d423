"""Wrenches between clients: sent during contact, valid for a tenth of a second, and no traffic otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.codec.forces import MAX_WRENCH, WrenchMessage, encode_wrenches
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.direct_messages import (
    HAND_FORCE,
    HAND_LEVER,
    MAX_PUSHING_PEOPLE,
    REACH,
    WRENCH_MAX_AGE,
    WrenchSync,
)
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_64
from vinesim.net.transport.memory_bus import MemoryBus, MemoryHub
from vinesim.scene.values import POINT_NAMES, HumanPose, HumanUpdate

_wrenches = arrays(float, 6, elements=st.floats(-MAX_WRENCH, MAX_WRENCH))
PUSH = np.array([10.0, 0.0, -5.0, 0.1, 0.2, 0.3])
TICK = 0.01
LINKS = {"arm": np.array([0.0, 0.0, 1.0]), "base": np.array([0.2, 0.0, 0.4])}
EVA = Hello("eva", kind="human")


def person(name: str = "eva", hands: tuple[float, float] = (0.3, 0.4)) -> HumanUpdate:
    """A person whose hands are at these x [m], 1 m above the ground."""
    points = np.tile(frames.pose(np.array([0.8, 0.0, 1.0])), (len(POINT_NAMES), 1))
    points[[POINT_NAMES.index("left"), POINT_NAMES.index("right")], 0] = hands
    return HumanUpdate(name, 0.0, HumanPose(*points), np.zeros((len(POINT_NAMES), 6)))


def peer(hello: Hello, pose: HumanUpdate | None) -> RemotePose:
    actor = RemotePose(hello)
    actor.update = pose
    return actor


def robot_sync(
    bus: MemoryBus | None = None, counters: Counters | None = None, hand_force: float = HAND_FORCE
) -> WrenchSync:
    """Of a robot with two links."""
    return WrenchSync(bus or MemoryHub().bus("anna"), "anna", counters or Counters(), hand_force, LINKS.get)


def receive(sync: WrenchSync, wrenches: dict[str, np.ndarray], sender: str = "eva", time: float = 1.0) -> None:
    payload = encode_wrenches(WrenchMessage(time, wrenches))
    sync.receive(payload, peer(Hello(sender, kind="human"), person(sender)), 0.0, 0.0)


class Pair:
    """A human and a robot of two clients."""

    def __init__(self, delay: float = 0.02) -> None:
        self.hub = MemoryHub(delay=delay)
        self.person_bus, self.robot_bus = self.hub.bus("eva"), self.hub.bus("anna")
        self.person = WrenchSync(self.person_bus, "eva", Counters())
        self.robot = robot_sync(self.robot_bus)
        self.robot_bus.subscribe("force/anna/*", KEEP_LAST_64)
        self.left: list[bytes] = []

    def tick(self, wrenches: dict | None = None) -> dict[str, np.ndarray]:
        now = self.hub.time
        for key, payload in self.robot_bus.poll():
            assert key == "force/anna/eva"
            self.robot.receive(payload, peer(EVA, person()), now, 0.0)
        self.left += self.person.publish({"anna": wrenches} if wrenches else {}, now, now)
        self.hub.advance(TICK)
        return self.robot.current(now)


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
    pair = Pair()
    applied = 0.0
    received = 0.0
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
            pair.robot.receive(payload, peer(EVA, person()), now, 0.0)
        pair.hub.advance(TICK)
        stale += bool(pair.robot.current(now))
    assert stale * TICK <= WRENCH_MAX_AGE + 0.04


def test_wrenches_of_two_humans_add_up_and_repeated_messages_are_ignored():
    pair = Pair()
    other = WrenchSync(pair.hub.bus("ida"), "ida", Counters())
    first = other.publish({"anna": {"arm": PUSH, "base": PUSH}}, 0.0, 5.0)
    assert first, "the robot subscribes"
    for sender in ("ida", "eva", "eva"):
        pair.robot.receive(first[0], peer(Hello(sender, kind="human"), person(sender)), 0.0, 0.0)
    received = pair.robot.current(0.0)
    np.testing.assert_allclose(received["arm"], 2.0 * PUSH, rtol=1e-6)
    assert set(received) == {"arm", "base"}
    pair.robot.remove_peer("ida")
    np.testing.assert_allclose(pair.robot.current(0.0)["base"], PUSH, rtol=1e-6)


@pytest.mark.parametrize("kind", ["robot", "spectator"])
def test_only_people_push(kind):
    robot = robot_sync()
    payload = encode_wrenches(WrenchMessage(1.0, {"arm": PUSH}))
    with pytest.raises(MessageError, match=f"a {kind}: only people"):
        robot.receive(payload, peer(Hello("eva", kind=kind), person()), 0.0, 0.0)
    assert robot.current(0.0) == {}


@pytest.mark.parametrize(
    ("pose", "refused"),
    [(None, 2), (person(hands=(REACH + 0.02, REACH + 0.3)), 1), (person(hands=(5.0, REACH - 0.1)), 0)],
    ids=["no pose", "too far", "one hand near"],
)
def test_a_link_that_no_hand_reaches_is_not_pushed(pose, refused):
    counters = Counters()
    robot = robot_sync(counters=counters)
    payload = encode_wrenches(WrenchMessage(1.0, {"arm": PUSH, "base": PUSH, "no such link": PUSH}))
    robot.receive(payload, peer(EVA, pose), 0.0, 0.0)
    assert counters.wrenches_refused == refused + 1
    assert len(robot.current(0.0)) == 2 - refused


@given(st.lists(st.dictionaries(st.sampled_from(sorted(LINKS)), _wrenches, min_size=1), min_size=1, max_size=8))
def test_no_person_and_not_all_together_push_harder_than_hands_can(pushes):
    robot = robot_sync()
    for number, wrenches in enumerate(pushes):
        alone = robot_sync()
        for sync in (alone, robot):
            receive(sync, wrenches, f"person_{number}")
        _assert_limited(alone.current(0.0), 1)
    _assert_limited(robot.current(0.0), MAX_PUSHING_PEOPLE)


def _assert_limited(wrenches: dict[str, np.ndarray], people: int) -> None:
    total = sum(np.linalg.norm(wrench.reshape(2, 3), axis=1) for wrench in wrenches.values())
    assert (total <= people * (1.0 + 1e-9) * 2.0 * HAND_FORCE * np.array([1.0, HAND_LEVER])).all()


def test_a_wrench_that_is_too_strong_keeps_its_line_of_action_and_is_counted():
    counters = Counters()
    robot = robot_sync(counters=counters)
    receive(robot, {"arm": 100.0 * PUSH})
    got = robot.current(0.0)["arm"]
    np.testing.assert_allclose(got / np.linalg.norm(got), PUSH / np.linalg.norm(PUSH), rtol=1e-6)
    assert np.linalg.norm(got[:3]) == pytest.approx(2.0 * HAND_FORCE)
    assert counters.wrenches_limited == 1


def test_wrenches_that_leave_are_limited_too():
    """A contact that physics resolves with a shock ends neither the tick nor is it sent."""
    pair = Pair()
    for _ in range(10):
        received = pair.tick({"arm": 1e6 * PUSH})
    assert np.linalg.norm(received["arm"][:3]) == pytest.approx(2.0 * HAND_FORCE)


@pytest.mark.parametrize("hand_force", [HAND_FORCE, 30.0])
@pytest.mark.parametrize(("hands", "count"), [((0.3, 5.0), 1), ((5.0, 0.4), 1), ((0.3, 0.4), 2)])
def test_each_hand_within_reach_pushes_with_its_own_limit_and_no_more(hands, count, hand_force):
    robot = robot_sync(hand_force=hand_force)
    payload = encode_wrenches(WrenchMessage(1.0, {"arm": 100.0 * PUSH, "base": 100.0 * PUSH}))
    robot.receive(payload, peer(EVA, person(hands=hands)), 0.0, 0.0)
    forces = [np.linalg.norm(wrench[:3]) for wrench in robot.current(0.0).values()]
    assert sum(forces) == pytest.approx(count * hand_force)
