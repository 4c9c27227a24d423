"""Facts on their way: once to each who listens, again to a server that was gone, asked for where one comes to."""

from __future__ import annotations

from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.counters import Counters
from vinesim.net.replication.retained_sync import RetainedSync
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id

HERE, THERE = (0, 0), (7, 7)


def fact(box: int, x: float = 0.0, author: str = "ada", authority: int = 1) -> RetainedRecord:
    return RetainedRecord(object_id(ObjectKind.BOX, box), 0, authority, author, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def heard(bus) -> list[tuple[str, int]]:
    return [(key, len(messages.decode_records(payload))) for key, payload in bus.poll()]


def speak(hub: MemoryHub, telling: RetainedSync, ticks: int = 3) -> None:
    for _ in range(ticks):
        telling.update_window([HERE], 0, hub.time)
        telling.flush()
        hub.advance(0.01)


def test_a_fact_waits_until_somebody_listens_and_leaves_once():
    hub = MemoryHub()
    ada = RetainedSync(hub.bus("ada"), Counters())
    ada.publish(HERE, fact(0))
    speak(hub, ada, 10)
    assert ada.counters.retained.messages_out == 0
    server = hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    speak(hub, ada, 10)
    assert heard(server) == [("fact/0/0/ada", 1)]
    # also far from where one is oneself, and what was overtaken is not said at all
    ada.publish(THERE, fact(1, 40.0))
    ada.publish(THERE, fact(1, 41.0, authority=2))
    speak(hub, ada)
    ((_, payload),) = server.poll()
    assert [one.pose[0] for one in messages.decode_records(payload)] == [41.0]


def test_many_facts_travel_together_in_messages_below_a_datagram():
    hub = MemoryHub()
    ada, server = RetainedSync(hub.bus("ada"), Counters()), hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    for box in range(40):
        ada.publish(HERE, fact(box))
    speak(hub, ada, 10)
    came = server.poll()
    assert sum(len(messages.decode_records(payload)) for _, payload in came) == 40
    assert max(len(payload) for _, payload in came) <= messages.MAX_DATAGRAM
    assert len(came) <= 5


def test_what_i_said_last_is_said_again_when_the_server_was_gone():
    hub = MemoryHub()
    ada, server = RetainedSync(hub.bus("ada"), Counters()), hub.bus("server")
    server.subscribe("fact/**", KEEP_ALL)
    ada.publish(HERE, fact(0))
    ada.publish(HERE, fact(1))
    speak(hub, ada)
    # another one has moved box 1 since: that is for it to repeat
    assert ada.merge(HERE, fact(1, 5.0, "bob", 2))
    server.poll()
    hub.down = True
    speak(hub, ada)
    hub.down = False
    speak(hub, ada)
    ((_, payload),) = server.poll()
    assert [one.object for one in messages.decode_records(payload)] == [object_id(ObjectKind.BOX, 0)]
    speak(hub, ada, 100)
    assert server.poll() == []


def test_the_server_is_asked_once_for_each_cell_and_again_only_if_it_is_silent():
    hub, asked = MemoryHub(), []
    ada, server = RetainedSync(hub.bus("ada"), Counters()), hub.bus("server")
    server.declare_queryable(
        "snap/0/0", lambda _: asked.append(hub.time) or messages.encode_records([fact(3, 1.0, "bob")])
    )
    speak(hub, ada)
    assert len(asked) == 1
    ((key, payload, _),) = ada.bus.replies()
    ada.mark_answered(HERE)
    assert (key, messages.decode_records(payload)[0].object) == ("snap/0/0", object_id(ObjectKind.BOX, 3))
    speak(hub, ada, 500)
    assert len(asked) == 1
    for _ in range(2000):
        ada.update_window([THERE], 1, hub.time)
        hub.advance(0.01)
    ada.update_window([HERE], 2, hub.time)
    hub.advance(0.01)
    assert len(asked) == 2
