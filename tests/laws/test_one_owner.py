"""Whatever three clients do to trees, boxes and bunches, on whatever network: soon there is one owner, everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.shared_vineyard import BOX, BUNCH, Server, vineyard
from vinesim import frames
from vinesim.net.codec.messages import Hello
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import is_tree
from vinesim.scene.values import RobotUpdate

TICK = 0.01
DELAY, JITTER = 0.03, 0.02
RTT = 2.0 * (DELAY + JITTER)
THINGS = (0, BOX(0), BUNCH(0), BUNCH(1))
NAMES = ("ada", "bob", "cleo")


class Echoing(MemoryHub):
    """A network that delivers some samples twice."""

    def send(self, sender: str, key: str, payload: bytes, reliable: bool) -> None:
        super().send(sender, key, payload, reliable)
        if not reliable and self._random.random() < 0.1:
            super().send(sender, key, payload, reliable)


class Least:
    """The least client of rigid things: what it touches it moves, each its own way."""

    def __init__(self, hub: MemoryHub, name: str, start: Claim) -> None:
        self.hub, self.name, self.model = hub, name, vineyard()
        self.bus = hub.bus(name)
        self.replicator = Replicator(self.bus, Hello(name, scene="rows", digest="same", joints=0), self.model)
        for thing in THINGS:
            self.replicator._state.ownership[thing].claim = start
        self.x = -1.5 + NAMES.index(name)
        self.robot = RobotUpdate(name, 0.0, frames.pose([self.x, 0.0, 0.0]), np.zeros(6), np.zeros(0), np.zeros(0))
        self.touched: set[int] = set()
        self.picked: set[int] = set()
        self.pose = {thing: frames.pose([-1.0, 0.0, 0.1]) for thing in THINGS if not is_tree(thing)}
        self.mine_to_tell: set[int] = set()

    def tick(self) -> None:
        now = self.hub.time
        inbox = self.replicator.receive(now)
        for fact, holds in inbox.records:
            if not is_tree(fact.object):
                self.picked.add(fact.object)
                if holds:
                    self.pose[fact.object] = np.array(fact.pose)
        for update in inbox.objects:
            self.picked.add(update.object)
            self.pose[update.object] = update.pose
        there = {thing for thing in self.touched if thing in self.picked or thing in (0, BOX(0))}
        for thing in there - {0}:
            self.pose[thing] = self.pose[thing] + [0.002 * self.x, 0.001, 0, 0, 0, 0, 0]
        told, self.mine_to_tell = self.mine_to_tell, set()
        self.replicator.send(
            now, self.robot, touched=there, moving=there, read=self.read, grabbed=told, detached=told & self.picked,
            pose_on_support=lambda thing: ("", self.pose[thing]),
        )  # fmt: skip

    def read(self, thing: int) -> tuple[np.ndarray, np.ndarray]:
        if is_tree(thing):
            here = self.model.bodies_of(thing)
            return self.model.joint_settled[here], np.zeros((here.stop - here.start, 3))
        return self.pose[thing], np.zeros(6)

    def act(self, action: str, thing: int) -> None:
        if action == "let":
            self.touched.discard(thing)
            return
        if action == "grab":
            picks = thing not in (0, BOX(0)) and thing not in self.picked
            self.picked |= {thing} if picks else set()
            self.mine_to_tell.add(thing)
        self.touched.add(thing)


def run(hub: MemoryHub, server: Server, clients: dict[str, Least], seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        hub.advance(TICK)
        server.tick()
        for client in clients.values():
            client.tick()


actions = st.lists(
    st.tuples(
        st.sampled_from(NAMES), st.sampled_from(["touch", "touch", "let", "grab", "leave"]), st.sampled_from(THINGS),
        st.integers(1, 12),
    ),
    min_size=1, max_size=20,
)  # fmt: skip


def tell(story, seed: int, loss: float, start: Claim) -> tuple[MemoryHub, Server, dict[str, Least], set[int]]:
    hub = Echoing(delay=DELAY, jitter=JITTER, loss=loss, seed=seed)
    server = Server(hub)
    clients = {name: Least(hub, name, start) for name in NAMES}
    run(hub, server, clients, 0.5)
    picked: set[int] = set()
    for name, action, thing, ticks in story:
        if action == "leave":
            clients.pop(name).bus.close()
            run(hub, server, clients, 0.15)
            # it comes back and remembers nothing
            clients[name] = Least(hub, name, start)
            run(hub, server, clients, 0.4)
        else:
            clients[name].act(action, thing)
        run(hub, server, clients, ticks * TICK)
        picked |= clients[name].picked
    return hub, server, clients, picked


@given(actions, st.integers(0, 2**31), st.sampled_from([Claim(), Claim(65534, 65533), Claim(65535, 65535)]))
@settings(max_examples=30, deadline=None)
def test_once_all_have_let_go_everything_lies_where_everybody_says_within_a_round_trip(story, seed, start):
    hub, server, clients, picked = tell(story, seed, 0.0, start)
    for client in clients.values():
        client.touched.clear()
    run(hub, server, clients, RTT + 2 * TICK)
    for thing in THINGS:
        owners = {client.replicator.owner(thing) for client in clients.values()}
        assert owners == {None}, [client.replicator.claim(thing) for client in clients.values()]
        records = {client.replicator.record(thing) for client in clients.values()}
        assert records == {server.records.get(thing)}
    for client in clients.values():
        # nothing picked hangs again, nothing is picked for some only
        assert client.picked - {BOX(0)} == picked - {BOX(0)}
        for thing in client.picked:
            np.testing.assert_array_equal(client.pose[thing], clients["ada"].pose[thing])


@given(actions, st.integers(0, 2**31), st.sampled_from([0.02, 0.3]))
@settings(max_examples=15, deadline=None)
def test_with_losses_one_heartbeat_later_there_is_one_owner_who_touches(story, seed, loss):
    hub, server, clients, _ = tell(story, seed, loss, Claim())
    hub.loss = 0.0
    run(hub, server, clients, 1.5)
    for thing in THINGS:
        owners = {client.replicator.owner(thing) for client in clients.values()}
        assert len(owners) == 1, [client.replicator.claim(thing) for client in clients.values()]
        touching = {
            c.name for c in clients.values() if thing in c.touched and (thing in c.picked or thing in (0, BOX(0)))
        }
        assert owners <= (touching or {None})
        where = [client.pose[thing] for client in clients.values() if thing in client.picked]
        for pose in where[1:]:
            assert np.linalg.norm(pose[:3] - where[0][:3]) < 0.05


@pytest.mark.parametrize("start", [Claim(), Claim(65535, 65535)])
@pytest.mark.parametrize("order", [("ada", "bob"), ("bob", "ada")])
def test_of_two_that_grab_in_the_same_tick_the_lower_name_has_it(start, order):
    _, _, clients, _ = tell([(name, "grab", BUNCH(0), 15 * i) for i, name in enumerate(order)], 1, 0.0, start)
    assert {client.replicator.owner(BUNCH(0)) for client in clients.values()} == {"ada"}
    assert {client.replicator.claim(BUNCH(0)).ownership for client in clients.values()} == {
        (start.ownership + 1) % 65536
    }
