"""``python -m benchmarks shared_harvest``: two clients prune, pick, tie and bend one vine for minutes, a third joins
half-way, and a recorder writes everything. Is the state of all equal by hash, and is a replay equal to the bit?

Real clients with physics over a bus in memory with delay, jitter and loss, in simulated time. The work is done by
command and by blades at the places where it is wanted, every few seconds, by a seeded random choice; nobody walks.
"""

from __future__ import annotations

import functools
import json
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from vinesim.client.client import Client
from vinesim.client.recording.recorder import Recorder
from vinesim.client.recording.replay import ReplayBus
from vinesim.client.recording.state_digest import StateDigest, lasting_digest, lasting_parts
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.net.codec.control import decode_records, decode_time, encode_records, encode_time
from vinesim.net.recording.mcap_reader import read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.values import Measurement

DT = 0.01
"""[s] Step of all clients."""
DELAY = 0.02
JITTER = 0.005
"""[s] From client to client, one way, and its spread."""
LOSS = 0.01
"""[1] Share of messages that may be lost."""
QUIET = 20.0
"""[s] Longest time after the work until everything is at rest."""
LONGEST_BEND = 60
"""Number of steps for which an actor pushes a cane at most."""
PLACES = {"ada": (0.0, -1.5), "bob": (1.0, -1.5), "carl": (0.5, 1.5)}
"""[m] Where the people stand."""


def small_vineyard(scene: str) -> Model:
    """Returns one vine of a scene whose canes can break, also those of dormant scenes, which have no strength."""
    spec = load_scene(scene)
    model = generate(msgspec.structs.replace(spec, layout=msgspec.structs.replace(spec.layout, rows=1, vines=1)))
    endless = (model.body_organ == int(Organ.CANE)) & (model.body_strength == 0.0)
    model.body_strength[endless] = 60e6
    model.body_yield_strength[endless] = 45e6
    return model


class SharedVine:
    """Clients of one vine on one bus in memory, with a server of retained records and a recorder."""

    def __init__(self, scene: str, seed: int, file: pathlib.Path) -> None:
        self.scene = load_scene(scene)
        self.model = small_vineyard(scene)
        self.now = 1000.0
        self.clients: dict[str, Client] = {}
        self.done: dict[str, int] = {}
        """Number of pieces of work, by kind."""
        self._random = np.random.default_rng(seed)
        self._hub = MemoryHub(delay=DELAY, jitter=JITTER, loss=LOSS, seed=seed)
        self._server = self._hub.bus("server")
        self._records = RetainedState()
        self._server.subscribe("fact/**", KEEP_ALL)
        self._server.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], self.now))
        for x in range(-4, 6):
            for y in range(-4, 6):
                self._server.declare_queryable(f"snap/{x}/{y}", functools.partial(self._reply, (x, y)))
        self.recording = RecordingWriter(file, {"world": "memory"})
        self._recorder = Recorder(self._hub.bus("recorder", live=False), self.recording, clock=lambda: self.now)
        self._bent: list[tuple[str, int, int]] = []

    def _reply(self, cell: tuple[int, int], _: bytes) -> bytes:
        return encode_records(self._records.in_cell(cell))

    def join(self, name: str) -> Client:
        """A person joins, who stands beside the vine."""
        stand = frames.pose([*PLACES[name], 0.0], frames.from_yaw(0.5 * np.pi))
        pose = standing_pose(stand)
        client = Client(
            self.scene,
            self.model,
            None,
            self._hub.bus(name),
            name=name,
            pose=stand,
            source=lambda _: pose,
            clock=lambda: self.now,
        )
        client.physics.wind = None
        self.clients[name] = client
        return client

    def run(self, seconds: float) -> None:
        """Let the clients make their steps."""
        for _ in range(round(seconds / DT)):
            for client in self.clients.values():
                client.tick()
            for key, payload in self._server.poll():
                _, x, y, _ = key.split("/")
                for record in decode_records(payload):
                    self._records.merge((int(x), int(y)), record)
            self._recorder.step()
            self._hub.advance(DT)
            self.now += DT

    def is_quiet(self) -> bool:
        """Returns whether nothing moves or has an owner."""
        return not any(c.objects.moving or c.replicator.owned for c in self.clients.values())

    # ------------------------------------------------------------------ work

    def work(self, name: str) -> None:
        """One person does one piece of work, whatever is possible."""
        kinds: list[Callable[[Client], bool]] = [
            self._cut,
            self._notch,
            self._pick,
            self._tie,
            self._untie,
            self._take_leaves,
            self._bend,
        ]
        for k in self._random.permutation(len(kinds)).tolist():
            if kinds[k](self.clients[name]):
                kind = kinds[k].__name__.strip("_")
                self.done[kind] = self.done.get(kind, 0) + 1
                return

    def _cane(self, client: Client) -> int:
        """Returns a segment of a cane that still hangs on its vine; -1 if there is none."""
        state = client.physics.state
        parts = client.physics.plants
        whole = (self.model.body_organ == int(Organ.CANE)) & (parts.body_start == 0.0)
        free = np.flatnonzero(whole & ~state.body_cut & (parts._root < 0))
        return int(self._random.choice(free)) if len(free) else -1

    def _cut(self, client: Client) -> bool:
        body = self._cane(client)
        if body < 0 or self._random.random() < 0.5:  # so that something is left to the end
            return False
        length = float(self.model.body_length[body])
        client.physics.cut(body, round(self._random.uniform(0.2, 0.8) * length / PLACE_STEP) * PLACE_STEP)
        return True

    def _notch(self, client: Client) -> bool:
        body = self._cane(client)
        if body < 0:
            return False
        physics = client.physics
        physics.update_kinematics()
        pose = physics.state.body_q[body].astype(float)
        length = float(self.model.body_length[body])
        place = frames.compose(pose, frames.pose([self._random.uniform(0.2, 0.8) * length, 0.0, 0.0]))[:3]
        turn = frames.normalize(frames.multiply(pose[3:], frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))))
        link = next(link for actor, link in physics.rigid.owners.values() if actor == client.name)
        here = frames.compose(frames.inverse(physics.rigid.link_pose(client.name, link)), frames.pose(place, turn))
        thick = 2.0 * float(self.model.body_radius[body, 0])
        weak = self._random.uniform(0.5, 0.9) * 0.25 * np.pi * thick**2 * physics.parameters.cutting_strength
        blade = physics.add_blade(client.name, link, here, np.array([0.02, 0.01, 0.004]), force=weak, speed=0.5)
        blade.close()
        return True

    def _pick(self, client: Client) -> bool:
        hanging = np.flatnonzero(client.physics.state.bunch_attached)
        if len(hanging) == 0:
            return False
        client.physics.pick(int(self._random.choice(hanging)))
        return True

    def _tie(self, client: Client) -> bool:
        body = self._cane(client)
        if body < 0:
            return False
        client.physics.update_kinematics()
        there = client.physics.state.body_q[body, :3].astype(float) + self._random.uniform(-0.03, 0.03, 3)
        try:
            client.physics.tie(body, 0.5 * float(self.model.body_length[body]), there, client.name)
        except ValueError:  # tied in two places already
            return False
        return True

    def _untie(self, client: Client) -> bool:
        handwork = client.physics.handwork
        bound = [tie for tie in handwork.ties.values() if not tie.is_open and not tie.is_pulling]
        if bound and self._random.random() < 0.5:
            handwork.open(bound[int(self._random.integers(len(bound)))], client.name)
            return True
        left = np.flatnonzero(~client.physics.state.tie_broken)
        if len(left) == 0:
            return False
        handwork.untie(int(self._random.choice(left)), client.name)
        return True

    def _take_leaves(self, client: Client) -> bool:
        body = self._cane(client)
        return body >= 0 and client.physics.take_leaves(client.physics.handwork.leaves_on(body), client.name) > 0

    def _bend(self, client: Client) -> bool:
        """Push a cane across the row, harder and harder, until its wood gives."""
        body = self._cane(client)
        if body < 0:
            return False
        plants = client.physics.plants
        tree = int(self.model.body_tree[body])
        here = self.model.bodies_of(tree)
        before = float(client.physics.state.joint_flow[here].sum())
        cut = int(client.physics.state.body_cut[here].sum())
        for k in range(LONGEST_BEND):
            plants.wake(tree)
            plants.body_load[body, 1] = 2.0 * k
            self.run(DT)
            state = client.physics.state
            if state.joint_flow[here].sum() != before or state.body_cut[here].sum() != cut:
                break
        plants.body_load[body, 1] = 0.0
        return True


def replayed(scene: Scene, model: Model, file: pathlib.Path) -> tuple[str, str]:
    """Let a spectator replay a recording. Returns the digest of all its states, and that of the lasting changes to
    plants in its last state (:func:`lasting_digest`)."""
    bus = ReplayBus(read_recording(file), "viewer")
    pose = frames.pose([0.5, -2.0, 1.6], frames.IDENTITY)
    client = Spectator(scene, model, None, bus, name="viewer", pose=pose, clock=lambda: bus.time)
    client.physics.wind = None
    digest = StateDigest()
    while not bus.ended:
        bus.play(DT)
        client.tick()
        digest(client)
    return digest.hexdigest(), lasting_digest(client.physics)


def shared_harvest(
    scene: str, minutes: float, period: float, seed: int, replays: int, announce: Callable[[str], None]
) -> Iterator[Measurement]:
    """Work for ``minutes`` of simulated time, a piece every ``period`` [s] by each of two people in turn."""
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "work.mcap"
        vine = SharedVine(scene, seed, file)
        start = vine.now
        for name in ("ada", "bob"):
            vine.join(name)
        vine.run(1.0)
        number = 0
        while vine.now < start + 60.0 * minutes:
            if "carl" not in vine.clients and vine.now >= start + 30.0 * minutes:
                vine.join("carl")
            vine.work(("ada", "bob")[number % 2])
            vine.run(period)
            number += 1
            if number % 20 == 0:
                spent = time.process_time() - begun
                announce(
                    f"{vine.now - start:.0f} s simulated, {spent:.0f} s of processor time, {json.dumps(vine.done)}"
                )
        end = vine.now + QUIET
        while vine.now < end and not vine.is_quiet():
            vine.run(0.5)
        moving = sorted({number for c in vine.clients.values() for number in c.objects.moving})
        vine.run(1.0)
        vine.recording.close()
        clients = list(vine.clients.values())
        parts = [lasting_parts(client.physics) for client in clients]
        differ = sorted({name for other in parts[1:] for name in other if other[name] != parts[0][name]})
        poses = [client.physics.snapshot().body_q[:, :3] for client in clients]
        apart = max(float(np.abs(other - poses[0]).max()) for other in poses[1:])
        announce(
            f"digests: {[lasting_digest(client.physics) for client in clients]}; differ: {differ}; moving: {moving}"
        )
        case = f"{scene}, {minutes:g} min, seed {seed}"
        for kind, count in sorted(vine.done.items()):
            yield Measurement("shared_harvest", f"{case}: {kind}", count, "pieces of work")
        yield Measurement("shared_harvest", f"{case}: lasting parts that differ", len(differ), "parts")
        yield Measurement("shared_harvest", f"{case}: objects that still move", len(moving), "objects")
        yield Measurement("shared_harvest", f"{case}: largest distance of bodies of plants", 1e3 * apart, "mm")
        yield Measurement("shared_harvest", f"{case}: recording", 1e-6 * file.stat().st_size, "MB")
        if replays:
            digests = [replayed(vine.scene, vine.model, file) for _ in range(replays)]
            lasting = lasting_digest(clients[0].physics)
            yield Measurement(
                "shared_harvest", f"{case}: different runs of replays", len({d for d, _ in digests}), "runs"
            )
            wrong = sum(found != lasting for _, found in digests)
            yield Measurement("shared_harvest", f"{case}: replays that differ for good", wrong, "replays")
        yield Measurement("shared_harvest", f"{case}: processor time", time.process_time() - begun, "s")
