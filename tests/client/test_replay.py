"""A tape, played: whoever listens to it sees what was recorded, the same at the same tick every time."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
import pytest

from tests.client.test_recorder import EPOCH, World
from tests.support.recorded_world import TICK, MinimalClient, vineyard
from vinesim.client.recording.replay import Replay, ReplayBus
from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.recording.mcap_reader import Recording, read_recording
from vinesim.net.transport.bus import KEEP_ALL, NameTaken
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id


@pytest.fixture(scope="module")
def tape(tmp_path_factory) -> Recording:
    """Ada bends a tree beside Bob; after a second of rest Bob leaves, and 0.3 s later a bunch falls."""
    world = World(tmp_path_factory.mktemp("tape") / "run.mcap")
    world.run(1.0)
    world.touch()
    world.run(0.5)
    world.bob.bus.close()
    world.clients.remove(world.bob)
    world.run(0.3)
    fact = RetainedRecord(object_id(ObjectKind.BUNCH, 4), 1, 0, "ada", pose=(1.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
    assert world.ada.bus.publisher("fact/0/0/ada", reliable=True).put(messages.encode_records([fact]))
    world.run(0.2)
    return world.tape()


def watch(tape: Recording, **span: float) -> tuple[MinimalClient, list[bytes], list[tuple]]:
    """One who stands beside the tree while the tape is played: it, its states, and what it saw move, tick by tick."""
    bus = ReplayBus(tape, "viewer", **span)
    viewer = MinimalClient(bus, 1.5, kind="spectator", joints=0)
    states, seen = [], []
    while not bus.ended:
        bus.play(TICK)
        viewer.tick(bus.time)
        states.append(viewer.state.joint_q.tobytes() + viewer.state.joint_qd.tobytes())
        poses = {name: update.base_q.tobytes() for name, update in viewer.inbox.robots.items()}
        seen.append((poses, [(update.tree, update.joint_q.tobytes()) for update in viewer.inbox.trees]))
    return viewer, states, seen


def recorded_trees(tape: Recording) -> list[messages.TreeStates]:
    kinds = (entry.payload for entry in tape.messages if entry.key in ("c/0/0/ada", "own/0/0/ada"))
    return [
        messages.decode_trees(payload) for payload in kinds if messages.kind_of(payload) == messages.MessageKind.TREES
    ]


def test_a_viewer_sees_what_was_recorded(tape):
    viewer, _, _ = watch(tape)
    assert viewer.joined == ["ada", "bob"]
    assert viewer.bus.bytes_out == 0
    recorded = recorded_trees(tape)
    rest = recorded[-1]
    assert rest.flags[0] == messages.RESTING
    np.testing.assert_array_equal(viewer.heard[-1].joint_q, rest.joint_q)
    np.testing.assert_array_equal(viewer.read(0)[0], rest.joint_q.astype(np.float32))
    # of all records of a tick the last one is seen, in order; these were said at no rate, so nothing is extrapolated
    position = 0
    for heard in viewer.heard:
        while not np.allclose(heard.joint_q, recorded[position].joint_q, rtol=0.0, atol=1e-12):
            position += 1
    assert len(viewer.heard) > 0.5 * len(recorded)


def test_twice_is_the_same_to_the_bit(tape):
    first, second = watch(tape), watch(tape)
    assert first[1] == second[1]
    assert first[2] == second[2]
    assert len(set(first[1])) > 50  # and it moved


def test_actors_come_and_go_as_they_did(tape):
    bus = ReplayBus(tape, "viewer")
    assert bus.alive() == {"viewer", "ada", "bob"}  # who is there at the first moment is there from the start
    there = []
    while not bus.ended:
        bus.play(TICK)
        there.append(bus.alive())
    assert there[0] == {"viewer", "ada", "bob"}
    assert there[-1] == {"viewer", "ada"}


def test_from_and_to(tape):
    start = tape.length - 1.5
    bus = ReplayBus(tape, "viewer", start=start, end=start + 0.5)
    bus.subscribe("a/*/far", KEEP_ALL)
    assert bus.time == pytest.approx(tape.start + start)
    bus.query("hello/bob")  # who came before is there
    assert messages.decode_hello(bus.replies()[0].payload).name == "bob"
    for _ in range(100):
        bus.play(TICK)
    assert bus.ended
    times = [messages.time_of(payload) - tape.start for _, payload in bus.poll()]
    assert start - 0.1 < min(times) < max(times) < start + 0.5


def test_facts_are_answered_as_the_server_would(tape):
    bus = ReplayBus(tape, "viewer")
    before, told = object_id(ObjectKind.BUNCH, 3), object_id(ObjectKind.BUNCH, 4)

    def known() -> set[int]:
        bus.query("snap/0/0")
        return {fact.object for answer in bus.replies() for fact in messages.decode_records(answer.payload)}

    assert known() == {before}
    while not bus.ended:
        bus.play(TICK)
    assert known() == {before, told}
    bus.query("snap/9/9")
    (empty,) = bus.replies()
    assert (empty.key, messages.decode_records(empty.payload)) == ("snap/9/9", [])
    bus.query("snap/*/*")
    assert {answer.key for answer in bus.replies()} == {"snap/0/0"}
    bus.query("snap/nonsense")
    assert bus.replies() == []


def test_a_name_on_the_tape_is_taken(tape):
    with pytest.raises(NameTaken, match="bob"):
        ReplayBus(tape, "bob")


def test_the_clock_is_that_of_the_recording(tape):
    bus = ReplayBus(tape, "viewer", start=0.5)
    bus.query("clock", messages.encode_time(3.0))
    assert messages.decode_time(bus.replies()[0].payload) == (3.0, pytest.approx(EPOCH + 0.6, abs=0.2))


class Stage:
    """A network in memory to which a tape is played."""

    def __init__(self, tape: Recording, **span: float) -> None:
        self.hub = MemoryHub(delay=0.004)
        server = self.hub.bus("server", live=False)
        server.declare_queryable(
            "clock", lambda asked: messages.encode_time(messages.decode_time(asked)[0], 5e8 + self.hub.time)
        )  # fmt: skip
        self.kept: list[RetainedRecord] = []
        self.server = server
        server.subscribe("fact/**", KEEP_ALL)
        self.viewer = MinimalClient(self.hub.bus("viewer"), 1.5, kind="spectator", joints=0)
        self.replay = Replay(tape, self.hub.bus("replay", live=False), self.hub.bus, self.hub.time, **span)

    def run(self) -> None:
        while not self.replay.ended:
            self.tick()
        self.tick()  # what was said last arrives

    def tick(self) -> None:
        self.hub.advance(TICK)
        self.replay.step(self.hub.time)
        self.viewer.tick(self.hub.time)
        self.kept += [fact for _, payload in self.server.poll() for fact in messages.decode_records(payload)]


def test_on_a_network_it_happens_again(tape):
    stage = Stage(tape)
    stage.run()
    assert sorted(stage.viewer.joined) == ["ada", "bob"]
    assert "bob" not in stage.viewer.replicator.peers
    rest = recorded_trees(tape)[-1]
    np.testing.assert_array_equal(stage.viewer.read(0)[0], rest.joint_q.astype(np.float32))
    # stamped anew: nobody extrapolates from the year of the recording, and velocities are believed
    heard = stage.viewer.replicator._state.peers.known["ada"].update
    assert 0.0 <= 5e8 + stage.hub.time - heard.time < 1.0  # since Bob left she had nobody to tell
    assert {fact.object for fact in stage.kept} == {object_id(ObjectKind.BUNCH, 3), object_id(ObjectKind.BUNCH, 4)}
    stage.replay.close()
    stage.hub.advance(0.1)
    assert stage.viewer.bus.alive() == {"viewer"}


def test_faster_and_slower(tape):
    lasted = {}
    for speed in (0.5, 1.0, 4.0):
        stage = Stage(tape, speed=speed)
        stage.run()
        lasted[speed] = stage.hub.time
        assert sorted(stage.viewer.joined) == ["ada", "bob"]
    assert lasted[0.5] == pytest.approx(2.0 * tape.length, abs=0.1)
    assert lasted[4.0] == pytest.approx(0.25 * tape.length, abs=0.1)


def test_a_recording_of_a_replay_is_the_recording(tape, tmp_path):
    """Record what a replay says, and read that: the same messages, stamped anew."""
    from vinesim.client.recording.recorder import Recorder
    from vinesim.net.recording.mcap_writer import RecordingWriter

    stage = Stage(tape)
    with RecordingWriter(tmp_path / "again.mcap") as recording:
        recorder = Recorder(stage.hub.bus("recorder", live=False), recording, clock=lambda: stage.hub.time)
        hub_tick = stage.viewer.tick

        def tick(now: float) -> None:
            hub_tick(now)
            recorder.step()

        stage.viewer.tick = tick
        stage.run()
    again = read_recording(tmp_path / "again.mcap")

    def bodies(recorded: Recording) -> list[bytes]:
        return [e.payload[14:] for e in recorded.messages if e.key == "c/0/0/ada"]

    assert bodies(again) == bodies(tape)
    assert dataclasses.replace(again, messages=[]).metadata["digest"] == vineyard().digest()
    assert isinstance(again.path, pathlib.Path)
