"""``vinesim bench fuzz``: a hundred thousand corrupted messages from an admitted actor, and their effect.

Every message begins as a valid one of any kind and is then corrupted: bits flipped, cut off, extended, spliced with
another, filled with extreme values, sent again later, sent under the key of another kind, or replaced by noise or by a
megabyte.
"""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Iterator

import numpy as np

from vinesim import frames
from vinesim.bench.support.fake_client import FakeClient, swinging_state, tree_row
from vinesim.net.codec import messages
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.messages import Hello, RetainedRecord
from vinesim.net.codec.wrenches import WrenchMessage, encode_wrenches
from vinesim.net.replication import interest
from vinesim.net.replication.authority import Claim
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.values import Measurement

ATTACKER = "evil"
MESSAGE_COUNT = 100_000
MESSAGES_PER_STEP = 50
"""Messages in one step: 5,000 a second, as many as eighty robots send."""

_EXTREMES = (
    b"\x00" * 8, b"\xff" * 8, struct.pack("<d", float("nan")), struct.pack("<d", float("inf")),
    struct.pack("<d", 1e308), struct.pack("<d", -1.0), struct.pack("<f", float("nan")), b"\x7f\xff", b"\x80\x00",
)  # fmt: skip


def valid_message(model: Model, actor: FakeClient, now: float, chance: random.Random) -> tuple[str, bytes]:
    """A family of keys and a message as ``actor`` might send it."""
    kind = chance.choice(("a", "c", "things", "own", "fact", "force", "hello"))
    tree = chance.randrange(len(model.tree_first))
    claim = Claim(chance.randrange(3), chance.randrange(1 << 16), ATTACKER)
    if kind == "a":
        return kind, encode_pose(actor.pose(now))
    if kind == "force":
        return kind, encode_wrenches(WrenchMessage(now, {"base_link": np.array([chance.uniform(-50.0, 50.0)] * 6)}))
    if kind == "c":
        q, qd = swinging_state(model, tree, now)
        flags = np.array([chance.choice((0, messages.TOUCHED, messages.RESTING))])
        record = messages.TreeStates(
            now, np.array([tree]), np.array([claim.ownership]), np.array([claim.authority]), flags,
            np.array([len(q)]), q, qd,
        )  # fmt: skip
        return kind, messages.encode_trees(record)[0][0]
    if kind == "things":
        number = np.array([object_id(ObjectKind.BOX, tree)])
        flags = np.array([messages.TOUCHED])
        record = messages.ObjectStates(
            now, number, np.array([claim.ownership]), np.array([claim.authority]), flags,
            frames.pose(np.array([[0.5, 0.5, 1.0]])), np.zeros((1, 6)),
        )  # fmt: skip
        return "c", messages.encode_objects(record, (0, 0))[0][0]
    if kind == "own":
        return kind, messages.encode_claims([(tree, claim, chance.random() < 0.5)])
    if kind == "fact":
        fact = RetainedRecord(object_id(ObjectKind.BUNCH, tree), claim.ownership, claim.authority, ATTACKER)
        return kind, messages.encode_records([fact])
    return "own", messages.encode_hello(Hello(ATTACKER, scene="fake_clients", digest="fake_clients"))


def corrupt(payload: bytes, other: bytes, chance: random.Random) -> bytes:
    """A corrupted copy of a message; sometimes unchanged."""
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
        data = bytearray(b"VS\x01\x02") + bytes(messages.MAX_MESSAGE + 1)
    return bytes(data)


def storm(model: Model, actor: FakeClient, seed: int, now: float = 0.0) -> Iterator[tuple[str, bytes]]:
    """Corrupted messages without end, each with the key it is sent under."""
    chance = random.Random(seed)
    cells = sorted({interest.cell_of(pose[:3]) for pose in model.tree_pose.astype(float)})
    earlier = [encode_pose(actor.pose(now))]
    while True:
        family, payload = valid_message(model, actor, now, chance)
        bad = corrupt(payload, chance.choice(earlier), chance)
        if len(bad) < 1000:
            earlier = [*earlier[-50:], bad]
        if chance.random() < 0.1:
            bad = chance.choice(earlier)
        if chance.random() < 0.1:
            family = chance.choice(("a", "c", "own", "fact", "force"))
        x, y = chance.choice(cells)
        if family == "a":
            key = chance.choice((f"a/{ATTACKER}", f"a/{ATTACKER}/far"))
        else:
            key = f"force/ada/{ATTACKER}" if family == "force" else f"{family}/{x}/{y}/{ATTACKER}"
        now += 0.001
        yield key, bad


def run_storm(count: int, seed: int = 0) -> tuple[FakeClient, FakeClient, np.ndarray, int]:
    """A storm against two clients: both, the time of each step of the first [s], and how many messages reached it."""
    hub = MemoryHub(delay=0.005, seed=seed)
    server = hub.bus("server")
    server.declare_queryable("clock", lambda asked: messages.encode_time(messages.decode_time(asked)[0], hub.time))
    model = tree_row()
    ada, bob, evil = (
        FakeClient(hub.bus(name), model, (x, 0.0)) for name, x in (("ada", 1.0), ("bob", 2.0), (ATTACKER, 3.0))
    )
    clients = (ada, bob, evil)
    for _ in range(100):
        hub.advance(0.01)
        for fake_client in clients:
            fake_client.tick(hub.time)
    before = received_count(ada)
    ada.touching = {1}
    wild = storm(model, evil, seed, hub.time)
    publishers = {}
    spent = []
    for _ in range(-(-count // MESSAGES_PER_STEP)):
        for _ in range(MESSAGES_PER_STEP):
            key, payload = next(wild)
            publisher = publishers.setdefault(key, evil.bus.publisher(key, reliable=True))
            publisher.put(payload)
        hub.advance(0.01)
        begin = time.thread_time()
        ada.tick(hub.time)
        spent.append(time.thread_time() - begin)
        bob.tick(hub.time)
    ada.touching = {1, 2}
    for _ in range(300):  # and the world goes on
        hub.advance(0.01)
        for fake_client in (ada, bob):
            fake_client.tick(hub.time)
    return ada, bob, np.array(spent), received_count(ada) - before


def received_count(fake_client: FakeClient) -> int:
    """Messages that arrived."""
    counters = fake_client.replicator.counters
    return counters.actor.messages_in + counters.environment.messages_in + counters.event.messages_in


def fuzz() -> Iterator[Measurement]:
    """Rows of the benchmark."""
    ada, _, spent, arrived = run_storm(MESSAGE_COUNT)
    counters = ada.replicator.counters
    for case, value, unit in (
        ("broken messages sent", MESSAGE_COUNT, ""),
        ("arrived where somebody listens, newest poses only", arrived, ""),
        ("counted as malformed", counters.malformed, ""),
        ("counted as sound and of no use", counters.dropped, ""),
        ("a tick with 50 of them, p50", 1e3 * np.percentile(spent, 50), "ms"),
        ("a tick with 50 of them, p99", 1e3 * np.percentile(spent, 99), "ms"),
        ("a tick with 50 of them, max", 1e3 * spent.max(), "ms"),
    ):
        yield Measurement("fuzz", case, float(value), unit)
