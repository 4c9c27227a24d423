"""The server's retained store: order of records, size of replies, quotas, and a full disk."""

from __future__ import annotations

import errno

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.waiting import wait
from vinesim.net.codec.control import RetainedRecord, decode_records, encode_records
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server import journal, retained_store
from vinesim.net.server.admission import SceneId
from vinesim.net.server.retained_store import Quota, RetainedStore
from vinesim.scene.ids import ObjectKind, object_id

SCENE = SceneId("vsp", "D1")
UNLIMITED = Quota(1e9, 1e12)


def record(index=0, ownership=1, author="ada", cut=()):
    kind = ObjectKind.TREE if cut else ObjectKind.BOX
    return RetainedRecord(object_id(kind, index), ownership, 0, author, cut=cut)


def submit(store, record, cell=(0, 0), world="w"):
    store.submit(f"{world}/fact/{cell[0]}/{cell[1]}/{record.author}", encode_records([record]))


def all_records(store, world="w"):
    """All records of a world with their cells, from its snapshots."""
    parts = store.snapshot(world, store.cells(world))
    found = [(cell, record) for cell, payload in parts for record in decode_records(payload)]
    return sorted(found, key=lambda row: row[1].object)


records = st.builds(
    record, st.integers(0, 3), st.integers(0, 4), st.sampled_from(["ada", "bob"]), st.sampled_from([(), (1,), (2, 3)])
)
submission_lists = st.lists(st.tuples(st.tuples(st.integers(-2, 2), st.just(0)), records), max_size=30)


@given(submission_lists, st.randoms())
def test_any_order_and_reloading_give_the_same_snapshot(tmp_path_factory, submissions, random):
    folder = tmp_path_factory.mktemp("kept")
    # under one claim an author publishes one record of an object, in one cell
    unique = {(one.claim, one.object): (cell, one) for cell, one in submissions}
    submissions = list(unique.values())
    expected = RetainedState()
    for cell, one in submissions:
        expected.merge(cell, one)
    shuffled = submissions * 2
    random.shuffle(shuffled)
    store = RetainedStore(folder, UNLIMITED)
    store.open("w", SCENE)
    for cell, one in shuffled:
        submit(store, one, cell)
    store.close()
    reloaded = RetainedStore(folder, UNLIMITED)
    reloaded.close()
    assert all_records(store) == all_records(reloaded) == list(expected)
    assert reloaded.scene_of("w") == (SCENE if submissions else None)


def test_an_empty_cell_gives_an_empty_reply():
    store = RetainedStore()
    store.close()
    ((cell, payload),) = store.snapshot("w", [(7, 7)])
    assert (cell, decode_records(payload)) == ((7, 7), [])


def test_replies_are_split_at_the_size_limit(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_REPLY", 500)
    store = RetainedStore(quota=UNLIMITED)
    store.open("w", SCENE)
    for index in range(100):
        submit(store, record(index))
    store.close()
    parts = store.snapshot("w", [(0, 0)])
    assert max(len(payload) for _, payload in parts) <= 500
    assert all_records(store) == [((0, 0), record(index)) for index in range(100)]


def test_the_number_of_stored_objects_is_limited(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_OBJECTS", 3)
    store = RetainedStore(quota=UNLIMITED)
    store.open("w", SCENE)
    for index in range(5):
        submit(store, record(index))
    submit(store, record(1, ownership=2))  # updates of a known object are always accepted
    store.close()
    assert all_records(store) == [((0, 0), record(0)), ((0, 0), record(1, 2)), ((0, 0), record(2))]
    assert store.counters.rejected == 2


def test_a_quota_refills_with_time(monkeypatch):
    now = 100.0
    monkeypatch.setattr(retained_store.time, "monotonic", lambda: now)
    bucket = retained_store._TokenBucket(Quota(2.0, 1000.0), now)
    assert [bucket.spend(1, now) for _ in range(11)] == [True] * 10 + [False]
    assert [bucket.spend(1, now + 1.0) for _ in range(3)] == [True, True, False]
    assert not bucket.spend(5001, now + 100.0)
    assert bucket.spend(4999, now + 100.0)


def test_records_stay_in_memory_while_the_disk_is_full_and_are_written_afterwards(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(retained_store, "RETRY_PERIOD", 0.05)
    store = RetainedStore(tmp_path, UNLIMITED)
    store.open("w", SCENE)
    submit(store, record(0))
    wait(lambda: store.count() == 1 and (tmp_path / "w.facts").exists(), "a record on disk")
    original = journal._packed

    attempts = []

    def fail(content):
        attempts.append(content)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(journal, "_packed", fail)
    submit(store, record(1))
    wait(lambda: store.status_message, "the disk to be full")
    assert "No space left" in store.status_message
    submit(store, record(2))
    wait(lambda: store.count() == 3, "all in memory")
    wait(lambda: len(attempts) >= 3, "attempts to write everything while the disk is still full")
    monkeypatch.setattr(journal, "_packed", original)
    wait(lambda: not store.status_message, "the disk to be writable")
    submit(store, record(3))
    store.close()
    reloaded = RetainedStore(tmp_path)
    reloaded.close()
    assert all_records(reloaded) == all_records(store) == [((0, 0), record(index)) for index in range(4)]
    assert len([line for line in caplog.messages if "kept in memory only" in line]) == 1


@pytest.mark.parametrize(
    "key",
    ["w", "w/fact", "", "w/fact/ada", "w/fact/0/ada", "w/fact/x/0/ada", "w/fact/0/0/0/ada", "w/fact/99999999999/0/ada"],
)
def test_a_key_without_a_valid_cell_is_malformed(key):
    store = RetainedStore()
    store.open("w", SCENE)
    store.submit(key, encode_records([record()]))
    store.close()
    assert (store.counters.malformed, store.count()) == (1, 0)


def test_a_message_that_ends_in_an_error_does_not_end_the_thread(monkeypatch, caplog):
    store = RetainedStore(quota=UNLIMITED)
    store.open("w", SCENE)
    failing = [True, True, False]
    monkeypatch.setattr(
        retained_store, "decode_records", lambda payload: 1 // 0 if failing.pop(0) else decode_records(payload)
    )
    for _ in range(3):
        submit(store, record())
    wait(lambda: store.count() == 1, "the third to be kept")
    store.close()
    assert store.counters.errors == 2
    assert len([line for line in caplog.messages if "ended in an error" in line]) == 1


def test_a_thread_that_has_ended_is_reported(monkeypatch):
    store = RetainedStore()
    monkeypatch.setattr(store, "_ingest_guarded", lambda *_: 1 // 0)
    submit(store, record())
    wait(lambda: "has ended" in store.status_message, "the thread to end")


def test_bytes_of_messages_that_wait_are_bounded(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_EARLY_BYTES", 1000)
    monkeypatch.setattr(retained_store, "MAX_QUEUED_BYTES", 5000)
    store = RetainedStore(quota=UNLIMITED)
    for _ in range(4):  # no actor was admitted to this world
        store.submit("w/fact/0/0/ada", bytes(400))
    wait(lambda: store.counters.rejected == 2, "the oldest to be discarded")
    store.submit("w/fact/0/0/ada", bytes(5001))
    assert store.counters.rejected == 3
    store.open("w", SCENE)
    wait(lambda: store.counters.malformed == 2, "those that waited")
    store.close()
    assert store._queued_bytes.value == 0


def test_records_beyond_the_queue_limit_are_rejected(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_QUEUED", 10)
    store = RetainedStore(quota=UNLIMITED)
    store.open("w", SCENE)
    with store._lock:  # while the writer thread is blocked
        for index in range(100):
            submit(store, record(index))
    store.close()
    assert 10 <= store.count() <= 12
    assert store.counters.rejected == 100 - store.count()
