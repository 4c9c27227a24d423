"""Actors far from each other: what they cost, what they know of each other, and what a crowd costs."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from benchmarks.support.fake_client import FakeClient, tree_row
from benchmarks.support.indexed_hub import IndexedHub
from vinesim.net.codec.control import Hello, encode_description
from vinesim.net.replication import interest
from vinesim.net.replication.peers import GREETING_BURST, GREETING_RATE, MAX_DESCRIPTIONS

TICK = 1.0 / 60.0
MODEL = tree_row(1)


class Plain:
    """Actors on a plain. They need no server: network time is their own."""

    def __init__(self) -> None:
        self.hub = IndexedHub()
        self.time = 0.0
        self.actors: dict[str, FakeClient] = {}

    def join(self, name: str, *place: float, **options) -> FakeClient:
        x, y = (*place, 0.0)[:2]
        self.actors[name] = FakeClient(self.hub.bus(name), MODEL, (x, y), **options)
        return self.actors[name]

    def run(self, seconds: float, tick: float = TICK) -> None:
        for _ in range(round(seconds / tick)):
            self.time += tick
            for actor in self.actors.values():
                actor.tick(self.time)


def test_two_actors_200_m_apart_know_each_other_for_less_than_40_bytes_a_second():
    plain = Plain()
    ada, bob = plain.join("ada", 0.0), plain.join("bob", 200.0, 30.0)
    plain.run(4.5)
    before = ada.bus.bytes_in, ada.bus.bytes_out
    plain.run(10.0)
    assert ada.replicator.peers.keys() == {"bob"}
    np.testing.assert_allclose(ada.replicator.peer_positions()["bob"], [200.0, 30.0, 0.0], atol=0.01)
    assert (ada.robots, bob.robots) == ({}, {})
    assert not len(ada.replicator.near_positions())
    received, sent = ada.bus.bytes_in - before[0], ada.bus.bytes_out - before[1]
    assert 200 <= received <= 400
    assert 200 <= sent <= 400


def test_who_comes_near_is_near_before_the_body_distance_and_far_again_with_hysteresis():
    plain = Plain()
    ada, bob = plain.join("ada", 1.0), plain.join("bob", 60.0)
    plain.run(2.5)
    near = []
    for x in (*np.arange(60.0, 9.0, -0.05), *np.arange(9.0, 60.0, 0.05)):
        bob.place[0] = x
        plain.run(TICK)
        near.append(("bob" in ada.robots, x - 1.0))
    began = next(away for is_near, away in near if is_near)
    ended = next(away for is_near, away in reversed(near) if is_near)
    moved = 3.0 * 0.4  # [m] at 3 m/s, two poses at 5 Hz
    assert interest.BODY_DISTANCE - moved < began <= interest.BODY_DISTANCE
    limit = interest.BODY_DISTANCE * interest.LAYER_HYSTERESIS
    assert limit - moved < ended < limit + 2.5 * 3.0, "a coarse pose comes every 2 s"
    changes = sum(a != b for (a, _), (b, _) in itertools.pairwise(near))
    assert changes == 2


@pytest.mark.parametrize("distance", [0.0, 2.0, 5.0, 10.0, 21.0])
def test_poses_arrive_once_wherever_the_regions_meet(distance):
    """Along a line across several regions, two actors at a distance receive each pose of the other one once."""
    plain = Plain()
    ada, bob = plain.join("ada", 0.0, joints=2), plain.join("bob", distance, joints=2)
    plain.run(1.0)
    layers = interest.count_layers(distance, 1)
    rate = interest.POSE_RATE / interest.POSE_LAYERS[layers - 1].every + interest.POSE_RATE / interest.FAR_EVERY
    for start in (0.0, 21.5, 23.9, 25.0, 47.0):
        ada.place[0], bob.place[0] = start, start + distance
        plain.run(0.4)
        before = ada.replicator.counters.actor.messages_in
        plain.run(2.0)
        received = ada.replicator.counters.actor.messages_in - before
        assert abs(received - 2.0 * rate) <= 2.0, f"from {start} m"


def test_one_who_joins_late_learns_everyone():
    count = int(GREETING_BURST) + 36
    plain = Plain()
    places = np.random.default_rng(2).uniform(0.0, 1000.0, (count, 2))
    for number, place in enumerate(places):
        plain.join(f"a{number}", *place, joints=2, kind="human" if number % 2 else "robot")
    plain.run(0.5, 0.1)
    late = plain.join("late", 500.0, 500.0)
    plain.run(0.3, 0.1)
    assert len(late.replicator.peers) <= GREETING_BURST + 1 + 0.3 * GREETING_RATE, "not all queries at once"
    plain.run(36 / GREETING_RATE + 2.5, 0.1)
    assert {name: hello.kind for name, hello in late.replicator.peers.items()} == {
        f"a{number}": "human" if number % 2 else "robot" for number in range(count)
    }
    known = late.replicator.peer_positions()
    np.testing.assert_allclose([known[f"a{number}"][:2] for number in range(count)], places, atol=0.01)


def test_a_neighbour_is_greeted_before_a_crowd_far_away():
    count = int(2 * GREETING_BURST)
    plain = Plain()
    for number in range(count):
        plain.join(f"a{number}", 300.0 + 4.0 * number, 300.0, joints=2)
    plain.join("z", 3.0)
    plain.run(0.4, 0.1)
    late = plain.join("late", 0.0)
    plain.run(1.0)
    assert "z" in late.robots
    assert len(late.replicator.peers) < count


@pytest.mark.slow
def test_what_a_crowd_sends_to_one_actor_does_not_grow_with_the_crowd():
    """At a distance of 1.5 m of neighbours; the limit of a client in a crowd is 60 kB/s."""
    rates = {}
    for count in (20, 68):
        plain = Plain()
        row = math.isqrt(count)
        for number in range(count):
            kind = "human" if number % 2 else "robot"
            plain.join(f"a{number}", 1.5 * (number % row), 1.5 * (number // row), kind=kind)
        plain.run(count / GREETING_RATE + 1.0, 0.25)
        plain.run(0.2)
        before = [actor.bus.bytes_in for actor in plain.actors.values()]
        plain.run(0.5)
        after = [actor.bus.bytes_in for actor in plain.actors.values()]
        rates[count] = max(b - a for a, b in zip(before, after, strict=True)) / 0.5
        bodies = {len(actor.replicator.near_positions()) for actor in plain.actors.values()}
        most = min(count - 1, interest.MAX_BODIES)
        assert bodies <= {most, min(count - 1, most + 1)}, "one more is kept once it is near"
    assert max(rates.values()) < 60_000
    assert rates[68] < 1.2 * rates[20]


def test_the_law_of_shared_rates():
    for count in (0, 1, 24, 25, 300, 5000):
        for rate, budget in ((5.0, interest.REGION_BUDGET), (0.5, interest.FAR_BUDGET)):
            divisor = interest.thinning(count, rate, budget)
            assert count * rate / divisor <= budget
            assert divisor == 1 or count * rate / (divisor - 1) > budget


# ---------------------------------------------------------------- descriptions of robots


def described(name: str, urdf: str = "<robot name='r'/>") -> Hello:
    return Hello(name, scene="fake_clients", digest="fake_clients", joints=2, robot="r", urdf=urdf, sidecar="{}")


class Robots(Plain):
    """Robots that have a URDF. :attr:`asked` has the keys of all queries for descriptions."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    def join(self, name: str, *place: float, urdf: str = "<robot name='r'/>", **options) -> FakeClient:
        actor = super().join(name, *place, joints=2, hello=described(name, urdf), **options)
        query = actor.bus.query

        def count(key: str, payload: bytes = b"") -> None:
            self.asked += [f"{name} {key}"] if key.startswith("robot/") else []
            query(key, payload)

        actor.bus.query = count
        return actor


def test_a_description_is_queried_once_for_all_robots_that_have_the_same():
    plain = Robots()
    ada = plain.join("ada", 0.0, urdf="<robot name='own'/>")
    for number in range(3):
        plain.join(f"r{number}", 5.0 + number)
    plain.run(1.0)
    assert plain.asked == []
    assert ada.replicator.describe("r1") is None
    assert ada.replicator.describe("r2") is None
    plain.run(0.1)
    for name in ("r0", "r1", "r2"):
        hello = ada.replicator.describe(name)
        assert hello is not None
        assert encode_description(hello) == encode_description(described(name))
    assert plain.asked == ["ada robot/r1"]
    plain.join("twin", 3.0, urdf="<robot name='own'/>")
    plain.run(1.0)
    assert ada.replicator.describe("twin").urdf == "<robot name='own'/>"
    assert plain.asked == ["ada robot/r1"], "its own robot has the same"


def test_a_false_description_is_counted_and_not_queried_again():
    plain = Robots()
    ada = plain.join("ada", 0.0, urdf="<robot name='own'/>")
    bob = plain.join("bob", 5.0)
    false = encode_description(described("bob", "<robot name='other'/>"))
    bob.bus.queryables["robot/bob"] = lambda _: false
    plain.run(1.0)
    assert ada.replicator.describe("bob") is None
    plain.run(2.0)
    assert ada.replicator.describe("bob") is None
    assert ada.replicator.counters.malformed == 1
    assert plain.asked == ["ada robot/bob"]


def test_the_number_of_kept_descriptions_is_bounded():
    plain = Robots()
    ada = plain.join("ada", 0.0, urdf="<robot name='own'/>")
    names = [f"r{number}" for number in range(MAX_DESCRIPTIONS + 4)]
    for number, name in enumerate(names):
        plain.join(name, 200.0 + 100.0 * number, urdf=f"<robot name='{name}'/>")
    plain.run(len(names) / GREETING_RATE + 1.0, 0.1)
    for name in names:
        ada.replicator.describe(name)
    plain.run(0.2, 0.1)
    found = [name for name in names if ada.replicator.describe(name) is not None]
    assert len(found) <= MAX_DESCRIPTIONS
    assert found[-1] == names[-1]
