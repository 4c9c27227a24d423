"""``python -m benchmarks hostile_actor``: an admitted actor tries all that it may, against a client with physics.

A server with certificates and a person's client are programs of their own. The hostile actor stands next to the person,
and sends as fast as its process can: poses, states of trees and objects, claims, records, forces, voices, corrupted
messages of all kinds, queries, joins, tokens and meshes. Quiet and hostile times take turns, so that other load on the
machine touches both. What counts is processor time, not the time of a clock, because the hostile process takes a core
for itself: that of a step of the person's client without its threads that read the network, that of these threads, and
that of the server.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import pathlib
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import zenoh

from benchmarks.message_fuzz import storm
from benchmarks.support.fake_client import FakeClient
from vinesim.bench.live_client import own_processes
from vinesim.client.programs import START_TIMEOUT, Program, ProgramFailed, ProgramGroup, free_port
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.net.codec.control import encode_time
from vinesim.net.codec.meshes import MAX_PART, MeshPart, encode_part
from vinesim.net.transport.certificates import create
from vinesim.net.transport.zenoh_bus import ROOT, WORLD, ZenohBus
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

SCENE = "demo"
HONEST = "honest"
HOSTILE = "hostile"
BUDGET = 1.1
"""Largest accepted ratio of a step's processor time under attack to that in quiet times."""
TURN = 8.0
"""Duration of one quiet or hostile time [s]."""
SETTLING = 1.0
"""Time after a change from quiet to hostile or back that is not counted [s]."""
BATCH = 50
"""Number of messages or queries between two looks at the clock."""
FACTOR = 0.2
"""Real-time factor of the world: 20 steps a second, so that a machine with other load can follow."""

DT = 0.01
"""Simulated time of a step [s]."""

Attack = Callable[[], object]


class _Person:
    """The honest client and its server, as users start them."""

    def __init__(self, group: ProgramGroup, folder: pathlib.Path, endpoint: str, place: np.ndarray) -> None:
        certificates = str(folder / "certs")
        self.server = group.start(
            "server",
            "-m",
            "vinesim",
            "server",
            "--listen",
            endpoint,
            "--tls",
            certificates,
            "--status",
            "json",
            "--state-dir",
            str(folder / "state"),
            "--real-time-factor",
            f"{FACTOR:g}",
        )
        self.server.next_line(START_TIMEOUT)
        words = ("--connect", endpoint, "--tls", certificates, "--scene", SCENE, "--status", "json")
        where = ("--pose", f"{place[0]:.3f}", f"{place[1]:.3f}", "0")
        self.client = group.start(
            HONEST, "-m", "vinesim", "client", "--role", "human", "--name", HONEST, *words, *where
        )
        self.status: dict[str, object] = json.loads(self.client.next_line(START_TIMEOUT))

    def read(self) -> None:
        """Read the newest status. Raises :class:`ProgramFailed` if a program has ended."""
        for line in self.client.new_lines():
            self.status = json.loads(line)
        self.server.new_lines()

    def wait_for_line(self) -> float:
        """Wait for the next status line of the client. Returns the simulated time in it [s]. Raises
        :class:`ProgramFailed` if a program has ended, or if none comes."""
        self.server.new_lines()
        self.status = json.loads(self.client.next_line(START_TIMEOUT))
        return float(self.status["time"])  # type: ignore[arg-type]


class _Cost(NamedTuple):
    """Processor time in one turn."""

    step: float
    """Of a step of the honest client, without threads of the network [s]."""
    network: float
    """Of the honest client's threads that read the network, in a second [s]."""
    server: float
    """Of the server, in a second [s]."""


NETWORK_THREADS = ("rx-", "tx-", "net-", "acc-", "app-")
"""First letters of the names of Zenoh's threads, which also call the client's callbacks."""


def _used(program: Program) -> tuple[float, float]:
    """Returns the processor times that Zenoh's threads and all other threads of a program have used [s]."""
    network = 0.0
    for thread in pathlib.Path(f"/proc/{program.child.pid}/task").iterdir():
        with contextlib.suppress(OSError):  # the thread may have ended meanwhile
            name, used = _times(thread / "stat")
            network += used if name.startswith(NETWORK_THREADS) else 0.0
    _, both = _times(pathlib.Path(f"/proc/{program.child.pid}/stat"))
    return network, both - network


def _times(stat: pathlib.Path) -> tuple[str, float]:
    """Returns the name of a process or thread, and the processor time that it has used [s]."""
    begin, _, end = stat.read_text().rpartition(")")
    fields = end.split()
    return begin.partition("(")[2], (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _attacks(evil: FakeClient, bus: ZenohBus, place: np.ndarray, seed: int) -> dict[str, Attack]:
    """Returns one batch of each kind of attack, by name."""
    session = bus.session_for(reliable=True)
    prefix = f"{ROOT}/{WORLD}/"
    wild = storm(evil.model, evil, seed, time.time(), [HOSTILE], pool_size=2000)
    triangles = np.random.default_rng(seed).bytes(MAX_PART)
    numbers = itertools.count()

    def put(key: str, payload: bytes) -> None:
        session.put(prefix + key, payload, source_info=bus.source, congestion_control=zenoh.CongestionControl.DROP)

    by_family: dict[str, list[tuple[str, bytes]]] = {}
    for key, payload in itertools.islice(wild, 4000):
        by_family.setdefault(key.partition("/")[0], []).append((key, payload))

    def flood(family: str) -> Attack:
        messages = itertools.cycle(by_family[family])
        return lambda: [put(*message) for message in itertools.islice(messages, BATCH)]

    def poses() -> None:
        for _ in range(BATCH):
            evil.tick(time.monotonic())

    def ask() -> None:
        for _ in range(BATCH // 10):
            bus.query(f"clock/{HOSTILE}", encode_time(time.monotonic()))
            bus.query("snap/*/*")
            bus.query(f"hello/{HONEST}")
            bus.query(f"holder/{HONEST}")
            bus.query(f"mesh/{next(numbers):040x}")
        bus.replies()
        time.sleep(0.002)

    def join() -> None:
        key = f"{prefix}join/{HOSTILE}/{session.zid()}"
        for _ in range(BATCH // 10):
            session.get(key, zenoh.handlers.Callback(lambda _: None), payload=os.urandom(200), timeout=1.0)
        time.sleep(0.002)

    def tokens() -> None:
        found = [session.liveliness().declare_token(f"{prefix}live/{HOSTILE}/x{next(numbers)}") for _ in range(BATCH)]
        for token in found:
            token.undeclare()

    def meshes() -> None:
        digest = f"{next(numbers):040x}"
        for offset in range(0, 16 * MAX_PART, MAX_PART):
            part = encode_part(MeshPart(digest, 16 * MAX_PART, offset, triangles))
            session.get(
                f"{prefix}offer/{HOSTILE}",
                zenoh.handlers.Callback(lambda _: None),
                payload=part,
                source_info=bus.source,
                timeout=1.0,
            )
        time.sleep(0.01)

    return {
        "poses and states, as its client sends them, without pauses": poses,
        **{f"broken messages under {family}/": flood(family) for family in sorted(by_family)},
        "queries": ask,
        "joins": join,
        "tokens": tokens,
        "meshes": meshes,
    }


def hostile_actor(minutes: float, seed: int, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Attack for ``minutes`` [min] in all, and measure. ``announce`` is called with a line of text after each turn.

    Raises :class:`ProgramFailed` if the server or the client ends.
    """
    model = generate(load_scene(SCENE))
    place = bunch_centres(model)[0, :2] - (1.5, 0.0)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with own_processes() as group, tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = pathlib.Path(name)
        for who in (HONEST, HOSTILE):
            create(folder / "certs", who)
        person = _Person(group, folder, endpoint, place)
        bus = stack.enter_context(ZenohBus(HOSTILE, connect=endpoint, certificates=folder / "certs"))
        digest = model.digest()
        evil = FakeClient(bus, model, (float(place[0]) + 1.0, float(place[1])), kind="human", digest=digest)
        attacks = _attacks(evil, bus, place, seed)
        end = time.monotonic() + START_TIMEOUT
        while HOSTILE not in person.status["others"]:  # type: ignore[operator]
            evil.tick(time.monotonic())
            person.read()
            time.sleep(0.02)
            if time.monotonic() > end:
                raise ProgramFailed("the honest client does not see the hostile one")
        costs: dict[str, list[tuple[float, _Cost]]] = {}
        quiet: list[_Cost] = []
        turns = max(1, round(60.0 * minutes / TURN))
        for turn in range(turns):
            kind = list(attacks)[turn % len(attacks)]
            alone = _turn(person, lambda: (evil.tick(time.monotonic()), time.sleep(0.02)))
            under = _turn(person, attacks[kind])
            quiet.append(alone)
            ratio = under.step / alone.step
            costs.setdefault(kind, []).append((ratio, under))
            announce(
                f"turn {turn + 1} of {turns}, {kind}: a step takes {ratio:.2f} times the processor time, "
                f"the network {100.0 * under.network:.0f} % of a core"
            )
        faults = person.status["faults"]
    yield from _rows(costs, quiet)
    yield Measurement("hostile actor", "messages that the honest client refused", sum(faults.values()), "1")  # type: ignore[attr-defined]


def _turn(person: _Person, act: Attack) -> _Cost:
    """Have a thread call ``act`` again and again for a :data:`TURN`. Returns the costs between two status lines of the
    client."""
    stop = threading.Event()

    def run() -> None:
        while not stop.is_set():
            act()

    thread = threading.Thread(target=run, name="attack")
    thread.start()
    try:
        settled = time.monotonic() + SETTLING
        while time.monotonic() < settled:
            person.wait_for_line()
        first = person.wait_for_line()
        begin = time.monotonic()
        network, steps = _used(person.client)
        server = sum(_used(person.server))
        last = first
        while time.monotonic() < begin + TURN or last <= first:
            last = person.wait_for_line()
        network_end, steps_end = _used(person.client)
        passed = time.monotonic() - begin
        server_share = (sum(_used(person.server)) - server) / passed
    finally:
        stop.set()
        thread.join()
    return _Cost((steps_end - steps) / ((last - first) / DT), (network_end - network) / passed, server_share)


def _rows(costs: dict[str, list[tuple[float, _Cost]]], quiet: list[_Cost]) -> Iterator[Measurement]:
    bench = "hostile actor"
    step = 1e3 * float(np.mean([one.step for one in quiet]))
    yield Measurement(bench, "a step of the honest client in quiet times, mean", step, "ms")
    for what in ("network", "server"):
        share = 1e2 * float(np.mean([getattr(one, what) for one in quiet]))
        yield Measurement(bench, f"the {what} in quiet times, mean", share, "% of a core")
    for kind, found in costs.items():
        ratio = float(np.median([ratio for ratio, _ in found]))
        case = f"{kind}: a step of the honest client, times that in quiet times"
        yield Measurement(bench, case, ratio, "1", "budget, at most", BUDGET, BUDGET / ratio)
        for what in ("network", "server"):
            share = 1e2 * float(np.median([getattr(cost, what) for _, cost in found]))
            yield Measurement(bench, f"{kind}: the {what}", share, "% of a core")
    every = float(np.median([ratio for found in costs.values() for ratio, _ in found]))
    yield Measurement(bench, "all kinds, median", every, "1", "budget, at most", BUDGET, BUDGET / every)
