"""What the server keeps: in whatever order facts come, however many answers they take, and when the disk is full."""

from __future__ import annotations

import errno

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.waiting import wait
from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server import journal, retained_store
from vinesim.net.server.admission import SceneId
from vinesim.net.server.retained_store import Quota, RetainedStore
from vinesim.scene.ids import ObjectKind, object_id

PLAN = SceneId("vsp", "D1")
PLENTY = Quota(1e9, 1e12)


def fact(index=0, ownership=1, author="ada", cut=()):
    kind = ObjectKind.TREE if cut else ObjectKind.BOX
    return RetainedRecord(object_id(kind, index), ownership, 0, author, cut=cut)


def hear(kept, fact, cell=(0, 0), world="w"):
    kept.submit(f"{world}/fact/{cell[0]}/{cell[1]}/{fact.author}", messages.encode_records([fact]))


def told(kept, world="w"):
    """All facts of a world as its snapshots tell them, with their cells."""
    parts = kept.snapshot(world, kept.cells(world))
    found = [(cell, fact) for cell, payload in parts for fact in messages.decode_records(payload)]
    return sorted(found, key=lambda row: row[1].object)


facts = st.builds(
    fact, st.integers(0, 3), st.integers(0, 4), st.sampled_from(["ada", "bob"]), st.sampled_from([(), (1,), (2, 3)])
)
said = st.lists(st.tuples(st.tuples(st.integers(-2, 2), st.just(0)), facts), max_size=30)


@settings(max_examples=25, deadline=None)
@given(said, st.randoms())
def test_in_any_order_and_from_disk_the_same_is_told(tmp_path_factory, sayings, random):
    folder = tmp_path_factory.mktemp("kept")
    # an author says one thing under one claim, in one cell
    once = {(one.claim, one.object): (cell, one) for cell, one in sayings}
    sayings = list(once.values())
    expected = RetainedState()
    for cell, one in sayings:
        expected.merge(cell, one)
    shuffled = sayings * 2
    random.shuffle(shuffled)
    kept = RetainedStore(folder, PLENTY)
    kept.open("w", PLAN)
    for cell, one in shuffled:
        hear(kept, one, cell)
    kept.close()
    again = RetainedStore(folder, PLENTY)
    again.close()
    assert told(kept) == told(again) == list(expected)
    assert again.scene_of("w") == (PLAN if sayings else None)


def test_a_cell_with_nothing_is_answered_with_nothing():
    kept = RetainedStore()
    kept.close()
    ((cell, payload),) = kept.snapshot("w", [(7, 7)])
    assert (cell, messages.decode_records(payload)) == ((7, 7), [])


def test_answers_are_cut_to_what_may_be_sent(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_REPLY", 500)
    kept = RetainedStore(quota=PLENTY)
    kept.open("w", PLAN)
    for index in range(100):
        hear(kept, fact(index))
    kept.close()
    parts = kept.snapshot("w", [(0, 0)])
    assert max(len(payload) for _, payload in parts) <= 500
    assert told(kept) == [((0, 0), fact(index)) for index in range(100)]


def test_there_is_an_end_to_what_is_kept(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_OBJECTS", 3)
    kept = RetainedStore(quota=PLENTY)
    kept.open("w", PLAN)
    for index in range(5):
        hear(kept, fact(index))
    hear(kept, fact(1, ownership=2))  # of what is known, news is always taken
    kept.close()
    assert told(kept) == [((0, 0), fact(0)), ((0, 0), fact(1, 2)), ((0, 0), fact(2))]
    assert kept.counters.rejected == 2


def test_a_quota_fills_again_with_time(monkeypatch):
    now = 100.0
    monkeypatch.setattr(retained_store.time, "monotonic", lambda: now)
    purse = retained_store._TokenBucket(Quota(2.0, 1000.0), now)
    assert [purse.spend(1, now) for _ in range(11)] == [True] * 10 + [False]
    assert [purse.spend(1, now + 1.0) for _ in range(3)] == [True, True, False]
    assert not purse.spend(5001, now + 100.0)
    assert purse.spend(4999, now + 100.0)


def test_when_the_disk_is_full_nothing_is_forgotten_and_when_it_is_not_all_is_written(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(retained_store, "RETRY_PERIOD", 0.05)
    kept = RetainedStore(tmp_path, PLENTY)
    kept.open("w", PLAN)
    hear(kept, fact(0))
    wait(lambda: kept.count() == 1 and (tmp_path / "w.facts").exists(), "a fact on disk")
    real = journal._packed

    def full(record):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(journal, "_packed", full)
    hear(kept, fact(1))
    wait(lambda: kept.status_message, "the disk to be full")
    assert "No space left" in kept.status_message
    hear(kept, fact(2))
    wait(lambda: kept.count() == 3, "all in memory")
    monkeypatch.setattr(journal, "_packed", real)
    wait(lambda: not kept.status_message, "the disk to be well")
    hear(kept, fact(3))
    kept.close()
    again = RetainedStore(tmp_path)
    again.close()
    assert told(again) == told(kept) == [((0, 0), fact(index)) for index in range(4)]
    assert len([line for line in caplog.messages if "kept in memory only" in line]) == 1


@pytest.mark.parametrize(
    "key", ["w/fact/ada", "w/fact/0/ada", "w/fact/x/0/ada", "w/fact/0/0/0/ada", "w/fact/99999999999/0/ada"]
)
def test_a_key_that_names_no_cell_is_malformed(key):
    kept = RetainedStore()
    kept.open("w", PLAN)
    kept.submit(key, messages.encode_records([fact()]))
    kept.close()
    assert (kept.counters.malformed, kept.count()) == (1, 0)


def test_a_flood_is_dropped_not_hoarded(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_QUEUED", 10)
    kept = RetainedStore(quota=PLENTY)
    kept.open("w", PLAN)
    with kept._lock:  # while the archive cannot go on
        for index in range(100):
            hear(kept, fact(index))
    kept.close()
    assert 10 <= kept.count() <= 12
    assert kept.counters.rejected == 100 - kept.count()
