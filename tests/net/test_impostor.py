"""A program that was written to deceive speaks in the name of an honest client: it copies the id of that client's
session from its messages, joins as that session, and withdraws its token. Without certificates, on every transport."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator

import pytest
import zenoh

from tests.support.waiting import deadline, wait
from vinesim.client.programs import free_port
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    decode_welcome,
    encode_hello,
    encode_records,
    encode_time,
)
from vinesim.net.codec.meshes import MeshPart, encode_part
from vinesim.net.pace import PaceReport
from vinesim.net.server.server import Server
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.endpoints import parse
from vinesim.net.transport.zenoh_bus import BusPublisher, ZenohBus
from vinesim.net.transport.zenoh_session import close_session, config, open_session
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.triangles import digest_of

ROOT = "vs/1/vineyard"
POSES = ("a/ada", "a/ada/far", "tree/0/0/ada", "near/0/0/ada", "c/0/0/ada", "force/bob/ada", "voice/ada")
"""Keys of best-effort messages of ada."""
RELIABLE = ("own/0/0/ada", "fact/0/0/ada")
"""Keys of ada's reliable messages: claims, and records such as a cut."""
LOSS_TIME = 5.0
"""Time [s] after which a best-effort message on an idle machine counts as lost."""
_others = itertools.count(100)
"""Numbers of records that are sent instead of lost ones."""


def hello(name: str, kind: str = "robot") -> bytes:
    return encode_hello(Hello(name, kind=kind, digest="D1", scene="vsp"))


def record(number: int) -> bytes:
    return encode_records([RetainedRecord(object_id(ObjectKind.BOX, number), 9, 0, "ada")])


class Impostor:
    """A session of another program that hears all messages and copies what they carry beside their payload."""

    def __init__(self, locator: str) -> None:
        self.session = open_session(config("client", connect__endpoints=[locator]))
        self.heard: list[zenoh.Sample] = []
        self.session.declare_subscriber(f"{ROOT}/**", self.heard.append)

    def of(self, key: str) -> zenoh.Sample | None:
        """Returns the first message that was heard under a key."""
        return next((sample for sample in self.heard if str(sample.key_expr) == f"{ROOT}/{key}"), None)

    def sources(self) -> list[zenoh.SourceInfo | None]:
        """Returns the sources to state: none, the own one, and every one that was heard."""
        stated = [sample.source_info for sample in self.heard if sample.source_info is not None]
        return [None, zenoh.SourceInfo(self.session.id, 0), *stated[:1]]

    def ask(self, key: str, payload: bytes) -> list[bytes]:
        """Returns the replies of the server to a query."""
        replies = self.session.get(f"{ROOT}/{key}", payload=payload, source_info=self.sources()[-1], timeout=5.0)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def deliver(publishers: dict[str, BusPublisher], receiver: ZenohBus) -> None:
    """Send record 0 under each key until the receiver has it, then another one, until the receiver has that too.

    ``matching`` does not say that the receiver's subscription has reached the server: the impostor hears all keys.
    """
    received: set[tuple[str, bytes]] = set()

    def is_subscribed() -> bool:
        for publisher in publishers.values():
            publisher.put(record(0))
        received.update(receiver.poll())
        return all((key, record(0)) in received for key in publishers)

    wait(is_subscribed, "the subscriptions")
    send_last(publishers, receiver, 1)


def send_last(publishers: dict[str, BusPublisher], receiver: ZenohBus, number: int) -> list[tuple[str, bytes]]:
    """Send record ``number`` once under each key, and return what the receiver has got when nothing is on its way any
    more. Where a best-effort message was lost, as on a busy machine, other records follow."""
    received: list[tuple[str, bytes]] = []
    last = {key: record(number) for key in publishers}
    for publisher in publishers.values():
        assert publisher.put(record(number))
    due = time.monotonic() + deadline(LOSS_TIME)

    def arrived() -> bool:
        nonlocal due
        received.extend(receiver.poll())
        missing = [key for key, payload in last.items() if (key, payload) not in received]
        if time.monotonic() > due:
            due = time.monotonic() + deadline(LOSS_TIME)
            for key in set(missing) - set(RELIABLE):
                last[key] = record(next(_others))
                publishers[key].put(last[key])
        return not missing

    wait(arrived, "the last messages")
    return received


@contextlib.contextmanager
def impostor(endpoint: str) -> Iterator[Impostor]:
    one = Impostor(parse(endpoint.replace("udp/", "tcp/")).locator)
    try:
        yield one
    finally:
        close_session(one.session)


@pytest.fixture(params=["tcp", "udp"])
def server(request: pytest.FixtureRequest) -> Iterator[Server]:
    port = free_port()
    with Server([f"{protocol}/127.0.0.1:{port}" for protocol in dict.fromkeys((request.param, "tcp"))]) as running:
        yield running


@contextlib.contextmanager
def two_actors(server: Server) -> Iterator[tuple[ZenohBus, ZenohBus]]:
    """Ada, who is honest, and bob, who listens."""
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        for each in (ada, bob):
            each.join(hello(each.name))
        wait(lambda: "ada" in bob.alive(), "bob to see ada")
        yield ada, bob


def test_no_message_of_an_impostor_is_accepted_under_another_name(server: Server) -> None:
    """Each message states ada's session, and carries a copy of what ada's own message of that key carried."""
    with two_actors(server) as (ada, bob), impostor(server.endpoint) as evil:
        for key in (*POSES, *RELIABLE):
            bob.subscribe(key, KEEP_ALL)
        publishers = {key: ada.publisher(key, reliable=key in RELIABLE) for key in (*POSES, *RELIABLE)}
        deliver(publishers, bob)
        wait(lambda: all(evil.of(key) for key in publishers), "the impostor to hear ada's messages")
        assert server.store is not None
        wait(lambda: server.store.count() == 2, "ada's records")
        tries = 0
        for key in publishers:
            own = evil.of(key)
            assert own is not None
            for source in evil.sources():
                for attachment in (None, own.attachment, b"\0" * 72, b"\xff" * 104):
                    evil.session.put(f"{ROOT}/{key}", record(2), source_info=source, attachment=attachment)
                    tries += 1
            evil.session.delete(f"{ROOT}/{key}", source_info=evil.sources()[-1], attachment=own.attachment)
            tries += 1
        wait(lambda: bob.foreign >= tries, "all forged messages to be counted")
        of_server = tries // len(publishers) - 1  # the server ignores what deletes
        wait(lambda: server.foreign >= of_server, "all forged records to be counted by the server")
        assert bob.poll() == []
        assert server.store.count() == 2
        received = send_last(publishers, bob, 3)
        assert record(2) not in {payload for _, payload in received}
        assert len(received) == len(set(received)), "none arrives twice"
        wait(lambda: server.store.count() == 3, "ada's next record")


def test_an_old_message_of_an_actor_is_not_accepted_again(server: Server) -> None:
    """The impostor sends ada's first pose, as it was, after her second one."""
    with two_actors(server) as (ada, bob), impostor(server.endpoint) as evil:
        bob.subscribe("a/ada", KEEP_ALL)
        deliver({"a/ada": ada.publisher("a/ada")}, bob)
        wait(lambda: evil.of("a/ada"), "the impostor to hear them")
        first = evil.of("a/ada")
        assert first is not None
        assert first.payload.to_bytes() == record(0)
        evil.session.put(f"{ROOT}/a/ada", first.payload, source_info=first.source_info, attachment=first.attachment)
        wait(lambda: bob.foreign == 1, "the old pose to be counted")
        assert bob.poll() == []


def test_an_impostor_neither_joins_nor_leaves_for_another_actor(server: Server) -> None:
    """It asks to join as ada's session and as a spectator, who publishes no records; and declares and withdraws her
    token."""
    with two_actors(server) as (ada, bob), impostor(server.endpoint) as evil:
        mine = str(ada.session_for(reliable=True).zid())
        for kind in ("spectator", "robot"):
            (answer,) = evil.ask(f"join/ada/{mine}", hello("ada", kind))
            assert "not signed" in decode_welcome(answer).refused
        token = evil.session.liveliness().declare_token(f"{ROOT}/live/ada/{mine}")
        token.undeclare()
        other = evil.session.liveliness().declare_token(f"{ROOT}/live/ada/{evil.session.zid()}")
        wait(lambda: len(bob._names._sessions["ada"]) == 2, "the second session that claims the name")
        other.undeclare()
        wait(lambda: sum(bob._names._sessions["ada"].values()) == 1, "the second session to leave")
        assert "ada" in bob.alive()
        assert server.actors == ["vineyard/ada", "vineyard/bob"]
        publisher = ada.publisher("fact/0/0/ada", reliable=True)
        wait(lambda: publisher.matching, "the server's subscription")
        assert publisher.put(record(1))
        assert server.store is not None
        wait(lambda: server.store.count() == 1, "ada's record: she is no spectator")


def test_an_impostor_slows_no_world_and_offers_no_mesh_for_another_actor(server: Server) -> None:
    with two_actors(server) as (ada, _), impostor(server.endpoint) as evil:
        for _ in range(20):
            evil.ask("clock/ada", encode_time(1.0, report=PaceReport(0.0, 0.01, "steps")))
        clock = server._clock("vineyard")
        assert "ada" not in clock._clients
        triangles = b"\0" * 36
        part = MeshPart(digest_of(triangles), len(triangles), 0, triangles)
        assert evil.ask("offer/ada", encode_part(part)) == []
        assert len(server.meshes) == 0
        ada.query("clock/ada", encode_time(1.0, report=PaceReport(0.0, 0.5, "steps")))
        wait(lambda: "ada" in clock._clients, "ada's own report")


def test_a_reply_of_an_impostor_is_not_accepted_as_a_greeting(server: Server) -> None:
    """It answers the query for ada's greeting with a greeting that makes her a person."""
    with two_actors(server) as (ada, bob), impostor(server.endpoint) as evil:

        def respond(query: zenoh.Query) -> None:
            with query:
                query.reply(str(query.key_expr), hello("ada", "human"), attachment=b"\xff" * 104)

        queryable = evil.session.declare_queryable(f"{ROOT}/hello/ada", respond)
        ada.declare_queryable("hello/ada", lambda _: hello("ada"))
        answers: list[bytes] = []

        def ask() -> bool:
            bob.query("hello/ada")
            answers.extend(reply.payload for reply in bob.replies())
            return bool(answers) and bob.foreign > 0

        wait(ask, "both answers")
        assert set(answers) == {hello("ada")}
        queryable.undeclare()


def test_what_comes_before_the_key_of_its_session_is_dropped_and_no_fault(server: Server) -> None:
    """Bob comes between two poses of ada that contain her key: he sees her within two seconds, and suspects nobody."""
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("cleo", connect=server.endpoint) as cleo:
        ada.join(hello("ada"))
        cleo.subscribe("a/*")
        pose = ada.publisher("a/ada")
        wait(lambda: pose.put(b"pose") and cleo.poll(), "cleo to hear ada")
        with ZenohBus("bob", connect=server.endpoint) as bob:
            bob.subscribe("a/*")
            wait(lambda: pose.put(b"pose") and bob.poll(), "bob to hear ada")
            assert bob.foreign == 0
