"""``python -m benchmarks fuzz``: effect of corrupted messages, and of well-formed false ones.

Every message begins as a well-formed one of any kind. Its content may be impossible: records with cuts, parents and
states of trees, or of objects that do not exist. The message is then corrupted: bits flipped, cut off, extended,
spliced with another message, filled with extreme values, sent again later, sent under the key of another kind or under
an odd key, or replaced by noise or by a megabyte. The sender is an admitted actor, or a stranger under any name. The
receivers are a client with physics, another client without, and the server's store of records. After every step the
receivers are checked against the laws of :mod:`benchmarks.support.fuzz_world`. Well-formed false messages come from
:mod:`benchmarks.support.false_messages`.
"""

from __future__ import annotations

import dataclasses
import itertools
import random
import struct
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

import msgspec
import numpy as np

from benchmarks.support.fake_client import FakeClient, swinging_state, tree_row
from benchmarks.support.fuzz_world import ATTACKER, DT, WORLD, FuzzWorld
from vinesim.audio.frame import Codec
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    Welcome,
    decode_time,
    encode_claims,
    encode_description,
    encode_hello,
    encode_records,
    encode_time,
    encode_welcome,
)
from vinesim.net.codec.forces import (
    MAX_COUPLINGS,
    Coupling,
    CouplingMessage,
    WrenchMessage,
    encode_couplings,
    encode_wrenches,
)
from vinesim.net.codec.header import MAX_MESSAGE
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.meshes import MeshPart, MeshWanted, encode_part, encode_request, encode_wanted
from vinesim.net.codec.messages import shift_time
from vinesim.net.codec.objects import ObjectStates, encode_objects
from vinesim.net.codec.trees import RESTING, TOUCHED, TreeStates, encode_trees
from vinesim.net.codec.voice import VoiceFrame, encode_voice
from vinesim.net.replication import interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.streams import object_counts
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.values import HumanUpdate, Measurement, RobotUpdate

MESSAGE_COUNT = 100_000
MESSAGES_PER_TICK = 200
"""Number of messages in one step of a world under attack: 20,000 a second."""
MESSAGES_PER_STEP = 50
"""Number of messages in one step of a storm: 5,000 a second, as many as eighty robots send."""

_EXTREMES = (
    b"\x00" * 8,
    b"\xff" * 8,
    struct.pack("<d", float("nan")),
    struct.pack("<d", float("inf")),
    struct.pack("<d", 1e308),
    struct.pack("<d", -1.0),
    struct.pack("<f", float("nan")),
    b"\x7f\xff",
    b"\x80\x00",
)


class Sender(Protocol):
    """The actor in whose name messages are made."""

    @property
    def name(self) -> str: ...

    def pose(self, now: float) -> RobotUpdate | HumanUpdate: ...


def valid_message(model: Model, actor: Sender, now: float, chance: random.Random) -> tuple[str, bytes]:
    """Returns a family of keys and a well-formed message as ``actor`` might send it. Its content may be impossible."""
    kind = chance.choice(("a", "tree", "things", "own", "fact", "force", "voice", "control"))
    claim = Claim(chance.randrange(3), chance.randrange(1 << 16), actor.name)
    if kind == "a":
        return kind, encode_pose(actor.pose(now))
    if kind == "voice":
        codec = chance.choice(tuple(Codec))
        sound = (
            chance.randbytes(640) if codec is Codec.PCM16 else bytes((72,)) + chance.randbytes(chance.randint(0, 90))
        )
        return kind, encode_voice(VoiceFrame(chance.randrange(1 << 16), now + chance.uniform(-0.1, 0.1), codec, sound))
    if kind == "force" and chance.random() < 0.5:
        return kind, _couplings_message(model, now, chance)
    if kind == "force":
        links = chance.sample(
            ("base_link", "arm_left_1_link", "arm_left_7_link", "no such link", ""), chance.randint(0, 3)
        )
        return kind, encode_wrenches(
            WrenchMessage(now, {link: np.array([chance.uniform(-1, 1) for _ in range(6)]) * 2000.0 for link in links})
        )
    if kind == "tree":
        tree = chance.randrange(len(model.tree_first))
        return chance.choice(("tree", "near")), _trees_message(model, tree, claim, now, chance)
    if kind == "things":
        number = np.array([_object_id(model, chance.choice((ObjectKind.BUNCH, ObjectKind.BOX)), chance)])
        flags = np.array([TOUCHED])
        record = ObjectStates(
            now,
            number,
            np.array([claim.ownership]),
            np.array([claim.authority]),
            flags,
            frames.pose(np.array([[0.5, 0.5, 1.0]])),
            np.zeros((1, 6)),
        )
        return "c", encode_objects(record, (0, 0))[0][0]
    if kind == "own":
        number = _object_id(model, chance.choice(tuple(ObjectKind)), chance)
        return kind, encode_claims([(number, claim, chance.random() < 0.5)])
    if kind == "fact":
        records = [_record(model, claim, now, chance) for _ in range(chance.randint(1, 3))]
        return kind, encode_records(records)
    return chance.choice(("own", "fact", "c", "tree", "near")), chance.choice(
        (
            encode_hello(Hello(actor.name, scene="fake_clients", digest="fake_clients")),
            encode_time(now, chance.uniform(-1e9, 1e9)),
            encode_welcome(Welcome("go away")),
            encode_part(MeshPart("0" * 40, 36, 0, chance.randbytes(36))),
            encode_request(chance.randrange(100)),
            encode_wanted(MeshWanted(chance.randrange(100))),
        )
    )


def _object_id(model: Model, kind: ObjectKind, chance: random.Random) -> int:
    """Returns the id of an object of the ``kind``, and sometimes one that is one too high."""
    return object_id(kind, chance.randrange(object_counts(model)[kind] + (chance.random() < 0.1) or 1))


def _trees_message(model: Model, tree: int, claim: Claim, now: float, chance: random.Random) -> bytes:
    """Returns an encoded state of one tree, sometimes with bodies that were cut off it."""
    q, qd = swinging_state(model, tree, now)
    flags = chance.choice((0, TOUCHED, RESTING))
    count = chance.randint(1, min(3, len(q))) if chance.random() < 0.3 else 0
    states = TreeStates(
        now,
        np.array([tree]),
        np.array([claim.ownership]),
        np.array([claim.authority]),
        np.array([flags]),
        np.array([len(q)]),
        q,
        qd,
        roots=np.array([count]),
        root=np.array(sorted(chance.sample(range(len(q)), count)), np.int64),
        root_x=np.array([[chance.uniform(-3.0, 3.0) for _ in range(3)] for _ in range(count)]).reshape(-1, 3),
        root_xd=np.array([[chance.uniform(-30.0, 30.0) for _ in range(3)] for _ in range(count)]).reshape(-1, 3),
    )
    return encode_trees(states)[0][0]


def _couplings_message(model: Model, now: float, chance: random.Random) -> bytes:
    """Returns an encoded message of springs (ties) on any bodies, wood, bunches or clusters, sometimes on one that does
    not exist."""
    bodies = sorted(chance.sample(range(len(model.body_tree) + 1), chance.randint(0, MAX_COUPLINGS)))
    return encode_couplings(
        CouplingMessage(
            now,
            tuple(
                Coupling(body, *(np.array([chance.uniform(-3.0, 3.0) for _ in range(3)]) for _ in range(2)))
                for body in bodies
            ),
        )
    )


def _record(model: Model, claim: Claim, now: float, chance: random.Random) -> RetainedRecord:
    """Returns a retained record of any object, with parents, cuts and states that are true or impossible."""
    kind = chance.choice(tuple(ObjectKind))
    number = _object_id(model, kind, chance)
    x, y, z = (chance.choice((chance.uniform(-3.0, 3.0), chance.uniform(-1e5, 1e5))) for _ in range(3))
    pose = (x, y, z, 0.0, 0.0, 0.0, 1.0)
    record = RetainedRecord(
        number,
        claim.ownership,
        claim.authority,
        claim.owner,
        pose=pose,
        moving=chance.random() < 0.3,
        parent=chance.choice(_PARENTS) if kind != ObjectKind.TREE or chance.random() < 0.1 else "",
    )
    if kind != ObjectKind.TREE and chance.random() < 0.9:
        return record
    tree = min(number, len(model.tree_first) - 1) if kind == ObjectKind.TREE else 0
    first = int(model.tree_first[tree])
    size = int(model.tree_size[tree])
    bodies = range(first, first + size + (chance.random() < 0.1))
    cut = tuple(sorted(chance.sample(bodies, chance.randint(0, min(3, len(bodies))))))
    other = tree if chance.random() < 0.8 else chance.randrange(len(model.tree_first))
    state = chance.choice((b"", _trees_message(model, other, claim, now, chance), chance.randbytes(30)))
    spares = range(first + int(model.tree_core[tree]) - 3, first + int(model.tree_core[tree]) + 1)
    stumps = tuple(
        (chance.choice(spares), chance.choice((*cut, first)), chance.randint(1, 1000))
        for _ in range(chance.randint(0, 3))
    )
    return msgspec.structs.replace(record, cut=cut, trees=state, stumps=stumps)


_PARENTS = (
    "",
    "box/0",
    "box/1",
    "box/2",
    "bunch/0",
    "ada/base_link",
    "evil/hand",
    "unknown/link",
    "box/-1",
    "box/1e9",
    "box/" + "9" * 40,
    "tree/0",
    "box/",
    "/",
    "box/\u0661",
    "\x00",
)
"""Names of parents in records: boxes that lie in each other, links of robots, and names of nothing."""


def key_of(family: str, name: str, cells: list[interest.Cell], chance: random.Random) -> str:
    """Returns the key of a message from ``name``. One key in ten is of another family or cell, too short or too
    long."""
    if chance.random() < 0.1:
        family = chance.choice(("a", "c", "tree", "near", "own", "fact", "force", "voice"))
    x, y = chance.choice(cells)
    if chance.random() < 0.05:
        odd = (
            f"{family}",
            f"{family}/{x}",
            f"{family}/{x}/{y}",
            f"{family}/{x}/{y}/{name}/more",
            f"{family}/x/y/{name}",
            f"{family}/{1 << 70}/{y}/{name}",
            f"{family}/{x}/{y}/{'n' * 60}",
            f"{family}/{x}/{y}/\u00e9",
            name,
        )
        return chance.choice(odd)
    if family == "a":
        return chance.choice((f"a/{name}", f"a/{name}/far", f"pose/0/0/{name}"))
    if family == "voice":
        return chance.choice((f"voice/{name}", f"voice/{name}", f"voice/{name}/pcm"))
    return f"force/ada/{name}" if family == "force" else f"{family}/{x}/{y}/{name}"


def corrupt(payload: bytes, other: bytes, chance: random.Random) -> bytes:
    """Returns a corrupted copy of a message, sometimes spliced with the ``other`` one, sometimes unchanged."""
    data = bytearray(payload)
    how = chance.randrange(9)
    if how == 0:
        for _ in range(chance.randint(1, 8)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif how == 1:
        del data[chance.randrange(len(data)) :]
    elif how == 2:
        data += chance.randbytes(chance.randint(1, 40))
    elif how == 3:
        at = chance.randrange(len(data))
        data[at:] = other[min(at, len(other)) :]
    elif how == 4:
        extreme = chance.choice(_EXTREMES)
        at = chance.randrange(max(len(data) - len(extreme), 1))
        data[at : at + len(extreme)] = extreme
    elif how == 5:
        data[4:] = chance.randbytes(len(data) - 4)
    elif how == 6:
        data = bytearray(chance.randbytes(chance.randint(0, 200)))
    elif how == 7 and chance.random() < 0.002:
        data = bytearray(b"VS\x01\x02") + bytes(MAX_MESSAGE + 1)
    return bytes(data)


def storm(
    model: Model,
    actor: Sender,
    seed: int,
    now: float = 0.0,
    names: Sequence[str] = (),
    *,
    pool_size: int = 0,
    period: float = 0.001,
) -> Iterator[tuple[str, bytes]]:
    """Yields corrupted messages without end, each with its key. ``names``: senders to use instead of the actor's own
    name.

    ``pool_size``: number of well-formed messages that are used many times, each time with another corruption and the
    present time, and that are replaced one after the other. 0: every message is newly made. ``period``: time between
    two messages [s].
    """
    chance = random.Random(seed)
    cells = sorted({interest.cell_of(pose[:3]) for pose in model.tree_pose.astype(float)})
    earlier = [encode_pose(actor.pose(now))]
    pool: list[tuple[str, bytes, float]] = []
    while True:
        if len(pool) < pool_size or not pool_size or chance.random() < 0.1:
            family, payload = valid_message(model, actor, now, chance)
            if pool_size:
                pool.append((family, payload, now))
                if len(pool) > pool_size:
                    pool[chance.randrange(pool_size)] = pool.pop()
        else:
            family, payload, made = chance.choice(pool)
            payload = shift_time(payload, now - made)
        bad = corrupt(payload, chance.choice(earlier), chance)
        if len(bad) < 1000:
            earlier = [*earlier[-50:], bad]
        if chance.random() < 0.1:
            bad = chance.choice(earlier)
        now += period
        yield key_of(family, chance.choice(names or (actor.name,)), cells, chance), bad


@dataclasses.dataclass(frozen=True, slots=True)
class Storm:
    """Result of a storm against two clients."""

    clients: tuple[FakeClient, FakeClient]
    step_times: np.ndarray
    """Processor time of each step of the first client [s]."""
    arrived: int
    """Number of messages that reached the first client."""


def run_storm(
    count: int, seed: int = 0, *, is_stranger: bool = False, kind: str = "robot", binds_names: bool = False
) -> Storm:
    """Send ``count`` corrupted messages to two clients: from an admitted actor of ``kind``, or, if ``is_stranger``,
    from a program that was never admitted.

    ``binds_names``: the bus refuses messages under the names of others; otherwise such messages reach the clients' own
    checks.
    """
    hub = MemoryHub(delay=0.005, seed=seed)
    hub.binds_names = binds_names
    server = hub.bus("server")
    server.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], hub.time))
    model = tree_row()
    ada, bob = (FakeClient(hub.bus(name), model, (x, 0.0)) for name, x in (("ada", 1.0), ("bob", 2.0)))
    evil = FakeClient((MemoryHub() if is_stranger else hub).bus(ATTACKER), model, (3.0, 0.0), kind=kind)
    bus = hub.bus("stranger", live=False) if is_stranger else evil.bus
    names = (ATTACKER, *(f"stranger_{number}" for number in range(200))) if is_stranger else ()
    for _ in range(100):
        hub.advance(0.01)
        for fake_client in (ada, bob) if is_stranger else (ada, bob, evil):
            fake_client.tick(hub.time)
    before = received_count(ada)
    ada.touching = {1}
    wild = storm(model, evil, seed, hub.time, names)
    publishers = {}
    spent = []
    for _ in range(-(-count // MESSAGES_PER_STEP)):
        for _ in range(MESSAGES_PER_STEP):
            key, payload = next(wild)
            if key not in publishers:
                publishers[key] = bus.publisher(key, reliable=True)
            publishers[key].put(payload)
        hub.advance(0.01)
        begin = time.thread_time()
        ada.tick(hub.time)
        spent.append(time.thread_time() - begin)
        bob.tick(hub.time)
    ada.touching = {1, 2}
    for _ in range(300):  # the world goes on after the storm
        hub.advance(0.01)
        for fake_client in (ada, bob):
            fake_client.tick(hub.time)
    return Storm((ada, bob), np.array(spent), received_count(ada) - before)


def received_count(fake_client: FakeClient | Client) -> int:
    """Returns the number of messages that arrived at a client."""
    counters = fake_client.replicator.counters
    families = (counters.actor, counters.environment, counters.event, counters.retained, counters.force, counters.voice)
    return sum(family.messages_in for family in families)


@dataclasses.dataclass(slots=True)
class Attack:
    """Counts of one attack on a client and the server's store."""

    sent: int = 0
    arrived: int = 0
    """Number of messages that arrived at the client with physics; of poses and states only the newest before each step
    counts."""
    malformed: int = 0
    """Number of arrived messages that the client with physics refused as malformed."""
    records: int = 0
    """Number of messages with records that reached the server's store."""
    checks: int = 0
    """Number of checks of all laws, each of which held."""
    tick: float = 0.0
    """Mean processor time of a tick of the client [s]."""


def attack(count: int, seed: int = 0, *, kind: str = "robot", is_stranger: bool = False) -> Attack:
    """Send ``count`` corrupted messages into a :class:`FuzzWorld`, from an actor of this ``kind`` or from a stranger.

    Every tenth step the actor's greeting is corrupted as well, and every hundredth step the actor leaves and comes
    back. Passes on exceptions of the attacked code, and :class:`benchmarks.support.fuzz_world.LawBroken`.
    """
    done = Attack()
    chance = random.Random(seed)
    with FuzzWorld(kind=kind, is_stranger=is_stranger, seed=seed) as world:
        names = (
            [f"stranger_{number}" for number in range(200)] if is_stranger else [ATTACKER] * 17 + ["ada", "bob", "x"]
        )
        wild = storm(
            world.model, world, seed, world.now, [ATTACKER, *names], pool_size=2000, period=DT / MESSAGES_PER_TICK
        )
        before = received_count(world.client)
        greeting = encode_hello(world.hello(kind))
        for step in range(-(-count // MESSAGES_PER_TICK)):
            for key, payload in itertools.islice(wild, MESSAGES_PER_TICK):
                world.put(key, payload)
                world.offer(payload)
            bad = corrupt(greeting, payload, chance)
            if step % 10 == 0:
                world.admission.decide(WORLD, ATTACKER, "another", bad, world.now)
            if step % 100 == 50:
                world.greet(bad, corrupt(encode_description(world.hello(kind)), payload, chance))
            elif step % 100 == 99:
                world.admit(kind)
            begin = time.thread_time()
            world.step()
            done.tick += time.thread_time() - begin
            if step % 5 == 0:
                world.check()
                done.checks += 1
        world.run(1.0)  # the world goes on after the attack
        world.check()
        counters = world.client.replicator.counters
        done.sent = (step + 1) * MESSAGES_PER_TICK
        done.arrived = received_count(world.client) - before
        done.malformed = counters.malformed
        done.records = world.store.counters.received
        done.tick = done.tick / (step + 1)
        world.check_store()
    return done


def fuzz(count: int = MESSAGE_COUNT, false_messages: int = 0, seed: int = 0) -> Iterator[Measurement]:
    """Measure attacks of ``count`` corrupted messages, and of ``false_messages`` series of well-formed false ones. Runs
    with different seeds are parts of a long one."""
    for case, share, kind, is_stranger in (
        ("a person that was admitted", 0.45, "human", False),
        ("a robot that was admitted", 0.45, "robot", False),
        ("a stranger", 0.1, "human", True),
    ):
        done = attack(round(share * count), seed, kind=kind, is_stranger=is_stranger) if count else Attack()
        for what, value, unit in (
            ("broken messages sent", done.sent, ""),
            ("arrived at a client", done.arrived, ""),
            ("of those refused as malformed", done.malformed, ""),
            ("reached the store of the server", done.records, ""),
            ("checks of all laws, none broken", done.checks, ""),
            (f"a step with {MESSAGES_PER_TICK} of them, two clients, mean", 1e3 * done.tick, "ms"),
        ):
            yield Measurement("fuzz", f"{case}: {what}", float(value), unit)
    for kind in ("human", "robot") if false_messages else ():
        from benchmarks.support.false_messages import send_false_messages  # needs hypothesis

        told = send_false_messages(false_messages // 2, seed=seed, kind=kind)
        yield Measurement("fuzz", f"well-formed false messages of a {kind}, no law broken", float(told), "")
