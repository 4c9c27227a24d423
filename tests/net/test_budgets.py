"""One short-lived stranger, or one admitted actor, breaks nothing for the others: attacks on real servers."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pathlib
import re
import signal
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import zenoh

from tests.support import programs
from tests.support.waiting import wait
from vinesim.net.codec.control import Hello, RetainedRecord, Welcome, decode_welcome, encode_hello, encode_records, pack
from vinesim.net.codec.meshes import MAX_PART, MeshPart, MeshWanted, decode_wanted, encode_part
from vinesim.net.server import admission, retained_store, sessions
from vinesim.net.server.journal import Journal
from vinesim.net.server.server import Server
from vinesim.net.transport import name_holders, zenoh_bus
from vinesim.net.transport.bus import JoinRejected, NameTaken
from vinesim.net.transport.signatures import Identity
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import SessionRefused, close_session, config, open_session
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.triangles import digest_of, encode_triangles

HELLO = 16
IDENTITIES: dict[str, Identity] = {}
"""Keys of the strangers' sessions, by session."""


def seal(session: zenoh.Session, key: str, payload: bytes) -> bytes:
    return IDENTITIES[str(session.zid())].seal(key, payload)


@contextlib.contextmanager
def stranger(endpoint: str):
    """A Zenoh session of a program that is no vinesim, and signs as vinesim does."""
    identity = Identity()
    session = open_session(config("client", connect__endpoints=[endpoint], id=identity.session))
    IDENTITIES[identity.session] = identity
    try:
        yield session
    finally:
        close_session(session)
        del IDENTITIES[identity.session]


def ask_to_join(session: zenoh.Session, world: str, name: str, who: str = "", **more) -> Welcome:
    """Send a join query as another program would: whatever the names are."""
    payload = pack(HELLO, Hello(name, digest="D", scene="s", **more))
    key = f"vs/1/{world}/join/{name}/{who or session.zid()}"
    replies = session.get(key, payload=payload, attachment=seal(session, key, payload), timeout=5.0)
    (reply,) = (reply.ok for reply in replies if reply.ok is not None)
    return decode_welcome(reply.payload.to_bytes())


def put_record(session: zenoh.Session, world: str, name: str, number: int = 0) -> None:
    record = RetainedRecord(object_id(ObjectKind.BUNCH, number), 1, 0, name, pose=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    key = f"vs/1/{world}/fact/0/0/{name}"
    payload = encode_records([record])
    session.put(key, payload, attachment=seal(session, key, payload))


def journal_size(folder: pathlib.Path, world: str) -> int:
    path = folder / f"{world}.facts"
    return path.stat().st_size if path.exists() else 0


class CommandLineServer:
    """``vinesim server`` in a process of its own."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "vinesim", "server", "--listen", "tcp/127.0.0.1:0", *options]
        self.process = programs.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert self.process.stdout is not None
        self.endpoint = self.process.stdout.readline().split()[2]

    def end(self) -> tuple[int, str]:
        """End the server with SIGTERM. Returns the exit code and all further output."""
        self.process.send_signal(signal.SIGTERM)
        output, _ = self.process.communicate(timeout=60)
        return self.process.returncode, output


@pytest.mark.parametrize("world", ["w" * 260, "a b"], ids=["long", "blank"])
def test_a_world_with_a_name_that_no_file_can_have_stops_the_records_of_no_other(tmp_path, world):
    server = CommandLineServer("--state-dir", str(tmp_path))
    with stranger(server.endpoint) as session:
        assert "use 1 to 48 letters" in ask_to_join(session, world, "mallory").refused
        put_record(session, world, "mallory")
        assert not ask_to_join(session, "second", "bob").refused
        put_record(session, "second", "bob")
        wait(lambda: journal_size(tmp_path, "second"), "the record of the honest world")
        size = journal_size(tmp_path, "second")
        put_record(session, "second", "bob", 1)
        wait(lambda: journal_size(tmp_path, "second") > size, "the next one")
    assert server.end()[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["second.facts"]


def test_a_world_that_cannot_be_written_is_trouble_of_that_world_and_of_the_exit_code(tmp_path):
    server = CommandLineServer("--state-dir", str(tmp_path))
    (tmp_path / "first.facts.part").mkdir()  # where the journal of the first world would be made
    with stranger(server.endpoint) as one, stranger(server.endpoint) as other:
        for session, world in ((one, "first"), (other, "second")):
            assert not ask_to_join(session, world, "bob").refused
            put_record(session, world, "bob")
        wait(lambda: journal_size(tmp_path, "second"), "the record of the second world")
    code, output = server.end()
    assert code == 4
    assert "records of world 'first' are lost" in output
    assert "second" not in output
    assert len(Journal.load(tmp_path / "second.facts").state) == 1


def test_a_world_that_can_be_written_again_is_not_lost(tmp_path):
    server = CommandLineServer("--state-dir", str(tmp_path))
    obstacle = tmp_path / "first.facts.part"
    obstacle.mkdir()
    with stranger(server.endpoint) as session:
        assert not ask_to_join(session, "first", "bob").refused
        put_record(session, "first", "bob")
        output = server.process.stdout.readline()
    assert "kept in memory only" in output
    obstacle.rmdir()
    assert server.end()[0] == 0
    assert len(Journal.load(tmp_path / "first.facts").state) == 1


def test_a_description_in_a_greeting_is_not_admitted():
    """Clients ask for it by its digest, and check it, only when they are near the robot."""
    links = "".join(f'<link name="l{number}"/>' for number in range(2000))
    with Server("tcp/127.0.0.1:0") as server, stranger(server.endpoint) as session:
        welcome = ask_to_join(session, "w", "mallory", urdf=f"<robot name='x'>{links}</robot>")
        assert "with a URDF: only the reply to a query has it" in welcome.refused
        assert not ask_to_join(session, "w", "mallory").refused


def offer(session: zenoh.Session, world: str, name: str, payload: bytes) -> MeshWanted | None:
    """Offer a mesh to the server. Returns its last reply; None if it does not reply."""
    digest = digest_of(payload)
    wanted = MeshWanted(0)
    while not wanted.refused and wanted.offset < len(payload):
        part = MeshPart(digest, len(payload), wanted.offset, payload[wanted.offset : wanted.offset + MAX_PART])
        key = f"vs/1/{world}/offer/{name}"
        payload = encode_part(part)
        replies = session.get(key, payload=payload, attachment=seal(session, key, payload), timeout=5.0)
        found = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        if not found:
            return None
        wanted = decode_wanted(found[0])
    return wanted


def triangles(faces: int, seed: int) -> bytes:
    return encode_triangles(np.random.default_rng(seed).normal(size=(faces, 3, 3)))


def test_meshes_of_actors_that_left_make_room_though_they_never_were_live():
    """Five names fill the store without a liveliness token. What they hold ends with their sessions."""
    with Server("tcp/127.0.0.1:0") as server:
        server.meshes.limits = type(server.meshes.limits)(total=5 * 36 * 1000, per_actor=36 * 1000)
        with contextlib.ExitStack() as stack:
            for number in range(5):
                session = stack.enter_context(stranger(server.endpoint))
                assert not ask_to_join(session, "w", f"m{number}").refused
                assert not offer(session, "w", f"m{number}", triangles(1000, number)).refused
                assert offer(session, "w", "m0", triangles(10, 99)) is None or number == 0  # under its own name only
        wait(lambda: not server._admission._admitted, "the strangers to be forgotten")
        with stranger(server.endpoint) as honest:
            assert not ask_to_join(honest, "w", "ada").refused
            assert not offer(honest, "w", "ada", triangles(1000, 77)).refused


def test_an_honest_actor_finds_room_among_five_that_stay_and_fill_the_store():
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        server.meshes.limits = type(server.meshes.limits)(total=5 * 36 * 1000, per_actor=36 * 1000)
        for number in range(5):
            session = stack.enter_context(stranger(server.endpoint))
            stack.enter_context(session.liveliness().declare_token(f"vs/1/w/live/m{number}/{session.zid()}"))
            assert not ask_to_join(session, "w", f"m{number}").refused
            for part in range(10):
                assert not offer(session, "w", f"m{number}", triangles(100, 10 * number + part)).refused
        honest = stack.enter_context(stranger(server.endpoint))
        assert not ask_to_join(honest, "w", "ada").refused
        assert not offer(honest, "w", "ada", triangles(400, 99)).refused


def test_join_queries_that_never_come_lock_out_no_client():
    with Server("tcp/127.0.0.1:0", max_actors=12) as server, contextlib.ExitStack() as stack:
        for number in range(12):
            session = stack.enter_context(stranger(server.endpoint))
            assert not ask_to_join(session, "vineyard", f"ghost{number}").refused
            assert "has joined as" in ask_to_join(session, "vineyard", f"more{number}").refused
        ada = stack.enter_context(ZenohBus("ada", connect=server.endpoint))
        ada.join(encode_hello(Hello("ada", digest="D")))


def test_liveliness_tokens_without_a_join_take_no_name(monkeypatch):
    monkeypatch.setattr("vinesim.net.server.server.GRACE_TIME", 0.0)
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        squatter = stack.enter_context(stranger(server.endpoint))
        for name in ("ada", *(f"name{number}" for number in range(200))):
            stack.enter_context(squatter.liveliness().declare_token(f"vs/1/vineyard/live/{name}/{squatter.zid()}"))
        bob = stack.enter_context(ZenohBus("bob", connect=server.endpoint))
        bob.join(encode_hello(Hello("bob", digest="D")))
        wait(lambda: "ada" in bob.alive(), "bob to see the squatter")
        ada = stack.enter_context(ZenohBus("ada", connect=server.endpoint))
        ada.join(encode_hello(Hello("ada", digest="D")))
        bob.subscribe("a/*")
        publisher = ada.publisher("a/ada")
        received: list = []

        def heard() -> bool:
            publisher.put(b"pose")
            received.extend(bob.poll())
            return ("a/ada", b"pose") in received

        wait(heard, "bob to hear ada, not the squatter")
        with pytest.raises(NameTaken):
            ZenohBus("ada", connect=server.endpoint)


def test_a_full_server_says_so_to_the_next_client_and_in_its_log(caplog):
    with Server("tcp/127.0.0.1:0", max_sessions=3) as server, contextlib.ExitStack() as stack:
        strangers = [stack.enter_context(stranger(server.endpoint)) for _ in range(3)]
        wait(lambda: server.figures()["sessions"] == 3, "all sessions")
        wait(lambda: "3 sessions: no further client can connect" in caplog.text, "the line in the log")
        with pytest.raises(SessionRefused, match="as many sessions as it admits"):
            ZenohBus("ada", connect=server.endpoint)
        close_session(strangers[0])
        wait(lambda: server.figures()["sessions"] == 2, "one to leave")
        ZenohBus("ada", connect=server.endpoint).close()


def test_a_client_beyond_the_limit_of_actors_still_gets_a_session_and_is_told_the_limit():
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server("tcp/127.0.0.1:0", max_actors=1))
        assert server.figures()["max_sessions"] == 102
        bob, carl = (stack.enter_context(ZenohBus(name, connect=server.endpoint)) for name in ("bob", "carl"))
        bob.join(encode_hello(Hello("bob", digest="D")))
        with pytest.raises(JoinRejected, match="admits 1 actors"):
            carl.join(encode_hello(Hello("carl", digest="D")))


def test_a_session_that_is_not_served_is_opened_anew_and_works_as_before(monkeypatch):
    """The link is live, and the server is there, but the session hears nothing from it."""
    monkeypatch.setattr(zenoh_bus, "UNSERVED_TIMEOUT", 0.5)
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        ada, bob = (stack.enter_context(ZenohBus(name, connect=server.endpoint)) for name in ("ada", "bob"))
        for bus in (ada, bob):
            bus.join(encode_hello(Hello(bus.name, digest="D")))
            bus.subscribe("a/*")
            bus.subscribe("own/**", zenoh_bus.KEEP_ALL)
        ada.declare_queryable("hello/ada", lambda _: b"i am ada")
        pose, event = ada.publisher("a/ada"), ada.publisher("own/0/0/ada", reliable=True)
        bobs = bob.publisher("own/0/0/bob", reliable=True)
        before = ada.identity.session
        deaf = ada._session.declare_querier("vs/1/vineyard/nowhere/ada")  # matches no server
        ada._admission._querier = deaf
        ada._admission.is_served = False
        assert "is gone" in ada.status_message
        wait(lambda: ada.sessions_opened_anew == 1 and not ada.status_message, "a new session")
        assert ada.identity.session != before
        assert ada.admissions >= 2
        heard: set = set()

        def all_heard() -> bool:
            pose.put(b"pose")
            event.put(b"event")
            bobs.put(b"bob")
            heard.update(bob.poll() + ada.poll())
            return {("a/ada", b"pose"), ("own/0/0/ada", b"event"), ("own/0/0/bob", b"bob")} <= heard

        wait(all_heard, "both to hear each other")
        assert bob.fetch("hello/ada") == [b"i am ada"]
        assert server.actors == ["vineyard/ada", "vineyard/bob"]


def test_a_router_behind_which_the_server_is_gone_keeps_its_session(monkeypatch):
    monkeypatch.setattr(zenoh_bus, "UNSERVED_TIMEOUT", 0.5)
    with Server("tcp/127.0.0.1:0") as main, Server("tcp/127.0.0.1:0", connect=[main.endpoint]) as router:
        wait(lambda: router._link_count() == 1, "the link")
        with ZenohBus("ada", connect=router.endpoint) as ada:
            ada.join(encode_hello(Hello("ada", digest="D")))
            wait(lambda: ada.admissions, "ada to be admitted")
            main.close()
            wait(lambda: ada.status_message, "ada to notice")
            opened = []
            monkeypatch.setattr(ada, "_try_anew", lambda run=ada._try_anew: (run(), opened.append(1)))
            wait(lambda: len(opened) >= 2, "two tries")
            assert ada.sessions_opened_anew == 0


def test_the_memory_of_a_server_and_of_a_client_does_not_grow_with_joins_and_leaves(monkeypatch):
    """What Python holds, by tracemalloc, after 400 joins and leaves of new names, and after 200 more."""
    monkeypatch.setattr(logging.root.manager, "disable", logging.CRITICAL)  # pytest keeps what is logged
    monkeypatch.setattr(admission, "JOIN_BURST_TIME", 1.0)
    monkeypatch.setattr("vinesim.net.server.server.MAX_WARNED", 20)
    monkeypatch.setattr("vinesim.net.server.server.MAX_KNOWN_SESSIONS", 20)
    monkeypatch.setattr(name_holders, "MAX_FORMER_NAMES", 50)
    monkeypatch.setattr(admission, "MAX_DEPARTED", 50)
    monkeypatch.setattr(retained_store, "MAX_BUCKETS", 50)
    monkeypatch.setattr(retained_store, "BURST_TIME", 0.1)
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(encode_hello(Hello("ada", digest="D")))

        def join(first: int, last: int) -> int:
            for number in range(first, last):
                with stranger(server.endpoint) as session:
                    name = f"guest{number}"
                    session.liveliness().declare_token(f"vs/1/vineyard/live/{name}/{session.zid()}")
                    assert not ask_to_join(session, "vineyard", name).refused
                    put_record(session, "vineyard", name, number % 3)
            wait(lambda: server.actors == ["vineyard/ada"], "all to leave")
            wait(lambda: ada.alive() == {"ada"}, "ada to see it")
            wait(lambda: not server._admission._joins, "the joins to be forgotten")
            gc.collect()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            before = join(0, 400)
            after = join(400, 600)
        finally:
            tracemalloc.stop()
        assert after - before < 200 * 250  # B for each join; one entry in one table by name has more
        assert len(server._admission._admitted) == 1


GUESTS = """
import time, zenoh
from vinesim.net.codec.control import Hello, encode_hello
from vinesim.net.server.server import Server
from vinesim.net.transport.zenoh_bus import ZenohBus

zenoh.init_log_from_env_or("error")
with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
    for name in ("guest_0", "guest_1", "guest_2"):
        with ZenohBus(name, connect=server.endpoint) as bus:
            bus.join(encode_hello(Hello(name, digest="D")))
    ada.close()
    while server.actors:
        time.sleep(0.01)
"""


def test_a_router_keeps_no_key_with_the_name_of_an_actor_that_has_left():
    """By Zenoh's own log: what it registers under the names of guests it also removes."""
    log_of = os.environ | {"RUST_LOG": "zenoh::net::routing::dispatcher::resource=debug", "NO_COLOR": "1"}
    ran = subprocess.run([sys.executable, "-c", GUESTS], env=log_of, capture_output=True, text=True, timeout=60.0)
    assert ran.returncode == 0, ran.stderr
    found = re.findall(
        r"(Register|Unregister) resource \S*/(live/guest_\d\S*)", re.sub(r"\x1b\[[0-9;]*m", "", ran.stdout)
    )
    registered, removed = ({key for what, key in found if what == wanted} for wanted in ("Register", "Unregister"))
    assert len(registered) >= 3
    assert not registered - removed


def test_sessions_are_no_more_than_the_system_has_files_for(monkeypatch, caplog):
    limits = [256, 1024]
    monkeypatch.setattr(sessions.resource, "getrlimit", lambda _: tuple(limits))
    monkeypatch.setattr(sessions.resource, "setrlimit", lambda _, pair: limits.__setitem__(slice(None), pair))
    assert sessions.fit_sessions(None, None) == 1024 - sessions.SPARE_FILES
    assert caplog.text == ""
    assert limits == [1024, 1024]
    assert sessions.fit_sessions(None, 5) == 110
    assert sessions.fit_sessions(2000, None) == 1024 - sessions.SPARE_FILES
    assert "enough for 768 of 2000 sessions" in caplog.text
