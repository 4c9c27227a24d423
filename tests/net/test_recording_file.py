"""Recording files: round trips, and reading of truncated, damaged and unrelated files."""

from __future__ import annotations

import base64
import contextlib
import errno
import io
import json
import os
import pathlib
import time
import tracemalloc

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, DataEnd, Footer, Header, Metadata
from mcap.writer import Writer

from tests.support.waiting import deadline
from vinesim.net.codec.control import RetainedRecord, encode_records
from vinesim.net.codec.forces import WrenchMessage, encode_wrenches
from vinesim.net.codec.header import PROTOCOL
from vinesim.net.codec.human import encode_human
from vinesim.net.codec.messages import describe_message, shift_time, time_of
from vinesim.net.codec.objects import ObjectStates, encode_objects
from vinesim.net.codec.trees import TOUCHED
from vinesim.net.recording import mcap_file, mcap_reader, mcap_writer
from vinesim.net.recording.mcap_file import McapFile
from vinesim.net.recording.mcap_reader import InvalidRecording, read_recording
from vinesim.net.recording.mcap_writer import RecordingStopped, RecordingWriter, free_path
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.values import POINT_NAMES, HumanUpdate

MAGIC = b"\x89MCAP0\r\n"


def write(path: pathlib.Path, entries: list[tuple[int, str, bytes]], **about: str) -> pathlib.Path:
    with RecordingWriter(path, about) as file:
        for entry in entries:
            file.put(*entry)
    return path


KEYS = st.sampled_from(
    [
        "a/ada",
        "a/ada/far",
        "c/-1/2/ada",
        "tree/-1/2/ada",
        "near/-1/2/ada",
        "own/0/0/bob",
        "fact/0/0/bob",
        "live/ada",
        "new/thing",
    ]
)


@given(st.lists(st.tuples(st.integers(0, 2**62), KEYS, st.binary(max_size=200)), max_size=30))
def test_written_messages_are_read_bit_for_bit(tmp_path_factory, entries):
    path = write(tmp_path_factory.mktemp("r") / "run.mcap", entries, scene="x")
    recording = read_recording(path)
    expected = sorted(entries, key=lambda entry: entry[0] * 1e-9)
    assert [(e.key, e.payload) for e in recording.messages] == [(key, payload) for _, key, payload in expected]
    assert [e.time for e in recording.messages] == pytest.approx([at * 1e-9 for at, _, _ in expected])
    assert recording.metadata["scene"] == "x"
    assert recording.damage == ""


def until(condition) -> None:
    """Wait for the writer thread."""
    end = time.monotonic() + deadline()
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_messages_are_described_as_json():
    """Every kind of message is described as JSON for other programs, with the raw bytes beside it."""
    pose = np.array([13.0, -3.5, 0.2, 0.0, 0.0, 0.6, 0.8])
    box = object_id(ObjectKind.BOX, 2)
    objects = ObjectStates(
        1e9 + 0.5,
        np.array([box]),
        np.array([3]),
        np.array([4]),
        np.array([TOUCHED]),
        pose[None],
        np.array([[0.5, 0.0, 0.0, 0.0, 0.0, 1.0]]),
    )
    (payload,), quantised = encode_objects(objects, (2, -1))
    description = describe_message("c/2/-1/ada", payload)
    assert base64.b64decode(description["raw"]) == payload
    assert description["actor"] == "ada"
    assert description["timestamp"] == {"sec": 10**9, "nsec": 500_000_000}
    (one,) = description["things"]
    assert (one["kind"], one["index"], one["ownership"], one["authority"], one["touched"]) == ("box", 2, 3, 4, True)
    assert list(one["pose"]["position"].values()) == pytest.approx(pose[:3], abs=2e-4)
    assert list(one["pose"]["orientation"].values()) == pytest.approx(pose[3:], abs=2e-3)
    assert one["velocity"] == quantised.velocity[0].tolist()
    assert time_of(shift_time(payload, 2.0)) == 1e9 + 2.5
    assert shift_time(payload, 2.0)[14:] == payload[14:]

    record = RetainedRecord(box, 1, 2, "ada", pose=tuple(pose.tolist()), parent="bob/arm", moving=True)
    (described,) = describe_message("fact/2/-1/ada", encode_records([record]))["facts"]
    assert (described["kind"], described["index"], described["parent"], described["moving"]) == (
        "box",
        2,
        "bob/arm",
        True,
    )
    assert described["pose"]["position"]["x"] == 13.0
    assert time_of(encode_records([record])) is None

    pose_of_human = standing_pose(pose, 1.8)
    description = describe_message("a/eva", encode_human(HumanUpdate("eva", 5.0, pose_of_human, np.zeros((7, 6)))))
    assert description["points"].keys() == set(POINT_NAMES)
    assert list(description["points"]["head"]["position"].values()) == pytest.approx(pose_of_human.head[:3], abs=2e-4)
    assert description["pose"] == description["points"]["hips"]
    wrenches = encode_wrenches(WrenchMessage(6.0, {"hand": np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.5])}))
    assert describe_message("force/bob/eva", wrenches)["links"] == [{"link": "hand", "wrench": [1, 2, 3, 0, 0, 0.5]}]
    assert time_of(shift_time(wrenches, 1.5)) == 7.5

    assert describe_message("live/ada", b"\x01")["live"] is True
    assert describe_message("live/ada", b"")["live"] is False
    assert "error" in describe_message("c/nowhere/ada", payload)
    assert "cut off" in describe_message("a/ada", b"VS")["error"]


@pytest.fixture(scope="module")
def whole_file(tmp_path_factory) -> bytes:
    """A file of five chunks of twenty messages, a second apart."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    with RecordingWriter(path) as file:
        for second in range(5):
            for number in range(20):
                file.put(int(1e9 * (second + number / 20)), "live/ada", bytes([1, second, number]))
            until(lambda count=20 * (second + 1): file.size and len(read_recording(path).messages) == count)
    return path.read_bytes()


def test_a_truncated_file_is_read_up_to_the_cut(whole_file, tmp_path):
    """Only messages after the cut are lost, none is wrong, and the damage is reported in one line."""
    path = tmp_path / "cut.mcap"
    complete = read_bytes(path, whole_file)
    assert len(complete.messages) == 100
    lengths = []
    for size in range(400, len(whole_file), 97):
        recording = read_bytes(path, whole_file[:size])
        assert [e.payload for e in recording.messages] == [
            e.payload for e in complete.messages[: len(recording.messages)]
        ]
        assert recording.damage.startswith(str(path))
        assert "\n" not in recording.damage
        lengths.append(len(recording.messages))
    assert lengths == sorted(lengths)
    assert len({0, 20, 40, 60, 80, 100} & set(lengths)) >= 5  # in steps of a chunk


def read_bytes(path: pathlib.Path, data: bytes) -> mcap_reader.Recording:
    path.write_bytes(data)
    return read_recording(path)


def test_the_official_reader_reads_a_truncated_file_as_far(whole_file, tmp_path):
    path = tmp_path / "cut.mcap"
    own_reader = read_bytes(path, whole_file[: int(0.4 * len(whole_file))])
    official_reader = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            official_reader.append((channel.topic, json.loads(message.data)["raw"]))
    assert 0 < len(own_reader.messages) < 100
    assert len(official_reader) == len(own_reader.messages)


@given(st.data())
def test_damaged_bytes_are_not_read_as_messages(whole_file, tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damaged") / "run.mcap"
    damaged = bytearray(whole_file)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(8, len(whole_file) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        recording = read_bytes(path, bytes(damaged))
    except InvalidRecording:
        return
    good = {e.payload for e in read_bytes(path, whole_file).messages}
    assert {e.payload for e in recording.messages if e.key == "live/ada"} <= good


def test_what_a_recorder_holds_of_its_file_hardly_grows(tmp_path, monkeypatch):
    """MCAP writes the index of all chunks last. With 30 keys ``mcap.writer.Writer`` keeps 2.5 kB of it a chunk, twice a
    second: 18 MB an hour."""
    keys = [f"tree/-1/2/actor_{i}" for i in range(30)]
    monkeypatch.setattr(mcap_writer, "FLUSH_PERIOD", 0.01)
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as file:
        for _ in range(40):
            size = file.size
            for i, key in enumerate(keys):
                file.put(i, key, bytes(i))
            until(lambda size=size: file.size > size)
        held = file._writer.chunk_indexes.size
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 20  # two rounds may share one
        assert held < 200 * summary.statistics.chunk_count
        assert sum(1 for _ in reader.iter_messages(topics=keys[:3])) == 3 * 40


MESSAGES = st.tuples(st.integers(0, 2**62), st.integers(0, 2), st.binary(max_size=200), st.booleans())


@given(st.lists(MESSAGES, max_size=30), st.sampled_from([1, 300, mcap_file.CHUNK_SIZE]))
def test_a_file_has_the_bytes_that_the_writer_of_the_mcap_package_writes(messages, chunk_size):
    """``mcap.writer.Writer`` is the oracle: it keeps more in memory, but the file is the same."""
    own, official = io.BytesIO(), io.BytesIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_file, "CHUNK_SIZE", chunk_size)
        for writer in (McapFile(own), Writer(official, chunk_size=chunk_size)):
            writer.start(library="a test")
            writer.add_metadata("about", {"scene": "x"})
            schema = writer.register_schema("one", "jsonschema", b"{}")
            channels: dict[int, int] = {}
            for at, number, data, flush in messages:
                if number not in channels:
                    channels[number] = writer.register_channel(f"topic/{number}", "json", schema)
                writer.add_message(channels[number], at, data, at + 1)
                if flush:
                    writer.flush()
            writer.add_metadata("about", {"scene": "y"})
            writer.finish()
    assert own.getvalue() == official.getvalue()


@pytest.mark.parametrize("content", [b"", b"abc", b"\x89PNG\r\n\x1a\n" + bytes(100), b"name = 'demo'\n" * 20])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "file.mcap"
    with pytest.raises(InvalidRecording, match=r"file\.mcap"):
        read_bytes(path, content)


def test_missing_files_folders_and_other_mcap_files_are_refused(tmp_path):
    with pytest.raises(InvalidRecording, match=r"nowhere\.mcap.*No such file"):
        read_recording(tmp_path / "nowhere.mcap")
    with pytest.raises(InvalidRecording, match=r"is a folder: give a file that 'vinesim record' wrote"):
        read_recording(tmp_path)
    for profile, words in (("", "another program"), ("ros2", "play it by: vinesim ros play")):
        with (tmp_path / "other.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start(profile)
            writer.finish()
        with pytest.raises(InvalidRecording, match=words):
            read_recording(tmp_path / "other.mcap")
    with pytest.raises(InvalidRecording, match="is a folder of rosbag2: play its ROS topics by: vinesim ros play"):
        read_recording(tmp_path)


def test_another_protocol_version_is_refused(tmp_path):
    path = write(tmp_path / "old.mcap", [(1, "live/ada", b"\x01")], protocol="0", release="0.0.9")
    with pytest.raises(InvalidRecording, match=rf"version 0.*version {PROTOCOL}.*0\.0\.9"):
        read_recording(path)


def test_existing_files_are_not_overwritten(tmp_path):
    path = tmp_path / "run.mcap"
    assert free_path(path) == path
    write(path, [])
    assert free_path(path) == tmp_path / "run-2.mcap"
    write(tmp_path / "run-2.mcap", [])
    assert free_path(path) == tmp_path / "run-3.mcap"
    before = path.read_bytes()
    with pytest.raises(RecordingStopped, match="File exists"):
        RecordingWriter(path)
    assert path.read_bytes() == before
    with pytest.raises(RecordingStopped, match="choose another"):
        RecordingWriter(tmp_path / "no" / "such" / "folder.mcap")


class FullDisk:
    """A file on a disk with ``room`` free bytes."""

    def __init__(self, file, room: int) -> None:
        self._file = file
        self._room = room

    def write(self, data: bytes) -> int:
        if self._file.tell() + len(data) > self._room:
            self._file.write(data[: self._room - self._file.tell()])
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data)

    def __getattr__(self, name: str):
        return getattr(self._file, name)


def test_a_full_disk_stops_the_recording_and_keeps_what_was_written(tmp_path):
    path = tmp_path / "run.mcap"
    file = RecordingWriter(path)
    file._writer.stream = FullDisk(file._file, 3000)
    stopped = None
    for number in range(100_000):
        try:
            file.put(int(1e9 * number), "live/ada", number.to_bytes(4, "little"))
        except RecordingStopped as error:
            stopped = error
            break
        file._thread.join(0.0005)
    assert stopped is not None
    assert stopped.exit_code == 5
    assert "No space left on device" in str(stopped)
    assert str(path) in str(stopped)
    with pytest.raises(RecordingStopped):
        file.close()
    assert path.stat().st_size == file.size <= 3000
    recording = read_recording(path)
    assert [int.from_bytes(e.payload, "little") for e in recording.messages] == list(range(len(recording.messages)))


def test_a_disk_that_is_full_from_the_start_leaves_no_file_and_the_same_command_goes_on(tmp_path, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "run.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(RecordingStopped, match=r"No space left on device.*nothing is recorded; make room") as said:
            RecordingWriter(path).close()
    assert "\n" not in str(said.value)
    assert not path.exists()
    assert free_path(path) == path
    RecordingWriter(path).close()
    assert not read_recording(path).messages


@pytest.mark.parametrize(
    "key", ["live", "hello", "a", "own", "fact", "snap", "c", "tree", "near", "", "/", "fact/x/y/ada", "c/1/2"]
)
def test_a_key_that_lacks_parts_is_recorded_like_any_other(tmp_path, key):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as file:
        for number, payload in enumerate((b"", b"\xff", b"\x01" * 50)):
            file.put(number, key, payload)
    assert [one.payload for one in read_recording(path).messages] == [b"", b"\xff", b"\x01" * 50]


def test_a_writer_that_fails_ends_the_recording_instead_of_losing_messages(tmp_path, monkeypatch):
    def broken(*_: object) -> None:
        raise ArithmeticError("a defect")

    file = RecordingWriter(tmp_path / "run.mcap")
    monkeypatch.setattr(file, "_write", broken)
    file.put(1, "live/ada", b"")
    with pytest.raises(RecordingStopped, match="ArithmeticError: a defect"):
        file.close()


def test_a_recording_is_readable_while_it_is_written(tmp_path):
    """A message can be read by another program soon after it is put, before the file is closed."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as file:
        file.put(1, "live/ada", b"\x01")
        until(lambda: file.size and len(read_recording(path).messages) == 1)
        with path.open("rb") as unfinished, pytest.raises(Exception):  # noqa: B017 PT011 - the index is written at the end
            make_reader(unfinished).get_summary()
    with path.open("rb") as finished:
        assert make_reader(finished).get_summary().statistics.message_count == 1


def bomb(path: pathlib.Path, size: int, chunks: int = 1, said: int | None = None) -> pathlib.Path:
    """Write a recording whose chunks unpack to ``size`` zeros each; they say that it is ``said``."""
    packer = zstandard.ZstdCompressor().compressobj(size=size)
    block = bytes(1 << 20)
    packed = b"".join(packer.compress(block) for _ in range(size >> 20)) + packer.flush()
    with path.open("wb") as file:
        file.write(MAGIC)
        for entry in (
            Header(profile="", library=""),
            Metadata("vinesim", {"protocol": str(PROTOCOL)}),
            *[Chunk("zstd", packed, 0, 0, 0, size if said is None else said)] * chunks,
            DataEnd(0),
            Footer(0, 0, 0),
        ):
            builder = RecordBuilder()
            entry.write(builder)
            file.write(builder.end())
        file.write(MAGIC)
    return path


@pytest.mark.parametrize(
    ("size", "more", "reason"),
    [
        (2 << 30, {}, "more than 200 times its size"),
        (2 << 30, {"said": 1 << 20}, "says it unpacks to 1048576 bytes, which is wrong"),
        (60 << 20, {"chunks": 30}, "more than 200 times its size"),
    ],
    ids=["honest", "lying", "many chunks"],
)
def test_a_file_that_unpacks_to_gigabytes_ends_with_one_line(tmp_path, size, more, reason):
    path = bomb(tmp_path / "bomb.mcap", size, **more)
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    begin = time.process_time()
    recording = read_recording(path)
    elapsed = time.process_time() - begin
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert not recording.messages
    assert reason in recording.damage
    assert "\n" not in recording.damage
    assert elapsed < 5.0
    assert peak < 100e6


def test_a_recording_is_not_held_in_memory(tmp_path):
    """30 MB of messages need 22 bytes each and the chunk that is read."""
    rng = np.random.default_rng(3)
    count = 15_000
    path = write(tmp_path / "long.mcap", [(i * 10**6, "tree/0/0/ada", rng.bytes(1500)) for i in range(count)])
    assert path.stat().st_size > 20e6
    tracemalloc.start()
    recording = read_recording(path)
    total = sum(len(entry.payload) for entry in recording.messages)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert total == 1500 * count
    assert peak < 10e6


def test_messages_are_read_in_any_order(tmp_path):
    entries = [(at * 10**6, f"live/{'ab'[at % 2]}", bytes((at % 256,)) * 2000) for at in range(3000)]
    recording = read_recording(write(tmp_path / "run.mcap", entries))
    expected = [payload for _, _, payload in entries]
    order = np.random.default_rng(1).permutation(len(entries))[:200]
    assert [recording.messages[int(i)].payload for i in order] == [expected[i] for i in order]
    assert [entry.payload for entry in recording.messages[-3:]] == expected[-3:]
    assert [entry.payload for entry in recording.messages.of("live", first=10, last=13)] == expected[10:13]
    assert not list(recording.messages.of("hello"))
    assert recording.actors == ["a", "b"]


def test_messages_that_are_missing_without_damage_are_told(tmp_path):
    """A chunk of which 36 bytes are zeros looks like an empty one; the statistics count its messages."""
    path = write(tmp_path / "run.mcap", [(i * 10**6, "live/ada", b"\1") for i in range(50)])
    content = bytearray(path.read_bytes())
    at = content.index(b"zstd") - 16
    content[at : at + 36] = bytes(36)
    path.write_bytes(content)
    assert "0 of its 50 messages are there" in read_recording(path).damage
