"""Bodies of remote actors: none while they are far away, one before they are within reach, none again afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.support.crowd_clients import yard
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.net.replication import interest
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.scene.spec import load_scene

DT = 0.01
HEIGHT = 1.75
pytestmark = pytest.mark.slow


class World:
    """A client that stands at the origin, and others that are where :attr:`places` says, along x."""

    def __init__(self) -> None:
        self.hub = MemoryHub(delay=0.02, seed=3)
        self.now = 100.0
        self.model = yard(1, 1.2)
        self.places: dict[str, float] = {}
        self.clients: dict[str, Client] = {}

    def join(self, name: str, x: float, robot: str = "") -> Client:
        self.places[name] = x
        client = Client(
            load_scene("demo"),
            self.model,
            load_description(robot) if robot else None,
            self.hub.bus(name),
            name=name,
            pose=frames.pose([x, 5.0, 0.0]),
            source=None if robot else lambda _: standing_pose(frames.pose([self.places[name], 5.0, 0.0]), HEIGHT),
            clock=lambda: self.now,
        )
        client.physics.wind = None
        self.clients[name] = client
        return client

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            for client in self.clients.values():
                client.tick()
            self.hub.advance(DT)
            self.now += DT


def test_a_person_far_away_is_a_point_and_has_a_body_before_it_is_within_reach():
    world = World()
    ada = world.join("ada", 0.0)
    world.join("bob", 200.0)
    world.run(2.5)
    assert ada.remote_actors == {}
    np.testing.assert_allclose(ada.far_actors()["bob"][:2], [200.0, 5.0], atol=0.1)
    assert "bob" not in ada.physics.rigid.actors
    assert not ada.is_alone
    before = ada.replicator.bus.bytes_in
    world.run(4.0)
    assert ada.replicator.bus.bytes_in - before <= 4.0 * 40.0
    world.places["bob"] = 30.0
    world.run(2.5)
    assert ada.remote_actors == {}
    with_body = {}
    while world.places["bob"] > 9.0:
        world.places["bob"] -= 3.0 * DT
        world.run(DT)
        with_body[world.places["bob"]] = "bob" in ada.remote_actors
    first = max(place for place, has in with_body.items() if has)
    assert first > 18.0
    assert all(has for place, has in with_body.items() if place <= first)
    assert ada.far_actors() == {}
    assert "bob" in ada.physics.contact_solver.remote_actors
    world.places["bob"] = 60.0
    world.run(2.5)
    assert ada.remote_actors == {}
    assert "bob" not in ada.physics.rigid.actors
    assert "bob" not in ada.physics.contact_solver.remote_actors
    assert ada.far_actors().keys() == {"bob"}
    world.places["bob"] = 4.0
    world.run(0.5)
    assert ada.remote_actors.keys() == {"bob"}


def test_the_urdf_of_a_robot_is_asked_for_only_when_it_comes_near(monkeypatch):
    world = World()
    ada = world.join("ada", 0.0)
    asked = []
    query = ada.replicator.bus.query
    monkeypatch.setattr(
        ada.replicator.bus,
        "query",
        lambda key, payload=b"": (asked.append(key) if key.startswith("robot/") else None, query(key, payload))[1],
    )
    bob = world.join("bob", 60.0, robot="logistic")
    world.run(1.0)
    assert asked == []
    assert ada.replicator.peers["bob"].urdf == ""
    bob.physics.rigid.place_robot("bob", frames.pose([15.0, 5.0, 0.0]), bob.robot.update(0.0).position)
    world.run(1.0)
    assert ada.remote_actors.keys() == {"bob"}
    assert asked == ["robot/bob"]
    assert interest.BODY_DISTANCE > 15.0
