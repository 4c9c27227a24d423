"""A world is recorded over real Zenoh, the recorder is killed, and its file is replayed to a viewer."""

from __future__ import annotations

import contextlib
import functools
import pathlib
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.support import programs
from tests.support.long_rows import long
from tests.support.recorded_world import TICK, MinimalClient
from tests.support.waiting import deadline
from vinesim.client.recording.recorder import Recorder
from vinesim.net.codec.header import kind_of
from vinesim.net.codec.messages import time_of
from vinesim.net.codec.trees import RESTING, TREES, TreeStates, decode_trees
from vinesim.net.recording.mcap_reader import InvalidRecording, Recording, read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication.interest import POSE_LAYERS
from vinesim.net.server.server import Server
from vinesim.net.transport.access_control import Role
from vinesim.net.transport.certificates import create as new_certificate
from vinesim.net.transport.zenoh_bus import ZenohBus

pytestmark = pytest.mark.slow


def command(*arguments: str) -> programs.Popen:
    return programs.Popen(
        [sys.executable, "-m", "vinesim", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@contextlib.contextmanager
def terminated(process: programs.Popen) -> Iterator[programs.Popen]:
    """A process that is killed, if necessary, when the block ends."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=deadline())


class TickedClients:
    """Clients that tick in real time while a test waits for a condition."""

    def __init__(self, *clients: MinimalClient) -> None:
        self.clients = list(clients)
        self.number = 0

    def until(
        self, condition: Callable[[], object], description: str, on_tick: Callable[[], None] = lambda: None
    ) -> None:
        end = time.monotonic() + deadline()
        while not condition():
            assert time.monotonic() < end, f"waited in vain for {description}"
            self.number += 1
            on_tick()
            for client in self.clients:
                client.tick(time.monotonic())
            time.sleep(TICK)


def partial_recording(path: pathlib.Path) -> Recording | None:
    """The readable part of a recording that may still grow; read again only when it has grown."""
    return _partial_recording_of_size(path, path.stat().st_size) if path.exists() else None


@functools.lru_cache(maxsize=4)
def _partial_recording_of_size(path: pathlib.Path, size: int) -> Recording | None:
    try:
        return read_recording(path)
    except InvalidRecording:
        return None


def keys(path: pathlib.Path) -> set[str]:
    recording = partial_recording(path)
    return {entry.key for entry in recording.messages} if recording else set()


@pytest.fixture(scope="module")
def killed_recording(tmp_path_factory) -> Iterator[tuple[str, pathlib.Path, float]]:
    """A server process, two minimal clients, and a recorder that is killed while a tree moves."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    with terminated(command("server", "--listen", "tcp/127.0.0.1:0")) as server:
        endpoint = server.stdout.readline().removeprefix("listening on ").strip()
        recorder = command("record", str(path), "--connect", endpoint)
        with (
            terminated(recorder),
            ZenohBus("ada", connect=endpoint) as ada_bus,
            ZenohBus("bob", connect=endpoint) as bob_bus,
        ):
            ada = MinimalClient(ada_bus, 0.5)
            clients = TickedClients(ada, MinimalClient(bob_bus, 2.0))
            clients.until(lambda: {"hello/ada", "hello/bob", "a/ada"} <= keys(path), "both to be recorded")

            # a tree is bent, rests, and is bent again until the recorder is killed
            clients.until(
                lambda: "tree/0/0/ada" in keys(path),
                "the tree to be recorded",
                lambda: ada.bend(0, 0.5 * np.sin(0.1 * clients.number)),
            )
            ada.touched = set()
            clients.until(lambda: "own/0/0/ada" in keys(path) and rest_updates(path), "its rest to be recorded")
            motion_start = time.monotonic()
            clients.until(
                lambda: time.monotonic() - motion_start > 1.5,
                "1.5 s of motion",
                lambda: ada.bend(0, 0.5 * np.sin(0.1 * clients.number)),
            )
            killed = time.time()
            recorder.send_signal(signal.SIGKILL)
            recorder.wait(deadline())
            state = [rest.joint_q for rest in rest_updates(path)]
        assert len(state) == 1
        yield endpoint, path, killed


def rest_updates(path: pathlib.Path) -> list[TreeStates]:
    recording = partial_recording(path)
    events = [entry.payload for entry in recording.messages if entry.key == "own/0/0/ada"] if recording else []
    trees = [decode_trees(payload) for payload in events if kind_of(payload) == TREES]
    return [batch for batch in trees if batch.flags[0] & RESTING]


def test_a_killed_recorder_loses_at_most_one_second(killed_recording):
    _, path, killed = killed_recording
    recording = read_recording(path)
    last = recording.messages[-1].time
    assert killed - 1.0 < last <= killed + 0.1
    assert "killed" in recording.damage
    assert recording.metadata["scene"] == "rows"
    moved = [entry for entry in recording.messages if entry.key in ("tree/0/0/ada", "near/0/0/ada")]
    assert killed - 1.0 < moved[-1].time


def test_a_second_recorder_writes_a_second_file(killed_recording):
    endpoint, path, _ = killed_recording
    before = path.read_bytes()
    with (
        terminated(command("record", str(path), "--connect", endpoint, "--area", "0", "-2", "4", "2")) as recorder,
        ZenohBus("eve", connect=endpoint) as bus,
    ):
        second = path.with_name("run-2.mcap")
        client = MinimalClient(bus, 1.5)
        clients = TickedClients(client)
        clients.until(
            lambda: {"hello/eve", "a/eve", "tree/0/0/eve"} <= keys(second),
            "a client alone in the area to be recorded",
            lambda: client.bend(1, 0.5 * np.sin(0.1 * clients.number)),
        )
        recorder.send_signal(signal.SIGINT)
        _, output = recorder.communicate(timeout=deadline())
    assert recorder.returncode == 0, output
    assert str(second) in output
    assert f"{path} is there already" in output
    assert path.read_bytes() == before
    with second.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == len(read_recording(second).messages)
    assert not any("recorder" in key for key in keys(second))


def without_time(payload: bytes) -> bytes:
    return payload if time_of(payload) is None else payload[:6] + payload[14:]


@pytest.mark.parametrize("listen", [False, True])
def test_a_truncated_recording_is_replayed_to_a_viewer(killed_recording, listen):
    """To a running server, or as a server that starts the replay when the viewer has joined."""
    endpoint, path, _ = killed_recording
    options = ["--listen", "tcp/127.0.0.1:0", "--speed", "2"] if listen else ["--connect", endpoint]
    with contextlib.ExitStack() as stack:
        if listen:
            replay = stack.enter_context(terminated(command("replay", str(path), *options)))
            endpoint = replay.stdout.readline().removeprefix("listening on ").strip()
        bus = stack.enter_context(ZenohBus("viewer", connect=endpoint))
        samples: list[tuple[str, bytes]] = []
        drain = bus.poll

        def drain_and_keep() -> list[tuple[str, bytes]]:
            samples.extend(new := drain())
            return new

        bus.poll = drain_and_keep
        viewer = MinimalClient(bus, 1.5, kind="spectator", joints=0)
        if not listen:
            replay = stack.enter_context(terminated(command("replay", str(path), *options)))
        TickedClients(viewer).until(lambda: replay.poll() is not None, "its end")
        _, output = replay.communicate()
    assert replay.returncode == 0, output
    output_lines = output.splitlines()
    assert "it ends in the middle" in output_lines[0]
    received = next(int(match[1]) for line in output_lines if (match := re.match(r"(\d+) messages were sent", line)))
    assert received > 100
    assert sorted(viewer.joined) == ["ada", "bob"]
    assert viewer.replicator.counters.malformed == 0
    # events equal the recorded ones but for their time, each once and in order; the tree moved
    before = [entry.payload for entry in read_recording(path).messages if entry.key == "own/0/0/ada"]
    after = [payload for key, payload in samples if key == "own/0/0/ada"]
    assert [without_time(payload) for payload in after] == [without_time(payload) for payload in before]
    assert len(viewer.received) > 20


POSE_SIZE = 56
"""Bytes of a pose of a client that moves nothing."""


def count_bytes(endpoint: str, path: pathlib.Path | None, distance: float) -> list[int]:
    """Payload bytes that two clients send in 200 ticks of touching, with a recorder if ``path`` is given.

    Time advances by one step a tick, after all subscriptions match: the result does not depend on the pace.
    """
    with contextlib.ExitStack() as stack:
        ada, bob = (
            MinimalClient(
                stack.enter_context(ZenohBus(name, connect=endpoint, world=f"count-{distance:g}-{path is None}")), x
            )
            for name, x in (("ada", 0.5), ("bob", 0.5 + distance))
        )
        recorder = None
        if path is not None:
            bus = stack.enter_context(ZenohBus("recorder", connect=endpoint, world=ada.bus.world, live=False))
            recorder = Recorder(bus, stack.enter_context(RecordingWriter(path)))
        now = 0.0

        def tick() -> None:
            nonlocal now
            now += TICK
            ada.tick(now)
            bob.tick(now)
            if recorder is not None:
                recorder.step()
            time.sleep(0.002)

        def all_matched() -> bool:
            ready = ada.joined == ["bob"] and bob.joined == ["ada"] and ada.replicator._state.peers._far.matching
            if distance < 5.0:
                streams = [p.matching for p in ada.replicator._state.tree_channels.publishers[-1].values()]
                ready &= (
                    ada.replicator._state.peers._layers[-1].matching
                    and bob.replicator._state.peers._layers[-1].matching
                    and any(streams)
                )
            if recorder is not None:
                ready &= recorder.greetings.keys() == {"ada", "bob"} and bool(recorder.recording.count > 6)
                ready &= distance > 5.0 or recorder._faster.get(("ada", POSE_LAYERS[-1]), (None, None))[1] is not None
            return ready

        end = time.monotonic() + deadline()
        while not all_matched():
            assert time.monotonic() < end
            tick()
        for _ in range(50):
            tick()
        now = round(now + 1.0)  # both runs start counting at the same phase of their periods
        tick()
        before = [client.bus.bytes_out for client in (ada, bob)]
        for number in range(200):
            ada.bend(0, 0.1 * number % 0.7)
            tick()
        if distance > 5.0:
            assert ada.environment() == 0
        else:
            assert ada.environment() > 10_000
        return [client.bus.bytes_out - bytes_out for client, bytes_out in zip((ada, bob), before, strict=True)]


@pytest.mark.parametrize("distance", [2.0, *long(40.0)])
def test_a_recorder_does_not_change_traffic(tmp_path, distance):
    with Server("tcp/127.0.0.1:0") as server:
        path = tmp_path / "run.mcap"
        without_recorder = count_bytes(server.endpoint, None, distance)
        with_recorder = count_bytes(server.endpoint, path, distance)
    # two runs begin at different phases of the poses' periods, so one pose and one coarse pose more may be due in one
    assert np.abs(np.subtract(without_recorder, with_recorder)).max() <= 2 * POSE_SIZE
    recorded = {entry.key for entry in read_recording(path).messages}
    assert ("tree/0/0/ada" in recorded) == (distance < 5.0)
    assert any(key.startswith("pose/") and key.endswith("/ada") for key in recorded)


def test_a_full_disk_ends_a_recording_with_one_line(tmp_path):
    """The disk is emulated by a limit on the size of files, which the system reports alike."""
    path = tmp_path / "run.mcap"
    limited = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000));"
        "sys.argv = ['vinesim', 'record', *sys.argv[1:]]; from vinesim.cli import main; main()"
    )
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        clients = [
            MinimalClient(stack.enter_context(ZenohBus(name, connect=server.endpoint)), x)
            for name, x in (("ada", 0.5), ("bob", 2.0))
        ]
        process = programs.Popen(
            [sys.executable, "-c", limited, str(path), "--connect", server.endpoint],
            stderr=subprocess.PIPE,
            text=True,
        )
        with terminated(process):
            TickedClients(*clients).until(lambda: process.poll() is not None, "its end")
            output = process.stderr.read().splitlines()
    assert process.returncode == 5, output
    assert [line for line in output if line.startswith("vinesim: ")] == output[1:]
    assert str(path) in output[1]
    recording = read_recording(path)
    assert len(recording.messages) > 0
    assert recording.metadata["scene"] == "rows"


def test_recording_needs_only_a_spectator_certificate(tmp_path):
    certs = tmp_path / "certs"
    for name, role in (("ada", Role.ROBOT), ("bob", Role.ROBOT), ("recorder", Role.SPECTATOR)):
        new_certificate(certs, name, role)
    with Server("tls/127.0.0.1:0", certificates=certs) as server, contextlib.ExitStack() as stack:

        def bus(name: str, **options: bool) -> ZenohBus:
            return stack.enter_context(ZenohBus(name, connect=server.endpoint, certificates=certs, **options))

        ada = MinimalClient(bus("ada"), 0.5)
        bob = MinimalClient(bus("bob"), 2.0)
        recording = stack.enter_context(RecordingWriter(tmp_path / "run.mcap"))
        recorder = Recorder(bus("recorder", live=False), recording)
        clients = TickedClients(ada, bob)

        poses = {"hello/ada", "hello/bob", "a/ada", "a/bob", "a/ada/far"}
        clients.until(lambda: poses <= keys(recording.path), "greetings and poses to be recorded", recorder.step)

        # a claim is sent once: bend and release repeatedly, as the recorder's subscriptions may match late
        def on_tick() -> None:
            if clients.number % 200 < 100:
                ada.bend(0, 0.5 * np.sin(0.1 * clients.number))
            else:
                ada.touched = set()
            recorder.step()

        plants = {"tree/0/0/ada", "near/0/0/ada", "own/0/0/ada"}
        clients.until(lambda: plants <= keys(recording.path), "the tree and its claim to be recorded", on_tick)
        assert poses | plants <= keys(recording.path)
