"""Two people of different clients hold one bunch: both simulations agree where it is and with which forces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from tests.support.long_rows import long
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import HAND_HALF_THICKNESS, standing_pose
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose

pytestmark = pytest.mark.slow

DT = 0.01
RADIUS = 0.04
"""Of the bunch [m]."""

HAND_STIFFNESS = 100.0
"""[N/m]"""


class TwoHands:
    """A person on either side of a hanging bunch, each of a client of its own; the first is at the side of -y."""

    def __init__(self, delay: float, *, jitter: float = 0.0, loss: float = 0.0) -> None:
        self.now = 100.0
        self.hub = MemoryHub(delay=delay, jitter=jitter, loss=loss, seed=3)
        self.hub.bus("server").declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], self.now))
        scene = load_scene("demo")
        self.model, self.body, self.rest = bunch_scene(0.5)
        self.model.bunch_pull[:] = self.model.bunch_bend[:] = 1e6
        self.hands = {"ada": -1.0, "bob": 1.0}
        self.at = {name: side * (RADIUS + HAND_HALF_THICKNESS + 0.1) for name, side in self.hands.items()}
        self.raised = 0.0
        self.closed = dict.fromkeys(self.hands, False)
        self.clients = {name: self._join(scene, name, side) for name, side in self.hands.items()}

    def _join(self, scene, name: str, side: float) -> Client:
        place = frames.pose([self.rest[0], self.rest[1] + 0.7 * side, 0.0], frames.from_yaw(-side * 0.5 * np.pi))
        stand = standing_pose(place)
        palm = frames.multiply(frames.from_yaw(-side * 0.5 * np.pi), frames.exp(np.array([0.0, -0.5 * np.pi, 0.0])))

        def pose(_: float) -> HumanPose:
            there = self.rest + np.array([0.0, self.at[name], 0.0])
            right = frames.pose((1.0 - self.raised) * stand.right[:3] + self.raised * there, palm)
            return dataclasses.replace(stand, right=right, right_closed=self.closed[name])

        client = Client(
            scene, self.model, None, self.hub.bus(name), name=name, pose=place, source=pose, clock=lambda: self.now
        )
        client.physics.wind = None
        return client

    def run(self, seconds: float) -> np.ndarray:
        """Step both clients; way of the bunch along y on both [step, client] m."""
        rows = []
        for _ in range(round(seconds / DT)):
            for client in self.clients.values():
                client.tick()
            self.hub.advance(DT)
            self.now += DT
            rows.append([self.middle(client)[1] - self.rest[1] for client in self.clients.values()])
        return np.array(rows)

    def move(self, name: str, y: float, seconds: float) -> np.ndarray:
        """Move one hand to ``y`` [m] from the bunch's place at rest."""
        rows = []
        for at in np.linspace(self.at[name], y, round(seconds / DT) + 1)[1:]:
            self.at[name] = float(at)
            rows.append(self.run(DT))
        return np.concatenate(rows)

    def pull_apart(self, ada: float, bob: float, seconds: float = 1.0) -> None:
        """Both hands move outwards at once, by these ways [m]."""
        start = dict(self.at)
        for share in np.linspace(0.0, 1.0, round(seconds / DT) + 1)[1:]:
            self.at = {"ada": start["ada"] - share * ada, "bob": start["bob"] + share * bob}
            self.run(DT)

    def grasp(self) -> None:
        """Both hands close on the bunch, ada's first."""
        for self.raised in np.linspace(0.0, 1.0, 200):
            self.run(DT)
        for name, side in self.hands.items():
            self.move(name, side * (RADIUS + HAND_HALF_THICKNESS + 0.01), 1.0)
            self.closed[name] = True
            self.run(0.5)
            assert self.clients[name].physics.hand(name, "right").held is not None

    def middle(self, client: Client) -> np.ndarray:
        client.physics.update_kinematics()
        pose = client.physics.state.body_q[self.body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([0.085, 0.0, 0.0]))

    def force(self, name: str) -> np.ndarray:
        """Force of a person's hand [3] N."""
        return self.clients[name].physics.hand(name, "right").force

    def force_bytes(self) -> int:
        return sum(client.replicator.counters.force.bytes_out for client in self.clients.values())


@pytest.mark.parametrize(("delay", "jitter", "loss"), [(0.05, 0.02, 0.02), *long((0.0, 0.0, 0.0), (0.1, 0.04, 0.04))])
def test_two_equal_pulls_leave_the_bunch_in_the_middle_on_both_clients(delay, jitter, loss):
    """F69, F93: both pull with 10 N. Each client alone would show the bunch 5 cm off to its own side."""
    world = TwoHands(delay, jitter=jitter, loss=loss)
    world.grasp()
    world.pull_apart(0.1, 0.1)
    way = world.run(3.0)
    assert np.abs(way[-1]).max() < 1e-3, "in the middle"
    assert np.abs(way[:, 0] - way[:, 1]).max() < 6e-3, "while they move"
    assert np.abs(way[-100:, 0] - way[-100:, 1]).max() < 5e-4, "and at rest"
    assert np.ptp(way[-100:], axis=0).max() < 1e-3, "nothing oscillates"
    first, second = (world.force(name)[1] for name in world.hands)
    assert first == pytest.approx(-0.1 * HAND_STIFFNESS, rel=0.02)
    assert second == pytest.approx(-first, rel=0.01), "the second feels what the first pulls"
    if loss:
        assert np.abs(world.run(8.0) - way[-1]).max() < 5e-4, "no pull ends because messages of it were lost"
    owners = {client.replicator.owner(0) for client in world.clients.values()}
    assert len(owners) == 1
    assert owners < set(world.hands)


@pytest.mark.long
@pytest.mark.parametrize("delay", [0.1, *long(0.0)])
def test_of_two_pulls_the_stronger_wins_on_both_clients(delay):
    world = TwoHands(delay)
    world.grasp()
    world.pull_apart(0.2, 0.1)
    way = world.run(4.0)
    assert way[-1].max() < -0.02, "towards the stronger"
    assert abs(way[-1, 0] - way[-1, 1]) < 1e-3
    assert np.ptp(way[-50:], axis=0).max() < 3e-3
    assert np.ptp(way[-100:], axis=0).max() < np.ptp(way[:100], axis=0).max(), "no growth"


def test_one_hand_sends_no_force_and_the_last_of_two_ends_the_messages():
    world = TwoHands(0.02)
    for world.raised in np.linspace(0.0, 1.0, 150):
        world.run(DT)
    world.move("ada", -(RADIUS + HAND_HALF_THICKNESS + 0.01), 0.5)
    world.closed["ada"] = True
    world.move("ada", -0.15, 1.0)
    assert world.clients["bob"].replicator.owner(0) == "ada"
    assert world.force_bytes() == 0
    # bob pushes against the bunch that ada holds
    world.move("bob", world.middle(world.clients["bob"])[1] - world.rest[1] + RADIUS, 1.0)
    assert world.force_bytes() > 0
    assert world.clients["ada"].couplings.trees == {0}
    world.move("bob", 0.3, 0.5)
    world.run(0.3)
    sent = world.force_bytes()
    world.run(0.5)
    assert world.force_bytes() == sent
    for client in world.clients.values():
        assert client.couplings.trees == set()
        assert not client.physics.contact_solver.trees_touched_by_copies[0] or client.name == "bob"


@pytest.mark.long
def test_the_other_pull_ends_when_its_client_falls_silent():
    """A client that crashes while it pulls lets go within a fifth of a second."""
    world = TwoHands(0.02)
    world.grasp()
    world.pull_apart(0.1, 0.1)
    world.run(1.0)
    owner = next(name for name in world.hands if world.clients[name].replicator.owner(0) == name)
    world.clients = {owner: world.clients[owner]}
    world.run(0.25)
    assert world.clients[owner].couplings.trees == set()
