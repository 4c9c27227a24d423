"""Actors without physics: scripted poses and trees on a real replicator. What the network does is measured with them.

    python -m vinesim.bench.support.fake_client '{"connect": "tcp/127.0.0.1:7447", "puppets": [{"name": "ada", "place":
    [1, 0]}]}'

Such a process answers each line on its input, a JSON object, with one line: ``{"who": "ada", "touch": [3]}`` lets it
act, and every answer is its :meth:`Puppet.report`. It ends with its input.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Self

import numpy as np

from vinesim import frames
from vinesim.net.codec.messages import Hello
from vinesim.net.replication import interest
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.bus import Bus
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import is_tree
from vinesim.scene.model import Model
from vinesim.scene.values import POINT_NAMES, HumanPose, HumanUpdate, RobotUpdate

TICK = 0.01
"""A client's tick [s]."""

ROBOT_JOINTS = 27
"""As many as vinebot has."""

SWAY, SWING = 0.12, 1.3
"""The tip of a touched tree sways by so much [m], so often [Hz]: its owner must then speak 12 to 20 times a second, as
for a cane that a robot pushes (13 times in the 0.4 s of the push itself, then 14 times in a second of holding it)."""


def row(count: int = 12, *, apart: float = 1.0) -> Model:
    """Trees of six bodies and a bunch along x, the first at half their distance [m], and a box below each."""
    trees = []
    for number in range(count):
        tree = TreeBuilder(frames.pose(np.array([(number + 0.5) * apart, 0.0, 1.5])))
        tip = tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)[-1]
        tree.add_bunch(tip, 0.4, clusters=False)
        trees.append(tree)
    boxes = np.array([frames.pose([(number + 0.5) * apart, 0.5, 0.12]) for number in range(count)])
    return assemble(trees, box_pose=boxes, box_size=np.tile([0.4, 0.3, 0.24], (count, 1)), box_mass=np.full(count, 1.0))


SILENCE = 1.5
"""After this [s] without news of a tree the next ones begin a new touch."""


class FakeClient:
    """The least client: it stands somewhere and swings its arms, touches trees, and believes what it hears."""

    def __init__(
        self,
        bus: Bus,
        model: Model,
        place: tuple[float, float],
        *,
        kind: str = "robot",
        joints: int = ROBOT_JOINTS,
        digest: str = "puppets",
        near: float = interest.INTEREST_RADIUS,
        restless: bool = True,
    ) -> None:
        """Stand at ``place`` [2] m; ``restless`` lets the joints swing, so that no two poses are alike."""
        joints = 0 if kind == "human" else joints
        hello = Hello(bus.name, kind=kind, scene="puppets", digest=digest, joints=joints)
        self.bus, self.model, self.name = bus, model, bus.name
        self.replicator = Replicator(bus, hello, model, interest_radius=near)
        self.place = np.array([*place, 0.0])
        self.joints, self.restless = joints, restless
        self.touching: set[int] = set()
        """Trees it touches."""
        self.swinging: set[int] = set()
        """Trees that move though it does not touch them."""
        self.grabbing: set[int] = set()
        """Things it grabs in its next tick."""
        self.picking: set[int] = set()
        """Bunches that it takes off their vines in its next tick, and carries then."""
        self.carrying: set[int] = set()
        """Boxes and loose bunches that move in its hands; what is let go rests where it is at once."""
        self.parents: dict[int, str] = {}
        """Where what it lets go of comes to lie, if not on the ground."""
        self.sway = SWAY
        self.came: dict[str, float] = {}
        self.went: dict[str, float] = {}
        self.heard: dict[int, float] = {}
        """When each tree was last heard of, by one's own clock [s]."""
        self.first: dict[int, float] = {}
        """When news of each tree last began to come [s]."""
        self._rested: set[int] = set()
        self.moved: dict[int, np.ndarray] = {}
        """Where others last moved boxes and loose bunches [7]."""
        self.facts: dict[int, dict[str, Any]] = {}
        """What it was told for good of each thing."""
        self.released: list[int] = []
        self.reads = 0
        self.ticks = 0
        self.robots: dict[str, RobotUpdate | HumanUpdate] = {}
        """The others, as last shown."""
        self._now = 0.0

    def tick(self, now: float) -> None:
        """One tick of a client's share in the network."""
        self._now = now
        inbox = self.replicator.receive(now)
        for hello in inbox.joined:
            self.came[hello.name] = now
        for name in inbox.left:
            self.went[name] = now
        for update in inbox.trees:
            if now - self.heard.get(update.tree, -np.inf) > SILENCE or update.tree in self._rested:
                self.first[update.tree] = now
            self.heard[update.tree] = now
            (self._rested.add if update.resting else self._rested.discard)(update.tree)
        for thing in inbox.objects:
            if thing.object not in self.moved or not np.array_equal(self.moved[thing.object], thing.pose):
                self.moved[thing.object], self.heard[thing.object] = thing.pose, now
        for fact, holds in inbox.records:
            self.facts[fact.object] = {"parent": fact.parent, "moving": fact.moving, "holds": holds, "pose": fact.pose}
        self.released += inbox.released
        self.robots = dict(inbox.robots)
        grabbed, self.grabbing = self.grabbing, set()
        picked, self.picking = self.picking, set()
        self.carrying |= picked
        self.replicator.send(
            now, self.pose(now), touched=self.touching | self.carrying, moving=self.swinging, read=self.read,
            grabbed=grabbed | picked, detached=picked, pose_on_support=self.lies,
        )  # fmt: skip
        self.ticks += 1

    def pose(self, now: float) -> RobotUpdate | HumanUpdate:
        """What it would say of itself at ``now``."""
        if self.replicator.hello.kind == "human":
            points = np.tile(frames.pose(self.place), (len(POINT_NAMES), 1))
            points[:, 2] = (0.0, 1.65, 1.1 + 0.2 * np.sin(2.0 * now), 1.1, 0.9, 0.1, 0.1)
            velocity = np.zeros((len(POINT_NAMES), 6))
            velocity[2, 2] = 0.4 * np.cos(2.0 * now)
            return HumanUpdate(self.name, now, HumanPose(*points), velocity)
        phase = np.arange(self.joints) + (2.0 * now if self.restless else 0.0)
        speed = 0.6 * np.cos(phase) if self.restless else np.zeros(self.joints)
        return RobotUpdate(self.name, now, frames.pose(self.place), np.zeros(6), 0.3 * np.sin(phase), speed)

    def held(self, thing: int) -> tuple[np.ndarray, np.ndarray]:
        """Pose [7] and velocity [6] of what it carries: to and fro above where it stands."""
        phase = 2.0 * np.pi * SWING * (self._now + self.replicator.offset) + thing
        pose, velocity = frames.pose(self.place + np.array([0.2 * np.sin(phase), 0.0, 1.0])), np.zeros(6)
        velocity[0] = 0.4 * np.pi * SWING * np.cos(phase)
        return pose, velocity

    def lies(self, thing: int) -> tuple[str, np.ndarray]:
        """Parent and pose [7] of what was let go."""
        return self.parents.get(thing, ""), self.held(thing)[0]

    def read(self, thing: int) -> tuple[np.ndarray, np.ndarray]:
        """How a thing it moves stands; a tree swings about one axis of every joint, the same on every clock."""
        self.reads += 1
        if not is_tree(thing):
            return self.held(thing)
        return swung(self.model, thing, self._now + self.replicator.offset, self.sway)

    def report(self) -> dict[str, Any]:
        """All that a test may want to know."""
        replicator = self.replicator
        return {
            "name": self.name,
            "ticks": self.ticks,
            "reads": self.reads,
            "now": self._now,
            "offset": replicator.offset,
            "others": sorted(replicator.peers),
            "came": self.came,
            "went": self.went,
            "owner": {thing: replicator.owner(thing) for thing in sorted(replicator.known)},
            "claim": {thing: list(replicator.claim(thing)) for thing in sorted(replicator.known)},
            "facts": self.facts,
            "heard": self.heard,
            "first": self.first,
            "released": self.released,
            "poses": {name: getattr(one, "position", one.base_q)[:1].tolist() for name, one in self.robots.items()},
            "counters": dataclasses.asdict(replicator.counters),
            "bytes_in": self.bus.bytes_in,
            "lost": self.bus.dropped,
            "trouble": self.bus.status_message,
        }

    def apply(self, order: dict[str, Any]) -> None:
        """``touch``, ``swing``, ``grab``, ``pick``, ``carry``: things; ``lay``: {thing: parent} of what is let go.

        ``place``: [x, y] m; ``sway``: m.
        """
        for what, value in order.items():
            if what == "touch":
                self.touching = set(value)
            elif what == "swing":
                self.swinging = set(value)
            elif what == "grab":
                self.grabbing = set(value)
            elif what == "pick":
                self.picking = set(value)
            elif what == "carry":
                self.carrying = set(value)
            elif what == "lay":
                self.parents |= {int(thing): parent for thing, parent in value.items()}
                self.carrying -= self.parents.keys()
            elif what == "place":
                self.place[:2] = value
            elif what == "sway":
                self.sway = float(value)
            else:
                raise ValueError(f"puppets do not know {what!r}")


def swung(model: Model, tree: int, time: float, sway: float = SWAY) -> tuple[np.ndarray, np.ndarray]:
    """Joint rotations [n, 4] and rates [n, 3] rad/s of a tree whose tip sways by ``sway`` [m] for ever."""
    bodies = model.bodies_of(tree)
    length = float(model.body_length[bodies].sum())
    amplitude = 2.0 * sway / max(length * len(model.joint_settled[bodies]), 1e-3)  # every joint bears half of it
    phase = 2.0 * np.pi * SWING * time + tree
    turn = frames.exp(np.array([0.0, amplitude * np.sin(phase), 0.0]))
    settled = model.joint_settled[bodies]
    rate = np.zeros((len(settled), 3))
    rate[:, 1] = amplitude * 2.0 * np.pi * SWING * np.cos(phase)
    return frames.multiply(turn, settled), rate


# ---------------------------------------------------------------- in processes of their own


class FakeClientProcess:
    """Puppets in a process of their own, seen from the one that plays with them. A context manager."""

    def __init__(
        self,
        connect: str,
        puppets: Iterable[dict[str, Any]],
        *,
        start: Callable[..., subprocess.Popen] = subprocess.Popen,
        **options: Any,
    ) -> None:
        """``start(command, **options of Popen)`` may put it into a namespace; ``options`` as in :func:`play`."""
        wanted = json.dumps({"connect": connect, "puppets": list(puppets), **options})
        self.process = start(
            [sys.executable, "-m", "vinesim.bench.support.fake_client", wanted],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._hear()

    def tell(self, who: str = "", **order: Any) -> dict[str, Any]:
        """Order a puppet about; its report of a moment later."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"who": who, **order}) + "\n")
        self.process.stdin.flush()
        return self._hear()

    def _hear(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the puppets' process ended with {self.process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        """Let the puppets leave, and wait for it."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None and not pipe.closed:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run(
    connect: str, puppets: list[dict[str, Any]], *, trees: int = 12, apart: float = 1.0, tick: float = TICK,
    skew: float = 0.0,
) -> None:  # fmt: skip
    """Tick puppets over Zenoh and do what the standard input says, until it ends. ``skew`` [s] sets the clock wrong."""
    from vinesim.net.transport.zenoh_bus import ZenohBus

    model = row(trees, apart=apart)
    orders: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    cast: dict[str, FakeClient] = {}
    late = 0
    try:
        for one in puppets:
            name, place = one.pop("name"), one.pop("place")
            cast[name] = FakeClient(ZenohBus(name, connect=connect), model, place, **one)
        threading.Thread(target=_listen, args=(orders,), daemon=True).start()
        _say({"ready": True})
        due = time.monotonic()
        answering: list[str] = []
        while True:
            begin = time.monotonic()
            for puppet in cast.values():
                puppet.tick(begin + skew)
            for name in answering:
                load = {"late": late, "cpu": time.process_time(), "clock": time.monotonic()}
                _say(cast[name].report() | load)
            answering.clear()
            while not orders.empty():
                order = orders.get()
                if order is None:
                    return
                name = order.pop("who") or next(iter(cast))
                cast[name].apply(order)
                answering.append(name)  # after its next tick
            due += tick
            late += time.monotonic() - due > tick
            if time.monotonic() - due > 0.5:
                due = time.monotonic()
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        for puppet in cast.values():
            puppet.bus.close()


def _say(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def _listen(orders: queue.SimpleQueue) -> None:
    for line in sys.stdin:
        orders.put(json.loads(line))
    orders.put(None)


if __name__ == "__main__":
    run(**json.loads(sys.argv[1]))
