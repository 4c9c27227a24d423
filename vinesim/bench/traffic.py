"""``vinesim bench traffic``: what a client of a full vineyard hears and says, beside a broadcast of the same records.

Ten robots and five people work on a block of about ten thousand bunches, each touches three bunches and two branches
(trees of which a hand holds a bunch, and bare ones), all of which swing. The exchanges are the real ones, the network
is the bus in memory with the delay of a LAN, and what moves is scripted: no physics is needed to count bytes.

The broadcast is what the same scene costs when everybody is sent everything: every actor's pose and a rigid record of
26 B for every bunch, at 60 Hz.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vinesim.bench.support.fake_client import FakeClient
from vinesim.net.codec import messages
from vinesim.net.codec.human import encode_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

ROBOTS, PEOPLE = 10, 5
BUNCHES, BRANCHES = 3, 2
"""What everybody touches."""

HZ = 60.0
SECONDS = 6.0
SETTLE = 2.0
"""Until all have met [s]."""

LAN = 0.001
"""[s]"""

RIGID = 26
"""Bytes of a record of one rigid thing."""

OVERHEAD = 6
"""Bytes of framing for each message that shares a packet with others; alone it costs far more, see the load bench."""


def places(model: Model, share: float, seed: int = 3) -> np.ndarray:
    """Where everybody stands [actor, 2] m: anywhere in a ``share`` of the block's edges."""
    low, high = model.tree_pose[:, :2].min(0), model.tree_pose[:, :2].max(0)
    return low + share * (high - low) * np.random.default_rng(seed).uniform(size=(ROBOTS + PEOPLE, 2))


def cast(hub: MemoryHub, model: Model, where: np.ndarray) -> list[FakeClient]:
    """Robots and people, each with its hands on the nearest trees: those with bunches first."""
    laden = np.zeros(len(model.tree_first), bool)
    laden[model.body_tree[model.bunch_body]] = True
    roots = model.tree_pose[:, :2]
    taken: set[int] = set()
    puppets = []
    for number, place in enumerate(where):
        person = number >= ROBOTS
        name = f"{'person' if person else 'robot'}{number}"
        puppet = FakeClient(
            hub.bus(name), model, (float(place[0]), float(place[1])), kind="human" if person else "robot"
        )  # fmt: skip
        near = np.argsort(np.linalg.norm(roots - place, axis=1), kind="stable").tolist()
        for wanted, has in ((BUNCHES, True), (BRANCHES, False)):
            mine = [tree for tree in near if tree not in taken and (laden[tree] or not has)][:wanted]
            taken.update(mine)
            puppet.touching.update(mine)
        puppets.append(puppet)
    return puppets


def broadcast(model: Model, puppets: list[FakeClient]) -> float:
    """Bytes a second that a client hears if everybody is sent everything at 60 Hz."""
    poses = sum(len(encode_pose(puppet.pose(0.0))) for puppet in puppets[1:])
    return HZ * (poses + RIGID * len(model.bunch_body))


def traffic() -> Iterator[Measurement]:
    """Rows for actors anywhere, and for the same ones close together."""
    model = generate(load_scene("tendone"))
    for case, share in (("all over the block", 1.0), ("in a quarter of it", 0.5)):
        hub = MemoryHub(delay=LAN, seed=1)
        server = hub.bus("server")
        server.declare_queryable(
            "clock", lambda asked, hub=hub: messages.encode_time(messages.decode_time(asked)[0], hub.time)
        )
        puppets = cast(hub, model, places(model, share))
        for _ in range(round(SETTLE * 100)):
            _tick(hub, puppets)
        rows = [[(p.bus.bytes_in, p.bus.bytes_out, _messages(p)) for p in puppets]]
        for tick in range(round(SECONDS * 100)):
            _tick(hub, puppets)
            if tick % 10 == 9:  # tenths of a second: what a link must carry, not what a packet holds
                rows.append([(p.bus.bytes_in, p.bus.bytes_out, _messages(p)) for p in puppets])
        rates = 10.0 * np.diff(np.array(rows, float), axis=0)  # [tenth, actor, (in, out, messages in)]
        everything = broadcast(model, puppets)
        size = f"{len(model.bunch_body)} bunches, {ROBOTS} robots, {PEOPLE} people {case}"

        def line(what: str, value: float, size: str = size, all_: float = everything) -> Measurement:
            return Measurement("traffic", f"{size}: {what}", value / 1e3, "kB/s", "broadcast", all_ / 1e3, all_ / value)

        heard, said, count = rates[..., 0], rates[..., 1], rates[..., 2]
        mean = heard.mean(0)
        yield line("heard by a client, mean of all", float(mean.mean()))
        yield line("heard by the client that hears most, mean", float(mean.max()))
        yield line("heard by a client, peak of a tenth of a second", float(heard.max()))
        yield line("heard with framing, the client that hears most", float((heard + OVERHEAD * count).mean(0).max()))
        yield line("said by a client, mean of all", float(said.mean()))
        poses = np.mean([p.replicator.counters.actor.bytes_in for p in puppets]) / hub.time
        trees = np.mean([p.replicator.counters.environment.bytes_in for p in puppets]) / hub.time
        yield Measurement("traffic", f"{size}: of that, poses", float(poses) / 1e3, "kB/s")
        yield Measurement("traffic", f"{size}: of that, trees", float(trees) / 1e3, "kB/s")
        for puppet in puppets:
            puppet.bus.close()


def _tick(hub: MemoryHub, puppets: list[FakeClient]) -> None:
    hub.advance(0.01)
    for puppet in puppets:
        puppet.tick(hub.time)


def _messages(puppet: FakeClient) -> int:
    counters = puppet.replicator.counters
    return counters.actor.messages_in + counters.environment.messages_in + counters.event.messages_in
