"""Laws of the network, on any network: whatever is delayed, lost, duplicated or overtaken, and whoever comes and
goes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.shared_vineyard import Server
from vinesim.bench.support.fake_client import FakeClient, tree_row
from vinesim.net.codec import messages
from vinesim.net.replication import interest
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id

TICK = 0.01
PLACES = {"ada": 1.0, "bob": 2.0, "cleo": 3.0, "dan": 2.5}
BUNCHES = [object_id(ObjectKind.BUNCH, index) for index in range(3)]
BOXES = [object_id(ObjectKind.BOX, index) for index in range(3)]


class Keeper(Server):
    """The server's part in memory: a clock, and the facts of every cell."""

    def open(self) -> None:
        super().open()
        self.bus.declare_queryable(
            "clock", lambda asked: messages.encode_time(messages.decode_time(asked)[0], self.hub.time)
        )


class World:
    """Fake clients, a keeper, and a network as bad as it is asked to be."""

    def __init__(self, *names: str, **network: float) -> None:
        self.hub = MemoryHub(**network)  # type: ignore[arg-type]
        self.keeper = Keeper(self.hub)
        self.model = tree_row(6)
        self.cast: dict[str, FakeClient] = {}
        for name in names:
            self.come(name)

    def come(self, name: str) -> None:
        self.cast[name] = FakeClient(self.hub.bus(name), self.model, (PLACES[name], 0.0), joints=2)

    def go(self, name: str) -> None:
        self.cast.pop(name).bus.close()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.hub.advance(TICK)
            self.keeper.tick()
            for fake_client in self.cast.values():
                fake_client.tick(self.hub.time)

    def owners(self, number: int) -> set:
        return {fake_client.replicator.owner(number) for fake_client in self.cast.values()}


names = st.sampled_from(sorted(PLACES))
acts = st.one_of(
    st.tuples(names, st.sampled_from(["touch", "let", "grab"]), st.integers(0, 2)),
    st.tuples(names, st.sampled_from(["pick", "lay"]), st.sampled_from(BUNCHES)),
    st.tuples(names, st.sampled_from(["lift", "lay"]), st.sampled_from(BOXES)),
    st.tuples(names, st.sampled_from(["come", "go"]), st.just(0)),
    st.tuples(st.just("ada"), st.sampled_from(["down", "up"]), st.just(0)),
)
stories = st.lists(st.tuples(acts, st.integers(1, 15)), min_size=1, max_size=20)


def play(world: World, name: str, act: str, number: int, picked: set[int]) -> None:
    """One act of a story, as far as it makes sense."""
    fake_client = world.cast.get(name)
    if act in ("down", "up"):
        world.hub.down = act == "down"
    elif act == "come" and fake_client is None and not world.hub.down:
        world.come(name)
    elif fake_client is None or act == "come":
        return
    elif act == "go" and len(world.cast) > 1:
        world.go(name)
    elif act == "touch":
        fake_client.touching.add(number)
    elif act == "let":
        fake_client.touching.discard(number)
    elif act == "grab":
        fake_client.touching.add(number)
        fake_client.grabbing.add(number)
    elif act == "pick":
        # somebody who has not heard of it may pick what another has picked: both believe it, one owns it
        first = fake_client.replicator.record(number) is None and number not in fake_client.carrying
        (fake_client.picking if first else fake_client.grabbing).add(number)
        fake_client.carrying.add(number)
        picked.add(number)
    elif act == "lift":
        fake_client.carrying.add(number)
        fake_client.grabbing.add(number)
    elif act == "lay":
        fake_client.carrying.discard(number)


@given(stories, st.integers(0, 2**31), st.sampled_from([0.0, 0.02, 0.3]), st.sampled_from([0.0, 0.3]))
@settings(max_examples=4, deadline=None)
def test_after_any_story_all_agree_and_nothing_picked_hangs_again(story, seed, loss, duplicated):
    world = World("ada", "bob", "cleo", delay=0.03, jitter=0.02, loss=loss, duplicated=duplicated, seed=seed)
    world.run(0.4)
    picked: set[int] = set()
    for (name, act, number), ticks in story:
        play(world, name, act, number, picked)
        world.run(ticks * TICK)
    world.hub.down = False
    world.hub.loss = 0.0
    world.run(2.0)
    for fake_client in world.cast.values():  # of two who carry one thing, the one who does not own it lets go
        for number in sorted(fake_client.carrying):
            if fake_client.replicator.owner(number) != fake_client.name:
                fake_client.carrying.discard(number)
    world.run(1.5)
    for number in (0, 1, 2, *BUNCHES, *BOXES):
        owners = world.owners(number)
        assert len(owners) == 1, (number, [(p.name, p.replicator.claim(number)) for p in world.cast.values()])
        assert owners <= {None, *world.cast}
    newcomer = next((name for name in PLACES if name not in world.cast), None)
    if newcomer is not None:
        world.come(newcomer)
        world.run(1.5)
    for number in picked:
        known = [fake_client.replicator.record(number) is not None for fake_client in world.cast.values()]
        kept = world.keeper.facts.get(number) is not None
        # who picked it alone and left before anybody could hear of it took the story along
        assert all(known) == any(known) == kept


@given(st.floats(0.0, 0.15), st.integers(0, 4), st.sampled_from(["touch", "grab"]), st.sampled_from(["touch", "grab"]))
@settings(max_examples=8, deadline=None)
def test_a_conflict_is_over_within_a_round_trip_and_two_ticks(delay, apart, first, second):
    """Two take the same thing at once, or so nearly that neither can have heard of the other."""
    world = World("ada", "bob", "cleo", delay=delay)
    world.run(1.0 + 4.0 * delay)
    ada, bob = world.cast["ada"], world.cast["bob"]
    for fake_client, how, pause in ((ada, first, apart), (bob, second, 0)):
        fake_client.touching.add(1)
        if how == "grab":
            fake_client.grabbing.add(1)
        if pause:
            world.run(pause * TICK)
    world.run(TICK)  # the act itself
    world.run(np.ceil(2.0 * delay / TICK) * TICK + 2 * TICK)
    settled = world.owners(1)
    assert len(settled) == 1
    assert settled <= {"ada", "bob"}
    for _ in range(30):
        world.run(TICK)
        assert world.owners(1) == settled, "and it stays so"


@given(
    st.lists(st.floats(0.0, 20.0), min_size=3, max_size=3), st.integers(0, 5), st.floats(0.5, 5.0),
)  # fmt: skip
@settings(max_examples=10, deadline=None)
def test_bytes_leave_exactly_when_somebody_is_near(where, tree, near):
    """Interest, as a law: for any places, any tree, any *near*."""
    hub = MemoryHub()
    model = tree_row(6, apart=3.0)
    cast = [
        FakeClient(hub.bus(name), model, (x, 0.0), joints=2, near=near)
        for name, x in zip(("ada", "bob", "cleo"), where, strict=True)
    ]

    def run(ticks: int) -> None:
        for _ in range(ticks):
            hub.advance(TICK)
            for fake_client in cast:
                fake_client.tick(hub.time)

    run(60)
    cast[0].touching.add(tree)
    run(60)
    middle = cast[0].replicator._state.tree_stream.middle[tree]
    away = [float(np.hypot(*(fake_client.place[:2] - middle[:2]))) for fake_client in cast]
    sent = cast[0].replicator.counters.environment.bytes_out
    if any(abs(one - near) < 0.01 for one in away):
        return  # a pose is quantised on its way: on the very edge either may be right
    assert (sent > 0) == any(one <= near for one in away[1:])
    for fake_client, one in zip(cast[1:], away[1:], strict=True):
        heard = tree in fake_client.heard
        assert not (heard and one > near + interest.HYSTERESIS + 0.01)
        assert heard or not one <= near


@given(st.integers(0, 2**31), st.floats(0.0, 0.1), st.floats(0.0, 1.0), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
@settings(max_examples=10, deadline=None)
def test_any_two_clocks_agree_as_far_as_jitter_allows(seed, delay, uneven, skew_a, skew_b):
    """However wrong they are. Each way takes delay +- jitter, so an offset is wrong by at most the jitter."""
    jitter = uneven * delay
    hub = MemoryHub(delay=delay, jitter=jitter, loss=0.2, seed=seed)
    Keeper(hub)
    ada, bob = (FakeClient(hub.bus(name), tree_row(1), (x, 0.0), joints=2) for name, x in (("ada", 1.0), ("bob", 2.0)))
    for _ in range(200):
        hub.advance(TICK)
        ada.tick(hub.time + skew_a)
        bob.tick(hub.time + skew_b)
    times = [hub.time + skew + fake_client.replicator.offset for skew, fake_client in ((skew_a, ada), (skew_b, bob))]
    for time in times:
        assert time == pytest.approx(hub.time, abs=jitter + 1e-6)
