"""A bunch that is cut in its peduncle has the same stalk on every client, however its state reaches them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import BUNCH, World
from vinesim.client.client import Client

pytestmark = pytest.mark.slow


def stalk(client: Client, bunch: int) -> tuple[int, float]:
    state = client.physics.state
    return int(state.cut_segment[bunch]), float(state.cut_at[bunch])


def weights(client: Client, bunch: int) -> tuple[float, float]:
    """Masses [kg] of a free bunch, with or without a body, and of the stump that it left."""
    physics = client.physics
    dormant = physics.dormant_bunches
    free = dormant._bunches[bunch] if bunch in dormant else physics.rigid.free_bunch(bunch)
    return free.mass, float(physics.plants.body_mass[physics.state.cut_segment[bunch]])


def test_a_cut_is_at_the_same_place_on_all_clients():
    world = World()
    ada = world.join("ada", 0.25, 0.0)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    model = ada.physics.model
    segment = int(model.body_parent[model.bunch_body[0]])
    above = model.body_parent[segment]
    if model.body_organ[above] == model.body_organ[segment]:
        segment = int(above)
    ada.physics.cut(segment, 0.4 * float(model.body_length[segment]))
    world.until(lambda: stalk(bob, 0)[0] == segment and not bob.physics.state.bunch_attached[0], 2.0)
    assert stalk(bob, 0) == stalk(ada, 0)
    assert weights(bob, 0) == pytest.approx(weights(ada, 0), rel=1e-6)
    world.until(lambda: not any(client.objects.moving for client in world.clients.values()), 60.0)
    carl = world.join("carl", 1.5, 2.0)
    world.until(lambda: not carl.physics.state.bunch_attached[0], 5.0)
    world.run(0.2)
    assert stalk(carl, 0) == stalk(ada, 0)
    assert weights(carl, 0) == pytest.approx(weights(ada, 0), rel=1e-6)
    np.testing.assert_allclose(
        carl.objects.read_state(BUNCH(0))[0] if BUNCH(0) in carl.physics.support_tracker else pose(carl),
        ada.objects.read_state(BUNCH(0))[0],
        atol=2e-3,
    )


def pose(client: Client) -> np.ndarray:
    dormant = client.physics.dormant_bunches
    return dormant.visual_q()[[visual.index for visual in dormant.visuals()].index(0)]
