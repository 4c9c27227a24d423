"""The recorder over a bus in memory: recorded messages, unchanged traffic, and observers for a whole area."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.support.recorded_world import TICK, MinimalClient, vineyard
from vinesim.client.recording.recorder import CHOICES, AreaTooLarge, Observer, Recorder, observer_grid
from vinesim.net.codec.control import RetainedRecord, decode_hello, decode_time, encode_records, encode_time
from vinesim.net.codec.header import PROTOCOL, kind_of
from vinesim.net.codec.messages import time_of
from vinesim.net.codec.trees import TREES, decode_trees
from vinesim.net.recording.mcap_reader import Recording, read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication.interest import INTEREST_RADIUS
from vinesim.net.replication.peers import WorldMismatch
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id

EPOCH = 1.7e9


class World:
    """Two minimal clients, a server with a clock and one retained record, and optionally a recorder."""

    def __init__(self, path: pathlib.Path | None, distance: float = 2.0, **options) -> None:
        self.hub = MemoryHub(delay=0.004)
        server = self.hub.bus("server", live=False)
        server.declare_queryable("clock/*", lambda payload: encode_time(decode_time(payload)[0], EPOCH + self.hub.time))
        record = RetainedRecord(object_id(ObjectKind.BUNCH, 3), 1, 0, "gone", pose=(1.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        server.declare_queryable("snap/0/0", lambda _: encode_records([record]))
        self.ada, self.bob = MinimalClient(self.hub.bus("ada"), 0.5), MinimalClient(self.hub.bus("bob"), 0.5 + distance)
        self.clients = [self.ada, self.bob]
        self.steps = [lambda: None]
        if path is not None:
            self.recording = RecordingWriter(path, {"world": "memory"})
            self.recorder = Recorder(
                self.hub.bus("recorder", live=False), self.recording, clock=lambda: self.hub.time, **options
            )
            self.steps.append(self.recorder.step)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.hub.advance(TICK)
            for client in self.clients:
                client.tick(self.hub.time)
            for step in self.steps:
                step()

    def touch(self) -> None:
        """Ada bends a tree for a second, then it rests."""
        for number in range(100):
            self.ada.bend(0, 0.5 * np.sin(0.1 * number))
            self.run(TICK)
        self.ada.touched = set()
        self.run(0.5)

    def recorded(self) -> Recording:
        self.recording.close()
        return read_recording(self.recording.path)


def families(recorded: Recording) -> set[str]:
    return {entry.key.partition("/")[0] for entry in recorded.messages}


def test_all_messages_are_recorded(tmp_path):
    world = World(tmp_path / "run.mcap")
    world.run(1.0)
    world.touch()
    world.bob.bus.close()
    world.clients.remove(world.bob)
    world.run(0.5)
    recorded = world.recorded()
    assert recorded.damage == ""
    assert families(recorded) == {"a", "pose", "tree", "near", "own", "hello", "live", "snap"}
    about = {
        "scene": "rows",
        "seed": "5",
        "digest": vineyard().digest(),
        "world": "memory",
        "protocol": str(PROTOCOL),
    }
    assert recorded.metadata.items() >= about.items()
    assert [(e.key, bool(e.payload)) for e in recorded.messages if e.key.startswith("live")] == [
        ("live/ada", True),
        ("live/bob", True),
        ("live/bob", False),
    ]
    assert {decode_hello(e.payload).name for e in recorded.messages if e.key.startswith("hello")} == {
        "ada",
        "bob",
    }

    # all tree updates and events that bob received are recorded, in order and bitwise
    updates = [decode_trees(e.payload) for e in recorded.messages if e.key in ("tree/0/0/ada", "near/0/0/ada")]
    assert len(updates) > 90
    last = [e for e in recorded.messages if e.key == "own/0/0/ada" and kind_of(e.payload) == TREES][-1]
    rest = decode_trees(last.payload)
    np.testing.assert_array_equal(rest.joint_q.astype(np.float32), world.ada.read(0)[0])
    np.testing.assert_array_equal(rest.joint_q.astype(np.float32), world.bob.read(0)[0])

    # log time is network time: a delay and a poll after the author's time stamp
    for entry in recorded.messages:
        if entry.key in ("tree/0/0/ada", "near/0/0/ada"):
            assert 0.0 < entry.time - time_of(entry.payload) < 0.03
    assert recorded.start == pytest.approx(EPOCH, abs=0.2)


def test_a_recorder_does_not_change_traffic(tmp_path):
    """The same contact, near and far from the other client, with and without a recorder."""
    sent = {}
    for distance in (2.0, 40.0):
        for path in (None, tmp_path / f"{distance}.mcap"):
            world = World(path, distance)
            world.run(2.0)
            before = [client.bus.bytes_out for client in world.clients]
            world.touch()
            sent[distance, path is None] = [c.bus.bytes_out - b for c, b in zip(world.clients, before, strict=True)]
            if distance > INTEREST_RADIUS:
                assert world.ada.environment() == 0
            else:
                assert world.ada.environment() > 5_000
            if path is not None:
                recorded = world.recorded()
                assert (not families(recorded).isdisjoint({"tree", "near"})) == (distance < INTEREST_RADIUS)
                fast = sum(entry.key in ("a/ada", "a/ada/near", "a/ada/mid") for entry in recorded.messages)
                assert (fast > 100) == (distance < INTEREST_RADIUS)
    assert sent[2.0, True] == sent[2.0, False]
    assert sent[40.0, True] == sent[40.0, False]
    assert sent[40.0, True][0] > 0  # slow poses


def test_an_actor_alone_sends_nothing_for_a_recorder(tmp_path):
    world = World(tmp_path / "run.mcap")
    world.bob.bus.close()
    world.clients.remove(world.bob)
    world.run(1.0)
    world.touch()
    assert world.ada.bus.bytes_out == 0
    assert families(world.recorded()) == {"live", "hello", "snap"}  # replies to its own queries


def test_an_observer_records_an_actor_that_is_alone(tmp_path):
    world = World(tmp_path / "run.mcap", everything=True)
    world.bob.bus.close()
    world.clients.remove(world.bob)
    digest = vineyard().digest()
    observer = Observer(world.hub.bus("recorder-1"), (0.5, 3.0), "rows", digest, world.hub.time)
    world.recorder.observers.add("recorder-1")
    world.steps.append(lambda: observer.step(world.hub.time))
    world.run(2.0)
    world.touch()
    recorded = world.recorded()
    assert families(recorded) == {
        "a",
        "pose",
        "tree",
        "own",
        "hello",
        "live",
        "snap",
    }  # nothing is within 3 m of the tree
    assert sum(entry.key.partition("/")[0] in ("a", "pose") for entry in recorded.messages) > 150
    assert sum(entry.key == "tree/0/0/ada" for entry in recorded.messages) > 50
    assert not any("recorder" in entry.key for entry in recorded.messages)


def test_two_recorders_do_not_keep_each_others_subscriptions(tmp_path):
    world = World(tmp_path / "run.mcap")
    with RecordingWriter(tmp_path / "other.mcap") as recording:
        other = Recorder(world.hub.bus("other", live=False), recording, clock=lambda: world.hub.time)
        world.steps.append(other.step)
        world.run(1.0)
        assert world.ada.replicator._state.peers._layers[-1].matching
        world.bob.robot.base_q[0] = 60.0
        world.run(1.0)
        assert not world.ada.replicator._state.peers._layers[-1].matching


@pytest.mark.parametrize("only", CHOICES)
def test_only_selected_families_are_recorded(tmp_path, only):
    world = World(tmp_path / "run.mcap", only=[only])
    world.run(0.5)
    world.touch()
    expected = {
        "poses": {"a", "pose"},
        "trees": {"tree", "near"},
        "things": set(),
        "events": {"own"},
        "facts": {"snap"},
        "forces": set(),
    }
    assert families(world.recorded()) == {"live", "hello"} | expected[only]


def test_another_scene_is_refused_and_ignored_from_a_late_peer(tmp_path):
    world = World(tmp_path / "other.mcap", digest="elsewhere")
    with pytest.raises(WorldMismatch, match=r"'(ada|bob)' has scene 'rows' .*elsewhere.*same|used there"):
        world.run(0.5)
    world.recording.close()

    world = World(tmp_path / "run.mcap")
    world.run(0.5)
    MinimalClient(world.hub.bus("late"), 1.0, digest="elsewhere")  # it serves its hello
    world.run(0.5)
    greetings = {e.key for e in world.recorded().messages if e.key.startswith("hello/")}
    assert greetings == {"hello/ada", "hello/bob"}


def test_the_official_reader_reads_the_json(tmp_path):
    world = World(tmp_path / "run.mcap")
    world.run(1.0)
    world.touch()
    path = world.recorded().path
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert {metadata.name for metadata in reader.iter_metadata()} == {"vinesim"}
        messages_of: dict[str, list] = {}
        for schema, channel, message in reader.iter_messages():
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            body = json.loads(message.data)
            described = json.loads(schema.data)
            assert described["type"] == "object"
            assert body.keys() <= described["properties"].keys(), channel.topic
            messages_of.setdefault(channel.topic, []).append((schema.name, message, body))
    assert summary.statistics.message_count == sum(map(len, messages_of.values()))
    name, message, pose = messages_of["a/ada"][-1]
    assert name == "foxglove.PoseInFrame"
    assert pose["frame_id"] == "map"
    assert pose["pose"]["position"] == {"x": 0.5, "y": 0.0, "z": 0.0}
    assert pose["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert pose["joint_position"] == pytest.approx([0.1, -0.2])
    stamp = pose["timestamp"]["sec"] * 10**9 + pose["timestamp"]["nsec"]
    assert stamp == message.publish_time <= message.log_time
    assert messages_of["tree/0/0/ada"][0][2]["trees"][0]["tree"] == 0
    assert messages_of["own/0/0/ada"][0][2]["claims"][0] == {
        "kind": "tree",
        "index": 0,
        "ownership": 0,
        "authority": 1,
        "owner": "ada",
        "touched": True,
    }
    assert messages_of["snap/0/0"][0][2]["facts"][0]["kind"] == "bunch"
    assert messages_of["hello/ada"][0][2]["scene"] == "rows"


def test_the_grid_of_observers_covers_the_area():
    for area in ((0.0, 0.0, 1.0, 1.0), (-3.0, -3.0, 25.0, 25.0), (0.0, 0.0, 100.0, 5.0)):
        observers = np.array(observer_grid(area))
        x, y = np.meshgrid(np.linspace(area[0], area[2], 60), np.linspace(area[1], area[3], 60))
        distances = np.hypot(x[..., None] - observers[:, 0], y[..., None] - observers[:, 1]).min(-1)
        assert distances.max() <= INTEREST_RADIUS
    for invalid in ((0.0, 0.0, 40.0, 40.0), (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, float("nan"), 1.0)):
        with pytest.raises(AreaTooLarge, match="give"):
            observer_grid(invalid)


def test_malformed_messages_are_recorded_and_counted(tmp_path):
    world = World(tmp_path / "run.mcap")
    faulty_publisher = world.hub.bus("faulty").publisher("own/0/0/faulty")
    world.run(0.5)
    assert faulty_publisher.put(b"not a message")
    world.run(0.1)
    recorded = world.recorded()
    assert [entry.payload for entry in recorded.messages if entry.key == "own/0/0/faulty"] == [b"not a message"]
    assert world.recorder.malformed == 1
