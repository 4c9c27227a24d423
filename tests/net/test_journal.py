"""The journal on disk: records before a torn write are read again, and no byte is deleted."""

from __future__ import annotations

import contextlib
import logging
import resource

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.codec.control import RetainedRecord, encode_records
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server import journal as journal_module
from vinesim.net.server.admission import SceneId
from vinesim.net.server.journal import Journal, JournalError, load_all
from vinesim.scene.ids import ObjectKind, object_id

SCENE = SceneId("vsp", "D1")


def record(index=0, ownership=1, x=0.0, **more):
    return RetainedRecord(
        object_id(ObjectKind.BOX, index), ownership, 0, "ada", (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), **more
    )


def add(journal, cell, record):
    """Append a record if it is new, as the retained store does."""
    if changed := journal.state.merge(cell, record):
        journal.append(cell, record)
    return changed


def records_of(journal):
    return list(journal.state)


def new_journal(folder, world="w"):
    return Journal(folder / f"{world}.facts", world, SCENE, RetainedState())


def test_added_records_are_read_again_with_their_scene(tmp_path):
    with new_journal(tmp_path) as journal:
        assert add(journal, (0, 1), record(0, x=1.5))
        assert add(journal, (0, 1), record(1))
        assert add(journal, (-3, 2), record(1, ownership=2))
        assert not add(journal, (0, 1), record(1))
        expected = records_of(journal)
    reloaded = load_all(tmp_path)["w"]
    assert reloaded.scene_id == SCENE
    assert records_of(reloaded) == expected == [((0, 1), record(0, x=1.5)), ((-3, 2), record(1, ownership=2))]


def test_an_added_record_is_in_the_file_at_once(tmp_path):
    journal = new_journal(tmp_path)
    add(journal, (0, 0), record(7))
    assert records_of(Journal.load(journal.path)) == [((0, 0), record(7))]


@given(st.data())
def test_a_file_torn_at_any_byte_yields_the_records_before_and_is_backed_up(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("torn")
    with new_journal(folder) as journal:
        ends = [journal.path.stat().st_size]
        for index in range(4):
            add(journal, (index, 0), record(index))
            ends.append(journal.path.stat().st_size)
    whole = journal.path.read_bytes()
    cut = data.draw(st.integers(ends[0], len(whole)))
    torn = whole[:cut] + data.draw(st.binary(max_size=12))
    journal.path.write_bytes(torn)
    reloaded = Journal.load(journal.path)
    sound = sum(end <= cut for end in ends[1:])
    assert records_of(reloaded)[:sound] == [((index, 0), record(index)) for index in range(sound)]
    reloaded.close()
    backups = list(folder.glob("*.torn-*"))
    if torn != whole[: ends[sound]]:
        assert [backup.read_bytes() for backup in backups] == [torn]
    else:
        assert backups == []
    assert records_of(Journal.load(journal.path))[:sound] == records_of(reloaded)[:sound]
    assert len(list(folder.glob("*.torn-*"))) == len(backups)


@given(st.data())
def test_a_damaged_file_is_refused_or_backed_up_unchanged(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("any")
    with new_journal(folder) as journal:
        for index in range(3):
            add(journal, (index, 0), record(index))
    content = bytearray(journal.path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    journal.path.write_bytes(content)
    reloaded = None
    with contextlib.suppress(JournalError):
        reloaded = Journal.load(journal.path)
    if reloaded is None:
        assert journal.path.read_bytes() == content
        return
    reloaded.close()
    backups = [backup.read_bytes() for backup in folder.glob("*.torn-*")]
    assert backups == [bytes(content)] or (backups == [] and len(reloaded.state) == 3)
    assert records_of(reloaded) == [((index, 0), record(index)) for index in range(len(reloaded.state))]


def test_reading_stops_at_a_flipped_bit_with_one_line(tmp_path, caplog):
    with new_journal(tmp_path) as journal:
        add(journal, (0, 0), record(0))
        end = journal.path.stat().st_size
        add(journal, (0, 0), record(1))
        add(journal, (0, 0), record(2))
    content = bytearray(journal.path.read_bytes())
    content[end + 12] ^= 1
    journal.path.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert records_of(Journal.load(journal.path)) == [((0, 0), record(0))]
    (line,) = caplog.messages
    assert "torn-1" in line
    assert "1 facts" in line


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no journal"),
        (b"PNG something else", "no journal"),
        (b"vsfacts\x09rest", "version 09"),
        (b"vsfacts\x01", "head is torn"),
        (b"vsfacts\x01" + journal_module._packed(b"nonsense"), "its world is unknown"),
        (
            b"vsfacts\x01"
            + journal_module._packed(journal_module._encoder.encode(journal_module._Header("w", "s", "d", 99))),
            "protocol version 99",
        ),
    ],
)
def test_a_file_of_another_format_is_refused_and_left_unchanged(tmp_path, content, reason):
    (tmp_path / "w.facts").write_bytes(content)
    with pytest.raises(JournalError, match=reason) as caught:
        load_all(tmp_path)
    assert "w.facts" in str(caught.value)
    assert "--state-dir" in str(caught.value)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("w.facts", content)]


@pytest.fixture
def full_disk():
    """Context manager under which no file grows beyond some bytes, which the operating system enforces."""

    @contextlib.contextmanager
    def limited(size):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


def test_a_torn_journal_on_a_full_disk_is_one_line_and_loses_nothing(tmp_path, full_disk):
    with new_journal(tmp_path) as journal:
        for index in range(20):
            add(journal, (0, 0), record(index))
    torn = journal.path.read_bytes()[:-3]
    journal.path.write_bytes(torn)
    with (
        full_disk(100),
        pytest.raises(JournalError, match=r"w\.facts: torn .* cannot be written .*make room") as caught,
    ):
        load_all(tmp_path)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 4
    assert [one.name for one in tmp_path.iterdir()] == ["w.facts"]
    assert journal.path.read_bytes() == torn
    assert len(load_all(tmp_path)["w"].state) == 19
    assert (tmp_path / "w.facts.torn-1").read_bytes() == torn


def test_an_unfinished_backup_is_removed(tmp_path):
    new_journal(tmp_path).close()
    (tmp_path / "w.facts.torn-1.part").write_bytes(b"x")
    load_all(tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["w.facts"]


def test_a_file_of_another_world_is_refused(tmp_path):
    new_journal(tmp_path, "w").close()
    (tmp_path / "w.facts").rename(tmp_path / "v.facts")
    with pytest.raises(JournalError, match=r"rename it to w\.facts"):
        load_all(tmp_path)


def test_an_unwritable_folder_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="cannot be written"):
        load_all(tmp_path / "file")


def test_obsolete_records_are_compacted(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_module, "MAX_OBSOLETE_RECORDS", 10)
    with new_journal(tmp_path) as journal:
        for ownership in range(1, 200):
            add(journal, (0, 0), record(0, ownership))
            journal.sync()
        assert journal.path.stat().st_size < 30 * len(encode_records([record(0, 199)]))
        add(journal, (0, 0), record(0, 200))
    assert records_of(Journal.load(journal.path)) == [((0, 0), record(0, 200))]


def test_an_unfinished_compaction_is_removed(tmp_path):
    with new_journal(tmp_path) as journal:
        add(journal, (0, 0), record(0))
    (tmp_path / "w.facts.part").write_bytes(b"vsfacts\x01half")
    assert records_of(load_all(tmp_path)["w"]) == [((0, 0), record(0))]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w.facts"]
