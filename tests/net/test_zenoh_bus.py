"""The bus over real Zenoh on loopback: tcp, free ports, no multicast; tests wait for conditions, not for times."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh

from tests.support import programs
from tests.support.waiting import deadline, wait
from vinesim.core import frames
from vinesim.net.codec.control import Hello, encode_hello
from vinesim.net.codec.header import MAX_MESSAGE
from vinesim.net.replication.replicator import Replicator
from vinesim.net.server.server import Server
from vinesim.net.transport import zenoh_bus, zenoh_session
from vinesim.net.transport import zenoh_bus as zenoh_entities
from vinesim.net.transport.bus import KEEP_ALL, JoinRejected, NameTaken
from vinesim.net.transport.certificates import create
from vinesim.net.transport.endpoints import parse, resolve_ports
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import ServerUnreachable, called_directly, close_session, open_client
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.state import State
from vinesim.scene.values import RobotUpdate

pytestmark = pytest.mark.slow


@pytest.fixture
def server() -> Iterator[Server]:
    with Server("tcp/127.0.0.1:0") as running:
        yield running


class CountingRelay:
    """A TCP relay between a client and the router that counts all bytes each way."""

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.up = self.down = 0
        self._sockets = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                router = socket.create_connection(self._target)
                self._sockets += [client, router]
                for source, target, direction in ((client, router, "up"), (router, client, "down")):
                    threading.Thread(target=self._forward, args=(source, target, direction), daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket, direction: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                setattr(self, direction, getattr(self, direction) + len(data))
                target.sendall(data)
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> CountingRelay:
        return self

    def __exit__(self, *_: object) -> None:
        for socket_ in self._sockets:
            socket_.close()


def test_samples_arrive_with_the_depth_of_their_subscription(server):
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.subscribe("c/0/0/*")
        bob.subscribe("own/0/0/*", KEEP_ALL)
        pose = ada.publisher("c/0/0/ada")
        event = ada.publisher("own/0/0/ada", reliable=True)
        wait(lambda: pose.matching and event.matching, "bob's subscriptions")
        for number in range(100):
            assert pose.put(bytes([number]))
            assert event.put(bytes([number]))
        wait(lambda: bob.bytes_in == 200, "all samples")
        received = bob.poll()
        assert [payload[0] for key, payload in received if key == "own/0/0/ada"] == list(range(100))
        assert [payload[0] for key, payload in received if key == "c/0/0/ada"] == [99]
        assert (ada.bytes_out, bob.bytes_in) == (200, 200)


def test_subscriptions_take_no_thread(server):
    """A client has a hundred of them, and two cores."""
    others = set(zenoh_session._direct)
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        before = threading.active_count()
        for i in range(50):
            bob.subscribe(f"c/{i}/0/*")
        last = ada.publisher("c/49/0/ada")
        wait(lambda: last.matching, "all subscriptions to be known")
        assert threading.active_count() == before
    wait(lambda: zenoh_session._direct <= others, "what the exit of the program waits for")


def test_without_a_subscriber_zenoh_sends_no_byte(server):
    with (
        CountingRelay(server.endpoint) as relay,
        ZenohBus("ada", connect=relay.endpoint) as ada,
        ZenohBus("bob", connect=server.endpoint) as bob,
    ):
        # both subscribe to a neighbouring cell, ada also to her own: neither may make her send
        bob.subscribe("c/1/0/*")
        ada.subscribe("c/0/0/*")
        here = ada.publisher("c/0/0/ada")
        there = ada.publisher("c/1/0/ada")
        wait(lambda: there.matching, "bob's subscription")
        assert not here.matching
        payload = bytes(200)

        def cost(publisher, count: int) -> int:
            before = relay.up
            received = bob.bytes_in
            for _ in range(count):
                # bypasses the bus's check of matching: Zenoh itself must not send
                publisher._publisher.put(payload)
            ended = received + 3 + (200 * count if publisher is there else 0)
            assert there.put(b"end")
            wait(lambda: bob.bytes_in == ended, "the sample that ends the count")
            return relay.up - before

        assert cost(there, 50) > 50 * 200
        # the end mark, and perhaps a keepalive of a few bytes
        assert cost(here, 20_000) < 200
        assert not here.put(payload)
        assert ada.bytes_out == 6  # the two end marks, put through the bus


def test_counted_payload_bytes_equal_the_traffic(server):
    with (
        CountingRelay(server.endpoint) as relay,
        ZenohBus("ada", connect=relay.endpoint) as ada,
        ZenohBus("bob", connect=server.endpoint) as bob,
    ):
        bob.subscribe("c/0/0/*", KEEP_ALL)
        publisher = ada.publisher("c/0/0/ada")
        wait(lambda: publisher.matching, "bob's subscription")
        before = relay.up
        for _ in range(50):
            publisher.put(bytes(1000))
            time.sleep(0.001)
        wait(lambda: bob.bytes_in == 50_000, "all samples")
        assert ada.bytes_out == 50_000
        assert 50_000 <= relay.up - before - ada.seal_bytes_out < 50_000 + 50 * 60
        assert bob.seal_bytes_in == ada.seal_bytes_out < 50 * 80


def joined(name: str, server: Server, world: str = "vineyard") -> ZenohBus:
    """Returns the bus of an actor whom the server has admitted, so that no other session can have the name."""
    bus = ZenohBus(name, connect=server.endpoint, world=world)
    try:
        bus.join(encode_hello(Hello(name, digest="D")))
    except BaseException:
        bus.close()
        raise
    return bus


def test_a_name_is_live_once_and_free_after_leaving(server):
    with joined("ada", server):
        with pytest.raises(NameTaken, match="'ada' is already live in world 'vineyard'"):
            ZenohBus("ada", connect=server.endpoint)
        with joined("ada", server, "other") as elsewhere:
            assert elsewhere.alive() == {"ada"}
    with joined("ada", server) as reset:
        assert reset.alive() == {"ada"}


def test_at_most_one_of_simultaneous_joins_keeps_the_name(server, monkeypatch):
    """Also when the server no longer reserves names for sessions that were there before it started."""
    monkeypatch.setattr(server._admission, "reserved_until", 0.0)
    outcomes: list[object] = []

    def join() -> None:
        try:
            outcomes.append(joined("ada", server))
        except (NameTaken, JoinRejected) as error:
            outcomes.append(error)

    threads = [threading.Thread(target=join) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    buses = [outcome for outcome in outcomes if isinstance(outcome, ZenohBus)]
    for bus in buses:
        bus.close()
    assert len(outcomes) == 4
    assert len(buses) <= 1


def test_actors_are_known_at_once_and_leaving_is_noticed(server):
    with ZenohBus("ada", connect=server.endpoint) as ada:
        with ZenohBus("bob", connect=server.endpoint) as bob:
            assert bob.alive() == {"ada", "bob"}
            wait(lambda: ada.alive() == {"ada", "bob"}, "bob to join")
        wait(lambda: ada.alive() == {"ada"}, "bob to leave")


def test_an_unreachable_server_is_one_clear_line():
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        endpoint = f"tcp/127.0.0.1:{reserved.getsockname()[1]}"
    with pytest.raises(ServerUnreachable, match="vinesim server") as caught:
        ZenohBus("ada", connect=endpoint)
    assert endpoint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["", "a/b", "*", "vs 1"])
def test_an_invalid_actor_name_is_refused(name):
    with pytest.raises(ValueError, match="letters, digits"):
        ZenohBus(name)


def test_a_query_returns_its_reply(server):
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.declare_queryable("hello/bob", lambda query: query + b"!")
        answers: list = []

        def reply_arrived() -> bool:
            ada.query("hello/bob", b"hi")
            time.sleep(0.02)
            answers.extend(ada.replies())
            return bool(answers)

        wait(reply_arrived, "bob's answer")
        assert answers[0][:2] == ("hello/bob", b"hi!")
        assert 0.0 <= answers[0].age < deadline()


def test_an_oversized_sample_is_dropped(server):
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.subscribe("own/0/0/*", KEEP_ALL)
        event = ada.publisher("own/0/0/ada", reliable=True)
        wait(lambda: event.matching, "bob's subscription")
        event.put(bytes(MAX_MESSAGE + 1))
        event.put(bytes(5 * MAX_MESSAGE))  # the router does not even reassemble this
        event.put(b"small")
        wait(lambda: bob.bytes_in == MAX_MESSAGE + 6, "both samples")
        assert bob.poll() == [("own/0/0/ada", b"small")]
        assert bob.dropped == 1


def test_the_end_of_a_callback_runs_no_python_code():
    """Else the interpreter may end between its mark, which the exit waits for, and the end of the thread of Zenoh,
    which aborts the program ("FATAL: exception not rethrown")."""
    others = set(zenoh_session._direct)
    seen = []
    callback = zenoh_session.called_directly(lambda _: None)
    (mark,) = zenoh_session._direct - others
    sys.setprofile(lambda frame, event, _: seen.append((event, frame.f_code.co_name)))
    try:
        callback.drop()
    finally:
        sys.setprofile(None)
    assert mark not in zenoh_session._direct
    assert [name for event, name in seen if event == "call"] == []


def test_an_open_session_does_not_block_exit(server):
    code = (
        "from vinesim.net.transport.zenoh_bus import ZenohBus\n"
        f"bus = ZenohBus('ada', connect={server.endpoint!r})\nprint('in')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=deadline(300.0), check=False
    )
    assert (done.returncode, done.stdout) == (0, "in\n"), done.stderr


# ---------------------------------------------------------------- exchanges over Zenoh


class Client:
    """A robot at ``x`` in a vineyard of three trees, ticking by the wall clock."""

    def __init__(self, bus: ZenohBus, x: float) -> None:
        trees = []
        for number in range(3):
            tree = TreeBuilder(frames.pose(np.array([number + 0.5, 0.0, 1.5])))
            tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)
            trees.append(tree)
        self.model = assemble(trees)
        self.state = State.at_rest(self.model)
        self.replicator = Replicator(bus, Hello(bus.name, digest=self.model.digest(), joints=1), self.model)
        self.robot = RobotUpdate(bus.name, 0.0, frames.pose(np.array([x, 0, 0])), np.zeros(6), np.zeros(1), np.zeros(1))
        self.touched: set[int] = set()
        self.robots: dict[str, RobotUpdate] = {}
        self.received: list = []

    def tick(self) -> None:
        now = time.monotonic()
        inbox = self.replicator.receive(now)
        self.robots = inbox.robots
        self.received += inbox.trees
        self.replicator.send(now, self.robot, touched=self.touched, read=self.read)

    def read(self, tree: int) -> tuple[np.ndarray, np.ndarray]:
        bodies = self.model.bodies_of(tree)
        return self.state.joint_q[bodies], self.state.joint_qd[bodies]


def ticking_all(*clients: Client) -> Callable[[Callable[[], object]], Callable[[], object]]:
    def ticking(condition: Callable[[], object]) -> Callable[[], object]:
        def check() -> object:
            for client in clients:
                client.tick()
            return condition()

        return check

    return ticking


def test_touched_trees_are_exchanged_near_and_not_far(server):
    with (
        CountingRelay(server.endpoint) as relay,
        ZenohBus("ada", connect=relay.endpoint) as a,
        ZenohBus("bob", connect=server.endpoint) as b,
    ):
        ada = Client(a, 1.0)
        bob = Client(b, 20.0)
        ticking = ticking_all(ada, bob)
        wait(ticking(lambda: "bob" in ada.robots and "ada" in bob.robots), "both to see each other")
        wait(ticking(lambda: abs(ada.replicator.offset + time.monotonic() - time.time()) < 0.1), "the server's clock")
        ada.touched = {0}
        turn = frames.exp(np.array([0.0, 0.3, 0.0]))
        ada.state.joint_q[:] = frames.multiply(turn, ada.model.joint_settled)
        counters = ada.replicator.counters
        poses = counters.actor.messages_out
        wait(ticking(lambda: counters.actor.messages_out > poses + 5), "a second of far poses")
        assert (counters.environment.messages_out, counters.event.messages_out) == (0, 0)
        # only poses and upkeep were sent: trees would cost thousands of bytes
        assert a.bytes_out == counters.actor.bytes_out
        assert ada.replicator.owner(0) == "ada"
        assert bob.replicator.owner(0) is None
        bob.robot = RobotUpdate("bob", 0.0, frames.pose(np.array([2.0, 0, 0])), np.zeros(6), np.zeros(1), np.zeros(1))
        wait(ticking(lambda: bob.received), "the touched tree")
        update = bob.received[0]
        assert (update.tree, update.owner) == (0, "ada")
        np.testing.assert_allclose(update.joint_q, ada.read(0)[0], atol=1e-4)
        ada.touched = set()
        wait(ticking(lambda: bob.replicator.owner(0) is None), "the rest record")
        assert relay.up > 0


def test_replication_resumes_after_a_router_restart():
    code = (
        "import sys\nfrom vinesim.net.server.server import Server\n"
        "with Server(sys.argv[1]) as server:\n    print('up', flush=True)\n    server.run()"
    )
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        endpoint = f"tcp/127.0.0.1:{reserved.getsockname()[1]}"

    def start() -> programs.Popen:
        process = programs.Popen([sys.executable, "-c", code, endpoint], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        return process

    router = start()
    try:
        with ZenohBus("ada", connect=endpoint) as a, ZenohBus("bob", connect=endpoint) as b:
            ada = Client(a, 1.0)
            bob = Client(b, 2.0)
            ticking = ticking_all(ada, bob)
            ada.touched = {1}
            wait(ticking(lambda: bob.replicator.owner(1) == "ada"), "the first touch")
            router.kill()
            router.wait()
            wait(ticking(lambda: a.status_message and b.status_message), "both to notice that the server is gone")
            assert endpoint in a.status_message
            wait(ticking(lambda: a.alive() == {"ada"} and not bob.robots), "both to be without peers")
            assert ada.replicator.owner(1) == "ada"
            router = start()
            wait(ticking(lambda: bob.replicator.owner(1) == "ada" and "ada" in bob.robots), "the stream again")
            assert a.status_message == b.status_message == ""
    finally:
        router.kill()
        router.wait()


# ---------------------------------------------------------------- links


class PoseAndEvent:
    """A condition for ``wait``: sends a pose and an event at each call, true when both have arrived."""

    def __init__(self, sender: ZenohBus, receiver: ZenohBus) -> None:
        receiver.subscribe(f"a/{sender.name}")
        receiver.subscribe(f"own/0/0/{sender.name}", KEEP_ALL)
        self._pose = sender.publisher(f"a/{sender.name}")
        self._event = sender.publisher(f"own/0/0/{sender.name}", reliable=True)
        self._receiver = receiver
        self._received: set[str] = set()

    def reset(self) -> None:
        self._receiver.poll()
        self._received.clear()

    def __call__(self) -> bool:
        self._pose.put(bytes(1000))
        self._event.put(b"event")
        time.sleep(0.002)
        self._received.update(key for key, _ in self._receiver.poll())
        return len(self._received) == 2


def test_poses_use_datagrams_and_events_the_stream(server):
    with CountingRelay(server.endpoint) as relay:
        port = relay.endpoint.rpartition(":")[2]
        # a datagram server at the relay's port number, so datagrams bypass the relay
        with (
            Server(f"udp/127.0.0.1:{port}", connect=[server.endpoint]),
            ZenohBus("ada", connect=f"udp/127.0.0.1:{port}") as ada,
            ZenohBus("bob", connect=server.endpoint) as bob,
        ):
            assert [link.partition(" ")[2] for link in ada.links] == ["reliable", "best effort", "reliable"]
            assert len(bob.links) == 1
            bob.subscribe("a/ada", KEEP_ALL)
            bob.subscribe("own/0/0/ada", KEEP_ALL)
            pose = ada.publisher("a/ada")
            event = ada.publisher("own/0/0/ada", reliable=True)
            wait(lambda: pose.matching and event.matching, "bob's subscriptions")
            before = relay.up
            wait(lambda: (pose.put(bytes(1000)) and time.sleep(0.001)) or bob.bytes_in >= 50_000, "fifty poses")
            assert relay.up - before < 5_000
            for _ in range(20):
                event.put(bytes(1000))
            received: list = []
            wait(lambda: received.extend(bob.poll()) or sum(k[0] == "o" for k, _ in received) == 20, "all events")
            assert relay.up - before > 20_000


def test_poses_use_the_stream_if_datagrams_are_blocked_and_this_is_logged(server, caplog):
    port = server.endpoint.rpartition(":")[2]
    with socket.socket(
        socket.AF_INET, socket.SOCK_DGRAM
    ) as unresponsive:  # receives every handshake and replies to none
        unresponsive.bind(("127.0.0.1", int(port)))
        with ZenohBus("ada", connect=f"udp/127.0.0.1:{port}") as ada, ZenohBus("bob", connect=server.endpoint) as bob:
            assert len([line for line in caplog.messages if "no datagrams pass" in line]) == 1
            assert [link.partition(" ")[2] for link in ada.links] == ["reliable"]
            wait(PoseAndEvent(ada, bob), "a pose and an event")


class DatagramRelay:
    """A UDP relay between one client and the router, until it is closed."""

    def __init__(self, port: int, target: int) -> None:
        self._outer, self._inner = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._outer.bind(("127.0.0.1", port))
        self._inner.connect(("127.0.0.1", target))
        self._client: tuple[str, int] | None = None
        for forward in (self._there, self._back):
            threading.Thread(target=forward, daemon=True).start()

    def _there(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                data, self._client = self._outer.recvfrom(65536)
                self._inner.send(data)

    def _back(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                data = self._inner.recv(65536)
                assert self._client is not None
                self._outer.sendto(data, self._client)

    def close(self) -> None:
        for socket_ in (self._outer, self._inner):
            socket_.close()


def test_a_short_loss_of_the_connection_is_not_reported_and_a_long_one_once(caplog, monkeypatch):
    """A client that joins must not begin with "lost the server" because a connection was replaced."""
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        lost = ada._lost_endpoints
        lost.add(ada.endpoint)
        wait(lambda: ada._lost_since is not None, "the bus to look at its links")
        lost.clear()
        wait(lambda: ada._lost_since is None, "the bus to look at its links again")
        assert ada.status_message == ""
        assert not [line for line in caplog.messages if "server" in line]
        monkeypatch.setattr(zenoh_bus, "LOSS_NOTICE", 0.0)
        lost.add(ada.endpoint)
        wait(lambda: "is gone" in ada.status_message, "the loss to be reported")
        lost.clear()
        wait(lambda: ada.status_message == "", "the bus to look at its links again")
        told = [line.partition(" at ")[0] for line in caplog.messages if "server" in line]
        assert told == ["ada: lost the server", "ada: connected to the server"]


def test_poses_move_to_the_stream_when_datagrams_stop(caplog, monkeypatch):
    monkeypatch.setattr(zenoh_bus, "SILENCE_TIMEOUT", 1.0)
    with Server(("tcp/127.0.0.1:0", "udp/127.0.0.1:0")) as server, CountingRelay(server.endpoint) as relay:
        port = int(relay.endpoint.rpartition(":")[2])
        datagrams = DatagramRelay(port, server.endpoints[1].port)
        with ZenohBus("ada", connect=f"udp/127.0.0.1:{port}") as ada, ZenohBus("bob", connect=server.endpoint) as bob:
            assert len(ada.links) == 3
            there = PoseAndEvent(ada, bob)
            back = PoseAndEvent(bob, ada)
            wait(lambda: there() and back(), "poses each way")
            datagrams.close()
            wait(lambda: "udp/" in ada.status_message, "ada to notice the lost datagrams")
            there.reset()
            back.reset()
            wait(lambda: there() and back(), "poses over the stream")
            wait(lambda: ada.status_message == "", "the actor to be served again")
            assert [link.partition(" ")[2] for link in ada.links] == ["reliable"]
            assert len([line for line in caplog.messages if "no datagrams pass" in line and "any more" in line]) == 1


def test_poses_return_to_datagrams_when_they_pass_again(monkeypatch):
    monkeypatch.setattr(zenoh_bus, "SILENCE_TIMEOUT", 0.5)
    monkeypatch.setattr(zenoh_bus, "DATAGRAM_RETRY_PERIOD", 0.5)
    with Server(("tcp/127.0.0.1:0", "udp/127.0.0.1:0")) as server, CountingRelay(server.endpoint) as relay:
        port = int(relay.endpoint.rpartition(":")[2])
        datagrams = DatagramRelay(port, server.endpoints[1].port)
        with ZenohBus("ada", connect=f"udp/127.0.0.1:{port}") as ada, ZenohBus("bob", connect=server.endpoint) as bob:
            there = PoseAndEvent(ada, bob)
            back = PoseAndEvent(bob, ada)
            wait(lambda: there() and back(), "poses each way")
            datagrams.close()
            wait(lambda: len(ada.links) == 1, "ada to give up datagrams")
            datagrams = DatagramRelay(port, server.endpoints[1].port)
            wait(lambda: len(ada.links) == 3, "ada to return to datagrams")
            there.reset()
            back.reset()
            wait(lambda: there() and back(), "poses each way again")
            up = relay.up
            pose = ada.publisher("a/ada")
            bob.subscribe("a/ada", KEEP_ALL)
            wait(lambda: pose.matching, "bob's subscription")
            before = bob.bytes_in
            wait(
                lambda: (pose.put(bytes(1000)) and time.sleep(0.001)) or bob.bytes_in - before >= 50_000, "fifty poses"
            )
            assert relay.up - up < 10_000, "poses took the stream"
            assert ada.status_message == ""
        datagrams.close()


def test_a_session_that_closes_under_the_real_time_loop_raises_nothing(server):
    """Puts, matching, new publishers, subscriptions and queries on a closed session are counted."""
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.subscribe("own/0/0/ada", KEEP_ALL)
        event = ada.publisher("own/0/0/ada", reliable=True)
        pose = ada.publisher("a/ada")
        wait(lambda: event.matching, "bob's subscription")
        close_session(ada.session_for(reliable=True))
        for publisher in (event, pose, ada.publisher("a/ada/far"), ada.publisher("own/0/1/ada", reliable=True)):
            assert not publisher.matching
            assert not publisher.put(b"lost")
        ada.subscribe("a/bob").close()
        ada.query("clock/ada")
        ada.poll()
        wait(lambda: ada.failures >= 4, "the failures to be counted")


def test_a_put_that_fails_is_counted_and_the_publisher_is_declared_again(server, monkeypatch):
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.subscribe("a/ada", KEEP_ALL)
        pose = ada.publisher("a/ada")
        wait(lambda: pose.matching, "bob's subscription")
        monkeypatch.setattr(zenoh_entities, "has_match", lambda _: True)
        pose._publisher.undeclare()
        assert not pose.put(b"lost")
        assert ada.failures == 1
        wait(lambda: pose.put(b"sent") and bob.poll(), "the publisher to work again")


def test_reliable_puts_that_wait_are_bounded(server, monkeypatch):
    """A router that takes nothing blocks the bus's thread: puts are refused, counted, and accepted again later."""
    monkeypatch.setattr(zenoh_bus, "MAX_PENDING_PUTS", 5)
    with ZenohBus("ada", connect=server.endpoint) as ada, ZenohBus("bob", connect=server.endpoint) as bob:
        bob.subscribe("own/0/0/ada", KEEP_ALL)
        event = ada.publisher("own/0/0/ada", reliable=True)
        wait(lambda: event.matching, "bob's subscription")
        stalled = threading.Event()
        ada.submit(stalled.wait)
        assert [event.put(b"event") for _ in range(8)] == [True] * 5 + [False] * 3
        assert (ada.failures, ada.bytes_out) == (3, 25)
        stalled.set()
        received: list = []
        wait(lambda: received.extend(bob.poll()) or len(received) == 5, "what was accepted")
        assert event.put(b"event")
        monkeypatch.setattr(zenoh_bus, "MAX_PENDING_BYTES", 100)
        assert not event.put(bytes(101))


def test_an_error_in_the_thread_of_the_bus_does_not_end_it(server):
    with ZenohBus("ada", connect=server.endpoint) as ada:
        ada.submit(lambda: 1 // 0)
        done = threading.Event()
        ada.submit(done.set)
        assert done.wait(deadline())
        assert ada.failures == 1


JOIN = """
import pathlib, sys
from vinesim.net.transport.zenoh_bus import ZenohBus
with ZenohBus("ada", connect=sys.argv[1]):
    print("in", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("direction", [0, 1], ids=["tcp", "udp"])
def test_a_frozen_client_is_removed(direction):
    with Server(("tcp/127.0.0.1:0", "udp/127.0.0.1:0")) as server, ZenohBus("bob", connect=server.endpoint) as bob:
        process = programs.Popen(
            [sys.executable, "-c", JOIN, str(server.endpoints[direction])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "in\n"
            wait(lambda: "ada" in bob.alive() and "vineyard/ada" in server.actors, "ada")
            process.send_signal(signal.SIGSTOP)
            wait(lambda: "ada" not in bob.alive() and "vineyard/ada" not in server.actors, "ada to leave")
        finally:
            process.kill()
            process.communicate()


@pytest.mark.parametrize("protocols", ["tcp udp", "tls quic"])
def test_all_links_resume_after_a_server_restart(protocols, tmp_path):
    stream, datagrams = protocols.split()
    secure = stream == "tls"
    for name in ("ada", "bob") if secure else ():
        create(tmp_path, name)
    endpoints = resolve_ports([f"{stream}/127.0.0.1:0", f"{datagrams}/127.0.0.1:0"], secured=secure)
    code = (
        "import pathlib, sys\nfrom vinesim.net.server.server import Server\n"
        f"with Server(sys.argv[1:], certificates={f'pathlib.Path({str(tmp_path)!r})' if secure else None}) as server:\n"
        "    print('up', flush=True)\n    server.run()"
    )

    def start() -> programs.Popen:
        process = programs.Popen([sys.executable, "-c", code, *map(str, endpoints)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        return process

    router = start()
    certificates = tmp_path if secure else None
    try:
        with (
            ZenohBus("ada", connect=str(endpoints[1]), certificates=certificates) as ada,
            ZenohBus("bob", connect=str(endpoints[1]), certificates=certificates) as bob,
        ):
            assert len(ada.links) == len(bob.links) == 3
            both = PoseAndEvent(ada, bob)
            wait(both, "a pose and an event")
            router.kill()
            router.wait()
            wait(lambda: ada.status_message and bob.status_message, "both to notice")
            router = start()
            both.reset()
            wait(both, "both streams again")
            wait(
                lambda: not ada.status_message and not bob.status_message and len(ada.links) == 3,
                "both to be connected",
            )
    finally:
        router.kill()
        router.wait()


def test_a_thread_of_zenoh_keeps_its_python_state_between_messages():
    """Making a Python thread state for each message takes two thirds of the time of a message."""
    local = threading.local()
    seen: list[tuple[int, bool]] = []

    def store(_: zenoh.Sample) -> None:
        seen.append((threading.get_native_id(), hasattr(local, "mark")))
        local.mark = True

    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        session = ada.session_for(reliable=True)
        subscriber = session.declare_subscriber("k/*", called_directly(store))
        sender = open_client(parse(server.endpoint), {})
        wait(lambda: (sender.put("k/1", b""), len(seen) > 200)[1], "messages")
        close_session(sender)
        subscriber.undeclare()
    threads = {thread for thread, _ in seen}
    assert sum(not is_kept for _, is_kept in seen) == len(threads)
