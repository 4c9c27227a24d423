"""Ownership of trees, boxes and bunches: any actions of three clients on any network end with one owner."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.examples import share
from tests.support.shared_vineyard import BOX, BUNCH, Server, vineyard
from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import is_tree
from vinesim.scene.values import RobotUpdate

pytestmark = pytest.mark.slow

TICK = 0.01
DELAY = 0.03
JITTER = 0.02
RTT = 2.0 * (DELAY + JITTER)
OBJECTS = (0, BOX(0), BUNCH(0), BUNCH(1))
NAMES = ("ada", "bob", "cleo")


class DuplicatingHub(MemoryHub):
    """A network that duplicates some unreliable samples."""

    def send(self, sender: str, key: str, payload: bytes, reliable: bool) -> None:
        super().send(sender, key, payload, reliable)
        if not reliable and self._random.random() < 0.1:
            super().send(sender, key, payload, reliable)


class MinimalClient:
    """A minimal client with rigid objects: it moves what it touches, in a direction of its own."""

    def __init__(self, hub: MemoryHub, name: str, start: Claim) -> None:
        self.hub = hub
        self.name = name
        self.model = vineyard()
        self.bus = hub.bus(name)
        self.replicator = Replicator(self.bus, Hello(name, scene="rows", digest="same", joints=0), self.model)
        for object_id in OBJECTS:
            self.replicator._state.ownership[object_id].claim = start
        self.x = -1.5 + NAMES.index(name)
        self.robot = RobotUpdate(name, 0.0, frames.pose([self.x, 0.0, 0.0]), np.zeros(6), np.zeros(0), np.zeros(0))
        self.touched: set[int] = set()
        self.picked: set[int] = set()
        self.pose = {object_id: frames.pose([-1.0, 0.0, 0.1]) for object_id in OBJECTS if not is_tree(object_id)}
        self.newly_grabbed: set[int] = set()

    def tick(self) -> None:
        now = self.hub.time
        inbox = self.replicator.receive(now)
        for record, is_newest in inbox.records:
            if not is_tree(record.object):
                self.picked.add(record.object)
                if is_newest:
                    self.pose[record.object] = np.array(record.pose)
        for update in inbox.objects:
            self.picked.add(update.object)
            self.pose[update.object] = update.pose
        active = {object_id for object_id in self.touched if object_id in self.picked or object_id in (0, BOX(0))}
        for object_id in active - {0}:
            self.pose[object_id] = self.pose[object_id] + [0.002 * self.x, 0.001, 0, 0, 0, 0, 0]
        grabbed = self.newly_grabbed
        self.newly_grabbed = set()
        self.replicator.send(
            now,
            self.robot,
            touched=active,
            moving=active,
            read=self.read,
            grabbed=grabbed,
            detached=grabbed & self.picked,
            pose_on_support=lambda object_id: ("", self.pose[object_id]),
        )

    def read(self, object_id: int) -> tuple[np.ndarray, np.ndarray]:
        if is_tree(object_id):
            bodies = self.model.bodies_of(object_id)
            return self.model.joint_settled[bodies], np.zeros((bodies.stop - bodies.start, 3))
        return self.pose[object_id], np.zeros(6)

    def apply_action(self, action: str, object_id: int) -> None:
        if action == "let":
            self.touched.discard(object_id)
            return
        if action == "grab":
            picks = object_id not in (0, BOX(0)) and object_id not in self.picked
            self.picked |= {object_id} if picks else set()
            self.newly_grabbed.add(object_id)
        self.touched.add(object_id)


def run(hub: MemoryHub, server: Server, clients: dict[str, MinimalClient], seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        hub.advance(TICK)
        server.tick()
        for client in clients.values():
            client.tick()


actions = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.sampled_from(["touch", "touch", "let", "grab", "leave"]),
        st.sampled_from(OBJECTS),
        st.integers(1, 12),
    ),
    min_size=1,
    max_size=20,
)


def play(
    scenario, seed: int, loss: float, start: Claim
) -> tuple[MemoryHub, Server, dict[str, MinimalClient], set[int]]:
    hub = DuplicatingHub(delay=DELAY, jitter=JITTER, loss=loss, seed=seed)
    server = Server(hub)
    clients = {name: MinimalClient(hub, name, start) for name in NAMES}
    run(hub, server, clients, 0.5)
    picked: set[int] = set()
    for name, action, object_id, ticks in scenario:
        if action == "leave":
            clients.pop(name).bus.close()
            run(hub, server, clients, 0.15)
            # it rejoins without its earlier state
            clients[name] = MinimalClient(hub, name, start)
            run(hub, server, clients, 0.4)
        else:
            clients[name].apply_action(action, object_id)
        run(hub, server, clients, ticks * TICK)
        picked |= clients[name].picked
    return hub, server, clients, picked


@given(actions, st.integers(0, 2**31), st.sampled_from([Claim(), Claim(65534, 65533), Claim(65535, 65535)]))
@settings(max_examples=share(0.2))
def test_after_all_release_all_agree_within_a_round_trip(scenario, seed, start):
    hub, server, clients, picked = play(scenario, seed, 0.0, start)
    for client in clients.values():
        client.touched.clear()
    run(hub, server, clients, RTT + 2 * TICK)
    for object_id in OBJECTS:
        owners = {client.replicator.owner(object_id) for client in clients.values()}
        assert owners == {None}, [client.replicator.claim(object_id) for client in clients.values()]
        records = {client.replicator.record(object_id) for client in clients.values()}
        assert records == {server.records.get(object_id)}
    for client in clients.values():
        # picked bunches stay picked, on all clients
        assert client.picked - {BOX(0)} == picked - {BOX(0)}
        for object_id in client.picked:
            np.testing.assert_array_equal(client.pose[object_id], clients["ada"].pose[object_id])


@given(actions, st.integers(0, 2**31), st.sampled_from([0.02, 0.3]))
@settings(max_examples=share(0.2))
def test_after_losses_one_heartbeat_restores_one_owner_among_those_that_touch(scenario, seed, loss):
    hub, server, clients, _ = play(scenario, seed, loss, Claim())
    hub.loss = 0.0
    run(hub, server, clients, 1.5)
    for object_id in OBJECTS:
        owners = {client.replicator.owner(object_id) for client in clients.values()}
        assert len(owners) == 1, [client.replicator.claim(object_id) for client in clients.values()]
        touching = {
            c.name
            for c in clients.values()
            if object_id in c.touched and (object_id in c.picked or object_id in (0, BOX(0)))
        }
        assert owners <= (touching or {None})
        poses = [client.pose[object_id] for client in clients.values() if object_id in client.picked]
        for pose in poses[1:]:
            assert np.linalg.norm(pose[:3] - poses[0][:3]) < 0.05


@pytest.mark.parametrize("start", [Claim(), Claim(65535, 65535)])
@pytest.mark.parametrize("order", [("ada", "bob"), ("bob", "ada")])
def test_of_two_that_grab_in_the_same_tick_the_lower_name_owns(start, order):
    _, _, clients, _ = play([(name, "grab", BUNCH(0), 15 * i) for i, name in enumerate(order)], 1, 0.0, start)
    assert {client.replicator.owner(BUNCH(0)) for client in clients.values()} == {"ada"}
    assert {client.replicator.claim(BUNCH(0)).ownership for client in clients.values()} == {
        (start.ownership + 1) % 65536
    }
