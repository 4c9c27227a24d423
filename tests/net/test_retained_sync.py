"""Synchronisation of retained records: sent once, sent again after a server outage, queried per cell."""

from __future__ import annotations

from vinesim.net.codec.control import RetainedRecord, decode_records, encode_records
from vinesim.net.codec.header import MAX_DATAGRAM
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.retained_sync import REPAIR_DELAY, REPAIR_PERIOD, RetainedSync
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id

HERE = (0, 0)
THERE = (7, 7)


def record(box: int, x: float = 0.0, author: str = "ada", authority: int = 1) -> RetainedRecord:
    return RetainedRecord(object_id(ObjectKind.BOX, box), 0, authority, author, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def received(bus) -> list[tuple[str, int]]:
    return [(key, len(decode_records(payload))) for key, payload in bus.poll()]


def run(hub: MemoryHub, sync: RetainedSync, ticks: int = 3) -> None:
    for _ in range(ticks):
        sync.update_window([HERE], 0, hub.time)
        sync.flush()
        hub.advance(0.01)


def test_a_record_waits_for_a_subscriber_and_is_sent_once():
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    ada.publish(HERE, record(0))
    run(hub, ada, 10)
    assert ada.counters.retained.messages_out == 0
    server = hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    run(hub, ada, 10)
    assert received(server) == [("fact/0/0/ada", 1)]
    # also in a cell outside the window; an outdated record is not sent
    ada.publish(THERE, record(1, 40.0))
    ada.publish(THERE, record(1, 41.0, authority=2))
    run(hub, ada)
    ((_, payload),) = server.poll()
    assert [one.pose[0] for one in decode_records(payload)] == [41.0]


def test_many_records_share_messages_below_the_datagram_size():
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    for box in range(40):
        ada.publish(HERE, record(box))
    run(hub, ada, 10)
    messages_received = server.poll()
    assert sum(len(decode_records(payload)) for _, payload in messages_received) == 40
    assert max(len(payload) for _, payload in messages_received) <= MAX_DATAGRAM
    assert len(messages_received) <= 5


def test_own_latest_records_are_sent_again_after_a_server_outage():
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    ada.publish(HERE, record(0))
    ada.publish(HERE, record(1))
    run(hub, ada)
    # bob has moved box 1 since: bob sends that record again
    assert ada.merge(HERE, record(1, 5.0, "bob", 2))
    server.poll()
    hub.down = True
    run(hub, ada)
    hub.down = False
    run(hub, ada)
    ((_, payload),) = server.poll()
    assert [one.object for one in decode_records(payload)] == [object_id(ObjectKind.BOX, 0)]
    run(hub, ada, 100)
    assert server.poll() == []


def test_each_cell_is_queried_once_and_again_when_it_is_entered_again():
    hub = MemoryHub()
    queries = []
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    server.declare_queryable("snap/0/0", lambda _: queries.append(hub.time) or encode_records([record(3, 1.0, "bob")]))
    run(hub, ada)
    assert len(queries) == 1
    ((key, payload, _),) = ada.bus.replies()
    ada.mark_answered(HERE)
    assert (key, decode_records(payload)[0].object) == ("snap/0/0", object_id(ObjectKind.BOX, 3))
    run(hub, ada, 500)
    assert len(queries) == 1
    for _ in range(2000):
        ada.update_window([THERE], 1, hub.time)
        hub.advance(0.01)
    ada.update_window([HERE], 2, hub.time)
    hub.advance(0.01)
    assert len(queries) == 2


def test_records_are_exchanged_again_some_time_after_a_message_was_dropped():
    """Ada receives a record under bob's name from a session that does not seem to hold it, and drops it."""
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    queries = []
    server.declare_queryable("snap/0/0", lambda _: queries.append(hub.time) or encode_records([record(3, 1.0, "bob")]))
    server.subscribe("fact/**", KEEP_ALL)
    ada.publish(HERE, record(0))
    run(hub, ada)
    ada.mark_answered(HERE)
    assert received(server) == [("fact/0/0/ada", 1)]
    for _ in range(5):
        server.publisher("fact/0/0/bob").put(encode_records([record(3, 1.0, "bob")]))
    server.publisher("a/bob").put(b"a pose, to which nobody subscribes")
    run(hub, ada, 2)
    assert ada.bus.missed == 5
    assert ada.bus.poll() == []
    run(hub, ada, round(0.9 * REPAIR_DELAY / 0.01))
    assert len(queries) == 1
    run(hub, ada, round(0.11 * REPAIR_DELAY / 0.01))
    assert (received(server), len(queries)) == ([("fact/0/0/ada", 1)], 2)
    ada.mark_answered(HERE)
    run(hub, ada, round(2.0 * REPAIR_PERIOD / 0.01))
    assert (received(server), len(queries)) == ([], 2), "once for all"


def test_false_messages_make_an_actor_exchange_its_records_seldom():
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    queries = []
    server.declare_queryable("snap/0/0", lambda _: queries.append(hub.time) or encode_records([]))
    false = server.publisher("fact/0/0/bob")
    start = hub.time
    while hub.time < start + 5.0 * REPAIR_PERIOD:
        false.put(b"false")
        run(hub, ada, 1)
        ada.mark_answered(HERE)
    assert 4 <= len(queries) <= 6


def test_records_are_exchanged_again_after_a_loss_of_the_connection_that_the_loop_did_not_see():
    """A loop that gets no processor time finds the connection as it was, and one more admission."""
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    server = hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    queries = []
    server.declare_queryable("snap/0/0", lambda _: queries.append(hub.time) or encode_records([]))
    ada.publish(HERE, record(0))
    run(hub, ada)
    ada.mark_answered(HERE)
    assert (received(server), len(queries)) == ([("fact/0/0/ada", 1)], 1)
    hub.admissions += 1
    run(hub, ada)
    assert (received(server), len(queries)) == ([("fact/0/0/ada", 1)], 2)
    ada.mark_answered(HERE)
    run(hub, ada, 2000)
    assert (received(server), len(queries)) == ([], 2)
