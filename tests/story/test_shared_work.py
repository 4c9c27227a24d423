"""Two clients and a late one after picks, cuts, cuts in part, breaks, ties and leaf removal: equal by hash."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import time
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.shared_harvest import replayed, small_vineyard
from tests.support.live_server import ServerProcess
from tests.support.long_rows import long
from tests.support.shared_vineyard import DT, World
from vinesim.client.client import Client
from vinesim.client.recording.recorder import Recorder
from vinesim.client.recording.state_digest import lasting_digest, lasting_parts
from vinesim.core import frames
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene import spec as scenes
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP

pytestmark = pytest.mark.slow


@dataclasses.dataclass
class Worker:
    """One client's actor, who works on plants at once where it is told: with blades, hands and commands."""

    client: Client

    @property
    def physics(self):
        return self.client.physics

    def notch(self, body: int, share: float = 0.45) -> None:
        """Begin to close a blade around a segment; :meth:`let_go` opens it when it is deep enough."""
        physics = self.physics
        physics.update_kinematics()
        model = physics.model
        at = share * float(model.body_length[body])
        pose = physics.state.body_q[body].astype(float)
        place = pose[:3] + frames.rotate(pose[3:], np.array([at, 0.0, 0.0]))
        turn = frames.multiply(pose[3:], frames.exp(np.array([0.0, 0.5 * np.pi, 0.0])))  # its z along the wood
        mouth = frames.pose(place, frames.normalize(turn))
        link = physics.rigid.link_pose(self.client.name, "hand")
        here = frames.compose(frames.inverse(link), mouth)
        thick = 2.0 * float(model.body_radius[body, 0])
        strength = physics.parameters.cutting_strength
        weak = 0.8 * 0.25 * np.pi * thick**2 * strength
        blade = physics.add_blade(self.client.name, "hand", here, np.array([0.02, 0.01, 0.004]), force=weak, speed=0.5)
        blade.close()


def canes_by_tree(model: Model, least: int = 5) -> list[np.ndarray]:
    """The cane segments of each tree that has some, without side shoots."""
    found = []
    for tree in range(len(model.tree_first)):
        here = model.bodies_of(tree)
        bodies = here.start + np.flatnonzero(model.body_organ[here] == int(Organ.CANE))
        if len(bodies) >= least:
            found.append(bodies)
    return found


def work(world: World, ada: Worker, bob: Worker) -> None:
    """The first half: both work on trees of their own and on shared ones."""
    model = ada.physics.model
    trees = canes_by_tree(model)
    a, b, c, d, e = (trees[k] for k in (1, 3, 5, 7, 8))
    for worker, bodies in ((ada, a), (bob, b)):
        worker.notch(int(bodies[2]))
        length = float(model.body_length[bodies[3]])
        worker.physics.cut(int(bodies[3]), round(0.5 * length / PLACE_STEP) * PLACE_STEP)
    world.run(0.3)
    # both work on one tree at once
    ada.physics.handwork.untie(int(np.flatnonzero(np.isin(model.tie_body, c))[0]), "ada")
    bob.notch(int(c[1]), 0.3)
    bob.physics.take_leaves(np.flatnonzero(np.isin(model.leaf_body, c[:3])), "bob")
    ada.physics.take_leaves(np.flatnonzero(np.isin(model.leaf_body, c[3:5])), "ada")
    world.run(0.5)
    pose = ada.physics.snapshot().body_q
    for worker, bodies in ((ada, d), (bob, e)):
        body = int(bodies[2])
        worker.physics.tie(body, 0.01, pose[body, :3] + np.array([0.0, 0.02, 0.0]), worker.client.name)
    for worker, bunch in ((ada, 0), (bob, 3)):
        if bunch < len(model.bunch_body):
            worker.physics.pick(bunch)
    world.run(1.0)


def more_work(world: World, ada: Worker, bob: Worker) -> None:
    """The second half: a tie is opened again, a cane is bent until it gives, a bunch is picked."""
    model = ada.physics.model
    trees = canes_by_tree(model)
    opened = next(t for t in ada.physics.handwork.ties.values() if t.actor == "ada")
    bob_knows = bob.physics.handwork.ties[opened.segment, opened.steps]
    bob.physics.handwork.open(bob_knows, "bob")
    bend(world, ada, int(trees[10][len(trees[10]) // 2]))
    if len(model.bunch_body) > 6:
        bob.physics.pick(6)
    world.run(0.5)


def bend(world: World, worker: Worker, body: int) -> None:
    """Push a cane across the row, harder and harder, until its wood keeps a set or breaks."""
    plants = worker.physics.plants
    tree = int(worker.physics.model.body_tree[body])
    force = 0.0
    here = worker.physics.model.bodies_of(tree)
    state = worker.physics.state
    cut = state.body_cut[here].copy()
    while not state.joint_flow[here].any() and (state.body_cut[here] == cut).all() and force < 400.0:
        force += 2.0
        plants.wake(tree)
        plants.body_load[body, 1] = force
        world.run(0.01)
    plants.body_load[body, 1] = 0.0
    assert state.joint_flow[here].any() or (state.body_cut[here] != cut).any()


def is_quiet(world: World) -> bool:
    return not any(c.objects.moving or c.replicator.owned for c in world.clients.values())


def differing(one: Client, other: Client) -> list[str]:
    here, there = (lasting_parts(client.physics) for client in (one, other))
    return [name for name in here if here[name] != there[name]]


@pytest.mark.parametrize("scene", ["winter_spur", *long("vsp")])
def test_two_clients_and_a_late_one_agree_by_hash_and_a_replay_to_the_bit(scene: str, tmp_path: pathlib.Path):
    world = World(small_vineyard(scene))
    world.server.bus.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], 1000.0 + world.now))
    ada, bob = (Worker(world.join(name, x, -2.0)) for name, x in (("ada", 0.5), ("bob", 1.5)))
    file = tmp_path / "work.mcap"
    recording = RecordingWriter(file, {"world": "memory"})
    recorder = Recorder(world.hub.bus("recorder", live=False), recording, clock=lambda: world.now)
    run = world.run

    def recorded_run(seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            run(DT)
            recorder.step()

    world.run = recorded_run
    world.until(lambda: "ada" in bob.client.remote_actors and "bob" in ada.client.remote_actors, 1.0)
    work(world, ada, bob)
    carl = world.join("carl", 1.0, 2.0)
    world.until(lambda: "ada" in carl.remote_actors, 5.0)
    world.run(0.5)
    more_work(world, ada, bob)
    world.until(lambda: is_quiet(world), 60.0)
    world.run(1.0)
    clients = [ada.client, bob.client, carl]
    state = ada.physics.state
    assert len(ada.physics.plants.stumps.table) >= 2
    assert (state.notch_depth > 0.2).sum() >= 2
    assert state.tie_broken.any()
    assert (state.joint_flow > 0.0).any()
    assert {tie.is_open for tie in ada.physics.handwork.ties.values()} == {False, True}
    assert state.leaf_off.any() == (len(state.leaf_off) > 0)
    assert (~state.bunch_attached).sum() == (3 if len(state.bunch_attached) else 0)
    for client in clients[1:]:
        assert differing(ada.client, client) == []
        apart = client.physics.snapshot().body_q[:, :3] - ada.physics.snapshot().body_q[:, :3]
        assert np.abs(apart).max() < 5e-3
    assert len({lasting_digest(client.physics) for client in clients}) == 1
    recording.close()
    digests = {replayed(world.scene, world.model, file) for _ in range(2)}
    assert len(digests) == 1
    assert {lasting for _, lasting in digests} == {lasting_digest(ada.physics)}


class ZenohWorld(World):
    """The same clients over real Zenoh, with a server in a process of its own, in real time."""

    def __init__(self, model: Model, endpoint: str) -> None:
        self.model = model
        self.scene = scenes.load_scene("demo")
        self.clients = {}
        self.hub = SimpleNamespace(
            bus=lambda name: self.opened.enter_context(ZenohBus(name, connect=endpoint)), advance=lambda _: None
        )
        self.server = SimpleNamespace(tick=lambda: None)
        self.opened = contextlib.ExitStack()

    @property
    def now(self) -> float:
        return time.monotonic()

    @now.setter
    def now(self, _: float) -> None:
        """Real time passes alone."""


@pytest.mark.long
def test_clients_over_zenoh_agree_by_hash():
    with ServerProcess("tcp/127.0.0.1:0") as server:
        world = ZenohWorld(small_vineyard("winter_spur"), server.endpoint)
        with world.opened:
            ada, bob = (Worker(world.join(name, x, -2.0)) for name, x in (("ada", 0.5), ("bob", 1.5)))
            world.until(lambda: "ada" in bob.client.remote_actors and "bob" in ada.client.remote_actors, 60.0)
            work(world, ada, bob)
            carl = world.join("carl", 1.0, 2.0)
            world.until(lambda: "ada" in carl.remote_actors, 60.0)
            world.until(lambda: len(bob.physics.handwork.ties) == 2, 60.0)
            more_work(world, ada, bob)
            world.until(lambda: is_quiet(world), 120.0)
            world.until(lambda: not any(differing(ada.client, other) for other in (bob.client, carl)), 60.0)
            assert (ada.physics.state.notch_depth > 0.2).sum() >= 2
            assert len(ada.physics.plants.stumps.table) >= 2
