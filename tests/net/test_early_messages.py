"""Messages of senders that are not admitted yet wait within bounds, and live senders come first."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.net.test_replicator import Client, run
from vinesim.net.codec.control import RetainedRecord, encode_records
from vinesim.net.replication import receiver
from vinesim.net.replication.receiver import (
    MAX_EARLY_BYTES,
    MAX_EARLY_MESSAGES,
    MAX_EARLY_SENDERS,
    MAX_EARLY_TOTAL,
    EarlyMessages,
)
from vinesim.net.transport.memory_bus import MemoryHub

_PUTS = st.lists(st.tuples(st.integers(0, 9), st.sampled_from((0, 1, 30, 60, 100))), max_size=80)


def test_messages_are_taken_in_order_and_once():
    early = EarlyMessages()
    for number in range(3):
        assert early.put("ada", f"fact/0/{number}/ada", bytes(number), lambda _: True) == 0
    assert early.take("ada") == [(f"fact/0/{number}/ada", bytes(number)) for number in range(3)]
    assert early.take("ada") == []
    assert early.size == len(early) == 0


@given(_PUTS)
def test_bytes_messages_and_senders_are_bounded_and_every_message_is_kept_or_counted(puts):
    bounds = {"MAX_EARLY_MESSAGES": 5, "MAX_EARLY_BYTES": 100, "MAX_EARLY_SENDERS": 4, "MAX_EARLY_TOTAL": 250}
    before = {name: getattr(receiver, name) for name in bounds}
    vars(receiver).update(bounds)
    try:
        early = EarlyMessages()
        discarded = 0
        for sender, size in puts:
            discarded += early.put(f"{sender}", "key", bytes(size), lambda name: int(name) < 3)
            assert len(early) <= 4
            assert early.size <= 250
        kept = [early.take(f"{sender}") for sender in range(10)]
    finally:
        vars(receiver).update(before)
    assert all(len(messages) <= 5 and sum(len(payload) for _, payload in messages) <= 100 for messages in kept)
    assert sum(map(len, kept)) + discarded == len(puts)


def test_names_that_are_not_live_do_not_keep_a_live_sender_out():
    early = EarlyMessages()
    for number in range(MAX_EARLY_SENDERS + 10):
        early.put(f"nobody_{number}", "key", bytes(10), lambda _: False)
    assert len(early) == MAX_EARLY_SENDERS
    assert early.put("ada", "key", b"record", lambda name: name == "ada") == MAX_EARLY_SENDERS
    assert early.take("ada") == [("key", b"record")]


def test_a_client_holds_a_bounded_amount_of_messages_of_strangers():
    """Any number of names, each with messages of any size."""
    hub = MemoryHub()
    hub.binds_names = False
    ada = Client(hub, "ada", 0.5)
    run(hub, [ada], 0.1)
    stranger = hub.bus("stranger", live=False)
    record = RetainedRecord(3, 1, 0, "stranger")
    payload = encode_records([record]) + bytes(MAX_EARLY_BYTES // 4)
    before = ada.replicator.counters.dropped
    sent = 0
    for name in range(3 * MAX_EARLY_SENDERS):
        publisher = stranger.publisher(f"fact/0/0/name_{name}", reliable=True)
        for _ in range(3):
            sent += publisher.put(payload)
        run(hub, [ada], 0.01)
    early = ada.replicator._receiver.early
    assert sent == 9 * MAX_EARLY_SENDERS
    assert early.size <= MAX_EARLY_TOTAL
    assert len(early) <= MAX_EARLY_SENDERS
    kept = sum(len(early.take(f"name_{name}")) for name in range(3 * MAX_EARLY_SENDERS))
    assert 0 < kept <= MAX_EARLY_MESSAGES
    assert ada.replicator.counters.dropped - before == sent - kept
