"""Laws of replication on any network: with delay, loss, duplicates and reordering, and with clients that join and
leave."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.support.fake_client import FakeClient, tree_row
from tests.support.examples import share
from tests.support.shared_vineyard import Server
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.replication import interest
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id

pytestmark = pytest.mark.slow

TICK = 0.01
PLACES = {"ada": 1.0, "bob": 2.0, "cleo": 3.0, "dan": 2.5}
BUNCHES = [object_id(ObjectKind.BUNCH, index) for index in range(3)]
BOXES = [object_id(ObjectKind.BOX, index) for index in range(3)]


class RetainedServer(Server):
    """A server in memory: a clock, and the retained records of every cell."""

    def open(self) -> None:
        super().open()
        self.bus.declare_queryable("clock/*", lambda payload: encode_time(decode_time(payload)[0], self.hub.time))


class World:
    """Fake clients and a server on an emulated network."""

    def __init__(self, *names: str, **network: float) -> None:
        self.hub = MemoryHub(**network)  # type: ignore[arg-type]
        self.server = RetainedServer(self.hub)
        self.model = tree_row(6)
        self.clients: dict[str, FakeClient] = {}
        for name in names:
            self.join(name)

    def join(self, name: str) -> None:
        self.clients[name] = FakeClient(self.hub.bus(name), self.model, (PLACES[name], 0.0), joints=2)

    def leave(self, name: str) -> None:
        self.clients.pop(name).bus.close()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.hub.advance(TICK)
            self.server.tick()
            for fake_client in self.clients.values():
                fake_client.tick(self.hub.time)

    def owners(self, number: int) -> set:
        return {fake_client.replicator.owner(number) for fake_client in self.clients.values()}


names = st.sampled_from(sorted(PLACES))
actions = st.one_of(
    st.tuples(names, st.sampled_from(["touch", "let", "grab"]), st.integers(0, 2)),
    st.tuples(names, st.sampled_from(["pick", "lay"]), st.sampled_from(BUNCHES)),
    st.tuples(names, st.sampled_from(["lift", "lay"]), st.sampled_from(BOXES)),
    st.tuples(names, st.sampled_from(["join", "leave"]), st.just(0)),
    st.tuples(st.just("ada"), st.sampled_from(["down", "up"]), st.just(0)),
)
scenarios = st.lists(st.tuples(actions, st.integers(1, 15)), min_size=1, max_size=20)


def apply_action(world: World, name: str, action: str, number: int, picked: set[int]) -> None:
    """Apply one action of a scenario, if it is possible in the current state."""
    fake_client = world.clients.get(name)
    if action in ("down", "up"):
        world.hub.down = action == "down"
    elif action == "join" and fake_client is None and not world.hub.down:
        world.join(name)
    elif fake_client is None or action == "join":
        return
    elif action == "leave" and len(world.clients) > 1:
        world.leave(name)
    elif action == "touch":
        fake_client.touching.add(number)
    elif action == "let":
        fake_client.touching.discard(number)
    elif action == "grab":
        fake_client.touching.add(number)
        fake_client.grabbing.add(number)
    elif action == "pick":
        # a client without the record may pick a bunch that another has picked: both hold it, one owns it
        first = fake_client.replicator.record(number) is None and number not in fake_client.carrying
        (fake_client.picking if first else fake_client.grabbing).add(number)
        fake_client.carrying.add(number)
        picked.add(number)
    elif action == "lift":
        fake_client.carrying.add(number)
        fake_client.grabbing.add(number)
    elif action == "lay":
        fake_client.carrying.discard(number)


@given(scenarios, st.integers(0, 2**31), st.sampled_from([0.0, 0.02, 0.3]), st.sampled_from([0.0, 0.3]))
@settings(max_examples=share(0.08))
def test_after_any_actions_all_agree_and_picked_bunches_stay_picked(scenario, seed, loss, duplicated):
    world = World("ada", "bob", "cleo", delay=0.03, jitter=0.02, loss=loss, duplicated=duplicated, seed=seed)
    world.run(0.4)
    picked: set[int] = set()
    for (name, action, number), ticks in scenario:
        apply_action(world, name, action, number, picked)
        world.run(ticks * TICK)
    world.hub.down = False
    world.hub.loss = 0.0
    world.run(2.0)
    for fake_client in world.clients.values():  # of two that carry one object, the one that does not own it releases it
        for number in sorted(fake_client.carrying):
            if fake_client.replicator.owner(number) != fake_client.name:
                fake_client.carrying.discard(number)
    world.run(1.5)
    for number in (0, 1, 2, *BUNCHES, *BOXES):
        owners = world.owners(number)
        assert len(owners) == 1, (number, [(p.name, p.replicator.claim(number)) for p in world.clients.values()])
        assert owners <= {None, *world.clients}
    newcomer = next((name for name in PLACES if name not in world.clients), None)
    if newcomer is not None:
        world.join(newcomer)
        world.run(1.5)
    for number in picked:
        known = [fake_client.replicator.record(number) is not None for fake_client in world.clients.values()]
        stored = world.server.records.get(number) is not None
        # the record is lost if its only author left before any other received it
        assert all(known) == any(known) == stored


@given(st.floats(0.0, 0.15), st.integers(0, 4), st.sampled_from(["touch", "grab"]), st.sampled_from(["touch", "grab"]))
@settings(max_examples=share(0.3))
def test_a_conflict_is_resolved_within_a_round_trip_and_two_ticks(delay, apart, first, second):
    """Two take the same object at once, or so close in time that neither can have received the other's claim."""
    world = World("ada", "bob", "cleo", delay=delay)
    world.run(1.0 + 4.0 * delay)
    ada = world.clients["ada"]
    bob = world.clients["bob"]
    for fake_client, action, pause in ((ada, first, apart), (bob, second, 0)):
        fake_client.touching.add(1)
        if action == "grab":
            fake_client.grabbing.add(1)
        if pause:
            world.run(pause * TICK)
    world.run(TICK)  # the action itself
    world.run(np.ceil(2.0 * delay / TICK) * TICK + 2 * TICK)
    settled = world.owners(1)
    assert len(settled) == 1
    assert settled <= {"ada", "bob"}
    for _ in range(30):
        world.run(TICK)
        assert world.owners(1) == settled, "the owner changed"


@given(
    st.lists(st.floats(0.0, 20.0), min_size=3, max_size=3),
    st.integers(0, 5),
    st.floats(0.5, 5.0),
)
@settings(max_examples=share(0.3))
def test_bytes_are_sent_exactly_when_a_peer_is_near(positions, tree, near):
    """Interest, for any positions, any tree and any interest radius."""
    hub = MemoryHub()
    model = tree_row(6, apart=3.0)
    clients = [
        FakeClient(hub.bus(name), model, (x, 0.0), joints=2, near=near)
        for name, x in zip(("ada", "bob", "cleo"), positions, strict=True)
    ]

    def run(ticks: int) -> None:
        for _ in range(ticks):
            hub.advance(TICK)
            for fake_client in clients:
                fake_client.tick(hub.time)

    run(60)
    clients[0].touching.add(tree)
    run(60)
    middle = clients[0].replicator._state.tree_stream.middle[tree]
    distances = [float(np.hypot(*(fake_client.place[:2] - middle[:2]))) for fake_client in clients]
    sent = clients[0].replicator.counters.environment.bytes_out
    if any(abs(distance - near) < 0.01 for distance in distances):
        return  # poses are quantised: within 1 cm of the radius both results are valid
    assert (sent > 0) == any(distance <= near for distance in distances[1:])
    for fake_client, distance in zip(clients[1:], distances[1:], strict=True):
        received = tree in fake_client.heard
        assert not (received and distance > near + interest.HYSTERESIS + 0.01)
        assert received or not distance <= near


@given(st.integers(0, 2**31), st.floats(0.0, 0.1), st.floats(0.0, 1.0), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
@settings(max_examples=share(0.3))
def test_clock_offsets_are_within_the_jitter(seed, delay, jitter_ratio, skew_a, skew_b):
    """For any skew. Each way takes delay +- jitter, so an offset is wrong by at most the jitter."""
    jitter = jitter_ratio * delay
    hub = MemoryHub(delay=delay, jitter=jitter, loss=0.2, seed=seed)
    RetainedServer(hub)
    ada, bob = (FakeClient(hub.bus(name), tree_row(1), (x, 0.0), joints=2) for name, x in (("ada", 1.0), ("bob", 2.0)))
    for _ in range(200):
        hub.advance(TICK)
        ada.tick(hub.time + skew_a)
        bob.tick(hub.time + skew_b)
    times = [hub.time + skew + fake_client.replicator.offset for skew, fake_client in ((skew_a, ada), (skew_b, bob))]
    for time in times:
        assert time == pytest.approx(hub.time, abs=jitter + 1e-6)
