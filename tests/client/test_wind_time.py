from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import World, vineyard
from vinesim.scene.wind import Wind
from vinesim.wind.sway import Sway


def test_clients_that_joined_at_different_times_draw_the_same_trees(tmp_path, monkeypatch) -> None:
    """Two clients, the second joined a second later: at the same network time trees sway alike; no message says how."""
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    model = vineyard()
    model.body_drag[:] = 0.003  # leaves
    world = World(model)
    ada = world.join("ada", -30.0, 0.0)
    ada.physics.wind = wind = Wind([2.0, 1.0, 0.0], gusts=1.0, seed=3)
    world.run(1.0)
    bob = world.join("bob", 40.0, 0.0)
    for one in (ada, bob):  # as if a server had told them
        one.world_time.follow(one.physics.time, world.now)
    bob.physics.wind = Wind([2.0, 1.0, 0.0], gusts=1.0, seed=3)
    world.run(0.5)
    assert ada.physics.time == pytest.approx(bob.physics.time + 1.0)
    views = [Sway(world.model).apply(one.physics.snapshot()) for one in (ada, bob)]
    assert views[0].wind is not None
    assert views[1].wind is not None
    assert views[0].wind.wind is wind
    asleep = (views[0].wind.tree_drawn == 1.0) & (views[1].wind.tree_drawn == 1.0)
    assert asleep.any()
    bodies = asleep[world.model.body_tree]
    still = ada.physics.snapshot().body_q
    assert np.abs(views[0].body_q - still)[bodies, :3].max() > 1e-4
    np.testing.assert_allclose(views[0].body_q[bodies], views[1].body_q[bodies], atol=1e-6)
