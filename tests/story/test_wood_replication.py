"""Wood that has given: the client that owns a tree decides; all clients have its set, also those that join later."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import World, vineyard
from vinesim.client.client import Client
from vinesim.scene.ids import Organ

pytestmark = pytest.mark.slow


def given(client: Client) -> tuple[bytes, bytes]:
    state = client.physics.state
    return state.joint_set[~state.body_cut].tobytes(), state.joint_flow.tobytes()


def test_a_cane_that_cracked_has_the_same_set_on_all_clients():
    weak = vineyard.__wrapped__()
    canes = weak.body_organ == int(Organ.CANE)
    weak.body_strength[canes], weak.body_yield_strength[canes], weak.body_toughness[canes] = 60e6, 45e6, 1e5
    weak.joint_damping *= 10.0
    world = World(weak)
    ada = world.join("ada", 0.25, 0.0)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    load = ada.physics.plants.body_load
    ada.physics.plants.wake(0)
    force = 0.0
    while not ada.physics.detachment_monitor.breakages and force < 60.0:
        load[12, 2] = -(force := force + 0.5)
        world.run(0.01)
    assert ada.physics.detachment_monitor.breakages[0].kind == "crack"
    assert not bob.physics.state.joint_flow.any()
    load[12, 2] = 0.0
    world.until(lambda: bob.physics.state.joint_flow.any(), 0.1)
    world.until(lambda: given(bob) == given(ada), 1.0)
    world.until(lambda: not any(c.objects.moving or c.replicator.owned for c in (ada, bob)), 60.0)
    world.run(0.2)
    assert (ada.physics.state.joint_flow > 0.0).sum() >= 1
    assert given(bob) == given(ada)
    carl = world.join("carl", 1.5, 2.0)
    world.until(lambda: carl.physics.state.joint_flow.any(), 5.0)
    world.run(0.2)
    assert given(carl) == given(ada)
    for client in (ada, bob, carl):
        client.physics.plants.forward_kinematics(0)
    for client in (bob, carl):
        apart = client.physics.state.body_q[:, :3] - ada.physics.state.body_q[:, :3]
        assert np.abs(apart).max() < 5e-3
    for client in (ada, bob, carl):
        client.physics.wake(np.array([0]))
    world.run(0.3)
    apart = carl.physics.state.body_q[:, :3] - ada.physics.state.body_q[:, :3]
    assert np.abs(apart).max() < 5e-3  # it rests there, so all have the same springs
