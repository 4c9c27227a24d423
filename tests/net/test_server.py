"""The server: routing, counters, clock, admission and retained records, and errors in one clear line."""

from __future__ import annotations

import contextlib
import pathlib
import re
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import zenoh

from benchmarks.support.fake_client import FakeClient, tree_row
from tests.support import programs
from tests.support.waiting import deadline, wait
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    Welcome,
    decode_records,
    decode_time,
    encode_hello,
    encode_records,
    encode_time,
    encode_welcome,
)
from vinesim.net.codec.header import MAX_MESSAGE, PROTOCOL
from vinesim.net.codec.messages import Counters
from vinesim.net.pace import PaceReport
from vinesim.net.replication.retained_sync import RetainedSync
from vinesim.net.server import retained_store
from vinesim.net.server import server as server_module
from vinesim.net.server.admission import SceneId
from vinesim.net.server.retained_store import Quota
from vinesim.net.server.server import PortTaken, Server
from vinesim.net.transport import endpoints
from vinesim.net.transport.bus import KEEP_ALL, JoinRejected, NameTaken
from vinesim.net.transport.endpoints import resolve_ports
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import NoServer, close_session, config, open_session
from vinesim.scene.ids import ObjectKind, object_id


def test_a_free_port_is_chosen_and_reported():
    with Server("tcp/127.0.0.1:0") as first, Server("tcp/127.0.0.1:0") as second:
        ports = [int(server.endpoint.rpartition(":")[2]) for server in (first, second)]
        assert all(1024 < port < 65536 for port in ports)
        assert ports[0] != ports[1]
        with ZenohBus("ada", connect=first.endpoint), ZenohBus("ada", connect=second.endpoint):
            wait(lambda: first.actors == second.actors == ["vineyard/ada"], "both rosters")


def test_a_taken_port_is_one_clear_line():
    with Server("tcp/127.0.0.1:0") as running:
        with pytest.raises(PortTaken, match="already in use") as caught:
            Server(running.endpoint)
        assert running.endpoint in str(caught.value)
        assert "another port" in str(caught.value)
        assert "\n" not in str(caught.value)
    Server(running.endpoint).close()


@pytest.mark.parametrize("endpoint", ["", "7377", "tls/127.0.0.1:0", "tcp/127.0.0.1", "tcp/:x", "tcp/1.2.3.4:99999"])
def test_an_invalid_endpoint_is_refused(endpoint):
    with pytest.raises(ValueError, match=r"expected tcp/HOST:PORT"):
        Server(endpoint)


def test_the_list_of_actors_follows_joins_and_leaves():
    with Server("tcp/127.0.0.1:0") as server:
        with ZenohBus("ada", connect=server.endpoint), ZenohBus("bob", connect=server.endpoint, world="row-2"):
            wait(lambda: server.actors == ["row-2/bob", "vineyard/ada"], "two actors")
        wait(lambda: server.actors == [], "no actors")
        assert server.joined == 2


def test_a_clock_query_returns_the_time_of_day():
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.query("clock/ada", b"nonsense")
        ada.query("clock/ada", encode_time(12.5))
        answers: list = []
        wait(lambda: answers.extend(ada.replies()) or answers, "the time")
        reply = decode_time(answers[0].payload)
        assert (reply.asked, reply.factor) == (12.5, 1.0)
        assert abs(reply.world - time.time()) < 10.0
        assert (server.pings, server.malformed) == (1, 1)


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
def test_a_step_of_the_time_of_day_does_not_move_the_network_time(monkeypatch, step):
    def server_minus_own_time(bus: ZenohBus) -> float:
        asked = time.monotonic()
        bus.query(f"clock/{bus.name}", encode_time(asked))
        answers: list = []
        wait(lambda: answers.extend(bus.replies()) or answers, "the time")
        return decode_time(answers[0].payload)[1] - asked

    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        before = server_minus_own_time(ada)
        time_of_day = time.time
        monkeypatch.setattr(time, "time", lambda: time_of_day() + step)
        assert abs(server_minus_own_time(ada) - before) < 60.0


def test_questions_with_wildcards_or_missing_parts_are_counted_and_nothing_ends():
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        session = ada.session_for(reliable=True)
        for key in ("vs/1/**", "vs/1/*/*/*/*", "**"):
            for payload in (b"", encode_time(1.0)):
                assert [reply for reply in session.get(key, payload=payload, timeout=2.0) if reply.ok] == []
        assert server.malformed >= 6
        for key in ("fact", "fact/0/0/ada/more", "fact/0/0/eve"):
            whole = f"vs/1/vineyard/{key}"
            session.put(whole, b"", attachment=ada.seal(whole, b""))
        wait(lambda: server.foreign == 3, "the records of no actor")
        ada.join(hello("ada"))
        for key in ("fact/ada", "fact/x/y/ada", "fact/0/0/more/ada"):
            whole = f"vs/1/vineyard/{key}"
            session.put(whole, b"", attachment=ada.seal(whole, b""))
        wait(lambda: server.store.counters.malformed == 3, "the keys without a cell")
        publish(ada, (0, 0), box(1))
        assert snapshot(ada, (0, 0), 1) == [box(1)]
        assert server.figures()["trouble"] == ""


def test_run_returns_when_stopped():
    with Server("tcp/127.0.0.1:0") as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        assert thread.is_alive()
        server.stop()
        thread.join(deadline())
        assert not thread.is_alive()
    server.close()


def test_the_server_simulates_nothing():
    heavy = {"warp", "mujoco", "vinesim.interaction", "vinesim.kernels"}
    code = f"import sys, vinesim.net.server.server; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=deadline(300.0), check=True
    )
    assert done.stdout == "[]\n"


# ---------------------------------------------------------------- joining


def hello(name, digest="D1", scene="vsp"):
    return encode_hello(Hello(name, scene=scene, digest=digest))


def test_another_scene_is_refused_with_both_names():
    with Server("tcp/127.0.0.1:0") as server:
        with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
            ada.join(hello("ada"))
            with pytest.raises(JoinRejected, match=r"'tendone' with digest 'D2', world 'vineyard' has 'vsp' with 'D1'"):
                bob.join(hello("bob", "D2", "tendone"))
            bob.join(hello("bob"))
        wait(lambda: server.actors == [], "both to leave")
        with ZenohBus("bob", connect=server.endpoint) as bob:
            bob.join(hello("bob", "D2"))  # no actor and no record is left: a new world
        assert server.figures()["refused"] == 1


def test_scene_protocol_and_actor_limit_of_the_server_are_enforced():
    with Server("tcp/127.0.0.1:0", scene=SceneId("vsp", "D1"), max_actors=1) as server, contextlib.ExitStack() as stack:
        ada, bob = (stack.enter_context(ZenohBus(name, connect=server.endpoint)) for name in ("ada", "bob"))
        with pytest.raises(JoinRejected, match="the server was started for 'vsp' with 'D1'"):
            ada.join(hello("ada", "D2"))
        other = bytearray(hello("ada"))
        other[2] = PROTOCOL + 1
        with pytest.raises(JoinRejected, match=f"version {PROTOCOL + 1}, the server version"):
            ada.join(bytes(other))
        ada.join(hello("ada"))
        with pytest.raises(JoinRejected, match="admits 1 actors"):
            bob.join(hello("bob"))
        with pytest.raises(JoinRejected, match="cannot be read"):
            bob.join(b"junk")


def test_a_reply_of_another_protocol_is_refused_with_both_versions():
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        newer = bytearray(encode_welcome(Welcome()))
        newer[2] = PROTOCOL + 1
        for answer, words in ((bytes(newer), f"protocol version {PROTOCOL + 1}"), (b"junk", "cannot be decoded")):
            # another program answers
            server._declared[1].undeclare()
            server._declared[1] = server._session.declare_queryable(
                "vs/1/*/join/*/*", lambda query, answer=answer: query.reply(str(query.key_expr), answer)
            )
            with pytest.raises(JoinRejected, match=words):
                ada.join(hello("ada"))


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        ([], "a Zenoh router, such as rmw_zenohd of ROS 2"),
        (["@ros2_lv/0/a/b"], "the router of a ROS 2 graph (rmw_zenohd)"),
    ],
)
@pytest.mark.parametrize("is_live", [True, False])
def test_a_router_of_another_program_is_no_server(tokens, words, is_live):
    """A client or a recorder that connects to a router of rmw_zenoh fails with one line that names this router."""
    (endpoint,) = resolve_ports(["tcp/127.0.0.1:0"])
    router = open_session(config("router", listen__endpoints=[endpoint.locator]))
    declared = [router.liveliness().declare_token(token) for token in tokens]
    others = router.declare_queryable("vs/2/*/server/*", lambda query: query.reply(str(query.key_expr), b""))
    with pytest.raises(NoServer, match="no vinesim server there") as caught:
        ZenohBus("ada", connect=str(endpoint), live=is_live)
    assert str(endpoint) in str(caught.value)
    assert words in str(caught.value)
    assert "'vinesim server'" in str(caught.value)
    assert "\n" not in str(caught.value)
    del declared, others
    close_session(router)


def test_a_client_waits_for_a_server_that_is_too_busy_to_answer_at_once(monkeypatch, caplog):
    """The server answers nothing until the client says that it waits, longer than a server that is not there has."""
    answer = server_module._on_server_query

    def late(query: zenoh.Query) -> None:
        if "is slow" in caplog.text:
            answer(query)

    monkeypatch.setattr(server_module, "_on_server_query", late)
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(hello("ada"))
        wait(lambda: server.actors == ["vineyard/ada"], "ada")
    assert caplog.text.count("is slow") == 1


def watched(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if "main_server_watch" in record.name]


def test_a_linked_server_says_that_no_server_answers_and_finds_the_one_that_appears(caplog):
    (endpoint,) = resolve_ports(["tcp/127.0.0.1:0"])
    with contextlib.ExitStack() as stack:
        linked = Server("tcp/127.0.0.1:0", connect=[str(endpoint)])
        wait(lambda: linked.figures()["trouble"], "the server to report a port where nobody listens")
        stack.enter_context(Server(str(endpoint)))
        stack.enter_context(linked)  # it ends first
        wait(lambda: not linked.figures()["trouble"], "the server that keeps the world")
    missing, found = watched(caplog)
    assert missing.startswith(f"no vinesim server answers at {endpoint} within 4 s (no connection): start one with")
    assert missing.endswith("this server goes on trying")
    assert "\n" not in missing
    assert str(endpoint) in found


def test_a_linked_server_says_that_a_router_of_another_program_is_no_server(caplog):
    (endpoint,) = resolve_ports(["tcp/127.0.0.1:0"])
    router = open_session(config("router", listen__endpoints=[endpoint.locator]))
    with Server("tcp/127.0.0.1:0", connect=[str(endpoint)]) as linked:
        wait(lambda: linked.figures()["trouble"], "the server to report the router")
        (line,) = watched(caplog)
        assert linked.figures()["trouble"] == line
    close_session(router)
    assert line.startswith(f"no vinesim server there: at {endpoint} is a Zenoh router")
    assert line.endswith("this server goes on trying")
    assert "\n" not in line


def test_the_default_port_is_none_of_zenoh_or_dds():
    """DDS gives participant p of domain d the ports 7400 + 250 d + 10 + 2 p and the next one."""
    assert endpoints.PORT != 7447
    assert 1024 < endpoints.PORT < 7400
    assert Server.__init__.__defaults__ == (f"tcp/127.0.0.1:{endpoints.PORT}",)


def test_a_client_announces_itself_again_to_a_restarted_server():
    first = Server("tcp/127.0.0.1:0")
    with first, ZenohBus("ada", connect=first.endpoint) as ada:
        ada.join(hello("ada"))
        endpoint = first.endpoint
        first.close()
        wait(lambda: ada.status_message, "ada to notice the lost server")
        with Server(endpoint) as second:
            wait(lambda: second._admission.scene_of("vineyard") == SceneId("vsp", "D1"), "ada to announce herself")
            wait(lambda: not ada.status_message, "ada to be connected")
            second.close()
        with Server(endpoint, scene=SceneId("tendone", "D2")):
            wait(lambda: "'tendone'" in ada.status_message, "ada to be refused for another scene")


def test_a_restarted_server_goes_on_with_the_time_that_its_clients_have(monkeypatch):
    """The world of the first server is an hour and a half behind the time of day, as one that was slow for long."""
    behind = 5400.0
    time_of_day = time.time
    monkeypatch.setattr(time, "time", lambda: time_of_day() - behind)
    first = Server("tcp/127.0.0.1:0")
    monkeypatch.setattr(time, "time", time_of_day)
    with first, contextlib.ExitStack() as stack:
        world = tree_row(1)
        clients = [
            FakeClient(stack.enter_context(ZenohBus(name, connect=first.endpoint)), world, (x, 0.0), kind="human")
            for name, x in (("ada", 1.0), ("bob", 2.0))
        ]
        for client in clients:
            clock = client.replicator
            clock.report_pace(lambda clock=clock: PaceReport(clock.network_time(time.monotonic()), 1.0, "steps"))
        times: list[list[float]] = [[], []]

        def run(condition) -> None:
            def tick() -> bool:
                now = time.monotonic()
                for client, own in zip(clients, times, strict=True):
                    client.tick(now)
                    own.append(client.replicator.network_time(now))
                return condition()

            wait(tick, "the clients")

        run(lambda: first.pings > 20 and all(abs(own[-1] + behind - time_of_day()) < 1.0 for own in times))
        first.close()
        run(lambda: all(client.bus.status_message for client in clients))
        for own in times:
            del own[:-1]
        with Server(first.endpoint) as second:
            run(lambda: second.pings > 20 and second.joined == 2)
            assert all(abs(np.diff(own)).max() < 1.0 for own in times)
            assert abs(second.time + behind - time_of_day()) < 2.0


# ---------------------------------------------------------------- retained records


def box(index=0, ownership=1, author="ada", x=0.0):
    return RetainedRecord(object_id(ObjectKind.BOX, index), ownership, 0, author, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def snapshot(bus, cell, count):
    """The retained records of a cell, as soon as there are ``count``."""
    found = {}
    answered = False

    def complete():
        nonlocal answered
        bus.query(f"snap/{cell[0]}/{cell[1]}")
        time.sleep(0.02)
        for answer in bus.replies():
            answered = True
            assert answer.key == f"snap/{cell[0]}/{cell[1]}"
            found.update({record.object: record for record in decode_records(answer.payload)})
        return answered and len(found) >= count

    wait(complete, f"{count} records of cell {cell}")
    return [found[number] for number in sorted(found)]


def publish(bus, cell, *records):
    publisher = bus.publisher(f"fact/{cell[0]}/{cell[1]}/{bus.name}", reliable=True)
    wait(lambda: publisher.matching, "the server's subscription")
    assert publisher.put(encode_records(list(records)))
    publisher.close()


def test_a_late_joiner_receives_the_winning_record_of_every_object():
    with Server("tcp/127.0.0.1:0") as server:
        with ZenohBus("ada", connect=server.endpoint) as ada:
            ada.join(hello("ada"))
            publish(ada, (0, -1), box(0), box(1))
            publish(ada, (4, 4), box(1, ownership=3))
            publish(ada, (5, 5), box(1, ownership=2))
            wait(lambda: server.store.counters.received == 3, "three messages")
        with ZenohBus("bob", connect=server.endpoint) as bob:
            assert snapshot(bob, (4, 4), 1) == [box(1, 3)]
            assert snapshot(bob, (0, -1), 1) == [box(0)]
            assert snapshot(bob, (5, 5), 0) == []
            with pytest.raises(JoinRejected, match="facts kept"):
                bob.join(hello("bob", "D2"))


def test_a_large_snapshot_arrives_in_several_replies():
    with Server("tcp/127.0.0.1:0", quota=Quota(1e6, 1e9)) as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(hello("ada"))
        publish(ada, (0, 0), *[box(number) for number in range(1000)])
        publish(ada, (0, 0), *[box(number) for number in range(1000, 2000)])
        assert snapshot(ada, (0, 0), 2000) == [box(number) for number in range(2000)]
        ada.query("snap/0/0")
        answers: list = []
        wait(lambda: answers.extend(ada.replies()) or len(answers) > 1, "several answers")
        assert max(len(answer.payload) for answer in answers) <= 64_000


def test_a_wildcard_query_returns_one_reply_per_cell():
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(hello("ada"))
        for x in range(3):
            publish(ada, (x, 0), box(x))
        snapshot(ada, (2, 0), 1)
        ada.query("snap/*/0")
        answers: list = []
        wait(lambda: answers.extend(ada.replies()) or len(answers) >= 3, "three cells")
        assert sorted(answer.key for answer in answers) == ["snap/0/0", "snap/1/0", "snap/2/0"]


def test_invalid_records_are_dropped_counted_and_logged_once(caplog):
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(hello("ada"))
        good = encode_records([box()])
        publisher = ada.publisher("fact/0/0/ada", reliable=True)
        nowhere = ada.publisher("fact/0/ada", reliable=True)
        wait(lambda: publisher.matching and nowhere.matching, "the server's subscription")
        for payload in (b"", b"junk", good[:-2], good[:2] + bytes((PROTOCOL + 1,)) + good[3:], bytes(MAX_MESSAGE + 1)):
            publisher.put(payload)
        nowhere.put(good)
        publisher.put(encode_records([box(author="bob")]))
        wait(lambda: server.malformed == 7, "seven to be dropped")
        publisher.put(good)
        assert snapshot(ada, (0, 0), 1) == [box()]
        assert len([line for line in caplog.messages if "sent an invalid message" in line]) == 1
        for question in ("snap/x/0", "snap/1/1.5"):
            ada.query(question)
        wait(lambda: server.malformed == 9, "two queries without a valid cell")


def test_a_quota_limits_only_the_client_that_exceeds_it(caplog):
    with (
        Server("tcp/127.0.0.1:0", quota=Quota(1.0, 1e6)) as server,
        ZenohBus("ada", connect=server.endpoint) as ada,
        ZenohBus("bob", connect=server.endpoint) as bob,
    ):
        ada.join(hello("ada"))
        flood = ada.publisher("fact/0/0/ada", reliable=True)
        wait(lambda: flood.matching, "the server's subscription")
        for number in range(50):
            flood.put(encode_records([box(number)]))
        publish(bob, (1, 1), box(99, author="bob"))
        assert snapshot(bob, (1, 1), 1) == [box(99, author="bob")]
        wait(lambda: server.store.counters.received == 51, "all to arrive")
        wait(lambda: server.store.count() + server.store.counters.over_quota == 51, "all to be processed")
        assert 5 <= server.store.count() <= 10
        assert len([line for line in caplog.messages if "quota" in line]) == 1


def test_records_wait_until_an_actor_is_admitted_to_their_world(monkeypatch):
    monkeypatch.setattr(retained_store, "MAX_EARLY", 2)
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        for number in range(3):
            publish(ada, (0, 0), box(number))
        wait(lambda: server.store.counters.rejected == 1, "the oldest to be rejected")
        assert server.store.count() == 0
        ada.join(hello("ada"))
        assert snapshot(ada, (0, 0), 2) == [box(1), box(2)]


SERVE = """
import pathlib, sys
from vinesim.net.server import server as zenoh_server
from vinesim.net.server.server import Server
with Server(sys.argv[1], state_folder=pathlib.Path(sys.argv[2])) as server:
    print(server.endpoint, flush=True)
    server.run()
"""


@contextlib.contextmanager
def serving(endpoint, folder):
    process = programs.Popen([sys.executable, "-c", SERVE, endpoint, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_killed_server_loses_no_record_that_it_published(tmp_path):
    with serving("tcp/127.0.0.1:0", tmp_path) as (process, endpoint), ZenohBus("ada", connect=endpoint) as ada:
        ada.join(hello("ada"))
        publish(ada, (0, 0), *[box(number) for number in range(50)])
        expected = snapshot(ada, (0, 0), 50)
        flood = ada.publisher("fact/0/0/ada", reliable=True)
        wait(lambda: flood.matching, "the server's subscription")
        for number in range(50, 150):
            flood.put(encode_records([box(number)]))
        process.kill()
        process.wait()
        with serving(endpoint, tmp_path):
            wait(lambda: not ada.status_message, "ada to be back")
            again = snapshot(ada, (0, 0), 50)
            assert again[:50] == expected
            assert again == [box(number) for number in range(len(again))]  # of the rest a prefix is kept


def test_records_are_published_again_to_a_server_that_lost_them(tmp_path):
    """Connected clients publish their records again."""
    with (
        serving("tcp/127.0.0.1:0", tmp_path / "one") as (first, endpoint),
        ZenohBus("ada", connect=endpoint) as ada,
        ZenohBus("late", connect=endpoint) as late,
    ):
        ada.join(hello("ada"))
        sync = RetainedSync(ada, Counters())
        received: list = []

        def while_syncing(condition):
            def check():
                sync.update_window([(0, 0)], 0, time.monotonic())
                sync.flush()
                time.sleep(0.005)
                return condition()

            return check

        def complete():
            late.query("snap/0/0")
            received[:] = [record for answer in late.replies() for record in decode_records(answer.payload)] or received
            return received == [box(number) for number in range(30)]

        for number in range(30):
            sync.publish((0, 0), box(number))
        wait(while_syncing(complete), "thirty records")
        first.kill()
        first.wait()
        wait(while_syncing(lambda: ada.status_message), "ada to notice the lost server")
        with serving(endpoint, tmp_path / "another"):  # an empty folder
            received.clear()
            wait(while_syncing(complete), "the same records again")


def test_the_scene_is_stored_with_the_records(tmp_path):
    with Server("tcp/127.0.0.1:0", state_folder=tmp_path) as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.join(hello("ada"))
        publish(ada, (0, 0), box())
        snapshot(ada, (0, 0), 1)
    assert [path.name for path in tmp_path.iterdir()] == ["vineyard.facts"]
    with Server("tcp/127.0.0.1:0", state_folder=tmp_path) as server, ZenohBus("bob", connect=server.endpoint) as bob:
        with pytest.raises(
            JoinRejected, match=r"facts kept of world 'vineyard' belong to 'vsp' with 'D1'.*--state-dir"
        ):
            bob.join(hello("bob", "D2"))
        assert snapshot(bob, (0, 0), 1) == [box()]


# ---------------------------------------------------------------- several servers


def assert_connected(one, other):
    """Poses and events of each reach the other over any number of routers."""
    for sender, receiver in ((one, other), (other, one)):
        receiver.subscribe(f"a/{sender.name}")
        receiver.subscribe(f"own/0/0/{sender.name}", KEEP_ALL)
        pose = sender.publisher(f"a/{sender.name}")
        event = sender.publisher(f"own/0/0/{sender.name}", reliable=True)
        wait(lambda pose=pose, event=event: pose.matching and event.matching, "the other's subscriptions")
        assert event.put(b"event")
        received: set = set()

        def arrived(pose=pose, receiver=receiver, received=received):
            pose.put(b"pose")
            time.sleep(0.002)
            received.update(receiver.poll())
            return len(received) == 2

        wait(arrived, "a pose and an event")


@pytest.mark.parametrize("protocol", ["tcp", "udp"])
def test_of_two_linked_servers_one_admits_and_stores_for_both(protocol):
    with Server(("tcp/127.0.0.1:0", "udp/127.0.0.1:0")) as hub:
        address = hub.endpoint.partition("/")[2]
        with (
            Server("tcp/127.0.0.1:0", connect=[f"{protocol}/{address}"]) as relay,
            ZenohBus("ada", connect=hub.endpoint) as ada,
            ZenohBus("bob", connect=relay.endpoint) as bob,
        ):
            wait(lambda: hub.actors == relay.actors == ["vineyard/ada", "vineyard/bob"], "both rosters")
            wait(lambda: ada.alive() == bob.alive() == {"ada", "bob"}, "both to see each other")
            bob.join(hello("bob"))
            with pytest.raises(JoinRejected, match="'D2', world 'vineyard' has 'vsp' with 'D1'"):
                ada.join(hello("ada", "D2"))
            ada.join(hello("ada"))
            assert_connected(ada, bob)
            publish(bob, (0, 0), box(0, author="bob"))
            publish(ada, (0, 0), box(1))
            assert snapshot(ada, (0, 0), 2) == snapshot(bob, (0, 0), 2) == [box(0, author="bob"), box(1)]
            with pytest.raises(NameTaken):
                ZenohBus("ada", connect=relay.endpoint)
            answers: list = []
            bob.query("clock/bob", encode_time(1.0))
            wait(lambda: answers.extend(bob.replies()) or answers, "the time")
            assert (hub.pings, relay.pings) == (1, 0)


def test_linked_servers_have_a_best_effort_and_a_reliable_link():
    with Server("udp/127.0.0.1:0") as hub, Server("tcp/127.0.0.1:0", connect=[hub.endpoint]) as relay:
        wait(lambda: len(relay._session.info.links()) == 2, "both links")
        kinds = [link.reliability for link in relay._session.info.links()]
        assert zenoh.Reliability.BEST_EFFORT in kinds
        assert zenoh.Reliability.RELIABLE in kinds


def test_a_relay_waits_for_its_hub():
    (endpoint,) = resolve_ports(["tcp/127.0.0.1:0"])
    with Server("tcp/127.0.0.1:0", connect=[str(endpoint)]) as relay, ZenohBus("ada", connect=relay.endpoint) as ada:
        ada.join(hello("ada"))  # no server decides yet
        assert not ada.status_message
        with Server(str(endpoint)) as hub:
            wait(lambda: hub._admission.scene_of("vineyard") == SceneId("vsp", "D1"), "ada to announce herself")
        wait(
            lambda: "the server that keeps world 'vineyard' is gone" in ada.status_message,
            "ada to notice the lost hub",
        )
        time.sleep(1.0)  # docs/network-routers.md: sooner, Zenoh may leave questions without a way
        with Server(str(endpoint)) as hub:
            wait(lambda: not ada.status_message and hub.actors == ["vineyard/ada"], "ada to be connected")


def test_a_relay_refuses_options_of_the_hub(tmp_path):
    with pytest.raises(
        ValueError, match=r"only routes: give --state-dir, --scene, --max-clients and --real-time-factor to"
    ):
        Server("tcp/127.0.0.1:0", connect=["tcp/127.0.0.1:1"], state_folder=tmp_path)


def test_the_documented_configuration_for_stock_routers_works():
    text = (pathlib.Path(__file__).parents[2] / "docs/network-routers.md").read_text()
    snippet = re.search(r"```json5\n(.*?)```", text, re.S).group(1)
    stream, datagrams = resolve_ports(["tcp/127.0.0.1:0", "udp/127.0.0.1:0"])
    with Server(("tcp/127.0.0.1:0", "udp/127.0.0.1:0")) as hub:
        snippet = snippet.replace("0.0.0.0:7377", f"127.0.0.1:{stream.port}")
        snippet = snippet.replace("10.0.0.1:7377", hub.endpoint.partition("/")[2])
        router = open_session(zenoh.Config.from_json5(snippet))
        with ZenohBus("ada", connect=hub.endpoint) as ada, ZenohBus("bob", connect=str(datagrams)) as bob:
            assert len(bob.links) == 3
            wait(lambda: ada.alive() == bob.alive() == {"ada", "bob"}, "both to see each other")
            ada.join(hello("ada"))
            with pytest.raises(JoinRejected, match="'D2'"):
                bob.join(hello("bob", "D2"))
            bob.join(hello("bob"))
            assert_connected(ada, bob)
        close_session(router)


def test_only_actors_with_a_body_that_were_admitted_slow_their_own_world(monkeypatch):
    """A spectator, a stranger and an actor of another world report that they can follow a tenth of real time."""
    monkeypatch.setattr("vinesim.net.server.server.GRACE_TIME", 0.0)  # else strangers' reports get no answer at first
    slow = encode_time(0.0, report=PaceReport(0.0, 0.1, "steps"))

    def reported_by(bus: ZenohBus, factor_falls: bool) -> None:
        answers: list = []

        def told() -> bool:
            bus.query(f"clock/{bus.name}", slow)
            answers.extend(decode_time(reply.payload) for reply in bus.replies())
            return any(one.factor < 0.5 for one in answers) if factor_falls else len(answers) > 20

        wait(told, "replies")
        assert any(one.cause for one in answers) == factor_falls

    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        eve, kim, bob, far = (
            stack.enter_context(ZenohBus(name, connect=server.endpoint, world=world))
            for name, world in (("eve", "vineyard"), ("kim", "vineyard"), ("bob", "vineyard"), ("far", "row-2"))
        )
        eve.join(encode_hello(Hello("eve", kind="spectator", scene="s", digest="1")))
        bob.join(encode_hello(Hello("bob", scene="s", digest="1")))
        far.join(encode_hello(Hello("far", scene="s", digest="1")))
        wait(lambda: len(server.actors) == 4, "all")
        for bus in (eve, kim):
            reported_by(bus, factor_falls=False)
        reported_by(far, factor_falls=True)
        reported_by(kim, factor_falls=False)
        reported_by(bob, factor_falls=True)
        assert server.figures()["clocks"]["vineyard"]["cause"].startswith("bob: ")
