"""Malformed messages: nothing stops, all are counted, and afterwards all clients agree as before."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
import time

import numpy as np
import pytest
import zenoh

from benchmarks import message_fuzz
from benchmarks.message_fuzz import ATTACKER, storm
from benchmarks.support.fake_client import FakeClient, FakeClientProcess, tree_row
from tests.support import programs
from tests.support.live_server import ServerProcess, wait
from tests.support.long_rows import long
from tests.support.waiting import deadline
from vinesim.client.client import Client
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.codec.control import encode_claims
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.objects import check_object_id
from vinesim.net.codec.robot import encode_robot
from vinesim.net.codec.trees import TOUCHED, TreeStates, encode_trees
from vinesim.net.replication import dead_reckoning, interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.receiver import check_record
from vinesim.net.replication.streams import object_counts
from vinesim.net.server.server import Server
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import close_session, config, open_session
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.spec import load_scene
from vinesim.scene.values import RobotUpdate


@pytest.mark.parametrize("kind", ["human", *long("robot")])
def test_a_flood_of_malformed_messages_is_counted_logged_once_and_leaves_all_in_agreement(caplog, kind):
    """Three thousand here; ``python -m benchmarks fuzz`` sends a hundred thousand."""
    result = message_fuzz.run_storm(3_000, seed=11, kind=kind)
    ada, bob = result.clients
    log_lines = [
        record.message for record in caplog.records if ATTACKER in record.message and "dropped" in record.message
    ]
    assert len(log_lines) == 2, "once by each of the two receivers"
    counters = ada.replicator.counters
    assert result.arrived > 1_500
    assert counters.malformed > 0.3 * result.arrived
    assert counters.retained.messages_in > 200
    for fake_client in (ada, bob):
        for tree in (1, 2):
            assert fake_client.replicator.owner(tree) == "ada"
        _assert_possible(fake_client)
    assert bob.heard[2] > 0.0


def test_a_flood_from_a_stranger_changes_nothing():
    """A program that was never admitted, under its own and other names."""
    ada, bob = message_fuzz.run_storm(3_000, seed=12, is_stranger=True).clients
    counters = ada.replicator.counters
    assert counters.retained.messages_in > 200
    assert counters.dropped > 1_000
    for fake_client in (ada, bob):
        assert fake_client.replicator.known == {1, 2}, "what ada touched, and nothing else"
        assert fake_client.facts == {}
        assert set(fake_client.robots) == {"ada", "bob"} - {fake_client.name}
        assert fake_client.replicator.owner(1) == fake_client.replicator.owner(2) == "ada"


def _assert_possible(fake_client: FakeClient) -> None:
    """Nothing is believed that the model forbids."""
    replicator = fake_client.replicator
    model = fake_client.model
    counts = object_counts(model)
    for number in replicator.known:
        check_object_id(number, counts)
    records = [record for record in map(replicator.record, sorted(fake_client.facts)) if record is not None]
    assert records
    for record in records:
        check_record(record, model, counts)
    for update in fake_client.robots.values():
        assert np.isfinite(update.base_q).all()
        if isinstance(update, RobotUpdate):
            assert np.isfinite(np.concatenate([update.base_qd, update.position, update.velocity])).all()


def test_a_message_from_the_far_future_does_not_block_its_sender():
    """A time of 1e300 once made every later update of that tree or pose of that actor outdated."""
    hub = MemoryHub()
    model = tree_row()
    ada, bob = (FakeClient(hub.bus(name), model, (x, 0.0)) for name, x in (("ada", 1.0), ("bob", 2.0)))

    def run(seconds: float) -> None:
        for _ in range(round(100 * seconds)):
            hub.advance(0.01)
            ada.tick(hub.time)
            bob.tick(hub.time)

    run(0.5)
    ada.touching = {0}
    run(0.5)
    bus = ada.replicator.bus
    pose = ada.pose(hub.time)
    bus.publisher("a/ada").put(encode_robot(type(pose)(**_fields(pose) | {"time": 1e300})))
    q, qd = ada.read(0)
    claim = ada.replicator.claim(0)
    header = np.array([0]), np.array([claim.ownership]), np.array([claim.authority]), np.array([TOUCHED])
    invalid = TreeStates(1e300, *header, np.array([len(q)]), q, qd)
    bus.publisher("tree/0/0/ada").put(encode_trees(invalid)[0][0])
    hub.advance(0.01)
    bob.tick(hub.time)
    ada.place[0] = 1.5
    run(dead_reckoning.MAX_CLOCK_SKEW + 0.5)
    assert bob.robots["ada"].base_q[0] > 1.49
    before = bob.heard[0]
    run(0.3)
    assert bob.heard[0] > before


def _fields(value: object) -> dict:
    return {name: getattr(value, name) for name in value.__slots__}  # type: ignore[attr-defined]


def robot_client(hub: MemoryHub, now: list[float]) -> tuple[Client, np.ndarray]:
    """A client in the demo scene whose clock reads ``now[0]`` [s], and the pose at which its robot starts."""
    scene = load_scene("demo")
    pose = spawn_pose(scene, 0)
    client = Client(
        scene, generate(scene), load_robot("vinebot"), hub.bus("ada"), name="ada", pose=pose, clock=lambda: now[0]
    )
    return client, pose


@pytest.mark.parametrize("kind", ["human", *long("robot")])
def test_a_client_with_physics_survives_malformed_messages(kind):
    """Valid messages may still be absurd (trees turned inside out, boxes in the sky): the state stays finite."""
    hub = MemoryHub()
    now = [10.0]
    client, pose = robot_client(hub, now)
    model = client.model
    attacker = FakeClient(
        hub.bus(ATTACKER), model, (float(pose[0]) + 0.7, float(pose[1])), digest=model.digest(), kind=kind
    )

    def tick() -> None:
        hub.advance(0.01)
        now[0] += 0.01
        client.tick()

    for _ in range(60):
        tick()
        attacker.tick(now[0])
    assert ATTACKER in client.replicator.peers
    malformed = storm(model, attacker, 3, now[0])
    publishers: dict = {}
    for _ in range(60):
        for key, payload in itertools.islice(malformed, 20):
            publishers.setdefault(key, attacker.bus.publisher(key, reliable=True)).put(payload)
        tick()
    attacker.bus.close()
    for _ in range(40):
        tick()
    state = client.physics.state
    assert np.isfinite(state.joint_q).all()
    assert np.isfinite(state.joint_qd).all()
    base, _ = client.physics.rigid.base_state("ada")
    assert np.linalg.norm(base[:3] - pose[:3]) < 0.5
    assert client.replicator.counters.malformed > 100
    assert (client.replicator.counters.wrenches_limited > 0) == (kind == "human")
    assert client.replicator.peers == {}


@pytest.mark.long
def test_jumps_of_a_remote_person_do_not_push_a_robot_on_its_wheels():
    """Poses of human size that jump in and about the robot, and corrupted ones of a seed that once pushed it 9 m."""
    hub = MemoryHub()
    now = [10.0]
    client, pose = robot_client(hub, now)
    attacker = FakeClient(
        hub.bus(ATTACKER),
        client.model,
        (float(pose[0]) + 0.7, float(pose[1])),
        digest=client.model.digest(),
        kind="human",
    )

    def tick() -> float:
        hub.advance(0.01)
        now[0] += 0.01
        client.tick()
        return float(np.linalg.norm(client.physics.rigid.base_state("ada")[0][:3] - pose[:3]))

    for _ in range(60):
        tick()
        attacker.tick(now[0])
    assert ATTACKER in client.remote_actors
    chance = np.random.default_rng(5)
    publisher = attacker.bus.publisher(f"a/{ATTACKER}")
    moved = []
    arrived = client.replicator.counters.actor.messages_in
    for _ in range(120):
        update = attacker.pose(now[0])
        points = update.pose.points.copy()
        points[:, :2] += pose[:2] - points[4, :2] + chance.uniform(-0.8, 0.8, 2)
        publisher.put(encode_pose(dataclasses.replace(update, pose=update.pose.with_points(points))))
        moved.append(tick())
    assert client.replicator.counters.actor.messages_in > arrived + 60
    malformed = storm(client.model, attacker, 11, now[0])
    for _ in range(60):
        for key, payload in itertools.islice(malformed, 20):
            attacker.bus.publisher(key, reliable=True).put(payload)
        moved.append(tick())
    assert max(moved) < 0.03


def test_a_hanging_bunch_that_is_claimed_by_an_actor_who_leaves_goes_on_hanging():
    """Its claim passes to the nearest actor, in whose simulation the bunch is part of its tree."""
    hub = MemoryHub()
    now = [10.0]
    client, pose = robot_client(hub, now)
    model = client.model
    other = FakeClient(hub.bus("bob"), model, (float(pose[0]) + 1.0, float(pose[1])), digest=model.digest())

    def tick() -> None:
        hub.advance(0.01)
        now[0] += 0.01
        client.tick()
        other.tick(now[0])

    for _ in range(60):
        tick()
    bunch = object_id(ObjectKind.BUNCH, 5)
    x, y = interest.cell_of(pose[:3])
    claims = encode_claims([(bunch, Claim(1, 1, "bob"), True)])
    assert other.bus.publisher(f"own/{x}/{y}/bob", reliable=True).put(claims)
    tick()
    assert client.replicator.owner(bunch) == "bob"
    other.bus.close()
    for _ in range(20):
        hub.advance(0.01)
        now[0] += 0.01
        client.tick()
    assert client.replicator.owner(bunch) is None
    assert client.replicator.record(bunch) is None
    assert client.physics.state.bunch_attached[5]


def test_zenoh_sessions_and_the_server_survive_malformed_messages():
    with (
        ServerProcess("tcp/127.0.0.1:0") as server,
        FakeClientProcess(server.endpoint, [{"name": "ada", "place": [1.0, 0.0]}], start=programs.Popen) as ada,
    ):
        model = tree_row()
        with ZenohBus(ATTACKER, connect=server.endpoint) as bus:
            attacker = FakeClient(bus, model, (2.0, 0.0))

            def joined() -> bool:
                attacker.tick(time.monotonic())
                return ATTACKER in ada.command()["others"] and "ada" in attacker.robots

            wait(joined, "the two to join")
            before = ada.command()["counters"]
            ticks = ada.command()["ticks"]
            publishers: dict = {}
            for number, (key, payload) in enumerate(itertools.islice(storm(model, attacker, 7), 1_500)):
                publisher = publishers.get(key) or publishers.setdefault(key, bus.publisher(key, reliable=True))
                publisher.put(payload)
                if number % 20 == 0:
                    bus.query(f"clock/{bus.name}", payload)
                    time.sleep(0.005)
            wait(
                lambda: ada.command()["counters"]["malformed"] > before["malformed"] + 100,
                "the malformed ones to be counted",
            )
            assert ada.command()["ticks"] > ticks
        wait(lambda: ATTACKER in ada.command()["left_at"], "the attacker to leave")
        with FakeClientProcess(server.endpoint, [{"name": "bob", "place": [2.0, 0.0]}], start=programs.Popen) as bob:
            wait(lambda: "ada" in bob.command()["poses"], "another client to be admitted")
            ada.command(touch=[3])
            wait(lambda: bob.command()["owner"].get("3") == "ada", "the stream to continue")
        assert server.process.poll() is None


def test_no_message_without_a_session_that_joined_is_believed():
    """A program that uses Zenoh alone puts all kinds of messages under the names of others and its own, without TLS.

    Its puts say no source, unlike those of actors. Zenoh itself drops what it cannot send at once unless told to wait.
    """
    model = tree_row()
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as bus:
        ada = FakeClient(bus, model, (1.0, 0.0))
        wait(lambda: ada.tick(time.monotonic()) or bus.admissions > 0, "the actor to be admitted")
        raw = open_session(config("client", connect__endpoints=[server.endpoint]))
        names = ["ada", "bob", ATTACKER]
        for number, (key, payload) in enumerate(
            itertools.islice(storm(model, ada, 7, names=names, pool_size=200), 1_500)
        ):
            raw.put(f"vs/1/vineyard/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)
            if number % 50 == 0:
                ada.tick(time.monotonic())
        raw.put("vs/1/vineyard/fact/0/0/last", b"")
        wait(lambda: "vineyard/fact/0/0/last" in server._warned, "the last message to be refused")
        close_session(raw)
        counters = ada.replicator.counters
        # how many of them the server can hand on at once depends on the machine: it drops what a client does not take
        wait(lambda: ada.tick(time.monotonic()) or counters.foreign > 0, "the client to refuse them")
        families = counters.actor, counters.environment, counters.event, counters.retained, counters.force
        assert [family.messages_in for family in families] == [0] * 5
        assert server.foreign > 150
        assert server.figures()["facts_heard"] == server.figures()["facts"] == 0
        assert ada.replicator.peers == {}
        assert ada.replicator.known == frozenset()
        pings = server.pings
        wait(lambda: ada.tick(time.monotonic()) or server.pings > pings, "the server to go on answering")
        assert server.actors == ["vineyard/ada"]


def test_bytes_of_other_protocols_do_not_stop_the_server():
    """Bytes of a port scanner or a web browser."""
    code = """
import os, socket, sys
for say in (b"GET / HTTP/1.1\\r\\n\\r\\n", os.urandom(4000), b"", b"\\xff" * 70000):
    with socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=120.0) as s:
        try:
            s.sendall(say)
        except OSError:
            pass
"""
    with ServerProcess("tcp/127.0.0.1:0") as server:
        host, port = server.endpoint.removeprefix("tcp/").split(":")
        subprocess.run([sys.executable, "-c", code, host, port], check=True, timeout=deadline(300.0))
        with FakeClientProcess(server.endpoint, [{"name": "ada", "place": [1.0, 0.0]}], start=programs.Popen) as ada:
            assert ada.command()["trouble"] == ""
