"""Replay of a recording: a viewer receives what was recorded, the same at each tick every time."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
import pytest

from tests.client.test_recorder import EPOCH, World
from tests.support.recorded_world import TICK, MinimalClient, vineyard
from vinesim.client.recording.replay import Replay, ReplayBus
from vinesim.net.codec.control import (
    RetainedRecord,
    decode_hello,
    decode_records,
    decode_time,
    encode_records,
    encode_time,
)
from vinesim.net.codec.header import kind_of
from vinesim.net.codec.messages import time_of
from vinesim.net.codec.trees import RESTING, TREES, TreeStates, decode_trees
from vinesim.net.recording.mcap_reader import Recording, read_recording
from vinesim.net.transport.bus import KEEP_ALL, NameTaken
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Recording:
    """Ada bends a tree beside Bob; after a second of rest Bob leaves, and 0.3 s later a bunch falls."""
    world = World(tmp_path_factory.mktemp("tape") / "run.mcap")
    world.run(1.0)
    world.touch()
    world.run(0.5)
    world.bob.bus.close()
    world.clients.remove(world.bob)
    world.run(0.3)
    record = RetainedRecord(object_id(ObjectKind.BUNCH, 4), 1, 0, "ada", pose=(1.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
    assert world.ada.bus.publisher("fact/0/0/ada", reliable=True).put(encode_records([record]))
    world.run(0.2)
    return world.recorded()


def watch(original: Recording, **span: float) -> tuple[MinimalClient, list[bytes], list[tuple]]:
    """A viewer beside the tree during a replay: the viewer, its states, and the updates it received, tick by tick."""
    bus = ReplayBus(original, "viewer", **span)
    viewer = MinimalClient(bus, 1.5, kind="spectator", joints=0)
    states = []
    updates = []
    while not bus.ended:
        bus.play(TICK)
        viewer.tick(bus.time)
        states.append(viewer.state.joint_q.tobytes() + viewer.state.joint_qd.tobytes())
        poses = {name: update.base_q.tobytes() for name, update in viewer.inbox.robots.items()}
        updates.append((poses, [(update.tree, update.joint_q.tobytes()) for update in viewer.inbox.trees]))
    return viewer, states, updates


def recorded_trees(original: Recording) -> list[TreeStates]:
    kinds = (
        entry.payload for entry in original.messages if entry.key in ("tree/0/0/ada", "near/0/0/ada", "own/0/0/ada")
    )
    return [decode_trees(payload) for payload in kinds if kind_of(payload) == TREES]


def test_a_viewer_receives_what_was_recorded(original):
    viewer, _, _ = watch(original)
    assert viewer.joined == ["ada", "bob"]
    assert viewer.bus.bytes_out == 0
    recorded = recorded_trees(original)
    rest = recorded[-1]
    assert rest.flags[0] == RESTING
    np.testing.assert_array_equal(viewer.received[-1].joint_q, rest.joint_q)
    np.testing.assert_array_equal(viewer.read(0)[0], rest.joint_q.astype(np.float32))
    # of all updates of a tick the last one is applied, in order; their rates are zero, so none is extrapolated
    position = 0
    for received in viewer.received:
        while not np.allclose(received.joint_q, recorded[position].joint_q, rtol=0.0, atol=1e-12):
            position += 1
    assert len(viewer.received) > 0.5 * len(recorded)


def test_two_replays_are_bitwise_equal(original):
    first = watch(original)
    second = watch(original)
    assert first[1] == second[1]
    assert first[2] == second[2]
    assert len(set(first[1])) > 50  # the tree moved


def test_actors_join_and_leave_as_recorded(original):
    bus = ReplayBus(original, "viewer")
    assert bus.alive() == {"viewer", "ada", "bob"}  # actors present at the start are alive at once
    alive = []
    while not bus.ended:
        bus.play(TICK)
        alive.append(bus.alive())
    assert alive[0] == {"viewer", "ada", "bob"}
    assert alive[-1] == {"viewer", "ada"}


def test_a_part_of_a_recording_is_replayed(original):
    start = original.length - 1.5
    bus = ReplayBus(original, "viewer", start=start, end=start + 0.5)
    bus.subscribe("pose/*/*/*", KEEP_ALL)
    assert bus.time == pytest.approx(original.start + start)
    bus.query("hello/bob")  # an actor that joined before is alive
    assert decode_hello(bus.replies()[0].payload).name == "bob"
    for _ in range(100):
        bus.play(TICK)
    assert bus.ended
    assert bus.time == pytest.approx(original.start + start + 0.5, abs=1e-6)  # no later than the end
    times = [time_of(payload) - original.start for _, payload in bus.poll()]
    assert start - 0.1 < min(times) < max(times) < start + 0.5


def test_queries_for_retained_records_are_answered(original):
    bus = ReplayBus(original, "viewer")
    before = object_id(ObjectKind.BUNCH, 3)
    later = object_id(ObjectKind.BUNCH, 4)

    def recorded_objects() -> set[int]:
        bus.query("snap/0/0")
        return {record.object for answer in bus.replies() for record in decode_records(answer.payload)}

    assert recorded_objects() == {before}
    while not bus.ended:
        bus.play(TICK)
    assert recorded_objects() == {before, later}
    bus.query("snap/9/9")
    (empty,) = bus.replies()
    assert (empty.key, decode_records(empty.payload)) == ("snap/9/9", [])
    bus.query("snap/*/*")
    assert {answer.key for answer in bus.replies()} == {"snap/0/0"}
    bus.query("snap/nonsense")
    assert bus.replies() == []


def test_a_recorded_actor_name_is_taken(original):
    with pytest.raises(NameTaken, match="bob"):
        ReplayBus(original, "bob")


def test_the_clock_is_that_of_the_recording(original):
    bus = ReplayBus(original, "viewer", start=0.5)
    bus.query("clock/viewer", encode_time(3.0))
    reply = decode_time(bus.replies()[0].payload)
    assert (reply.asked, reply.factor) == (3.0, 1.0)
    assert reply.world == pytest.approx(EPOCH + 0.6, abs=0.2)


class ReplayNetwork:
    """A network in memory to which a recording is replayed."""

    def __init__(self, original: Recording, **span: float) -> None:
        self.hub = MemoryHub(delay=0.004)
        server = self.hub.bus("server", live=False)
        server.declare_queryable("clock/*", lambda payload: encode_time(decode_time(payload)[0], 5e8 + self.hub.time))
        self.kept: list[RetainedRecord] = []
        self.server = server
        server.subscribe("fact/**", KEEP_ALL)
        self.viewer = MinimalClient(self.hub.bus("viewer"), 1.5, kind="spectator", joints=0)
        self.replay = Replay(original, self.hub.bus("replay", live=False), self.hub.bus, self.hub.time, **span)

    def run(self) -> None:
        while not self.replay.ended:
            self.tick()
        self.tick()  # the last messages arrive

    def tick(self) -> None:
        self.hub.advance(TICK)
        self.replay.step(self.hub.time)
        self.viewer.tick(self.hub.time)
        self.kept += [record for _, payload in self.server.poll() for record in decode_records(payload)]


def test_a_replay_to_a_network(original):
    network = ReplayNetwork(original)
    network.run()
    assert sorted(network.viewer.joined) == ["ada", "bob"]
    assert "bob" not in network.viewer.replicator.peers
    rest = recorded_trees(original)[-1]
    np.testing.assert_array_equal(network.viewer.read(0)[0], rest.joint_q.astype(np.float32))
    # with new time stamps, so that updates are extrapolated from the present
    received = network.viewer.replicator._state.peers.known["ada"].update
    assert 0.0 <= 5e8 + network.hub.time - received.time < 1.0  # after Bob left, Ada sent nothing
    assert {record.object for record in network.kept} == {
        object_id(ObjectKind.BUNCH, 3),
        object_id(ObjectKind.BUNCH, 4),
    }
    network.replay.close()
    network.hub.advance(0.1)
    assert network.viewer.bus.alive() == {"viewer"}


def test_replay_speed(original):
    durations = {}
    for speed in (0.5, 1.0, 4.0):
        network = ReplayNetwork(original, speed=speed)
        network.run()
        durations[speed] = network.hub.time
        assert sorted(network.viewer.joined) == ["ada", "bob"]
    assert durations[0.5] == pytest.approx(2.0 * original.length, abs=0.1)
    assert durations[4.0] == pytest.approx(0.25 * original.length, abs=0.1)


def test_a_recording_of_a_replay_is_the_recording(original, tmp_path):
    """A recording of a replay holds the same messages with new time stamps."""
    from vinesim.client.recording.recorder import Recorder
    from vinesim.net.recording.mcap_writer import RecordingWriter

    network = ReplayNetwork(original)
    with RecordingWriter(tmp_path / "again.mcap") as recording:
        recorder = Recorder(network.hub.bus("recorder", live=False), recording, clock=lambda: network.hub.time)
        hub_tick = network.viewer.tick

        def tick(now: float) -> None:
            hub_tick(now)
            recorder.step()

        network.viewer.tick = tick
        network.run()
    second = read_recording(tmp_path / "again.mcap")

    def bodies(recorded: Recording) -> list[bytes]:
        return [e.payload[14:] for e in recorded.messages if e.key in ("tree/0/0/ada", "near/0/0/ada")]

    assert bodies(second) == bodies(original)
    assert dataclasses.replace(second, messages=[]).metadata["digest"] == vineyard().digest()
    assert isinstance(second.path, pathlib.Path)
