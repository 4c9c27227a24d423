"""``python -m benchmarks traffic``: bytes of a client of a full vineyard, compared with a broadcast of the same states.

Ten robots and five people work on a block of about ten thousand bunches. Each touches three trees with a bunch and two
without, all of which swing. The replicators are real, the network is the bus in memory with the delay of a LAN, and
motion is scripted: no physics is needed to count bytes.

The broadcast is the cost of sending everything to all clients: the pose of every actor and a rigid record of 26 B for
every bunch, at 60 Hz.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from benchmarks.support.fake_client import FakeClient
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.codec.human import encode_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement, RobotUpdate

ROBOTS = 10
PEOPLE = 5
BUNCHES = 3
BRANCHES = 2
"""Number of trees without a bunch that each actor touches; ``BUNCHES`` is the number of those with a bunch."""

HZ = 60.0
SECONDS = 6.0
SETTLE = 2.0
"""Time for all actors to meet [s]."""

LAN = 0.001
"""Delay of the network one way [s]."""

RIGID = 26
"""Size of the state of a rigid object in the broadcast [B]."""

RINGS = (0.0, 3.0, 6.0, 12.0, 100.0)
"""Bounds of the classes of distance [m] for which errors of shown robots are reported."""
REACH = 1.0
"""Length of an arm [m], by which a joint's error is multiplied to estimate the error of the hand."""

OVERHEAD = 6
"""Framing of a message that shares a packet with others [B]. A message alone in its packet costs far more, see the
benchmark ``load``."""


def places(model: Model, share: float, seed: int = 3) -> np.ndarray:
    """Returns random positions of all actors [actor, 2] m, in a part of the block with ``share`` of the length of its
    edges."""
    low = model.tree_pose[:, :2].min(0)
    high = model.tree_pose[:, :2].max(0)
    return low + share * (high - low) * np.random.default_rng(seed).uniform(size=(ROBOTS + PEOPLE, 2))


def place_actors(hub: MemoryHub, model: Model, where: np.ndarray) -> list[FakeClient]:
    """Returns robots and people at the positions ``where`` [actor, 2] m, in contact with the nearest trees."""
    laden = np.zeros(len(model.tree_first), bool)
    laden[model.body_tree[model.bunch_body]] = True
    roots = model.tree_pose[:, :2]
    taken: set[int] = set()
    fake_clients = []
    for number, place in enumerate(where):
        person = number >= ROBOTS
        name = f"{'person' if person else 'robot'}{number}"
        fake_client = FakeClient(
            hub.bus(name), model, (float(place[0]), float(place[1])), kind="human" if person else "robot"
        )
        near = np.argsort(np.linalg.norm(roots - place, axis=1), kind="stable").tolist()
        for wanted, has in ((BUNCHES, True), (BRANCHES, False)):
            mine = [tree for tree in near if tree not in taken and (laden[tree] or not has)][:wanted]
            taken.update(mine)
            fake_client.touching.update(mine)
        fake_clients.append(fake_client)
    return fake_clients


def broadcast(model: Model, fake_clients: list[FakeClient]) -> float:
    """Returns the bytes a second that a client receives if everything is sent to all clients at 60 Hz."""
    poses = sum(len(encode_pose(fake_client.pose(0.0))) for fake_client in fake_clients[1:])
    return HZ * (poses + RIGID * len(model.bunch_body))


def traffic() -> Iterator[Measurement]:
    """Measure actors anywhere in the block, then the same actors close together."""
    model = generate(load_scene("tendone"))
    for case, share in (("all over the block", 1.0), ("in a quarter of it", 0.5)):
        hub = MemoryHub(delay=LAN, seed=1)
        server = hub.bus("server")
        server.declare_queryable("clock/*", lambda asked, hub=hub: encode_time(decode_time(asked)[0], hub.time))
        fake_clients = place_actors(hub, model, places(model, share))
        for _ in range(round(SETTLE * 100)):
            _tick(hub, fake_clients)
        rows = [[(p.bus.bytes_in, p.bus.bytes_out, _messages(p)) for p in fake_clients]]
        errors: list[np.ndarray] = []
        for tick in range(round(SECONDS * 100)):
            _tick(hub, fake_clients)
            if tick % 7 == 0:
                errors.append(shown_errors(fake_clients, hub.time))
            if tick % 10 == 9:  # sums over tenths of a second: the load of a link, not single packets
                rows.append([(p.bus.bytes_in, p.bus.bytes_out, _messages(p)) for p in fake_clients])
        rates = 10.0 * np.diff(np.array(rows, float), axis=0)  # [tenth, actor, (in, out, messages in)]
        everything = broadcast(model, fake_clients)
        size = f"{len(model.bunch_body)} bunches, {ROBOTS} robots, {PEOPLE} people {case}"

        def line(what: str, value: float, size: str = size, all_: float = everything) -> Measurement:
            return Measurement("traffic", f"{size}: {what}", value / 1e3, "kB/s", "broadcast", all_ / 1e3, all_ / value)

        received = rates[..., 0]
        sent = rates[..., 1]
        count = rates[..., 2]
        mean = received.mean(0)
        yield line("received by a client, mean of all", float(mean.mean()))
        yield line("received by the client that receives most, mean", float(mean.max()))
        yield line("received by a client, peak of a tenth of a second", float(received.max()))
        framed = received + OVERHEAD * count
        yield line("received with framing, the client that receives most", float(framed.mean(0).max()))
        yield line("sent by a client, mean of all", float(sent.mean()))
        poses = np.mean([p.replicator.counters.actor.bytes_in for p in fake_clients]) / hub.time
        trees = np.mean([p.replicator.counters.environment.bytes_in for p in fake_clients]) / hub.time
        yield Measurement("traffic", f"{size}: of that, poses", float(poses) / 1e3, "kB/s")
        yield Measurement("traffic", f"{size}: of that, trees", float(trees) / 1e3, "kB/s")
        away, error = np.concatenate(errors).T
        for low, high in itertools.pairwise(RINGS):
            here = (away >= low) & (away < high)
            if here.any():
                seen = 1e3 * error[here] * REACH / away[here]
                ring = f"{size}: robots {low:g} to {high:g} m away as shown, worst joint"
                yield Measurement("traffic", f"{ring}, p95", 1e3 * float(np.percentile(error[here], 95)), "mrad")
                yield Measurement(
                    "traffic", f"{ring}, {REACH:g} m from it, seen, p95", float(np.percentile(seen, 95)), "mrad"
                )
        for fake_client in fake_clients:
            fake_client.bus.close()


def shown_errors(fake_clients: list[FakeClient], now: float) -> np.ndarray:
    """Returns [k, 2] the distance [m] and the largest joint error [rad] of every robot on every other client,
    ``now``."""
    found = []
    for viewer in fake_clients:
        for other in fake_clients:
            shown = viewer.robots.get(other.name)
            if isinstance(shown, RobotUpdate):
                truth = other.pose(now)
                assert isinstance(truth, RobotUpdate)
                error = float(np.abs(shown.position - truth.position).max())
                found.append((float(np.hypot(*(viewer.place - other.place)[:2])), error))
    return np.array(found).reshape(-1, 2)


def _tick(hub: MemoryHub, fake_clients: list[FakeClient]) -> None:
    hub.advance(0.01)
    for fake_client in fake_clients:
        fake_client.tick(hub.time)


def _messages(fake_client: FakeClient) -> int:
    counters = fake_client.replicator.counters
    return counters.actor.messages_in + counters.environment.messages_in + counters.event.messages_in
