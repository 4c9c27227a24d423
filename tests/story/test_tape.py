"""A world is recorded over real Zenoh, the recorder is killed, and what it left is replayed to another viewer."""

from __future__ import annotations

import contextlib
import functools
import os
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

from tests.support.recorded_world import TICK, Light
from tests.support.waiting import TIMEOUT
from vinesim.client.recording.recorder import Recorder
from vinesim.net.codec import messages
from vinesim.net.recording.mcap_reader import InvalidRecording, Recording, read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.server.server import Server
from vinesim.net.transport.access_control import Role
from vinesim.net.transport.certificates import create as new_certificate
from vinesim.net.transport.zenoh_bus import ZenohBus


def command(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "vinesim.cli", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@contextlib.contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """A process that is gone when the block is left."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=TIMEOUT)


class Company:
    """Light clients that tick in real time while one waits for something."""

    def __init__(self, *clients: Light) -> None:
        self.clients = list(clients)
        self.number = 0

    def until(self, condition: Callable[[], object], what: str, each: Callable[[], None] = lambda: None) -> None:
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, f"waited in vain for {what}"
            self.number += 1
            each()
            for client in self.clients:
                client.tick(time.monotonic())
            time.sleep(TICK)


def tape_of(path: pathlib.Path) -> Recording | None:
    """What can be read of a recording that may still grow; read anew only when it has grown."""
    return _tape_of_size(path, path.stat().st_size) if path.exists() else None


@functools.lru_cache(maxsize=4)
def _tape_of_size(path: pathlib.Path, size: int) -> Recording | None:
    try:
        return read_recording(path)
    except InvalidRecording:
        return None


def keys(path: pathlib.Path) -> set[str]:
    tape = tape_of(path)
    return {entry.key for entry in tape.messages} if tape else set()


@pytest.fixture(scope="module")
def story(tmp_path_factory) -> Iterator[tuple[str, pathlib.Path, float]]:
    """A server process, two light clients, and a recorder that is killed while a tree moves."""
    path = tmp_path_factory.mktemp("story") / "run.mcap"
    with ended(command("server", "--listen", "tcp/127.0.0.1:0")) as server:
        endpoint = server.stdout.readline().removeprefix("listening on ").strip()
        recorder = command("record", str(path), "--connect", endpoint)
        with (
            ended(recorder),
            ZenohBus("ada", connect=endpoint) as ada_bus,
            ZenohBus("bob", connect=endpoint) as bob_bus,
        ):
            ada = Light(ada_bus, 0.5)
            company = Company(ada, Light(bob_bus, 2.0))
            company.until(lambda: {"hello/ada", "hello/bob", "a/ada"} <= keys(path), "both on the tape")

            # a tree is bent, rests, and is bent again until the recorder is killed
            company.until(
                lambda: "c/0/0/ada" in keys(path), "the tree on the tape",
                lambda: ada.bend(0, 0.5 * np.sin(0.1 * company.number)),
            )  # fmt: skip
            ada.touched = set()
            company.until(lambda: "own/0/0/ada" in keys(path) and rests(path), "its rest on the tape")
            begun = time.monotonic()
            company.until(
                lambda: time.monotonic() - begun > 1.5, "1.5 s of motion",
                lambda: ada.bend(0, 0.5 * np.sin(0.1 * company.number)),
            )  # fmt: skip
            killed = time.time()
            recorder.send_signal(signal.SIGKILL)
            recorder.wait(TIMEOUT)
            state = [rest.joint_q for rest in rests(path)]
        assert len(state) == 1
        yield endpoint, path, killed


def rests(path: pathlib.Path) -> list[messages.TreeStates]:
    tape = tape_of(path)
    events = [entry.payload for entry in tape.messages if entry.key == "own/0/0/ada"] if tape else []
    trees = [
        messages.decode_trees(payload) for payload in events if messages.kind_of(payload) == messages.MessageKind.TREES
    ]
    return [batch for batch in trees if batch.flags[0] & messages.RESTING]


def test_a_killed_recorder_loses_at_most_the_last_second(story):
    _, path, killed = story
    tape = read_recording(path)
    last = tape.messages[-1].time
    assert killed - 1.0 < last <= killed + 0.1
    assert "killed" in tape.damage
    assert tape.metadata["scene"] == "rows"
    moved = [entry for entry in tape.messages if entry.key == "c/0/0/ada"]
    assert killed - 1.0 < moved[-1].time


def test_a_second_recorder_leaves_the_first_ones_file_alone(story):
    endpoint, path, _ = story
    before = path.read_bytes()
    with (
        ended(command("record", str(path), "--connect", endpoint, "--area", "0", "-2", "4", "2")) as recorder,
        ZenohBus("eve", connect=endpoint) as bus,
    ):
        second = path.with_name("run-2.mcap")
        alone = Light(bus, 1.5)
        company = Company(alone)
        company.until(
            lambda: {"hello/eve", "a/eve", "c/0/0/eve"} <= keys(second), "one who is alone on the tape, in an area",
            lambda: alone.bend(1, 0.5 * np.sin(0.1 * company.number)),
        )  # fmt: skip
        recorder.send_signal(signal.SIGINT)
        _, said = recorder.communicate(timeout=TIMEOUT)
    assert recorder.returncode == 0, said
    assert str(second) in said
    assert f"{path} is there already" in said
    assert path.read_bytes() == before
    with second.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == len(read_recording(second).messages)
    assert not any("recorder" in key for key in keys(second))


def stampless(payload: bytes) -> bytes:
    return payload if messages.time_of(payload) is None else payload[:6] + payload[14:]


@pytest.mark.parametrize("listen", [False, True])
def test_what_was_left_is_replayed_to_a_viewer(story, listen):
    """To a server that is there, or as one that begins when the viewer has come."""
    endpoint, path, _ = story
    way = ["--listen", "tcp/127.0.0.1:0", "--speed", "2"] if listen else ["--connect", endpoint]
    with contextlib.ExitStack() as stack:
        if listen:
            replay = stack.enter_context(ended(command("replay", str(path), *way)))
            endpoint = replay.stdout.readline().removeprefix("listening on ").strip()
        bus = stack.enter_context(ZenohBus("viewer", connect=endpoint))
        arrived: list[tuple[str, bytes]] = []
        drain = bus.poll

        def noted() -> list[tuple[str, bytes]]:
            arrived.extend(new := drain())
            return new

        bus.poll = noted
        viewer = Light(bus, 1.5, kind="spectator", joints=0)
        if not listen:
            replay = stack.enter_context(ended(command("replay", str(path), *way)))
        Company(viewer).until(lambda: replay.poll() is not None, "its end")
        _, said = replay.communicate()
    assert replay.returncode == 0, said
    lines = said.splitlines()
    assert "it ends in the middle" in lines[0]
    heard = next(int(found[1]) for line in lines if (found := re.match(r"(\d+) messages were sent", line)))
    assert heard > 100
    assert sorted(viewer.joined) == ["ada", "bob"]
    assert viewer.replicator.counters.malformed == 0
    # events are what they were but for their time, each once and in order; the tree moved
    before = [entry.payload for entry in read_recording(path).messages if entry.key == "own/0/0/ada"]
    after = [payload for key, payload in arrived if key == "own/0/0/ada"]
    assert [stampless(payload) for payload in after] == [stampless(payload) for payload in before]
    assert len(viewer.heard) > 20


def count(endpoint: str, path: pathlib.Path | None, apart: float) -> list[int]:
    """Payload bytes that two clients send in 200 ticks of touching, perhaps before a recorder.

    They live by a clock of their own, a tick a tick, and wait for matching beforehand: nothing depends on the pace.
    """
    with contextlib.ExitStack() as stack:
        ada, bob = (
            Light(stack.enter_context(ZenohBus(name, connect=endpoint, world=f"count-{apart:g}-{path is None}")), x)
            for name, x in (("ada", 0.5), ("bob", 0.5 + apart))
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

        def settled() -> bool:
            there = ada.joined == ["bob"] and bob.joined == ["ada"] and ada.replicator._state.peers._far_pose.matching
            if apart < 5.0:
                streams = [s.matching and e.matching for s, e in ada.replicator._state.cells.publishers.values()]
                there &= (
                    ada.replicator._state.peers._pose.matching
                    and bob.replicator._state.peers._pose.matching
                    and any(streams)
                )
            if recorder is not None:
                there &= recorder.greetings.keys() == {"ada", "bob"} and bool(recorder.recording.count > 6)
                there &= apart > 5.0 or recorder._full_rate.get("ada", (None, None))[1] is not None
            return there

        end = time.monotonic() + TIMEOUT
        while not settled():
            assert time.monotonic() < end
            tick()
        for _ in range(50):
            tick()
        now = round(now + 1.0)  # both runs count from the same phase of their periods
        tick()
        before = [client.bus.bytes_out for client in (ada, bob)]
        for number in range(200):
            ada.bend(0, 0.1 * number % 0.7)
            tick()
        if apart > 5.0:
            assert ada.environment() == 0
        else:
            assert ada.environment() > 10_000
        return [client.bus.bytes_out - bytes_out for client, bytes_out in zip((ada, bob), before, strict=True)]


@pytest.mark.parametrize("apart", [2.0, 40.0])
def test_a_recorder_changes_not_one_byte(tmp_path, apart):
    with Server("tcp/127.0.0.1:0") as server:
        path = tmp_path / "run.mcap"
        without, beside = count(server.endpoint, None, apart), count(server.endpoint, path, apart)
    assert without == beside
    recorded = {entry.key for entry in read_recording(path).messages}
    assert ("c/0/0/ada" in recorded) == (apart < 5.0)
    assert "a/ada/far" in recorded


def test_a_disk_that_is_full_ends_a_recording_in_one_line(tmp_path):
    """Here: a limit on the size of files, which the system reports the same way."""
    path = tmp_path / "run.mcap"
    limited = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000));"
        "sys.argv = ['vinesim', 'record', *sys.argv[1:]]; from vinesim.cli import main; main()"
    )
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        clients = [
            Light(stack.enter_context(ZenohBus(name, connect=server.endpoint)), x)
            for name, x in (("ada", 0.5), ("bob", 2.0))
        ]
        process = subprocess.Popen(
            [sys.executable, "-c", limited, str(path), "--connect", server.endpoint], stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        )  # fmt: skip
        with ended(process):
            Company(*clients).until(lambda: process.poll() is not None, "its end")
            said = process.stderr.read().splitlines()
    assert process.returncode == 4, said
    assert [line for line in said if line.startswith("vinesim: ")] == said[1:]
    assert str(path) in said[1]
    tape = read_recording(path)
    assert len(tape.messages) > 0
    assert tape.metadata["scene"] == "rows"


def test_a_spectators_certificate_is_enough_to_record(tmp_path):
    certs = tmp_path / "certs"
    for name, role in (("ada", Role.ROBOT), ("bob", Role.ROBOT), ("recorder", Role.SPECTATOR)):
        new_certificate(certs, name, role)
    with Server("tls/127.0.0.1:0", certificates=certs) as server, contextlib.ExitStack() as stack:

        def bus(name: str, **more: bool) -> ZenohBus:
            return stack.enter_context(ZenohBus(name, connect=server.endpoint, certificates=certs, **more))

        ada, bob = Light(bus("ada"), 0.5), Light(bus("bob"), 2.0)
        recording = stack.enter_context(RecordingWriter(tmp_path / "run.mcap"))
        recorder = Recorder(bus("recorder", live=False), recording)
        company = Company(ada, bob)

        poses = {"hello/ada", "hello/bob", "a/ada", "a/bob", "a/ada/far"}
        company.until(lambda: poses <= keys(recording.path), "greetings and poses on the tape", recorder.step)

        # a claim is sent once: bend and release again and again, for the recorder's subscriptions may come late
        def each() -> None:
            if company.number % 200 < 100:
                ada.bend(0, 0.5 * np.sin(0.1 * company.number))
            else:
                ada.touched = set()
            recorder.step()

        plants = {"c/0/0/ada", "own/0/0/ada"}
        company.until(lambda: plants <= keys(recording.path), "the tree and its claim on the tape", each)
        assert poses | plants <= keys(recording.path)
