"""``python -m benchmarks actors``: 64 robots and people with bodies in one world, compared on all clients at the end.

Every client has the whole physics, some of the actors, and a copy of every other actor. All actors stand within the
distance in which they receive each other, in rows 1.2 m apart, each with a bunch above it and a box before it. Each
actor picks its bunch, which falls to the ground, and pushes its box: robots with their base, people with their shins.
When everything is at rest, the retained objects and their owners are compared between all clients. The bus is in memory
and the clock simulated: the figures do not depend on the machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator

import numpy as np

from vinesim.client.client import Client, label_index
from vinesim.core import frames
from vinesim.net.codec.control import decode_records, encode_records
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose, HumanSpec, Measurement

ACTORS = 64
APART = 1.2
"""Distance between neighbours [m]."""
DELAY = 0.02
JITTER = 0.004
LOSS = 0.01
"""Network delay one way [s], jitter [s], and share of messages that is lost."""
PUSH = 0.15
"""Distance by which each actor pushes its box [m]."""
PUSH_TIME = 1.0
"""Duration of a push [s]."""
DT = 0.01
HEIGHT = 1.75
"""Height of people [m]."""
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


def _place(number: int, count: int) -> np.ndarray:
    """Returns the position [2] m of the actor ``number`` among ``count`` actors."""
    row = math.ceil(math.sqrt(count))
    return APART * np.array([number % row, number // row], float)


def yard(count: int) -> Model:
    """Returns a model with a short cane and its bunch 0.35 m from each of ``count`` places, and a box before each
    place."""
    trees = []
    boxes = []
    for number in range(count):
        x, y = _place(number, count)
        tree = TreeBuilder(frames.pose(np.array([x - 0.2, y + 0.6, 1.6])))
        tip = tree.add_rod(-1, 0.3, (0.006, 0.004), RodMaterial(2e9, 900.0), 3)[-1]
        tree.add_bunch(tip, 0.4, clusters=False)
        trees.append(tree)
        boxes.append(frames.pose([x + 0.55, y, 0.001]))
    return assemble(
        trees, box_pose=np.array(boxes), box_size=np.tile([0.2, 0.3, 0.2], (count, 1)), box_mass=np.full(count, 1.0)
    )


class Crowd:
    """Clients on one bus in memory, with a server of retained records. Every second actor is a person."""

    def __init__(self, count: int, robot: RobotDescription, clients: int | None = None) -> None:
        """Start ``count`` actors that are shared out among ``clients`` clients. None: each actor has a client of its
        own."""
        self.count = count
        self.now = 100.0
        self.model = yard(count)
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
            x, y = _place(number, count)
            person = number % 2 == 1
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
