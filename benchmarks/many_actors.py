"""``python -m benchmarks actors``: 64 robots and people with bodies in one world, compared on all clients at the end.
``python -m benchmarks many_actors``: hundreds of whole clients over linked routers, and a thousand actors on a plain.

**actors.** Every client has the whole physics, some of the actors, and a copy of every other actor. All actors stand
within the distance in which they receive each other, in rows 1.2 m apart, each with a bunch above it and a box before
it. Each actor picks its bunch, which falls to the ground, and pushes its box: robots with their base, people with their
shins. When everything is at rest, the retained objects and their owners are compared between all clients. The bus is in
memory and the clock simulated: the figures do not depend on the machine.

**many_actors.** Whole clients without renderers, each with a session of its own on one of three linked routers. Each
actor picks its bunch and pushes its box; at the end all clients have equal records. The world passes as fast as the
machine can step all clients. Besides, 30 to 1,000 actors without physics walk on a square kilometre, with the
replication and the codecs of a client and a network in memory that counts what a router would deliver.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from benchmarks.router_load import cpu, router
from benchmarks.support.crowd_clients import (
    HEIGHT,
    PUSH,
    PUSH_TIME,
    CrowdProcess,
    is_person,
    place_of,
    yard,
)
from benchmarks.support.fake_client import FakeClient, tree_row
from benchmarks.support.indexed_hub import IndexedHub
from vinesim.client.client import Client, label_index
from vinesim.core import frames
from vinesim.net.codec.control import decode_records, decode_time, encode_records, encode_time
from vinesim.net.replication import authority, interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose, HumanSpec, Measurement

ACTORS = 64
APART = 1.2
"""Distance between neighbours [m]."""
DELAY = 0.02
JITTER = 0.004
LOSS = 0.01
"""Network delay one way [s], jitter [s], and share of messages that is lost."""
DT = 0.01
CLIENTS = 2
"""Number of clients of the command. Each simulates half of the actors, and has copies of the others."""
MEETING_LIMIT = 10.0
REST_LIMIT = 20.0
"""Limits of simulated time [s]: until each client has bodies of all actors, and until everything is at rest."""


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How far the clients agree when everything is at rest."""

    bodies: int
    """Smallest number of actors that have a body on a client."""
    objects: int
    """Number of moved bunches and boxes that are at rest by a retained record which is equal on all clients, to the
    bit."""
    owned: int
    """Number of objects that some client still considers owned by an actor."""
    position: float
    """Largest difference of the position of an object's body between two clients [m]. The bodies settle on each client
    separately, some against copies of actors that lean on them."""
    angle: float
    """Largest difference of the rotation of an object's body between two clients [rad]."""
    tick: float
    """Mean processor time of one tick of one client [s]."""
    faults: dict[str, int]
    """Numbers of faults of all clients together, by name."""


class Crowd:
    """Clients on one bus in memory, with a server of retained records. Every second actor is a person."""

    def __init__(self, count: int, robot: RobotDescription, clients: int | None = None) -> None:
        """Start ``count`` actors that are shared out among ``clients`` clients. None: each actor has a client of its
        own."""
        self.count = count
        self.now = 100.0
        self.model = yard(count, APART)
        self.hub = MemoryHub(delay=DELAY, jitter=JITTER, loss=LOSS, seed=1)
        self._records = RetainedState()
        self._server = self.hub.bus("server")
        self._server.subscribe("fact/**", KEEP_ALL)
        for x in range(-3, 6):
            for y in range(-3, 6):
                self._server.declare_queryable(f"snap/{x}/{y}", functools.partial(self._reply, (x, y)))
        scene = load_scene("demo")
        self._pushing_since = math.inf
        self.clients: list[Client] = []
        for number in range(count):
            x, y = place_of(number, count, APART)
            person = is_person(number)
            name = f"{'person' if person else 'robot'}{number}"
            pose = frames.pose([x, y, 0.0])
            source = self._walk(x, y)
            bus = self.hub.bus(name)
            if clients is None or number < clients:
                client = Client(
                    scene,
                    self.model,
                    None if person else robot,
                    bus,
                    name=name,
                    pose=pose,
                    source=source if person else None,
                    clock=lambda: self.now,
                )
                client.physics.wind = None
                self.clients.append(client)
                continue
            client = self.clients[number % clients]
            if person:
                client.add_human(HumanSpec(name, label_index(name), standing_pose(pose, HEIGHT), HEIGHT), source, bus)
            else:
                client.add_robot(robot, name, pose, bus)
        self.ticks = 0
        self.busy = 0.0

    def _reply(self, cell: tuple[int, int], _: bytes) -> bytes:
        return encode_records(self._records.in_cell(cell))

    def _walk(self, x: float, y: float) -> Callable[[float], HumanPose]:
        """Returns the pose over time of a person who starts at ``x``, ``y`` [m], walks against a box and stops."""

        def source(_: float) -> HumanPose:
            share = min(max((self.now - self._pushing_since) / PUSH_TIME, 0.0), 1.0)
            return standing_pose(frames.pose([x + (0.25 + PUSH) * share, y, 0.0]), HEIGHT)

        return source

    def tick(self) -> None:
        """Step all clients and the server once."""
        start = time.thread_time()
        for client in self.clients:
            client.tick()
        self.busy = self.busy + time.thread_time() - start
        self.ticks = self.ticks + 1
        for key, payload in self._server.poll():
            _, x, y, _ = key.split("/")
            for record in decode_records(payload):
                self._records.merge((int(x), int(y)), record)
        self.hub.advance(DT)
        self.now += DT

    def until(self, condition: Callable[[], bool], limit: float) -> None:
        """Tick until ``condition()`` is true. Raises RuntimeError after ``limit`` [s] of simulated time."""
        end = self.now + limit
        while not condition():
            if self.now > end:
                raise RuntimeError(f"{self.count} actors: not done after {limit} s of simulated time")
            self.tick()

    def meet(self) -> None:
        """Tick until each client has a body of every other actor."""
        self.until(lambda: min(map(bodies, self.clients)) == self.count, MEETING_LIMIT)

    def work(self) -> None:
        """Let each actor pick its bunch and push its box, and tick until everything is at rest by equal records on all
        clients."""
        self._pushing_since = self.now
        for number in range(self.count):
            self.clients[number % len(self.clients)].physics.pick(number)
        while self.now < self._pushing_since + PUSH_TIME:
            for client in self.clients:
                for robot in client.robots.values():
                    robot.command_base((0.15 + PUSH) / PUSH_TIME, 0.0, client.physics.time)
            self.tick()
        self.until(self._all_at_rest, REST_LIMIT)

    def moved(self) -> list[int]:
        """Returns the ids of the moved objects. An object counts as moved if a client has a retained record of it."""
        kinds = (ObjectKind.BUNCH, ObjectKind.BOX)
        every = [object_id(kind, number) for kind in kinds for number in range(self.count)]
        return [number for number in every if any(client.replicator.record(number) for client in self.clients)]

    def _all_at_rest(self) -> bool:
        bunches = [object_id(ObjectKind.BUNCH, number) for number in range(self.count)]
        for client in self.clients:
            records = [client.replicator.record(number) for number in bunches]
            if any(replicator.owned for replicator in client.replicators.values()) or any(
                record is None or record.moving for record in records
            ):
                return False
        return all(self._is_known_alike(number) for number in self.moved())

    def _is_known_alike(self, number: int) -> bool:
        records = [client.replicator.record(number) for client in self.clients]
        return all(record is not None and not record.moving and record == records[0] for record in records)

    def agreement(self) -> Agreement:
        """Compare the moved objects between all clients."""
        moved = self.moved()
        poses = np.array([[_pose_of(client, number) for number in moved] for client in self.clients])
        chord = np.minimum(
            np.linalg.norm(poses[..., 3:] - poses[0, :, 3:], axis=-1),
            np.linalg.norm(poses[..., 3:] + poses[0, :, 3:], axis=-1),
        )
        spread = poses[..., :3].max(0) - poses[..., :3].min(0)
        faults: dict[str, int] = {}
        for client in self.clients:
            for name, fault_count in client.physics.faults.items():
                faults[name] = faults.get(name, 0) + fault_count
        return Agreement(
            bodies=min(map(bodies, self.clients)),
            objects=len(moved),
            owned=sum(client.replicator.owner(number) is not None for client in self.clients for number in moved),
            position=float(np.linalg.norm(spread, axis=-1).max()),
            angle=float((4.0 * np.arcsin(0.5 * chord)).max()),
            tick=self.busy / (self.ticks * len(self.clients)),
            faults={name: fault_count for name, fault_count in faults.items() if fault_count},
        )

    def close(self) -> None:
        """Close all buses."""
        for client in self.clients:
            for replicator in client.replicators.values():
                replicator.bus.close()
        self._server.close()


def bodies(client: Client) -> int:
    """Returns the number of actors that have a body on a client."""
    return len(client.replicators) + len(client.remote_actors)


def _pose_of(client: Client, number: int) -> np.ndarray:
    """Returns the pose [7] m, 1 of a box or free bunch on one client. The bunch may be dormant."""
    tracker = client.physics.support_tracker
    if number in tracker:
        return tracker.object_state(number)[0]
    dormant = client.physics.dormant_bunches
    rows = {object_id(ObjectKind.BUNCH, visual.index): row for row, visual in enumerate(dormant.visuals())}
    return dormant.visual_q()[rows[number]]


def run_crowd(count: int, robot: RobotDescription, clients: int | None = None) -> Agreement:
    """Let ``count`` actors meet, work and come to rest, and return how far their clients agree.

    Arguments as of :class:`Crowd`.
    """
    with contextlib.closing(Crowd(count, robot, clients)) as crowd:
        crowd.meet()
        crowd.work()
        return crowd.agreement()


def actors(count: int = ACTORS) -> Iterator[Measurement]:
    """Measure one crowd of ``count`` actors on two clients: half carriers (robots), half people."""
    found = run_crowd(count, load_description("logistic"), CLIENTS)
    case = f"{count} actors with bodies, half carriers, half people, one world, {CLIENTS} clients"
    rows = (
        ("actors that have a body on every client", found.bodies, "actors", count),
        ("objects moved, at rest by the same record on all clients", found.objects, "objects", None),
        ("of these with an owner on any client", found.owned, "objects", 0),
        ("largest difference of the bodies' positions between two clients", 1e3 * found.position, "mm", None),
        ("largest difference of a rotation", 1e3 * found.angle, "mrad", None),
        ("faults of all clients", sum(found.faults.values()), "faults", None),
        ("processor time of a tick of one client, mean", 1e3 * found.tick, "ms", None),
    )
    for what, value, unit, wanted in rows:
        if wanted is None:
            yield Measurement("actors", f"{case}: {what}", float(value), unit)
        else:
            yield Measurement("actors", f"{case}: {what}", float(value), unit, "wanted", float(wanted))


# ---------------------------------------------------------------- whole clients over linked routers

ROUTERS = 3
"""Number of linked servers; the first keeps the world, the others only route."""
WORKING_LIMIT = 20.0
"""Limit of simulated time [s] until everything is at rest by equal records."""
POLL = 1.0
"""Real time between two reports of all clients [s]."""
SHOWN = 3
"""Number of objects whose different records are shown."""
NEWS_PERIOD = 10.0
"""Real time between two lines that tell how far the clients are [s]."""


def _ask(processes: list[CrowdProcess], end: float, do: str = "report") -> list[dict[str, Any]]:
    """Send a command to all processes, and return their answers. Raises RuntimeError if one does not answer until the
    time ``end`` [s] of the monotonic clock."""
    for process in processes:
        process.send(do=do)
    return [process.answer(max(end - time.monotonic(), POLL)) for process in processes]


def _clients(answers: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted((one for answer in answers for one in answer["clients"]), key=lambda one: one["number"])


def _are_equal(reports: list[dict[str, Any]]) -> tuple[int, int, bool]:
    """Returns the number of objects with a record, the number of those that :func:`_unequal` does not name, and whether
    nothing has an owner any more."""
    objects = {name for report in reports for name in report["records"]}
    return len(objects), len(objects) - len(_unequal(reports)), not any(report["owned"] for report in reports)


def _unequal(reports: list[dict[str, Any]]) -> dict[str, str]:
    """Returns, by object, in words what is wrong: the record with the greatest claim is of a moving object, or a client
    that receives the records of its cell has another one or none.

    Other clients may have a former record, for example because they owned the object while its neighbours seemed to be
    gone. They receive the valid one when they come near.
    """
    found: dict[str, str] = {}
    for name in {name for report in reports for name in report["records"]}:
        held = {report["number"]: report["records"][name] for report in reports if name in report["records"]}
        best = next(iter(held.values()))
        for record in held.values():
            if authority.wins(Claim(*record[2]), Claim(*best[2])):
                best = record
        others = [
            report["number"]
            for report in reports
            if best[3] in report["window"] and report["records"].get(name, [""])[0] != best[0]
        ]
        if best[1] or others:
            state = "moving" if best[1] else "at rest"
            found[name] = f"{state} by the record of {best[2][2]} with claim {best[2][:2]}, not on clients {others}"
    return found


def _how_far(reports: list[dict[str, Any]], wanted: np.ndarray) -> str:
    """Returns in words how far the clients are. ``wanted``: number of bodies that each client should have."""
    others = len(reports) - 1
    objects, equal, _ = _are_equal(reports)
    return (
        f"{sum(one['known'] == others for one in reports)} of {others + 1} clients know all others, "
        f"{sum(one['placed'] == others for one in reports)} know where they are, "
        f"{sum(one['bodies'] >= enough for one, enough in zip(reports, wanted.tolist(), strict=True))} have the bodies "
        f"of those around; {objects} objects have a record, {equal} of them the same one at rest on all clients "
        f"around, {sum(one['owned'] for one in reports)} have an owner; world time "
        f"{min(one['time'] for one in reports):.2f} to {max(one['time'] for one in reports):.2f} s; "
        f"{sum(one['admissions'] for one in reports)} admissions, {sum(one['missed'] for one in reports)} signs of "
        f"lost messages{''.join(f'; {name}: {held}' for name, held in list(_unequal(reports).items())[:SHOWN])}"
    )


def whole_clients(
    count: int,
    apart: float,
    seconds: float,
    processes: int,
    factor: float | None,
    limit: float,
    announce: Callable[[str], None],
) -> Iterator[Measurement]:
    """Measure ``count`` whole clients in rows ``apart`` [m], over three linked routers.

    ``seconds``: measured simulated time, in steps that each client has made. ``processes``: number of processes that
    share the clients. ``factor``: real-time factor of the world; None: as fast as all clients can follow. ``limit``:
    real time [s] after which the benchmark gives up, with the reason. ``announce`` is called with lines of text that
    tell how far the clients are.
    """
    options = () if factor is None else ("--real-time-factor", f"{factor:g}")
    with contextlib.ExitStack() as stack:
        ends = [stack.enter_context(router(*options))]
        for _ in range(ROUTERS - 1):
            ends.append(stack.enter_context(router("--connect", ends[-1][0])))
        groups = [list(range(first, count, processes)) for first in range(min(processes, count))]
        crowd = [
            stack.enter_context(CrowdProcess(ends[i % ROUTERS][0], group, count, apart))
            for i, group in enumerate(groups)
        ]
        end = time.monotonic() + limit
        places = np.array([place_of(number, count, apart) for number in range(count)])
        away = np.linalg.norm(places[:, None] - places[None], axis=-1)
        wanted = np.minimum((away < interest.BODY_DISTANCE - 1.0).sum(1) - 1, interest.MAX_BODIES)

        def until(condition: Callable[[list[dict[str, Any]]], bool], what: str) -> list[dict[str, Any]]:
            """Returns the answers of all processes for which the condition holds."""
            told_at = time.monotonic()
            while not condition(reports := _clients(answers := _ask(crowd, end))):
                now = time.monotonic()
                if now > end:
                    raise RuntimeError(f"{count} clients: not {what} after {limit:g} s: {_how_far(reports, wanted)}")
                if now - told_at > NEWS_PERIOD:
                    told_at = now
                    announce(f"waiting until {what}: {_how_far(reports, wanted)}")
                time.sleep(POLL)
            return answers

        start = time.monotonic()
        until(
            lambda reports: all(
                one["known"] == count - 1 and one["placed"] == count - 1 and one["bodies"] >= enough
                for one, enough in zip(reports, wanted.tolist(), strict=True)
            ),
            "all know each other",
        )
        met = time.monotonic() - start
        before = _ask(crowd, end, "work"), [cpu(process) for _, process in ends], time.monotonic()
        begun = np.array([one["time"] for one in _clients(before[0])])
        after = until(
            lambda reports: min(one["time"] - since for one, since in zip(reports, begun, strict=True)) >= seconds,
            f"all have simulated {seconds:g} s",
        )
        spans = np.array([one["time"] for one in _clients(after)]) - begun
        router_time = sum(cpu(process) for _, process in ends) - sum(before[1])
        wall = time.monotonic() - before[2]
        received = [b["bytes_in"] - a["bytes_in"] for a, b in zip(_clients(before[0]), _clients(after), strict=True)]
        rates = np.array(received) / spans
        at_rest = until(
            lambda reports: (found := _are_equal(reports))[0] == found[1] >= count and found[2],
            "all records are equal",
        )
        objects, equal, _ = _are_equal(_clients(at_rest))
        reports = _clients(at_rest)
    case = f"{count} whole clients {apart:g} m apart, {ROUTERS} linked routers"
    simulated = float(spans.mean())
    rows = (
        ("clients that know all others and where they are", sum(one["known"] == count - 1 for one in reports), ""),
        ("real time until all knew each other", met, "s"),
        ("bodies of others on a client, most", max(one["bodies"] for one in reports), ""),
        ("received by the client that receives most, per simulated second", float(rates.max()) / 1e3, "kB/s"),
        ("received by a client, mean, per simulated second", float(rates.mean()) / 1e3, "kB/s"),
        ("routers' CPU, per simulated second", router_time / simulated, "s"),
        ("real-time factor", simulated / wall, ""),
        ("objects with a record", objects, "objects"),
        ("of these at rest by the same record on all clients around", equal, "objects"),
        ("signs of lost messages, all clients", sum(one["missed"] for one in reports), ""),
        ("admissions by the server", sum(one["admissions"] for one in reports), ""),
        ("faults of all clients", sum(sum(one["faults"].values()) for one in reports), "faults"),
    )
    for what, value, unit in rows:
        yield Measurement("many_actors", f"{case}: {what}", float(value), unit)


# ---------------------------------------------------------------- a thousand actors without physics

SIDE = 1000.0
"""Edge length of the ground on which the actors walk [m]."""
WALK = 1.0
"""Speed of the actors [m/s]."""
DELIVERY = 8e-6
"""Processor time of a router for a delivered pose [s], as ``python -m benchmarks load`` measured with 100 clients on 16
cores."""
COARSE_TICK = 0.25
"""Time step before the measured time [s]."""
SETTLING = 4.0
"""Time before the measured time [s]: until each actor knows its neighbours."""


def walking_actors(count: int, seconds: float, seed: int = 1) -> dict[str, float]:
    """Let ``count`` actors walk, half of them robots and half people, spread evenly over the ground, and return what
    one of them receives and what a router delivers in ``seconds``, after each knows its neighbours."""
    rng = np.random.default_rng(seed)
    hub = IndexedHub()
    now = 0.0
    hub.answers["clock"] = lambda _, asked: encode_time(decode_time(asked).asked, now)
    hub.answers["snap"] = lambda *_: encode_records([])
    model = tree_row(1)
    actors = [
        FakeClient(hub.bus(f"a{number}"), model, tuple(place), kind="human" if is_person(number) else "robot")
        for number, place in enumerate(rng.uniform(0.0, SIDE, (count, 2)))
    ]
    heading = rng.uniform(0.0, 2.0 * np.pi, count)
    steps = WALK * np.stack([np.cos(heading), np.sin(heading)], axis=1)

    def tick(dt: float) -> None:
        nonlocal now
        now += dt
        for actor, step in zip(actors, steps, strict=True):
            actor.place[:2] = np.abs(actor.place[:2] + dt * step)
            actor.tick(now)

    def received() -> np.ndarray:
        """Returns the bytes that each actor has received: all, and those of hellos, the clock and snapshots."""
        return np.array([(actor.bus.bytes_in, actor.replicator.counters.control.bytes_in) for actor in actors], float)

    start = time.process_time()
    for _ in range(round(SETTLING / COARSE_TICK)):
        tick(COARSE_TICK)
    before = received(), hub.deliveries, hub.delivered_bytes
    for _ in range(round(60.0 * seconds)):
        tick(1.0 / 60.0)
    all_bytes, control = ((received() - before[0]) / seconds / 1e3).T
    deliveries = (hub.deliveries - before[1]) / seconds
    return {
        "received by an actor, mean": float((all_bytes - control).mean()),
        "received by the actor that receives most": float((all_bytes - control).max()),
        "besides, hellos and the clock while it gets to know the others, most": float(control.max()),
        "delivered by a router": deliveries,
        "delivered by a router, bytes": (hub.delivered_bytes - before[2]) / seconds / 1e3,
        "a router's CPU at 8 us a delivery": DELIVERY * deliveries,
        "near actors, most": float(max(len(actor.replicator.near_positions()) for actor in actors)),
        "processor time of the simulation": time.process_time() - start,
    }


_UNITS = ("kB/s", "kB/s", "kB/s", "1/s", "kB/s", "cores", "", "s")


def many_actors(
    clients: int,
    apart: float,
    seconds: float,
    processes: int,
    factor: float | None,
    limit: float,
    simulated: list[int],
    announce: Callable[[str], None],
) -> Iterator[Measurement]:
    """Measure ``simulated`` numbers of actors without physics, then ``clients`` whole clients (0: none), each for
    ``seconds`` of simulated time."""
    for count in simulated:
        for (what, value), unit in zip(walking_actors(count, seconds).items(), _UNITS, strict=True):
            yield Measurement("many_actors", f"{count} actors on 1 km2, without physics: {what}", value, unit)
    if clients:
        yield from whole_clients(clients, apart, seconds, processes, factor, limit, announce)
