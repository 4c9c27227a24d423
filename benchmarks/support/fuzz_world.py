"""A small world under attack: a client with physics, a person of another client, a store of records; and laws that must
hold.

The client ``ada`` controls a robot and has copies of all other actors. The person ``bob`` belongs to another client and
only moves its hands. The store is the server's, with journals on disk. The attacker sends any message under any key,
from a session with or without admission. After each step :meth:`FuzzWorld.check` checks client and store against the
laws.
"""

from __future__ import annotations

import pathlib
import tempfile
import threading
from collections.abc import Iterator
from typing import Self

import msgspec
import numpy as np

from benchmarks.support.fake_client import FakeClient
from benchmarks.support.sound_recorder import SoundRecorder
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    decode_records,
    decode_time,
    encode_description,
    encode_hello,
    encode_time,
)
from vinesim.net.codec.header import MAX_COORDINATE, MessageError
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.meshes import MESH_PART, MESH_REQUEST, decode_part, decode_request, encode_part, encode_wanted
from vinesim.net.codec.objects import check_object_id
from vinesim.net.replication import interest
from vinesim.net.replication.receiver import check_record
from vinesim.net.replication.streams import object_counts
from vinesim.net.server.admission import AdmissionControl, SceneId
from vinesim.net.server.journal import load_all
from vinesim.net.server.mesh_store import MeshStore
from vinesim.net.server.retained_store import Quota, RetainedStore
from vinesim.net.transport.bus import KEEP_ALL, Publisher
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import encode_sidecar
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import OBJECT_STRIDE
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose, HumanUpdate, RobotUpdate

ATTACKER = "evil"
WORLD = "vineyard"
HEIGHT = 1.75
"""Height of people [m]."""
DT = 0.01
CELLS = [(x, y) for x in range(-2, 2) for y in range(-2, 2)]
"""Cells around the origin."""
BOB = frames.pose([-1.5, -1.0, 0.0])
MAX_DRIFT = 0.1
"""Speed at which the body of an admitted actor may push a robot with a locked base, beyond the first metre [m/s]."""
HONEST_ERROR = 0.3
"""Largest accepted distance of the middle of the copy of ``bob`` from its true place [m]."""
FARTHEST = 2.0 * MAX_COORDINATE
"""Largest coordinate that an object may reach [m]: messages with coordinates beyond half of it are refused, and no
object is fast."""


class LawBroken(AssertionError):
    """An attack had an effect that it must not have."""


def small_vineyard() -> Model:
    """Returns a model of eight trees in two rows, every second one with berry clusters, and a box next to each of the
    first four."""
    trees = []
    for number in range(8):
        tree = TreeBuilder(frames.pose(np.array([0.8 * (number % 4) - 1.2, 1.5 - number // 4, 1.5])))
        tip = tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 4)[-1]
        tree.add_bunch(tip, 0.4, clusters=number % 2 == 1)
        trees.append(tree)
    boxes = np.array([frames.pose([0.8 * number - 1.2, 1.0, 0.001]) for number in range(4)])
    return assemble(trees, box_pose=boxes, box_size=np.tile([0.3, 0.2, 0.15], (4, 1)), box_mass=np.full(4, 1.0))


class FuzzWorld:
    """World with one client, one person, a store and an attacker. A context manager; see the module."""

    def __init__(self, *, is_stranger: bool = False, kind: str = "robot", seed: int = 0) -> None:
        """Start the world. ``is_stranger``: the attacker was never admitted, and no bus checks the names under which it
        sends; otherwise the attacker is admitted as ``kind``."""
        self.model = small_vineyard()
        self.now = 100.0
        self.is_stranger = is_stranger
        self.counts = object_counts(self.model)
        self.hub = MemoryHub(delay=0.005, seed=seed)
        self.hub.binds_names = not is_stranger
        self._folder = tempfile.TemporaryDirectory()
        self.store = RetainedStore(pathlib.Path(self._folder.name), Quota(1e9, 1e12))
        self.meshes = MeshStore()
        self.admission = AdmissionControl()
        self.robot = load_description("vinebot")
        self._declare_server()
        self._kind = kind
        scene = load_scene("demo")
        self.client = Client(
            scene,
            self.model,
            self.robot,
            self.hub.bus("ada"),
            name="ada",
            pose=frames.pose([0.0, 0.0, 0.0]),
            clock=lambda: self.now,
        )
        self.client.physics.wind = None
        self.ear = SoundRecorder(self.client, "ada")
        self.bob = FakeClient(
            self.hub.bus("bob"), self.model, (float(BOB[0]), float(BOB[1])), kind="human", digest=self.model.digest()
        )
        self.publishers: dict[str, Publisher] = {}
        self.greeting = b""
        self.description = b""
        self.threads = {thread for thread in threading.enumerate() if thread.is_alive()}
        self.bus = self.hub.bus(ATTACKER, live=False)
        self.run(0.5)
        self.admit(kind)
        self._home = self._base()

    def _declare_server(self) -> None:
        """Start what a server offers: a clock, snapshots, and a store, which accepts records from every sender."""
        self._server = self.hub.bus("server", live=False)
        self._server.subscribe("fact/**", KEEP_ALL)
        self._server.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], self.now))
        for x, y in CELLS:
            self._server.declare_queryable(
                f"snap/{x}/{y}", lambda _, cell=(x, y): self.store.snapshot(WORLD, [cell])[0][1]
            )
        self.store.open(WORLD, SceneId("demo", self.model.digest()))

    # ------------------------------------------------------------ the attacker

    def hello(self, kind: str = "robot", **values: object) -> Hello:
        """Returns a true greeting of the attacker, with the fields ``values`` replaced."""
        hello = Hello(
            ATTACKER,
            kind=kind,
            robot=self.robot.name,
            urdf=self.robot.urdf,
            sidecar=encode_sidecar(self.robot.base_limits, self.robot.groups),
            scene="demo",
            digest=self.model.digest(),
            joints=len(self.robot.joints) if kind == "robot" else 0,
        )
        return msgspec.structs.replace(hello, **values)

    def greet(self, hello: Hello | bytes, description: bytes = b"") -> None:
        """Leave the world as the attacker, and come back with this greeting. ``description``: of its robot, if
        ``hello`` is bytes."""
        if self.is_stranger:
            return
        self.greeting = hello if isinstance(hello, bytes) else encode_hello(hello)
        self.description = description if isinstance(hello, bytes) else encode_description(hello)
        self.admission.decide(WORLD, ATTACKER, "session", self.greeting, self.now)
        self.bus.close()
        self.step()
        self.bus = self.hub.bus(ATTACKER)
        self.bus.declare_queryable(f"hello/{ATTACKER}", lambda _: self.greeting)
        self.bus.declare_queryable(f"robot/{ATTACKER}", lambda _: self.description)
        self.publishers.clear()

    def admit(self, kind: str) -> None:
        """Come back with a true greeting and pose, unless the attacker has a body as an actor of this ``kind``
        already."""
        if self.is_stranger or (ATTACKER in self.client.remote_actors and self._kind == kind):
            return
        self._kind = kind
        self.greet(self.hello(kind))
        for _ in range(100):  # a client asks the server about a name twice a second
            if ATTACKER in self.client.remote_actors:
                break
            pose = self.pose(self.now)
            region = interest.region_chunks(interest.cell_of(pose.base_q, interest.REGION_SIZE))
            self.put(interest.POSE_LAYERS[0].key.format(region=region, actor=ATTACKER), encode_pose(pose))
            self.step()
        if ATTACKER not in self.client.remote_actors and kind != "spectator":
            raise LawBroken("an actor that greets and poses as it should gets no body")

    def put(self, key: str, payload: bytes) -> None:
        """Send a message as the attacker."""
        if key not in self.publishers:
            if len(self.publishers) > 10_000:
                self.publishers.clear()
            self.publishers[key] = self.bus.publisher(key, reliable=True)
        self.publishers[key].put(payload)

    def offer(self, payload: bytes) -> None:
        """Offer the server a part of a mesh as the attacker, or ask the server for one."""
        if len(payload) < 4 or payload[3] not in (MESH_PART, MESH_REQUEST):
            return
        try:
            if payload[3] == MESH_PART:
                part = decode_part(payload)
                encode_wanted(self.meshes.offer((WORLD, ATTACKER), part))
                encode_part(self.meshes.part(part.digest, part.offset))
            else:
                decode_request(payload)
        except MessageError:
            pass

    @property
    def name(self) -> str:
        """The attacker's name."""
        return ATTACKER

    def pose(self, now: float) -> RobotUpdate | HumanUpdate:
        """Returns a true pose of the attacker, who stands near the robot."""
        sway = 0.3 * np.sin(now)
        at = frames.pose([1.0 + sway, -0.5, 0.0])
        if self._kind == "human":
            return HumanUpdate(ATTACKER, now, standing_pose(at, HEIGHT), np.zeros((7, 6)))
        count = len(self.robot.joints)
        return RobotUpdate(ATTACKER, now, at, np.zeros(6), np.full(count, sway), np.zeros(count))

    # ------------------------------------------------------------ time

    def step(self) -> None:
        """Step client, person, attacker and server once."""
        self.hub.advance(DT)
        self.now += DT
        self.client.tick()
        self.bob.tick(self.now)
        for key, payload in self._server.poll():
            self.store.submit(f"{WORLD}/{key}", payload)

    def run(self, seconds: float) -> None:
        """Step for ``seconds`` [s] of simulated time."""
        for _ in range(round(seconds / DT)):
            self.step()

    # ------------------------------------------------------------ the laws

    def check(self) -> None:
        """Raise :class:`LawBroken` if a law does not hold."""
        for law in self.broken_laws():
            raise LawBroken(law)

    def broken_laws(self) -> Iterator[str]:
        """Yields a sentence for each law that does not hold now."""
        physics = self.client.physics
        client = self.client
        state = physics.state
        data = physics.rigid.mj_data
        if self.ear.blocks and not np.isfinite(self.ear.take()).all():
            yield "what the microphone hears is not finite"
        for name in ("joint_q", "joint_qd", "joint_x", "joint_xd"):
            if not np.isfinite(getattr(state, name)).all():
                yield f"{name} of the plants is not finite"
        if not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
            yield "the state of rigid bodies is not finite"
        tracked = [number for kind in (1, 2) for number in range(kind * OBJECT_STRIDE, kind * OBJECT_STRIDE + 8)]
        places = [physics.support_tracker.object_state(n)[0][:3] for n in tracked if n in physics.support_tracker]
        if np.abs(places).max() > FARTHEST or np.abs(state.joint_x[state.body_cut]).max(initial=0.0) > FARTHEST:
            yield "an object is farther away than any message can say"
        rank = np.arange(len(self.model.body_tree)) - self.model.tree_first[self.model.body_tree]
        if (state.body_cut & (rank >= self.model.tree_core[self.model.body_tree])).any():
            yield "a berry cluster was cut off its bunch"
        for replicator in (*client.replicators.values(), self.bob.replicator):
            for number in replicator.known:
                if not self._is_object(number):
                    yield f"object {number} is known, and there is none"
                record = replicator.record(number)
                if record is not None and (wrong := self._contradiction(record)):
                    yield wrong
        allowed = {"bob"} if self.is_stranger else {"bob", ATTACKER}
        if not client.remote_actors.keys() <= allowed:
            yield f"actors {sorted(client.remote_actors)} have bodies, allowed are {sorted(allowed)}"
        yield from self._harms()
        yield from self._faults_of_threads()

    def _harms(self) -> Iterator[str]:
        """Yields a sentence for each harm that the attacker has done to other actors."""
        client = self.client
        if "bob" not in client.remote_actors:
            yield "the copy of another person has vanished"
        else:
            copy = client.physics.rigid.human("bob").part_poses[:, :2]
            true = self._points_of_bob()
            away = float(np.linalg.norm(copy.mean(0) - true, axis=-1).max())
            if away > HONEST_ERROR:
                yield f"the copy of another person is {away:.3f} m away from where it is"
        if abs(client.replicator.offset) > 0.1:
            yield f"the network clock was moved by {client.replicator.offset:.3g} s"
        moved = float(np.linalg.norm(self._base()[:3] - self._home[:3]))
        if moved > 1.0 + MAX_DRIFT * client.physics.time:  # an admitted actor may lean on a robot
            yield f"the robot was moved by {moved:.3g} m"

    def _faults_of_threads(self) -> Iterator[str]:
        """Yields a sentence for threads that have ended, and for errors that threads have counted."""
        store = self.store
        if dead := sorted(thread.name for thread in self.threads if not thread.is_alive()):
            yield f"threads have ended: {', '.join(dead)}"
        if store.status_message or store.counters.errors:
            yield f"the store of the server: {store.status_message or 'an error in a message'}"

    def check_store(self) -> None:
        """Close the store. Raises :class:`LawBroken` unless a server that starts from the store's journals has the same
        records."""
        kept = {cell: self.store.snapshot(WORLD, [cell]) for cell in self.store.cells(WORLD)}
        self.store.close()
        self.check_closed_store()
        journals = load_all(pathlib.Path(self._folder.name))
        found = journals[WORLD].state if WORLD in journals else None
        for cell, parts in kept.items():
            known = [record for _, payload in parts for record in decode_records(payload)]
            if found is None or found.in_cell(cell) != known:
                raise LawBroken(f"the journal has other records of cell {cell} than the store had")

    def check_closed_store(self) -> None:
        """Raise :class:`LawBroken` if a law about the store does not hold, for a store that was closed."""
        if self.store.status_message or self.store.counters.errors:
            raise LawBroken(f"the store of the server: {self.store.status_message or 'an error in a message'}")

    def _is_object(self, number: int) -> bool:
        try:
            check_object_id(number, self.counts)
        except MessageError:
            return False
        return True

    def _contradiction(self, record: RetainedRecord) -> str:
        try:
            check_record(record, self.model, self.counts)
        except MessageError as error:
            return f"a record is believed that the model forbids: {error}"
        return ""

    def _points_of_bob(self) -> np.ndarray:
        pose = self.bob.pose(self.now)
        assert isinstance(pose, HumanUpdate)
        return pose.pose.points[4, :2]

    def _base(self) -> np.ndarray:
        return self.client.physics.rigid.base_state("ada")[0]

    def close(self) -> None:
        """End all threads and remove all files."""
        self.client.meshes.close()
        self.store.close()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def human_at(place: np.ndarray) -> HumanPose:
    """Returns the pose of a person who stands at ``place`` [7] m, 1."""
    return standing_pose(place, HEIGHT)
