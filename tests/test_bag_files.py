"""Recordings of ROS topics as people have them: folders, several files, SQLite, compressed, cut off; without ROS."""

from __future__ import annotations

import pathlib
import random
import shutil
import sqlite3

import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, Writer

from vinesim.core.bag_files import BagError, BagMessage, open_bag

QOS = "- durability: transient_local\n"


def messages(count: int, first: int = 0) -> list[BagMessage]:
    """Returns messages of two topics, each unlike the others."""
    return [BagMessage(f"/topic_{i % 2}", 1000 * i, f"message {i}".encode() * 9) for i in range(first, first + count)]


def write_mcap(file: pathlib.Path, rows: list[BagMessage], chunk: int = 2000, packing=CompressionType.ZSTD) -> None:
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk or 1, compression=packing, use_chunking=bool(chunk))
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        ids: dict[str, int] = {}
        for topic, time, data in rows:
            if topic not in ids:
                ids[topic] = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": QOS})
            writer.add_message(ids[topic], time, data, time)
        writer.finish()


def write_sqlite(file: pathlib.Path, rows: list[BagMessage]) -> None:
    """Write the schema of rosbag2, with later messages first, as a recorder may."""
    with sqlite3.connect(file) as base:
        base.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT)"
        )
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        names = sorted({row.topic for row in rows})
        for number, name in enumerate(names):
            base.execute("INSERT INTO topics VALUES(?, ?, 'std_msgs/msg/String', 'cdr', ?)", (number, name, QOS))
        for topic, time, data in reversed(rows):
            base.execute("INSERT INTO messages VALUES(NULL, ?, ?, ?)", (names.index(topic), time, data))
    base.close()


def write_metadata(folder: pathlib.Path, names: list[str], **about: str) -> None:
    text = yaml.safe_dump({"rosbag2_bagfile_information": {"version": 9, "relative_file_paths": names, **about}})
    (folder / "metadata.yaml").write_text(text)


@pytest.mark.parametrize("write", [write_mcap, write_sqlite])
@pytest.mark.parametrize("is_named", [True, False])
def test_the_files_of_a_folder_are_read_in_order(tmp_path, write, is_named):
    """Twelve files: by their names alone, file 10 would come after file 1."""
    suffix = {write_mcap: "mcap", write_sqlite: "db3"}[write]
    names = [f"run_{number}.{suffix}" for number in range(12)]
    for number, name in enumerate(names):
        write(tmp_path / name, messages(5, 5 * number))
    if is_named:
        write_metadata(tmp_path, names)
    bag = open_bag(tmp_path)
    assert list(bag.messages()) == messages(60)
    assert [row for row in messages(60) if row.topic == "/topic_1"] == list(bag.messages({"/topic_1"}))
    assert (bag.topics["/topic_0"].type_name, bag.topics["/topic_0"].qos) == ("std_msgs/msg/String", QOS)
    assert bag.damage == ""
    if is_named:
        (tmp_path / names[4]).unlink()
        with pytest.raises(BagError, match=rf"{names[4]}: is not there"):
            open_bag(tmp_path)


@pytest.mark.parametrize("write", [write_mcap, write_sqlite])
def test_compressed_recordings_are_read(tmp_path, write):
    """Files and messages compressed by zstd, as rosbag2 does; another compressor is named."""
    plain = tmp_path / "plain"
    write(plain, messages(20))
    (tmp_path / "run_0.x.zstd").write_bytes(zstandard.compress(plain.read_bytes()))
    write_metadata(tmp_path, ["run_0.x.zstd"], compression_mode="FILE", compression_format="zstd")
    assert list(open_bag(tmp_path).messages()) == messages(20)

    write(tmp_path / "run_0", [row._replace(data=zstandard.compress(row.data)) for row in messages(20)])
    write_metadata(tmp_path, ["run_0"], compression_mode="MESSAGE", compression_format="zstd")
    assert list(open_bag(tmp_path).messages()) == messages(20)
    write_metadata(tmp_path, ["run_0"], compression_mode="MESSAGE", compression_format="lz4")
    with pytest.raises(BagError, match="lz4; convert it without compression by: ros2 bag convert"):
        open_bag(tmp_path)


@pytest.mark.parametrize("packing", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("chunk", [0, 2000])
def test_of_a_cut_file_all_that_is_whole_is_read(tmp_path, packing, chunk):
    """At any byte: the first messages, none wrong, and how many there are."""
    rows = messages(200)
    file = tmp_path / "run.mcap"
    write_mcap(file, rows, chunk, packing)
    whole = file.read_bytes()
    counts = []
    for size in sorted(random.Random(1).sample(range(20, len(whole)), 40)):
        file.write_bytes(whole[:size])
        bag = open_bag(file)
        read = list(bag.messages())
        assert read == rows[: len(read)]
        assert bag.damage == f"{file}: is cut off after message {len(read)}"
        counts.append(len(read))
    assert counts == sorted(counts)
    assert counts[0] < 20 < 180 < counts[-1]


def test_a_whole_file_is_read_by_its_index_and_damage_ends_it(tmp_path):
    """By the index a topic is read without the rest of the file, and messages in the order of their times."""
    rows = messages(200)
    file = tmp_path / "run.mcap"
    write_mcap(file, rows[100:] + rows[:100], packing=CompressionType.NONE)
    assert list(open_bag(file).messages()) == rows
    data = bytearray(file.read_bytes())
    data[data.index(b"message 150")] ^= 0x55
    file.write_bytes(data)
    bag = open_bag(file)
    read = list(bag.messages())
    assert 0 < len(read) < 200
    assert read == rows[: len(read)]
    assert bag.damage.startswith(f"{file}: is damaged after message {len(read)} (")


def test_a_cut_file_of_a_folder_does_not_hide_the_next_one(tmp_path):
    for number in range(2):
        write_mcap(tmp_path / f"run_{number}.mcap", messages(20, 20 * number), chunk=0)
    first = tmp_path / "run_0.mcap"
    first.write_bytes(first.read_bytes()[:-900])
    bag = open_bag(tmp_path)
    read = list(bag.messages())
    assert read[-20:] == messages(20, 20)
    assert bag.damage == f"{first}: is cut off after message {len(read) - 20}"


def test_a_cut_sqlite_file_is_refused(tmp_path):
    """SQLite would take the missing bytes of the last page for zeros."""
    file = tmp_path / "run.db3"
    write_sqlite(file, messages(200))
    whole = file.read_bytes()
    for size in random.Random(1).sample(range(20, len(whole)), 30):
        file.write_bytes(whole[:size])
        with pytest.raises(
            BagError, match=r"is cut off, \d+ of \d+ bytes are there; recover what is whole by: sqlite3"
        ):
            open_bag(file)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("run.mcap", b"", "is empty"),
        ("run.mcap", b"nothing", "is no MCAP or SQLite file"),
        ("run.bag", b"#ROSBAG V2.0\n" + bytes(50), "recording of ROS 1; convert it"),
        ("run.db3", b"SQLite format 3\0" + bytes(200), "no whole recording of rosbag2"),
        (None, b"", "No such file"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, name, content, words):
    file = tmp_path / (name or "missing.mcap")
    if name is not None:
        file.write_bytes(content)
    with pytest.raises(BagError, match=words) as caught:
        open_bag(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_recording_is_refused(tmp_path):
    with pytest.raises(BagError, match=r"no \.mcap and no \.db3 file"):
        open_bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(BagError, match=r"no \.mcap and no \.db3 file"):
        open_bag(tmp_path)
    write_mcap(tmp_path / "run_0.mcap", messages(3))
    assert list(open_bag(tmp_path).messages()) == messages(3)
    shutil.rmtree(tmp_path)
