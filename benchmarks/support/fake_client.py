r"""Clients without physics: scripted poses and objects on a real replicator, to measure and test the network.

    python -m benchmarks.support.fake_client \\
        '{"connect": "tcp/127.0.0.1:7377", "fake_clients": [{"name": "ada", "place": [1, 0]}]}'

Such a process reads JSON objects from its standard input, one a line, and answers each with one line. ``{"who": "ada",
"touch": [3]}`` is a command for one client (:meth:`FakeClient.apply`); the answer is the client's
:meth:`FakeClient.report`. The process ends with its input.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.support.json_process import JsonProcess
from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.replication import interest
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.bus import Bus
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import is_tree
from vinesim.scene.model import Model
from vinesim.scene.values import POINT_NAMES, HumanPose, HumanUpdate, RobotUpdate

STEP_PERIOD = 0.01
"""Time step of a client [s]."""

ROBOT_JOINTS = 27
"""Number of joints of a robot, the same as of vinebot."""

SWAY = 0.12
SWING = 1.3
"""Amplitude [m] and frequency [Hz] with which the tip of a touched tree swings. Its owner must then publish 12 to 20
times a second, as for a cane that a robot pushes (measured: 13 messages in the 0.4 s of a push, then 14 in a second of
holding)."""


def tree_row(count: int = 12, *, apart: float = 1.0) -> Model:
    """Returns a model with trees of six bodies and a bunch along x, ``apart`` [m] from each other, and a box below
    each."""
    trees = []
    for number in range(count):
        tree = TreeBuilder(frames.pose(np.array([(number + 0.5) * apart, 0.0, 1.5])))
        tip = tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)[-1]
        tree.add_bunch(tip, 0.4, clusters=False)
        trees.append(tree)
    boxes = np.array([frames.pose([(number + 0.5) * apart, 0.5, 0.12]) for number in range(count)])
    return assemble(trees, box_pose=boxes, box_size=np.tile([0.4, 0.3, 0.24], (count, 1)), box_mass=np.full(count, 1.0))


SILENCE = 1.5
"""Time without an update of a tree after which the next one counts as a new contact [s]."""


class FakeClient:
    """A minimal client: a robot with swinging joints that touches objects and applies the updates it receives."""

    def __init__(
        self,
        bus: Bus,
        model: Model,
        place: tuple[float, float],
        *,
        kind: str = "robot",
        joints: int = ROBOT_JOINTS,
        digest: str = "fake_clients",
        near: float = interest.INTEREST_RADIUS,
        restless: bool = True,
        hello: Hello | None = None,
    ) -> None:
        """Join at ``place`` [2] m. ``restless``: the joints swing, so that no two poses are equal. ``hello``: of a
        robot with ``joints``; None: one without a URDF."""
        joints = 0 if kind == "human" else joints
        hello = hello or Hello(bus.name, kind=kind, scene="fake_clients", digest=digest, joints=joints)
        self.bus = bus
        self.model = model
        self.name = bus.name
        self.replicator = Replicator(bus, hello, model, interest_radius=near)
        self.place = np.array([*place, 0.0])
        self.joints = joints
        self.restless = restless
        self.touching: set[int] = set()
        """Trees that this client touches."""
        self.swinging: set[int] = set()
        """Trees that this client moves without contact."""
        self.grabbing: set[int] = set()
        """Objects that this client grabs in its next step."""
        self.picking: set[int] = set()
        """Bunches that this client picks in its next step and then carries."""
        self.carrying: set[int] = set()
        """Boxes and free bunches that this client carries; an object that is released is at rest at once, where it
        is."""
        self.parents: dict[int, str] = {}
        """Frame in which a released object rests, by object; the world if there is no entry."""
        self.sway = SWAY
        self.joined_at: dict[str, float] = {}
        self.left_at: dict[str, float] = {}
        self.heard: dict[int, float] = {}
        """Time of the last update of each object [s, clock of this client]."""
        self.first: dict[int, float] = {}
        """Time at which updates of each tree began after a pause [s, clock of this client]."""
        self._rested: set[int] = set()
        self.moved: dict[int, np.ndarray] = {}
        """Last received poses [7] of boxes and free bunches."""
        self.facts: dict[int, dict[str, Any]] = {}
        """Received retained records, by object."""
        self.released: list[int] = []
        self.reads = 0
        self.ticks = 0
        self.robots: dict[str, RobotUpdate | HumanUpdate] = {}
        """Remote actors as last shown, by name."""
        self._now = 0.0

    def tick(self, now: float) -> None:
        """Step this client once, at ``now`` [s] of its own clock."""
        self._now = now
        inbox = self.replicator.receive(now)
        for hello in inbox.joined:
            self.joined_at[hello.name] = now
        for name in inbox.left:
            self.left_at[name] = now
        for update in inbox.trees:
            if now - self.heard.get(update.tree, -np.inf) > SILENCE or update.tree in self._rested:
                self.first[update.tree] = now
            self.heard[update.tree] = now
            (self._rested.add if update.resting else self._rested.discard)(update.tree)
        for object_id in inbox.objects:
            if object_id.object not in self.moved or not np.array_equal(self.moved[object_id.object], object_id.pose):
                self.moved[object_id.object] = object_id.pose
                self.heard[object_id.object] = now
        for record, holds in inbox.records:
            self.facts[record.object] = {
                "parent": record.parent,
                "moving": record.moving,
                "holds": holds,
                "pose": record.pose,
            }
        self.released += inbox.released
        self.robots = {**inbox.robots, **inbox.people}
        grabbed = self.grabbing
        self.grabbing = set()
        picked = self.picking
        self.picking = set()
        self.carrying |= picked
        self.replicator.send(
            now,
            self.pose(now),
            touched=self.touching | self.carrying,
            moving=self.swinging,
            read=self.read,
            grabbed=grabbed | picked,
            detached=picked,
            pose_on_support=self.pose_on_support,
        )
        self.ticks += 1

    def pose(self, now: float) -> RobotUpdate | HumanUpdate:
        """Returns this client's pose at ``now`` [s]."""
        if self.replicator.hello.kind == "human":
            points = np.tile(frames.pose(self.place), (len(POINT_NAMES), 1))
            points[:, 2] = (0.0, 1.65, 1.1 + 0.2 * np.sin(2.0 * now), 1.1, 0.9, 0.1, 0.1)
            velocity = np.zeros((len(POINT_NAMES), 6))
            velocity[2, 2] = 0.4 * np.cos(2.0 * now)
            return HumanUpdate(self.name, now, HumanPose(*points), velocity)
        phase = np.arange(self.joints) + (2.0 * now if self.restless else 0.0)
        speed = 0.6 * np.cos(phase) if self.restless else np.zeros(self.joints)
        return RobotUpdate(self.name, now, frames.pose(self.place), np.zeros(6), 0.3 * np.sin(phase), speed)

    def carried_state(self, object_id: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose [7] and velocity [6] of a carried object, which moves to and fro above the client's
        place."""
        phase = 2.0 * np.pi * SWING * (self._now + self.replicator.offset) + object_id
        pose = frames.pose(self.place + np.array([0.2 * np.sin(phase), 0.0, 1.0]))
        velocity = np.zeros(6)
        velocity[0] = 0.4 * np.pi * SWING * np.cos(phase)
        return pose, velocity

    def pose_on_support(self, object_id: int) -> tuple[str, np.ndarray]:
        """Returns the parent frame and the pose [7] of a released object."""
        return self.parents.get(object_id, ""), self.carried_state(object_id)[0]

    def read(self, object_id: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the state of an object. A tree swings about one axis of every joint, equally on every clock."""
        self.reads += 1
        if not is_tree(object_id):
            return self.carried_state(object_id)
        return swinging_state(self.model, object_id, self._now + self.replicator.offset, self.sway)

    def report(self) -> dict[str, Any]:
        """Returns all state that a test may need, as JSON values."""
        replicator = self.replicator
        return {
            "name": self.name,
            "ticks": self.ticks,
            "reads": self.reads,
            "now": self._now,
            "offset": replicator.offset,
            "others": sorted(replicator.peers),
            "joined_at": self.joined_at,
            "left_at": self.left_at,
            "owner": {object_id: replicator.owner(object_id) for object_id in sorted(replicator.known)},
            "claim": {object_id: list(replicator.claim(object_id)) for object_id in sorted(replicator.known)},
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

    def apply(self, command: dict[str, Any]) -> None:
        """Apply a command, a dictionary with any of these keys.

        ``touch``, ``swing``, ``grab``, ``pick``, ``carry``: object ids. ``lay``: {object id: parent frame}, objects to
        release. ``place``: [x, y] m, where to stand. ``sway``: amplitude of touched trees [m].
        """
        for what, value in command.items():
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
                self.parents |= {int(object_id): parent for object_id, parent in value.items()}
                self.carrying -= self.parents.keys()
            elif what == "place":
                self.place[:2] = value
            elif what == "sway":
                self.sway = float(value)
            else:
                raise ValueError(f"fake_clients do not know {what!r}")


def swinging_state(model: Model, tree: int, time: float, sway: float = SWAY) -> tuple[np.ndarray, np.ndarray]:
    """Returns joint rotations [n, 4] and rates [n, 3] rad/s of a tree whose tip sways without end, by ``sway`` [m]."""
    bodies = model.bodies_of(tree)
    length = float(model.body_length[bodies].sum())
    amplitude = 2.0 * sway / max(length * len(model.joint_settled[bodies]), 1e-3)  # shared equally by all joints
    phase = 2.0 * np.pi * SWING * time + tree
    turn = frames.exp(np.array([0.0, amplitude * np.sin(phase), 0.0]))
    settled = model.joint_settled[bodies]
    rate = np.zeros((len(settled), 3))
    rate[:, 1] = amplitude * 2.0 * np.pi * SWING * np.cos(phase)
    return frames.multiply(turn, settled), rate


# ---------------------------------------------------------------- in processes of their own


class FakeClientProcess(JsonProcess):
    """Fake clients in a process of their own, as the process that started them controls them. A context manager."""

    def __init__(
        self,
        connect: str,
        fake_clients: Iterable[dict[str, Any]],
        *,
        start: Callable[..., Any] = subprocess.Popen,
        **options: Any,
    ) -> None:
        """Start the process. ``start(command, **options of Popen)`` may start it in a network namespace; ``options`` as
        in :func:`run`."""
        wanted = {"connect": connect, "fake_clients": list(fake_clients), **options}
        super().__init__("benchmarks.support.fake_client", wanted, start)
        self.answer()

    def command(self, who: str = "", **command: Any) -> dict[str, Any]:
        """Send a command to the client ``who``; return the client's report after its next step."""
        self.send(who=who, **command)
        return self.answer()


def run(
    connect: str,
    fake_clients: list[dict[str, Any]],
    *,
    trees: int = 12,
    apart: float = 1.0,
    tick: float = STEP_PERIOD,
    skew: float = 0.0,
    certificates: str = "",
) -> None:
    """Step clients over Zenoh and apply commands from standard input until it ends.

    ``trees``, ``apart``: arguments of :func:`tree_row`. ``tick``: period of steps [s]. ``skew``: error of the clock
    [s]. ``certificates``: folder with the certificates of all clients, for ``tls/`` and ``quic/``.
    """
    from vinesim.net.transport.zenoh_bus import ZenohBus

    model = tree_row(trees, apart=apart)
    folder = pathlib.Path(certificates) if certificates else None
    commands: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    by_name: dict[str, FakeClient] = {}
    late = 0
    try:
        for one in fake_clients:
            name = one.pop("name")
            place = one.pop("place")
            by_name[name] = FakeClient(ZenohBus(name, connect=connect, certificates=folder), model, place, **one)
        threading.Thread(target=_read_commands, args=(commands,), daemon=True).start()
        _write_line({"ready": True})
        due = time.monotonic()
        answering: list[str] = []
        while True:
            begin = time.monotonic()
            for fake_client in by_name.values():
                fake_client.tick(begin + skew)
            for name in answering:
                load = {"late": late, "cpu": time.process_time(), "clock": time.monotonic()}
                _write_line(by_name[name].report() | load)
            answering.clear()
            while not commands.empty():
                command = commands.get()
                if command is None:
                    return
                name = command.pop("who") or next(iter(by_name))
                by_name[name].apply(command)
                answering.append(name)  # answered after the next tick of this client
            due += tick
            late += time.monotonic() - due > tick
            if time.monotonic() - due > 0.5:
                due = time.monotonic()
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        for fake_client in by_name.values():
            fake_client.bus.close()


def _write_line(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def _read_commands(commands: queue.SimpleQueue) -> None:
    for line in sys.stdin:
        commands.put(json.loads(line))
    commands.put(None)


if __name__ == "__main__":
    run(**json.loads(sys.argv[1]))
