"""A robot is killed while it carries a box and a bunch: both lie on the ground on all clients, near or late."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import BOX, BUNCH, DT, REACH, World, bytes_sent, pose_of, position_difference, put
from vinesim.client.client import Client
from vinesim.core import frames

pytestmark = pytest.mark.slow

CARRIED = (BOX(1), BUNCH(0))
ON_GROUND = 0.3
"""[m] The origin of a bunch or box on the ground is below this."""


def base_of(client: Client) -> np.ndarray:
    return client.physics.rigid.base_state(client.name)[0]


def at_rest(world: World) -> bool:
    return not any(client.objects.moving or client.replicator.owned for client in world.clients.values())


def load(world: World, ada: Client) -> None:
    """Put a box on the deck of ada and a bunch between the fingers of its hand; until both are at rest there."""
    tracker = ada.physics.support_tracker
    ada.physics.pick(0)
    hand = frames.compose(base_of(ada), frames.pose([REACH - 0.07, 0.0, 0.95]))
    put(ada, BOX(1), frames.compose(base_of(ada), frames.pose([0.0, 0.0, 0.253])))
    ada.robot.command_position(np.array([0.0, 0.07, 0.07]))
    for _ in range(50):  # rising, so that it does not count as at rest on nothing
        hand[2] += 0.001
        if BUNCH(0) in tracker:
            tracker.set_state(BUNCH(0), hand, np.zeros(6))
        world.run(DT)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.1)
    supports = [world.server.records.get(number).parent for number in CARRIED]
    assert supports[0] == "ada/base_footprint"
    assert supports[1] in ("ada/left", "ada/right")


def test_what_a_robot_carries_does_not_fall_when_its_body_is_removed_because_it_is_far_away():
    """On the client that went away, box and bunch stay where their records state, and are on the robot again later."""
    world = World()
    ada = world.join("ada", -1.0, -1.0)
    bob = world.join("bob", 0.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors, 1.0)
    load(world, ada)
    world.run(0.3)
    home = base_of(bob).copy()
    records = {number: world.server.records.get(number) for number in CARRIED}
    joints = bob.robot.update(0.0).position
    bob.physics.rigid.place_robot("bob", frames.pose([home[0], home[1] - 60.0, 0.0]), joints)
    world.until(lambda: "ada" not in bob.remote_actors, 3.0)
    assert bob.far_actors().keys() == {"ada"}
    world.run(0.5)
    for number in CARRIED:
        assert bob.replicator.record(number) == records[number]
        np.testing.assert_allclose(pose_of(bob, number)[:3], records[number].place[:3], atol=0.02)
    assert not bob.replicator.owned
    bob.physics.rigid.place_robot("bob", home, joints)
    world.until(lambda: "ada" in bob.remote_actors, 1.0)
    world.run(0.3)
    for number in CARRIED:
        assert world.server.records.get(number) == records[number]
        assert position_difference(ada, bob, number) < 0.02


def kill(world: World) -> np.ndarray:
    """End ada at once; where its base was [3] m."""
    place = base_of(world.clients["ada"])[:3].copy()
    world.leave("ada")
    return place


def assert_all_lies_on_the_ground(world: World, place: np.ndarray, within: float) -> None:
    """On all clients alike, and by the records of the server, within so many metres of ``place`` on the ground."""
    clients = list(world.clients.values())
    for number in CARRIED:
        record = world.server.records.get(number)
        assert (record.parent, record.moving) == ("", False), number
        assert record.pose[2] < ON_GROUND
        assert np.linalg.norm(np.array(record.pose[:2]) - place[:2]) < within
        for client in clients:
            assert not client.physics.state.bunch_attached[0]
            assert pose_of(client, number)[2] < ON_GROUND
            assert position_difference(client, clients[0], number) < 5e-3


@pytest.mark.parametrize(("y", "is_late"), [(-2.0, False), (-9.0, True)])
def test_what_a_killed_robot_carried_falls_on_a_client_that_knew_of_it(y, is_late):
    """One that joins late and at a distance knows of it by records alone."""
    world = World()
    ada = world.join("ada", -1.0, -1.0)
    if is_late:
        load(world, ada)
    bob = world.join("bob", 0.0, y)
    world.until(lambda: "ada" in bob.remote_actors, 1.0)
    if not is_late:
        load(world, ada)
    world.run(0.3)
    for number in CARRIED:
        assert position_difference(ada, bob, number) < 0.02
    place = kill(world)
    world.until(lambda: "ada" not in bob.remote_actors, 0.3)
    world.until(lambda: all(bob.replicator.record(number).author == "bob" for number in CARRIED), 5.0)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.1)
    assert_all_lies_on_the_ground(world, place, 1.5)


@pytest.mark.long
def test_what_a_killed_robot_carried_is_found_on_the_ground_by_those_who_come_later():
    """It was alone, and had driven to other cells since it took the box and the bunch."""
    world = World()
    ada = world.join("ada", -1.0, -1.0)
    load(world, ada)
    before = bytes_sent(ada)
    ada.pre_step[:] = [lambda time: ada.robot.command_base(1.0, 0.0, time)]
    world.until(lambda: base_of(ada)[0] > 9.0, 15.0)
    assert bytes_sent(ada) - before < 2 * 4 * 200, "both records every 3 m"
    place = kill(world)
    world.run(0.5)
    cy = world.join("cy", 8.0, -3.0)
    dan = world.join("dan", 11.0, 1.0)
    world.until(lambda: all(world.server.records.get(number).parent == "" for number in CARRIED), 10.0)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.1)
    assert_all_lies_on_the_ground(world, place, 5.0)
    assert {cy.name, dan.name} >= {world.server.records.get(number).author for number in CARRIED}


def test_what_a_robot_put_down_on_itself_before_it_left_is_found_by_those_who_come_later():
    """It ends in order, alone: the records that it leaves say where its box was, which falls there."""
    world = World()
    ada = world.join("ada", -1.0, -1.0)
    load(world, ada)
    place = base_of(ada)[:3].copy()
    ada.leave()
    world.leave("ada")
    world.run(0.2)
    world.join("cy", 1.0, -3.0)
    world.until(lambda: all(not world.server.records.get(number).moving for number in CARRIED), 10.0)
    world.until(lambda: at_rest(world), 5.0)
    assert_all_lies_on_the_ground(world, place, 1.5)


def test_a_box_on_a_robot_that_has_no_body_here_yet_is_at_its_last_known_place():
    """A robot that has joined is compiled beside the steps, which may take seconds."""
    world = World()
    ada = world.join("ada", -1.0, -1.0)
    load(world, ada)
    bob = world.join("bob", 0.0, -3.0)
    bob.spawner.enqueue = lambda hello: None
    world.until(lambda: bob.replicator.record(BOX(1)) is not None, 1.0)
    world.run(1.5)
    for number in CARRIED:
        assert position_difference(ada, bob, number) < 0.02
        assert world.server.records.get(number).author == "ada"
