"""Files of recordings: round trips, and what is left of a file that was cut off, damaged or never was one."""

from __future__ import annotations

import base64
import contextlib
import errno
import json
import pathlib
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from tests.support.waiting import TIMEOUT
from vinesim.net.codec import messages
from vinesim.net.codec.human import encode_human
from vinesim.net.codec.wrenches import WrenchMessage, encode_wrenches
from vinesim.net.recording import mcap_reader
from vinesim.net.recording.mcap_reader import InvalidRecording, read_recording
from vinesim.net.recording.mcap_writer import RecordingStopped, RecordingWriter, free_path
from vinesim.net.recording.message_json import describe_message
from vinesim.physics.rigid.human_posture import standing_pose
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.values import POINT_NAMES, HumanUpdate


def write(path: pathlib.Path, entries: list[tuple[int, str, bytes]], **about: str) -> pathlib.Path:
    with RecordingWriter(path, about) as file:
        for entry in entries:
            file.put(*entry)
    return path


KEYS = st.sampled_from(["a/ada", "a/ada/far", "c/-1/2/ada", "own/0/0/bob", "fact/0/0/bob", "live/ada", "new/thing"])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**62), KEYS, st.binary(max_size=200)), max_size=30))
def test_whatever_was_put_in_comes_out_to_the_bit(tmp_path_factory, entries):
    path = write(tmp_path_factory.mktemp("r") / "run.mcap", entries, scene="x")
    tape = read_recording(path)
    expected = sorted(entries, key=lambda entry: entry[0] * 1e-9)
    assert [(e.key, e.payload) for e in tape.messages] == [(key, payload) for _, key, payload in expected]
    assert [e.time for e in tape.messages] == pytest.approx([at * 1e-9 for at, _, _ in expected])
    assert tape.metadata["scene"] == "x"
    assert tape.damage == ""


def until(condition) -> None:
    """Wait for the thread that writes."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_what_a_message_says():
    """Every kind in words and numbers that can be read without us, and the bytes beside them."""
    pose = np.array([13.0, -3.5, 0.2, 0.0, 0.0, 0.6, 0.8])
    box = object_id(ObjectKind.BOX, 2)
    things = messages.ObjectStates(
        1e9 + 0.5, np.array([box]), np.array([3]), np.array([4]), np.array([messages.TOUCHED]), pose[None],
        np.array([[0.5, 0.0, 0.0, 0.0, 0.0, 1.0]]),
    )  # fmt: skip
    (payload,), heard = messages.encode_objects(things, (2, -1))
    said = describe_message("c/2/-1/ada", payload)
    assert base64.b64decode(said["raw"]) == payload
    assert said["actor"] == "ada"
    assert said["timestamp"] == {"sec": 10**9, "nsec": 500_000_000}
    (one,) = said["things"]
    assert (one["kind"], one["index"], one["ownership"], one["authority"], one["touched"]) == ("box", 2, 3, 4, True)
    assert list(one["pose"]["position"].values()) == pytest.approx(pose[:3], abs=2e-4)
    assert list(one["pose"]["orientation"].values()) == pytest.approx(pose[3:], abs=2e-3)
    assert one["velocity"] == heard.velocity[0].tolist()
    assert messages.time_of(messages.shift_time(payload, 2.0)) == 1e9 + 2.5
    assert messages.shift_time(payload, 2.0)[14:] == payload[14:]

    fact = messages.RetainedRecord(box, 1, 2, "ada", pose=tuple(pose.tolist()), parent="bob/arm", moving=True)
    (told,) = describe_message("fact/2/-1/ada", messages.encode_records([fact]))["facts"]
    assert (told["kind"], told["index"], told["parent"], told["moving"]) == ("box", 2, "bob/arm", True)
    assert told["pose"]["position"]["x"] == 13.0
    assert messages.time_of(messages.encode_records([fact])) is None

    person = standing_pose(pose, 1.8)
    said = describe_message("a/eva", encode_human(HumanUpdate("eva", 5.0, person, np.zeros((7, 6)))))
    assert said["points"].keys() == set(POINT_NAMES)
    assert list(said["points"]["head"]["position"].values()) == pytest.approx(person.head[:3], abs=2e-4)
    assert said["pose"] == said["points"]["hips"]
    pushed = encode_wrenches(WrenchMessage(6.0, {"hand": np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.5])}))
    assert describe_message("force/bob/eva", pushed)["links"] == [{"link": "hand", "wrench": [1, 2, 3, 0, 0, 0.5]}]
    assert messages.time_of(messages.shift_time(pushed, 1.5)) == 7.5

    assert describe_message("live/ada", b"\x01")["live"] is True
    assert describe_message("live/ada", b"")["live"] is False
    assert "error" in describe_message("c/nowhere/ada", payload)
    assert "cut off" in describe_message("a/ada", b"VS")["error"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """A file of five chunks of twenty messages, a second apart."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    with RecordingWriter(path) as file:
        for second in range(5):
            for number in range(20):
                file.put(int(1e9 * (second + number / 20)), "live/ada", bytes([1, second, number]))
            until(lambda count=20 * (second + 1): file.size and len(read_recording(path).messages) == count)
    return path.read_bytes()


def test_cut_off_anywhere_what_lies_before_can_be_read(whole, tmp_path):
    """Only what follows the cut is lost, never a message is wrong, and it is said in one line."""
    path = tmp_path / "cut.mcap"
    everything = read_bytes(path, whole)
    assert len(everything.messages) == 100
    lengths = []
    for size in range(400, len(whole), 97):
        tape = read_bytes(path, whole[:size])
        assert [e.payload for e in tape.messages] == [e.payload for e in everything.messages[: len(tape.messages)]]
        assert tape.damage.startswith(str(path))
        assert "\n" not in tape.damage
        lengths.append(len(tape.messages))
    assert lengths == sorted(lengths)
    assert len({0, 20, 40, 60, 80, 100} & set(lengths)) >= 5  # in steps of a chunk


def read_bytes(path: pathlib.Path, data: bytes) -> mcap_reader.Recording:
    path.write_bytes(data)
    return read_recording(path)


def test_the_official_reader_reads_a_cut_file_as_far(whole, tmp_path):
    path = tmp_path / "cut.mcap"
    ours = read_bytes(path, whole[: int(0.4 * len(whole))])
    theirs = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            theirs.append((channel.topic, json.loads(message.data)["raw"]))
    assert 0 < len(ours.messages) < 100
    assert len(theirs) == len(ours.messages)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_never_pass_for_messages(whole, tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damaged") / "run.mcap"
    broken = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        broken[data.draw(st.integers(8, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        tape = read_bytes(path, bytes(broken))
    except InvalidRecording:
        return
    good = {e.payload for e in read_bytes(path, whole).messages}
    assert {e.payload for e in tape.messages if e.key == "live/ada"} <= good


@pytest.mark.parametrize("content", [b"", b"abc", b"\x89PNG\r\n\x1a\n" + bytes(100), b"name = 'demo'\n" * 20])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "file.mcap"
    with pytest.raises(InvalidRecording, match=r"file\.mcap"):
        read_bytes(path, content)


def test_missing_files_folders_and_mcaps_of_others_are_refused(tmp_path):
    with pytest.raises(InvalidRecording, match=r"nowhere\.mcap.*No such file"):
        read_recording(tmp_path / "nowhere.mcap")
    with pytest.raises(InvalidRecording, match="cannot read"):
        read_recording(tmp_path)
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(InvalidRecording, match="another program"):
        read_recording(tmp_path / "other.mcap")


def test_another_protocol_is_refused_by_its_number(tmp_path):
    path = write(tmp_path / "old.mcap", [(1, "live/ada", b"\x01")], protocol="0", release="0.0.9")
    with pytest.raises(InvalidRecording, match=rf"version 0.*version {messages.PROTOCOL}.*0\.0\.9"):
        read_recording(path)


def test_nothing_is_overwritten(tmp_path):
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


class Full:
    """A file on a disk with room for so many bytes."""

    def __init__(self, file, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: bytes) -> int:
        if self._file.tell() + len(data) > self._room:
            self._file.write(data[: self._room - self._file.tell()])
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data)

    def __getattr__(self, name: str):
        return getattr(self._file, name)


def test_a_full_disk_ends_the_recording_and_what_was_written_stays(tmp_path):
    path = tmp_path / "run.mcap"
    file = RecordingWriter(path)
    file._writer._Writer__stream = Full(file._file, 3000)
    stopped = None
    for number in range(100_000):
        try:
            file.put(int(1e9 * number), "live/ada", number.to_bytes(4, "little"))
        except RecordingStopped as error:
            stopped = error
            break
        file._thread.join(0.0005)
    assert stopped is not None
    assert stopped.exit_code == 4
    assert "No space left on device" in str(stopped)
    assert str(path) in str(stopped)
    with pytest.raises(RecordingStopped):
        file.close()
    assert path.stat().st_size == file.size <= 3000
    tape = read_recording(path)
    assert [int.from_bytes(e.payload, "little") for e in tape.messages] == list(range(len(tape.messages)))


def test_what_was_recorded_is_readable_while_the_recorder_runs(tmp_path):
    """Within a second of being put, a message can be read by another program."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as file:
        file.put(1, "live/ada", b"\x01")
        until(lambda: file.size and len(read_recording(path).messages) == 1)
        with path.open("rb") as half, pytest.raises(Exception):  # noqa: B017 PT011 - its index comes at the end
            make_reader(half).get_summary()
    with path.open("rb") as full:
        assert make_reader(full).get_summary().statistics.message_count == 1
