"""The replicator over a bus in memory: interest, ownership and traffic, with delay, jitter and loss."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.examples import share
from vinesim.core import frames
from vinesim.net.codec import control
from vinesim.net.codec.control import HELLO, Hello, decode_time, encode_claims, encode_hello, encode_time
from vinesim.net.codec.header import PROTOCOL
from vinesim.net.replication import dead_reckoning, interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.peers import WorldMismatch
from vinesim.net.replication.receiver import Inbox
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.memory_bus import MemoryBus, MemoryHub
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import RobotUpdate, TreeUpdate

pytestmark = pytest.mark.slow

TICK = 0.01
TREES = 12
"""One tree a metre, from x = 0.5 m on."""


@functools.cache
def vineyard() -> Model:
    trees = []
    for number in range(TREES):
        tree = TreeBuilder(frames.pose(np.array([number + 0.5, 0.0, 1.5])))
        tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)
        trees.append(tree)
    return assemble(trees)


class Client:
    """A minimal client: a robot at ``x`` that touches trees and applies the updates it receives."""

    def __init__(self, hub: MemoryHub, name: str, x: float, *, digest: str = "same", **hello) -> None:
        self.hub = hub
        self.name = name
        self.model = vineyard()
        self.bus: MemoryBus = hub.bus(name)
        self.replicator = Replicator(self.bus, Hello(name, scene="rows", digest=digest, joints=2, **hello), self.model)
        self.state = State.at_rest(self.model)
        self.robot = RobotUpdate(
            name, 0.0, frames.pose(np.array([x, 0.0, 0.0])), np.zeros(6), np.array([0.1, -0.2]), np.zeros(2)
        )
        self.touched: set[int] = set()
        self.swinging: set[int] = set()
        self.grabbed: set[int] = set()
        self.inbox = Inbox()
        self.received: list[TreeUpdate] = []
        self.released: list[int] = []
        self.joined: list[str] = []
        self.left: list[str] = []
        self.reads = 0

    def tick(self) -> None:
        now = self.hub.time
        self.inbox = inbox = self.replicator.receive(now)
        self.received += inbox.trees
        self.released += inbox.released
        self.joined += [hello.name for hello in inbox.joined]
        self.left += inbox.left
        for update in inbox.trees:
            bodies = self.model.bodies_of(update.tree)
            self.state.joint_q[bodies], self.state.joint_qd[bodies] = update.joint_q, update.joint_qd
        self.left_records = self.replicator.send(
            now, self.robot, touched=self.touched, moving=self.swinging, read=self.read, grabbed=self.grabbed
        )
        self.grabbed = set()

    def read(self, tree: int) -> tuple[np.ndarray, np.ndarray]:
        self.reads += 1
        bodies = self.model.bodies_of(tree)
        return self.state.joint_q[bodies], self.state.joint_qd[bodies]

    def bend(self, tree: int, angle: float, rate: float = 0.0) -> None:
        bodies = self.model.bodies_of(tree)
        turn = frames.exp(np.array([0.0, angle, 0.0]))
        self.state.joint_q[bodies] = frames.multiply(turn, self.model.joint_settled[bodies])
        self.state.joint_qd[bodies] = (0.0, rate, 0.0)

    def goto(self, x: float) -> None:
        self.robot = dataclasses.replace(self.robot, base_q=frames.pose(np.array([x, 0.0, 0.0])))

    def environment_bytes(self) -> int:
        counters = self.replicator.counters
        return sum(t.bytes_in + t.bytes_out for t in (counters.environment, counters.event))


def run(hub: MemoryHub, clients: list[Client], seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        hub.advance(TICK)
        for client in clients:
            client.tick()


def owners(clients: list[Client], tree: int) -> set[str | None]:
    return {client.replicator.owner(tree) for client in clients}


# ---------------------------------------------------------------- joining and leaving


def test_actors_join_receive_poses_and_leave():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0, urdf="<robot/>", index=4)
    run(hub, [ada, bob], 0.5)
    assert (ada.joined, bob.joined) == (["bob"], ["ada"])
    assert ada.replicator.peers["bob"].urdf == ""
    assert ada.replicator.peers["bob"].robot_digest
    assert ada.replicator.peers["bob"].index == 4
    pose = ada.inbox.robots["bob"]
    np.testing.assert_allclose(pose.base_q, bob.robot.base_q, atol=1e-4)
    np.testing.assert_allclose(pose.position, [0.1, -0.2], atol=1e-4)
    assert pose.time == pytest.approx(hub.time)
    bob.bus.close()
    run(hub, [ada], 0.1)
    assert ada.left == ["bob"]
    assert ada.inbox.robots == {}


@pytest.mark.parametrize(("x", "low", "high"), [(3.0, 58, 61.5), (5.0, 29, 31.5), (10.0, 14, 16.5), (20.0, 4.5, 6)])
def test_poses_arrive_at_a_rate_that_falls_with_the_distance(x, low, high):
    """60, 30, 15 and 5 Hz at 2, 4, 9 and 19 m; none arrives twice, but a coarse pose every 2 s."""
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", x)
    run(hub, [ada, bob], 1.0)
    before = ada.replicator.counters.actor.messages_in
    run(hub, [ada, bob], 2.0)
    assert low <= (ada.replicator.counters.actor.messages_in - before) / 2 <= high


def test_a_driving_robot_is_extrapolated_to_the_current_time():
    hub = MemoryHub(delay=0.08)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    bob.robot = dataclasses.replace(bob.robot, base_qd=np.array([1.0, 0, 0, 0, 0, 0.5]), velocity=np.array([0.3, 0.0]))
    for _ in range(100):
        t = hub.time + TICK
        bob.robot = dataclasses.replace(
            bob.robot,
            base_q=frames.pose(np.array([2.0 + t, 0, 0]), frames.from_yaw(0.5 * t)),
            position=np.array([0.1 + 0.3 * t, -0.2]),
        )
        run(hub, [ada, bob], TICK)
    pose = ada.inbox.robots["bob"]
    np.testing.assert_allclose(pose.base_q, bob.robot.base_q, atol=2e-3)
    np.testing.assert_allclose(pose.position, bob.robot.position, atol=2e-3)
    np.testing.assert_allclose(pose.base_qd, bob.robot.base_qd, atol=1e-3)
    hub.down = True
    poses = []
    for _ in range(60):
        hub.advance(TICK)
        poses.append(ada.replicator._state.peers.known["bob"].sample(hub.time, hub.time))
    assert poses[-1].base_q[0] == pytest.approx(poses[-20].base_q[0], abs=1e-9)
    assert not poses[-1].base_qd.any()
    assert not poses[-1].velocity.any()


def test_a_pose_correction_is_blended_and_its_velocity_applied_at_once():
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.5)
    bob.goto(2.5)
    bob.robot = dataclasses.replace(bob.robot, base_qd=np.array([0.2, 0, 0, 0, 0, 0]))
    shown = []
    for _ in range(20):
        run(hub, [bob, ada], TICK)
        bob.goto(2.5 + 0.2 * TICK * (len(shown) + 1))
        shown.append((ada.inbox.robots["bob"].base_q[0], ada.inbox.robots["bob"].base_qd[0]))
    x = np.array(shown)
    received = int(np.argmax(x[:, 1] > 0.1))
    assert x[received, 0] < 2.2
    assert np.abs(np.diff(x[:, 0])).max() < 0.15
    assert x[-1, 0] == pytest.approx(2.5 + 0.2 * 20 * TICK, abs=0.02)


@pytest.mark.parametrize("change", ["digest", "protocol"])
def test_another_scene_or_protocol_is_refused_with_both_values(change):
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    run(hub, [ada], 0.1)
    cy = Client(hub, "cy", 2.0, **({"digest": "other"} if change == "digest" else {"protocol": PROTOCOL + 1}))
    expected = "'same'.*'other'|'other'.*'same'" if change == "digest" else "version"
    if change == "digest":
        with pytest.raises(WorldMismatch, match=expected):
            run(hub, [cy], 0.2)
    run(hub, [ada], 0.2)
    assert ada.joined == []
    assert ada.inbox.robots == {}


def test_a_protocol_mismatch_names_both_versions():
    hub = MemoryHub()
    old = hub.bus("old")
    hello = Hello("old", digest="same", protocol=PROTOCOL + 1)
    old.declare_queryable("hello/old", lambda _: control.pack(HELLO, hello))
    new = Client(hub, "new", 1.0)
    with pytest.raises(WorldMismatch, match=f"version {PROTOCOL + 1}, 'new' version {PROTOCOL}"):
        run(hub, [new], 0.2)


# ---------------------------------------------------------------- interest


def test_far_from_all_peers_no_environment_byte_is_sent():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 60.0)
    cleo = Client(hub, "cleo", -40.0)
    run(hub, [ada, bob, cleo], 1.0)
    ada.touched = {0, 1}
    for k in range(200):
        ada.bend(0, 0.3 * np.sin(0.2 * k), 6.0 * np.cos(0.2 * k))
        run(hub, [ada, bob, cleo], TICK)
    ada.touched = set()
    ada.swinging = {0}
    run(hub, [ada, bob, cleo], 0.5)
    ada.swinging = set()
    run(hub, [ada, bob, cleo], 0.5)
    assert ada.replicator.owner(0) is None
    assert [c.environment_bytes() for c in (ada, bob, cleo)] == [0, 0, 0]
    assert ada.reads == 0


def test_within_the_cell_window_but_beyond_the_radius_no_byte_is_sent():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 7.5)
    run(hub, [ada, bob], 1.0)
    ada.touched = {0}
    run(hub, [ada, bob], 1.0)
    assert ada.replicator._state.cells.publishers[(0, 0)][0].matching
    assert ada.environment_bytes() == 0


def test_only_trees_near_a_peer_are_sent():
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 7.0)
    run(hub, [ada, bob], 0.5)
    ada.touched = {0, 3}
    run(hub, [ada, bob], 1.5)
    assert {update.tree for update in bob.received} == {3}
    assert ada.replicator.counters.environment.bytes_out == bob.replicator.counters.environment.bytes_in
    assert bob.replicator.claim(0) == Claim()
    assert ada.replicator.counters.environment.bytes_out == 2 * (14 + 13 + 6 * 9)


def test_tree_state_arrives_within_quantisation():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 3.0)
    run(hub, [ada, bob], 0.5)
    ada.touched = {0, 2}
    ada.bend(0, 0.4)
    ada.bend(2, -0.7)
    run(hub, [ada, bob], 0.1)
    assert owners([ada, bob], 0) == owners([ada, bob], 2) == {"ada"}
    for tree in (0, 2):
        bodies = ada.model.bodies_of(tree)
        error = dead_reckoning.angle_between(
            ada.state.joint_q[bodies].astype(float), bob.state.joint_q[bodies].astype(float)
        )
        assert error.max() < np.radians(0.02)
    assert {update.owner for update in bob.received} == {"ada"}


def test_a_steady_touch_sends_heartbeats_and_a_moving_one_when_extrapolation_fails():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 3.0)
    run(hub, [ada, bob], 0.5)
    ada.touched = {0}
    ada.bend(0, 0.2)
    run(hub, [ada, bob], 0.5)
    before = ada.replicator.counters.environment.messages_out
    run(hub, [ada, bob], 10.0)
    assert ada.replicator.counters.environment.messages_out - before == 10
    worst = 0.0
    bodies = ada.model.bodies_of(0)
    for k in range(300):
        t = k * TICK
        ada.bend(0, 0.2 + 0.1 * np.sin(3 * t), 0.3 * np.cos(3 * t))
        run(hub, [ada, bob], TICK)
        if k > 20:
            stream = ada.replicator._state.tree_stream
            silence = dead_reckoning.clamp_age(hub.time - ada.replicator._state.ownership[0].published_at)
            extrapolated = dead_reckoning.extrapolate(
                stream._published_q[-1, bodies], stream._published_rate[-1, bodies], silence
            )
            worst = max(
                worst, dead_reckoning.angle_between(ada.state.joint_q[bodies].astype(float), extrapolated).max()
            )
    moved = ada.replicator.counters.environment.messages_out - before - 10
    assert 20 < moved < 200
    assert worst <= dead_reckoning.ANGLE_ERROR


def test_copies_of_a_tree_are_as_wrong_as_their_distance_allows_and_rest_exactly():
    """The owner knows the copy of every peer to the bit; those beyond 3 m get fewer states, all the state of rest."""
    hub = MemoryHub(delay=0.02)
    ada, bob, cleo = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 2.0), Client(hub, "cleo", -3.6)]
    ada.touched = {0}
    run(hub, clients, 1.0)
    bodies = ada.model.bodies_of(0)
    worst = [0.0, 0.0]
    for k in range(300):
        ada.bend(0, 0.2 + 0.15 * np.sin(0.06 * k), 0.15 * 0.06 / TICK * np.cos(0.06 * k))
        run(hub, clients, TICK)
        stream = ada.replicator._state.tree_stream
        entry = ada.replicator._state.ownership[0]
        for layer, sent in enumerate((entry.published_to_all_at, entry.published_at)):
            position, _ = stream.prediction_error(layer, np.array([hub.time - sent]))
            worst[layer] = max(worst[layer], float(position[0]))
    for layer, (_, _, tolerance) in enumerate(interest.TREE_LAYERS):
        assert (
            0.2 * tolerance * dead_reckoning.POSITION_ERROR < worst[layer] <= tolerance * dead_reckoning.POSITION_ERROR
        )
    assert 10 < len(cleo.received) < 0.7 * len(bob.received)
    run(hub, clients, 0.2)
    for layer, peer in ((0, cleo), (1, bob)):
        there = peer.replicator._state.tree_stream
        np.testing.assert_array_equal(there._published_q[0, bodies], stream._published_q[layer, bodies])
    ada.touched = set()
    run(hub, clients, 0.2)
    assert bob.received[-1].resting
    assert cleo.received[-1].resting
    np.testing.assert_array_equal(bob.state.joint_q[bodies], cleo.state.joint_q[bodies])


def test_a_copy_that_received_more_states_than_its_distance_asks_for_is_no_more_wrong():
    """A peer beyond 3 m from a tree hears the states for those near it if its cell is close; when these leave, its
    copy is extrapolated from another state than the copies of the peers that did not hear them."""
    hub = MemoryHub(delay=0.02)
    ada, bob, cleo = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 2.0), Client(hub, "cleo", 4.6)]
    ada.touched = {0}
    run(hub, clients, 1.0)
    stream = ada.replicator._state.tree_stream
    entry = ada.replicator._state.ownership[0]
    # a twitch too small for those far away, with a rate that would carry it on, while the only one near it leaves
    bob.goto(60.0)
    run(hub, clients, TICK)
    ada.bend(0, 0.004, 2.0)
    run(hub, clients, TICK)
    assert entry.published_at > entry.published_to_all_at
    ada.bend(0, 0.0)
    worst = 0.0
    for _ in range(50):
        run(hub, clients, TICK)
        position, _ = stream.prediction_error(1, np.array([hub.time - entry.published_at]))
        worst = max(worst, float(position[0]))
    assert cleo.received[-1].tree == 0
    assert worst <= interest.TREE_LAYERS[0].tolerance * dead_reckoning.POSITION_ERROR


def test_trees_of_one_cell_share_a_message():
    hub = MemoryHub()
    ada = Client(hub, "ada", 2.0)
    bob = Client(hub, "bob", 3.0)
    run(hub, [ada, bob], 0.5)
    ada.touched = {0, 1}
    run(hub, [ada, bob], TICK)
    assert ada.replicator.counters.environment.messages_out == 1
    assert ada.replicator.counters.environment.bytes_out == 14 + 2 * (13 + 6 * 9)
    assert ada.replicator.counters.event.messages_out == 1


def test_a_peer_that_comes_near_receives_at_once_and_one_that_leaves_costs_nothing():
    hub = MemoryHub(delay=0.01)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 30.0)
    ada.touched = {0}
    run(hub, [ada, bob], 1.5)
    assert ada.environment_bytes() == 0
    bob.goto(3.0)
    run(hub, [ada, bob], 0.3)
    assert bob.replicator.owner(0) == "ada"
    assert {update.tree for update in bob.received} == {0}
    bob.goto(30.0)
    run(hub, [ada, bob], 0.5)
    before = ada.replicator.counters.environment.bytes_out
    run(hub, [ada, bob], 4.0)
    assert ada.replicator.counters.environment.bytes_out == before
    assert bob.replicator.owner(0) is None
    assert bob.released == [0]


def test_rest_is_sent_once_reliably_and_nothing_after_it():
    hub = MemoryHub(delay=0.02, jitter=0.02, loss=0.3, seed=1)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 3.0)
    run(hub, [ada, bob], 1.0)
    ada.touched = {0}
    ada.bend(0, 0.5)
    run(hub, [ada, bob], 0.5)
    ada.touched = set()
    ada.swinging = {0}
    ada.bend(0, 0.1, -0.5)
    run(hub, [ada, bob], 0.3)
    assert owners([ada, bob], 0) == {"ada"}
    ada.swinging = set()
    ada.bend(0, 0.0)
    run(hub, [ada], TICK)
    (rest,) = ada.left_records
    assert rest.resting
    run(hub, [ada, bob], 0.3)
    assert owners([ada, bob], 0) == {None}
    assert bob.released == [0]
    assert bob.received[-1].resting
    assert bob.received[-1].joint_q.tobytes() == rest.joint_q.tobytes()
    before = ada.environment_bytes()
    run(hub, [ada, bob], 3.0)
    assert ada.environment_bytes() == before


# ---------------------------------------------------------------- authority


def test_two_that_touch_agree_on_one_owner():
    hub = MemoryHub(delay=0.03)
    ada, bob, cleo = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 2.0), Client(hub, "cleo", 3.0)]
    run(hub, clients, 0.5)
    ada.touched = bob.touched = {1}
    run(hub, clients, 2 * 0.03 + 2 * TICK + TICK)
    assert owners(clients, 1) == {"ada"}
    claims = {client.replicator.claim(1) for client in clients}
    run(hub, clients, 2.0)
    # both keep pressing, and ownership does not alternate
    assert {client.replicator.claim(1) for client in clients} == claims
    ada.touched = set()
    ada.swinging = {1}
    run(hub, clients, 0.2)
    assert owners(clients, 1) == {"bob"}
    cleo.grabbed = {1}
    cleo.touched = {1}
    run(hub, clients, 0.1)
    assert owners(clients, 1) == {"cleo"}


def test_a_late_joiner_receives_the_current_claim_and_can_take_ownership():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.5)
    for _ in range(3):
        for client in (ada, bob):
            client.touched = {0}
            run(hub, [ada, bob], 0.1)
            client.touched = set()
            run(hub, [ada, bob], 0.1)
    assert ada.replicator.claim(0) == Claim(0, 6, "")
    cy = Client(hub, "cy", 2.5)
    run(hub, [ada, bob, cy], 0.5)
    cy.touched = {0}
    run(hub, [ada, bob, cy], 0.3)
    assert owners([ada, bob, cy], 0) == {"cy"}
    assert cy.replicator.claim(0) == Claim(0, 7, "cy")


def test_touches_without_peers_use_no_sequence_numbers():
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    for _ in range(5):
        ada.touched = {0}
        run(hub, [ada], 0.05)
        assert ada.replicator.owner(0) == "ada"
        ada.touched = set()
        run(hub, [ada], 0.05)
    assert ada.replicator.claim(0) == Claim()


def test_when_an_owner_leaves_the_nearest_takes_over():
    hub = MemoryHub(delay=0.02)
    ada, bob, cleo = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 4.0), Client(hub, "cleo", 2.0)]
    run(hub, clients, 0.5)
    ada.touched = {0}
    run(hub, clients, 0.3)
    assert owners(clients, 0) == {"ada"}
    ada.bus.close()
    bob.swinging = cleo.swinging = {0}
    run(hub, [bob, cleo], 0.1)
    assert owners([bob, cleo], 0) == {"cleo"}
    cleo.swinging = set()
    run(hub, [bob, cleo], 0.1)
    assert owners([bob, cleo], 0) == {None}


def test_an_owner_is_followed_again_after_a_long_loss_of_its_messages():
    hub = MemoryHub(delay=0.02)
    ada, bob = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 2.0)]
    run(hub, clients, 0.5)
    ada.touched = {0}
    run(hub, clients, 0.3)
    claim = ada.replicator.claim(0)
    hub.loss = 1.0
    run(hub, clients, 4.0)
    assert (bob.replicator.owner(0), bob.released) == (None, [0])
    hub.loss = 0.0
    run(hub, clients, 1.1)
    assert owners(clients, 0) == {"ada"}
    # bob published no claim: a silent owner does not mean that the tree is at rest
    assert ada.replicator.claim(0) == bob.replicator.claim(0) == claim


def test_a_restarted_owner_receives_the_current_sequence_numbers():
    hub = MemoryHub(delay=0.02)
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.5)
    for _ in range(4):
        ada.touched = {0}
        run(hub, [ada, bob], 0.1)
        ada.touched = set()
        run(hub, [ada, bob], 0.1)
    ada.touched = {0}
    run(hub, [ada, bob], 0.1)
    bob.goto(40.0)
    ada.bus.close()
    run(hub, [bob], 0.2)
    assert bob.replicator.claim(0).owner == "ada"
    assert bob.replicator.owner(0) is None
    bob.goto(2.0)
    again = Client(hub, "ada", 1.0)
    again.touched = {0}
    run(hub, [again, bob], 1.5)
    assert owners([again, bob], 0) == {"ada"}
    assert again.replicator.claim(0) == bob.replicator.claim(0)


def test_all_agree_again_after_a_server_outage():
    hub = MemoryHub(delay=0.02)
    ada, bob = clients = [Client(hub, "ada", 1.0), Client(hub, "bob", 2.0)]
    run(hub, clients, 0.5)
    ada.touched = {0}
    run(hub, clients, 0.3)
    hub.down = True
    run(hub, clients, 1.0)
    # without a server each client owns what it touches
    assert bob.left == ["ada"]
    bob.touched = {0}
    run(hub, clients, 0.5)
    assert (ada.replicator.owner(0), bob.replicator.owner(0)) == ("ada", "bob")
    hub.down = False
    run(hub, clients, 1.0)
    assert len(owners(clients, 0)) == 1
    assert owners(clients, 0) <= {"ada", "bob"}
    assert ada.joined == ["bob", "bob"]


actions = st.lists(
    st.tuples(
        st.sampled_from(["ada", "bob", "cleo"]),
        st.sampled_from(["touch", "let", "grab"]),
        st.integers(0, 2),
        st.integers(1, 12),
    ),
    min_size=1,
    max_size=25,
)


@settings(max_examples=share(0.3))
@given(actions, st.integers(0, 2**31), st.sampled_from([0.0, 0.02, 0.3]))
def test_any_sequence_of_actions_on_any_network_ends_with_one_owner(scenario, seed, loss):
    hub = MemoryHub(delay=0.03, jitter=0.02, loss=loss, seed=seed)
    clients = {name: Client(hub, name, x) for name, x in (("ada", 1.0), ("bob", 2.0), ("cleo", 3.0))}
    all_clients = list(clients.values())
    run(hub, all_clients, 0.5)
    for name, action, tree, ticks in scenario:
        client = clients[name]
        if action == "let":
            client.touched.discard(tree)
        else:
            client.touched.add(tree)
            client.grabbed |= {tree} if action == "grab" else set()
        run(hub, all_clients, ticks * TICK)
    # without further loss, one heartbeat repeats what was lost, and an outdated claim is corrected within 0.2 s
    hub.loss = 0.0
    run(hub, all_clients, 1.5)
    for tree in range(3):
        assert len(owners(all_clients, tree)) == 1, [client.replicator.claim(tree) for client in all_clients]
        touching = {client.name for client in all_clients if tree in client.touched}
        assert owners(all_clients, tree) <= (touching or {None})


# ---------------------------------------------------------------- invalid input


def test_malformed_messages_are_counted_logged_once_and_do_not_stop_the_tick(caplog):
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.3)
    publishers = [bob.bus.publisher(key, reliable=True) for key in ("a/bob", "c/0/0/bob", "own/0/0/bob")]
    for k in range(20):
        for publisher in publishers:
            publisher.put(b"VS\x01" + bytes([k]) + bytes(k))
        run(hub, [ada, bob], TICK)
    assert ada.replicator.counters.malformed == 60
    assert sum("bob" in record.message for record in caplog.records) == 1
    assert "bob" in ada.inbox.robots


def test_a_message_under_a_key_of_other_kinds_is_malformed():
    hub = MemoryHub()
    bob = Client(hub, "bob", 1.0)
    ada = Client(hub, "ada", 1.5)
    run(hub, [bob, ada], 1.0)
    claims = encode_claims([(3, Claim(1, 1, "ada"), True)])
    wrong = ("c/0/0/ada", "fact/0/0/ada", "force/bob/ada", "a/ada/far")
    for key in wrong:
        assert ada.bus.publisher(key).put(claims)
    run(hub, [bob, ada], 0.1)
    assert bob.replicator.counters.malformed == len(wrong)
    assert bob.replicator.claim(3) == Claim()


def test_an_unknown_peer_an_invalid_tree_and_a_repeated_message_are_ignored():
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.3)
    unknown = hub.bus("unknown")
    unknown.publisher("own/0/0/unknown", True).put(encode_claims([(0, Claim(5, 5, "unknown"), True)]))
    bob.bus.publisher("own/0/0/bob", True).put(encode_claims([(TREES, Claim(5, 5, "bob"), True)]))
    run(hub, [ada, bob], 0.2)
    assert ada.replicator.claim(0) == Claim()
    assert ada.replicator.counters.malformed == 1
    assert ada.replicator.counters.dropped >= 1
    bob.touched = {0}
    bob.bend(0, 0.3)
    eavesdropper = hub.bus("eavesdropper")
    eavesdropper.subscribe("tree/**", 100)
    run(hub, [ada, bob], 0.1)
    (key, recorded), *_ = eavesdropper.poll()
    bob.bend(0, -0.3)
    run(hub, [ada, bob], 0.1)
    held = ada.state.joint_q.copy()
    received = len(ada.received)
    bob.bus.publisher(key).put(recorded)
    run(hub, [ada, bob], 0.1)
    assert len(ada.received) == received
    np.testing.assert_array_equal(ada.state.joint_q, held)


def test_a_pose_with_another_number_of_joints_is_malformed():
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.3)
    bob.robot = dataclasses.replace(bob.robot, position=np.zeros(3), velocity=np.zeros(3))
    run(hub, [ada, bob], 0.1)
    assert ada.replicator.counters.malformed > 0
    assert len(ada.inbox.robots["bob"].position) == 2


def test_the_clock_offset_to_the_server_is_estimated():
    hub = MemoryHub(delay=0.02, jitter=0.01)
    server = hub.bus("server")
    server.declare_queryable("hello/server", lambda _: encode_hello(Hello("server", "spectator", digest="same")))
    server.declare_queryable("clock/*", lambda q: encode_time(decode_time(q)[0], hub.time + 1000.0))
    ada = Client(hub, "ada", 1.0)
    run(hub, [ada], 1.5)
    assert ada.replicator.offset == pytest.approx(1000.0, abs=0.012)


def test_the_actor_name_must_match_the_bus_and_the_radius_is_bounded():
    hub = MemoryHub()
    with pytest.raises(ValueError, match="one actor has one name"):
        Replicator(hub.bus("ada"), Hello("bob"), vineyard())
    with pytest.raises(ValueError, match=r"near = 9\.0 m"):
        Replicator(hub.bus("bob"), Hello("bob"), vineyard(), interest_radius=9.0)


def test_two_runs_are_identical():
    def scenario() -> bytes:
        hub = MemoryHub(delay=0.03, jitter=0.02, loss=0.1, seed=5)
        ada = Client(hub, "ada", 1.0)
        bob = Client(hub, "bob", 2.0)
        ada.touched = {0, 1}
        bob.touched = {1, 2}
        for k in range(100):
            ada.bend(0, 0.2 * np.sin(0.3 * k), 6.0 * np.cos(0.3 * k))
            run(hub, [ada, bob], TICK)
        return ada.state.joint_q.tobytes() + bob.state.joint_q.tobytes() + str(bob.replicator.counters).encode()

    assert scenario() == scenario()
