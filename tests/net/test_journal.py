"""Facts on disk: whatever byte a process dies at, what was written before is there, and nothing is lost."""

from __future__ import annotations

import contextlib
import logging

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server import journal as keep
from vinesim.net.server.admission import SceneId
from vinesim.net.server.journal import Journal, JournalError, load_all
from vinesim.scene.ids import ObjectKind, object_id

PLAN = SceneId("vsp", "D1")


def fact(index=0, ownership=1, x=0.0, **more):
    return RetainedRecord(
        object_id(ObjectKind.BOX, index), ownership, 0, "ada", (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), **more
    )


def add(journal, cell, fact):
    """As the archive does it."""
    if news := journal.state.merge(cell, fact):
        journal.append(cell, fact)
    return news


def held(journal):
    return list(journal.state)


def fresh(folder, world="w"):
    return Journal(folder / f"{world}.facts", world, PLAN, RetainedState())


def test_what_was_added_is_there_again_with_its_scene(tmp_path):
    with fresh(tmp_path) as journal:
        assert add(journal, (0, 1), fact(0, x=1.5))
        assert add(journal, (0, 1), fact(1))
        assert add(journal, (-3, 2), fact(1, ownership=2))
        assert not add(journal, (0, 1), fact(1))
        expected = held(journal)
    again = load_all(tmp_path)["w"]
    assert again.scene_id == PLAN
    assert held(again) == expected == [((0, 1), fact(0, x=1.5)), ((-3, 2), fact(1, ownership=2))]


def test_what_is_added_is_in_the_file_at_once(tmp_path):
    journal = fresh(tmp_path)
    add(journal, (0, 0), fact(7))
    assert held(Journal.load(journal.path)) == [((0, 0), fact(7))]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_torn_at_any_byte_the_records_before_hold_and_the_file_is_kept(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("torn")
    with fresh(folder) as journal:
        ends = [journal.path.stat().st_size]
        for index in range(4):
            add(journal, (index, 0), fact(index))
            ends.append(journal.path.stat().st_size)
    whole = journal.path.read_bytes()
    cut = data.draw(st.integers(ends[0], len(whole)))
    torn = whole[:cut] + data.draw(st.binary(max_size=12))
    journal.path.write_bytes(torn)
    again = Journal.load(journal.path)
    sound = sum(end <= cut for end in ends[1:])
    assert held(again)[:sound] == [((index, 0), fact(index)) for index in range(sound)]
    again.close()
    asides = list(folder.glob("*.torn-*"))
    if torn != whole[: ends[sound]]:
        assert [aside.read_bytes() for aside in asides] == [torn]
    else:
        assert asides == []
    assert held(Journal.load(journal.path))[:sound] == held(again)[:sound]
    assert len(list(folder.glob("*.torn-*"))) == len(asides)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_whatever_is_in_the_file_nothing_of_it_is_lost(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("any")
    with fresh(folder) as journal:
        for index in range(3):
            add(journal, (index, 0), fact(index))
    content = bytearray(journal.path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    journal.path.write_bytes(content)
    again = None
    with contextlib.suppress(JournalError):
        again = Journal.load(journal.path)
    if again is None:
        assert journal.path.read_bytes() == content
        return
    again.close()
    asides = [aside.read_bytes() for aside in folder.glob("*.torn-*")]
    assert asides == [bytes(content)] or (asides == [] and len(again.state) == 3)
    assert held(again) == [((index, 0), fact(index)) for index in range(len(again.state))]


def test_a_flipped_bit_ends_what_is_believed_in_one_line(tmp_path, caplog):
    with fresh(tmp_path) as journal:
        add(journal, (0, 0), fact(0))
        end = journal.path.stat().st_size
        add(journal, (0, 0), fact(1))
        add(journal, (0, 0), fact(2))
    content = bytearray(journal.path.read_bytes())
    content[end + 12] ^= 1
    journal.path.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert held(Journal.load(journal.path)) == [((0, 0), fact(0))]
    (line,) = caplog.messages
    assert "torn-1" in line
    assert "1 facts" in line


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "no journal"),
        (b"PNG something else", "no journal"),
        (b"vsfacts\x09rest", "version 09"),
        (b"vsfacts\x01", "head is torn"),
        (b"vsfacts\x01" + keep._packed(b"nonsense"), "its world is unknown"),
        (b"vsfacts\x01" + keep._packed(keep._encoder.encode(keep._Header("w", "s", "d", 9))), "protocol version 9"),
    ],
)
def test_a_foreign_file_is_refused_and_left_as_it_is(tmp_path, content, word):
    (tmp_path / "w.facts").write_bytes(content)
    with pytest.raises(JournalError, match=word) as caught:
        load_all(tmp_path)
    assert "w.facts" in str(caught.value)
    assert "--state-dir" in str(caught.value)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("w.facts", content)]


def test_a_file_of_another_world_is_refused(tmp_path):
    fresh(tmp_path, "w").close()
    (tmp_path / "w.facts").rename(tmp_path / "v.facts")
    with pytest.raises(JournalError, match=r"rename it to w\.facts"):
        load_all(tmp_path)


def test_an_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="cannot be written"):
        load_all(tmp_path / "file")


def test_what_holds_no_more_is_left_out_in_time(tmp_path, monkeypatch):
    monkeypatch.setattr(keep, "MAX_OBSOLETE_RECORDS", 10)
    with fresh(tmp_path) as journal:
        for ownership in range(1, 200):
            add(journal, (0, 0), fact(0, ownership))
            journal.sync()
        assert journal.path.stat().st_size < 30 * len(messages.encode_records([fact(0, 199)]))
        add(journal, (0, 0), fact(0, 200))
    assert held(Journal.load(journal.path)) == [((0, 0), fact(0, 200))]


def test_half_a_new_journal_does_no_harm(tmp_path):
    with fresh(tmp_path) as journal:
        add(journal, (0, 0), fact(0))
    (tmp_path / "w.facts.part").write_bytes(b"vsfacts\x01half")
    assert held(load_all(tmp_path)["w"]) == [((0, 0), fact(0))]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w.facts"]
