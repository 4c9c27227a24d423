"""A name belongs to the session that joined with it: messages and answers of others under it are dropped."""

from __future__ import annotations

import contextlib

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.support.fake_client import FakeClient, tree_row
from tests.support.waiting import wait
from vinesim.net.codec.control import Hello, RetainedRecord, encode_claims, encode_hello, encode_records, encode_time
from vinesim.net.replication.authority import Claim
from vinesim.net.server.server import Server
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.endpoints import parse
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.net.transport.name_holders import NameHolders, bound_name
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import close_session, config, open_session
from vinesim.scene.ids import ObjectKind, object_id

KEYS = (
    "a/ada",
    "a/ada/far",
    "pose/0/-1/ada",
    "c/0/-1/ada",
    "tree/0/-1/ada",
    "near/0/-1/ada",
    "own/0/0/ada",
    "fact/3/4/ada",
    "force/bob/ada",
    "voice/ada",
    "voice/ada/pcm",
)


def hello(name: str, kind: str = "robot") -> bytes:
    return encode_hello(Hello(name, kind=kind, digest="D1", scene="vsp"))


@pytest.fixture
def server():
    with Server("tcp/127.0.0.1:0") as running:
        yield running


@contextlib.contextmanager
def stranger(server):
    """A session of any other program that reaches the server."""
    session = open_session(config("client", connect__endpoints=[parse(server.endpoint).locator]))
    try:
        yield session
    finally:
        close_session(session)


def test_messages_under_a_name_count_only_from_the_session_that_joined_with_it(server):
    with (
        ZenohBus("ada", connect=server.endpoint) as ada,
        ZenohBus("bob", connect=server.endpoint) as bob,
        stranger(server) as evil,
    ):
        for each in (ada, bob):
            each.join(hello(each.name))
        wait(lambda: "ada" in bob.alive(), "bob to see ada")
        for key in KEYS:
            bob.subscribe(key, KEEP_ALL)
        publishers = [ada.publisher(key, reliable=True) for key in KEYS]
        wait(lambda: all(publisher.matching for publisher in publishers), "bob's subscriptions")
        token = evil.liveliness().declare_token(f"vs/1/vineyard/live/ada/{evil.zid()}")
        wait(lambda: len(bob._names._sessions["ada"]) == 2, "the second session that claims the name")
        for source in (None, zenoh.SourceInfo(evil.id, 0)):
            for key in KEYS:
                evil.put(f"vs/1/vineyard/{key}", b"forged", source_info=source)
        wait(lambda: bob.foreign == 2 * len(KEYS), "the forged messages to be counted")
        for publisher in publishers:
            publisher.put(b"own")
        received: list = []
        wait(lambda: received.extend(bob.poll()) or len(received) >= len(KEYS), "ada's own messages")
        assert sorted(received) == sorted((key, b"own") for key in KEYS)
        token.undeclare()


def test_records_that_the_server_keeps_come_from_the_session_that_joined(server):
    record = encode_records([RetainedRecord(object_id(ObjectKind.BOX, 1), 9, 0, "ada")])
    with ZenohBus("ada", connect=server.endpoint) as ada, stranger(server) as evil:
        ada.join(hello("ada"))
        evil.put("vs/1/vineyard/fact/0/0/ada", record)
        evil.put("vs/1/vineyard/fact/0/0/ada", record, source_info=zenoh.SourceInfo(evil.id, 0))
        evil.put("vs/1/vineyard/fact/0/0/eve", record.replace(b"ada", b"eve"))
        wait(lambda: server.foreign == 3, "the forged records to be counted")
        assert server.store.count() == 0
        publisher = ada.publisher("fact/0/0/ada", reliable=True)
        wait(lambda: publisher.matching, "the server's subscription")
        publisher.put(record)
        wait(lambda: server.store.count() == 1, "ada's own record")


def test_a_record_that_is_put_right_before_leaving_is_kept(server):
    """The end of a session and its last record reach the server's threads in any order."""
    with ZenohBus("witness", connect=server.endpoint) as witness:
        witness.join(hello("witness"))
        for number in range(20):
            with ZenohBus("ada", connect=server.endpoint) as ada:
                ada.join(hello("ada"))
                publisher = ada.publisher("fact/0/0/ada", reliable=True)
                wait(lambda publisher=publisher: publisher.matching, "the server's subscription")
                publisher.put(encode_records([RetainedRecord(object_id(ObjectKind.BOX, number), 9, 0, "ada")]))
        wait(lambda: server.store.count() + server.foreign == 20, "all records")
        assert server.foreign == 0


def test_a_spectator_publishes_no_records(server):
    with ZenohBus("guest", connect=server.endpoint) as guest:
        guest.join(hello("guest", "spectator"))
        publisher = guest.publisher("fact/0/0/guest", reliable=True)
        wait(lambda: publisher.matching, "the server's subscription")
        publisher.put(encode_records([RetainedRecord(object_id(ObjectKind.BOX, 1), 9, 0, "guest")]))
        wait(lambda: server.foreign == 1, "the record to be counted")
        assert server.store.count() == 0


def test_only_the_server_answers_what_is_asked_of_it_and_an_actor_for_itself(server):
    """A session that answers on every key, also by wildcards, before any other does."""
    forged: list[str] = []

    def respond(query: zenoh.Query) -> None:
        with query:
            for key in ("clock/bob", "snap/0/0", "hello/ada", "join/bob/1"):
                with contextlib.suppress(zenoh.ZError):
                    query.reply(f"vs/1/vineyard/{key}", b"forged")
            forged.append(str(query.key_expr))

    with stranger(server) as evil, ZenohBus("ada", connect=server.endpoint) as ada:
        served = [evil.declare_queryable(key, respond) for key in ("**", "vs/1/vineyard/**", "vs/1/vineyard/clock/*")]
        ada.join(hello("ada"))
        ada.declare_queryable("hello/ada", lambda _: hello("ada"))
        with ZenohBus("bob", connect=server.endpoint) as bob:
            bob.join(hello("bob"))
            wait(lambda: "ada" in bob.alive(), "bob to see ada")
            answers: list = []

            def is_answered() -> bool:
                for key in ("clock/bob", "snap/0/0", "hello/ada"):
                    bob.query(key, encode_time(1.0))
                answers.extend(bob.replies())
                return {answer.key for answer in answers} == {"clock/bob", "snap/0/0", "hello/ada"} and bob.foreign > 0

            wait(is_answered, "the answers, and a forged one to be counted")
            assert b"forged" not in {answer.payload for answer in answers}
            assert forged
        for each in served:
            each.undeclare()


def test_a_spectator_moves_nothing_on_clients():
    hub = MemoryHub()
    model = tree_row()
    ada = FakeClient(hub.bus("ada"), model, (1.0, 0.0))
    guest = FakeClient(hub.bus("guest"), model, (2.0, 0.0), kind="spectator", joints=0)

    def run(steps: int) -> None:
        for _ in range(steps):
            hub.advance(0.01)
            for each in (ada, guest):
                each.tick(hub.time)

    run(100)
    assert "guest" in ada.replicator.peers
    claims = encode_claims([(1, Claim(5, 5, "guest"), True)])
    record = encode_records([RetainedRecord(object_id(ObjectKind.BUNCH, 1), 9, 0, "guest", moving=True)])
    for key, payload in (("own/0/0/guest", claims), ("fact/0/0/guest", record)):
        guest.bus.publisher(key, reliable=True).put(payload)
    run(5)
    assert ada.replicator.counters.malformed == 2
    assert ada.replicator.known == frozenset()
    assert ada.facts == {}


def test_the_network_in_memory_binds_names_alike():
    hub = MemoryHub()
    ada, bob, evil = (hub.bus(name, live=name != "evil") for name in ("ada", "bob", "evil"))
    ada.declare_queryable("hello/ada", lambda _: b"own")
    evil.declare_queryable("hello/ada", lambda _: b"forged")
    bob.subscribe("a/*")
    for bus, payload in ((evil, b"forged"), (ada, b"own")):
        bus.publisher("a/ada").put(payload)
    bob.query("hello/ada")
    hub.advance(0.1)
    assert bob.poll() == [("a/ada", b"own")]
    assert [reply.payload for reply in bob.replies()] == [b"own"]
    assert bob.foreign == 2


def test_those_who_saw_the_first_session_keep_to_it_and_others_believe_neither():
    first = NameHolders()
    later = NameHolders()
    for session in ("1", "2"):
        first.update("ada", session, True)
    later.start([("ada", "2"), ("ada", "1")])
    assert (first.holder("ada"), later.holder("ada")) == ("1", "")
    assert first.live == later.live == {"ada"}
    for each in (first, later):
        each.update("ada", "1", False)
        assert each.holder("ada") == "2"
        each.update("ada", "2", False)
        assert each.holder("ada") == "2", "its last messages may be under way"
        assert each.live == frozenset()


def test_a_thousand_names_keep_their_holders_while_the_connection_is_lost():
    names = NameHolders()
    tokens = [(f"actor{number}", f"{number}") for number in range(1000)]
    names.start(tokens)
    names.refresh([])
    assert names.live == frozenset()
    assert [names.holder(name) for name, _ in tokens] == [session for _, session in tokens]
    assert names.returned == 0
    names.refresh(tokens)
    assert names.returned == 1000


@given(st.lists(st.tuples(st.sampled_from("123"), st.booleans()), max_size=30))
def test_no_session_takes_a_name_while_its_holder_is_live(changes):
    names = NameHolders()
    live = set()
    for session, is_live in changes:
        before = names.holder("ada")
        was_live = before in live
        (live.add if is_live else live.discard)(session)
        names.update("ada", session, is_live)
        assert ("ada" in names.live) == bool(live)
        assert not live or names.holder("ada") in live
        if was_live and before in live:
            assert names.holder("ada") == before


def test_keys_that_belong_to_an_actor():
    assert {bound_name(key) for key in (*KEYS, "hello/ada")} == {"ada"}
    assert {bound_name(key) for key in ("clock/ada", "snap/0/0", "join/ada/1", "live/ada/1", "a", "c", "fact")} == {""}
