"""A cane that is cut has the same stump on every client, however the cut reaches them."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from tests.support.shared_vineyard import World, vineyard
from vinesim.client.client import Client
from vinesim.net.codec.control import RetainedRecord
from vinesim.net.replication.retained import RetainedState
from vinesim.scene.spare_bodies import PLACE_STEP, with_spares

pytestmark = pytest.mark.slow


SEGMENT = 4
"""A segment of the first cane."""


def bodies_of(client: Client, segment: int) -> np.ndarray:
    model = client.physics.model
    here = model.bodies_of(int(model.body_tree[segment]))
    return np.arange(here.start, here.stop)


def assert_equal(one: Client, other: Client, segment: int, *, moving: bool = False) -> None:
    """Both clients have the same stumps, masses, springs and cuts in the tree of a segment, and about the same pose."""
    bodies = bodies_of(one, segment)
    for name in ("body_cut", "stump_of", "stump_end"):
        mine, theirs = (getattr(client.physics.state, name)[bodies] for client in (one, other))
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    for name in ("body_mass", "body_com", "body_inertia", "joint_stiffness", "body_parent", "body_start", "body_end"):
        mine, theirs = (getattr(client.physics.plants, name)[bodies] for client in (one, other))
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-9, err_msg=name)
    if not moving:
        mine, theirs = (client.physics.snapshot().body_q[bodies, :3] for client in (one, other))
        np.testing.assert_allclose(mine, theirs, atol=5e-3)


def test_a_cut_cane_has_the_same_stump_on_all_clients():
    world = World(with_spares(vineyard()))
    ada = world.join("ada", 0.25, 0.0)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    model = ada.physics.model
    segment = SEGMENT
    at = round(0.4 * float(model.body_length[segment]) / PLACE_STEP) * PLACE_STEP
    ada.physics.cut(segment, at)
    world.until(lambda: bool(bob.physics.state.body_cut[segment]) and len(bob.physics.plants.stumps.table) == 1, 2.0)
    assert_equal(ada, bob, segment, moving=True)
    world.run(3.0)
    assert_equal(ada, bob, segment)
    carl = world.join("carl", 1.5, 2.0)
    world.until(lambda: len(carl.physics.plants.stumps.table) == 1, 5.0)
    world.run(1.5)  # the piece still swings, on the ground and on a robot, when carl comes
    assert_equal(ada, carl, segment)
    stump = int(ada.physics.plants.stumps.table[0, 0])
    bob.physics.cut(stump, 0.5 * at)
    world.until(lambda: all(len(c.physics.plants.stumps.table) == 2 for c in (ada, carl)), 2.0)
    dora = world.join("dora", 1.5, 3.0)
    world.until(lambda: len(dora.physics.plants.stumps.table) == 2, 5.0)
    world.run(0.3)
    for client in (ada, carl, dora):
        assert_equal(bob, client, segment, moving=True)


def test_the_motion_of_what_was_cut_may_arrive_before_the_record():
    """A client that learns of the stump after the piece has left has it, too."""
    world = World(with_spares(vineyard()))
    ada = world.join("ada", 0.25, 0.0)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    segment = SEGMENT
    bob.objects.apply_remote_cut(segment)
    assert len(bob.physics.plants.stumps.table) == 0
    ada.physics.cut(segment, 0.02)
    world.until(lambda: len(bob.physics.plants.stumps.table) == 1, 2.0)
    assert_equal(ada, bob, segment, moving=True)
    world.run(2.0)
    stump = int(ada.physics.plants.stumps.table[0, 0])
    mine, theirs = (client.physics.snapshot().body_q[stump, :3] for client in (ada, bob))
    np.testing.assert_allclose(mine, theirs, atol=5e-3)


def test_two_cuts_with_one_spare_body_end_equal():
    """Both clients cut the same tree before they hear of each other: both use its first spare body."""
    world = World(with_spares(vineyard()))
    ada = world.join("ada", 0.25, 0.0)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    segment = SEGMENT
    bob.physics.cut(segment + 2, 0.02)
    ada.physics.cut(segment, 0.03)
    both = [segment, segment + 2]
    world.until(lambda: all(c.physics.state.body_cut[both].all() for c in (ada, bob)), 3.0)
    world.run(0.5)
    assert ada.physics.plants.stumps.table[:, 1:].tolist() == [[segment, pytest.approx(0.03)]]
    assert_equal(ada, bob, segment, moving=True)


def test_records_with_stumps_merge_in_any_order():
    tree = 7
    random = np.random.default_rng(0)
    records = [
        RetainedRecord(tree, 1, k, "ada", cut=(50 + k % 3,), stumps=((60 + k % 2, 50 + k % 3, 100 + 7 * k),))
        for k in range(6)
    ]
    ends = set()
    for _ in range(20):
        state = RetainedState()
        for k in random.permutation(6).tolist():
            state.merge((0, 0), records[k])
        kept = state.get(tree)
        ends.add((kept.cut, kept.stumps, kept.authority))
    assert len(ends) == 1
    (stumps,) = {stumps for _, stumps, _ in ends}
    assert stumps == ((60, 50, 100), (61, 50, 121))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(records[0]), type=RetainedRecord) == records[0]
