"""A dormant cane that is pruned has the same buds in the same places on every client, also on one that joins later."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from tests.support.shared_vineyard import World
from vinesim.client.client import Client
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

pytestmark = pytest.mark.slow


def buds_of(client: Client) -> tuple[np.ndarray, np.ndarray]:
    """The bodies that carry the nodes, and the poses of all buds."""
    physics = client.physics
    nodes = physics.model.nodes
    carrier = nodes.carriers(physics.state.stump_of, physics.state.stump_end)
    return carrier, nodes.bud_poses(physics.snapshot().body_q, carrier)


def test_buds_are_the_same_on_all_clients_after_pruning() -> None:
    scene = load_scene("winter_spur")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=2)
    model = generate(msgspec.structs.replace(scene, layout=layout))
    nodes = model.nodes
    world = World(model)
    ada = world.join("ada", 0.25, -0.8)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    for cane in np.flatnonzero(model.canes.year == 1)[2:8:5].tolist():
        mine = np.flatnonzero(nodes.cane == cane)
        ada.physics.cut(int(nodes.body[mine[1]]), float(nodes.along[mine[1]]) + 0.008)
    world.until(lambda: len(bob.physics.plants.stumps.table) == 2, 2.0)
    world.run(4.0)
    carl = world.join("carl", 1.5, 2.0)
    world.until(lambda: len(carl.physics.plants.stumps.table) == 2, 5.0)
    world.run(0.5)
    carrier, poses = buds_of(ada)
    assert len(np.unique(nodes.cane[carrier != nodes.body])) == 2
    for other in (bob, carl):
        theirs, places = buds_of(other)
        np.testing.assert_array_equal(carrier, theirs)
        np.testing.assert_allclose(poses[:, :3], places[:, :3], atol=5e-3)
