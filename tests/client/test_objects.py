"""Shared objects of a client: retained records of boxes by several authors, contradictory ones included."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.client.client import Client
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.net.codec.control import RetainedRecord
from vinesim.net.codec.trees import RESTING, TreeStates, encode_trees
from vinesim.net.replication.receiver import Inbox
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.spec import load_scene

FIRST, SECOND = (object_id(ObjectKind.BOX, i) for i in range(2))


@pytest.fixture
def client() -> Client:
    scene = load_scene("demo")
    return Client(
        scene,
        generate(scene),
        load_description("vinebot"),
        MemoryHub().bus("robot"),
        name="robot",
        pose=spawn_pose(scene, 0),
    )


def at_rest(box: int, parent: str, author: str) -> tuple[RetainedRecord, bool]:
    return RetainedRecord(box, 1, 1, author, (0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0), parent), True


def test_two_boxes_that_are_said_to_lie_in_each_other_do_not_end_the_loop(client) -> None:
    """Each record alone may be true; only both together cannot."""
    records = [at_rest(FIRST, "box/1", "ada"), at_rest(SECOND, "box/0", "bob")]
    client.objects.receive(Inbox(records=records))
    for _ in range(5):
        client.tick()
    assert np.isfinite(client.physics.support_tracker.object_state(FIRST)[0]).all()
    assert client.objects.supported_by("robot") == []


def test_a_box_in_a_box_is_moved_by_whoever_carries_the_lower_one(client, monkeypatch) -> None:
    monkeypatch.setattr(client.objects, "_is_present", {"eva"}.__contains__)
    client.objects.receive(Inbox(records=[at_rest(FIRST, "box/1", "ada"), at_rest(SECOND, "eva/gripper", "bob")]))
    assert client.objects._is_moved_remotely("box/1")
    assert client.objects._supporting_actor(FIRST) == "eva"
    client.objects.receive(Inbox(records=[at_rest(SECOND, "robot/gripper", "bob")]))
    assert not client.objects._is_moved_remotely("box/1")
    client.objects.receive(Inbox(records=[at_rest(SECOND, "", "bob")]))
    assert client.objects._supporting_actor(FIRST) == "bob"


def test_records_that_each_local_actor_receives_are_applied_once(client) -> None:
    """All actors of a client receive the same records: more than there are trees, of a bunch twice, and late ones."""
    objects = client.objects
    model = client.model
    trees = [tree_at_rest(client, tree, authority=2, turn=0.1) for tree in range(len(model.tree_first))]
    late = tree_at_rest(client, 0, authority=1, turn=0.2)
    bunch = object_id(ObjectKind.BUNCH, 0)
    moving = RetainedRecord(bunch, 1, 2, "ada", (0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0), moving=True), True
    objects.receive(Inbox(records=[*trees, at_rest(bunch, "", "ada"), moving, *trees, late, at_rest(bunch, "", "ada")]))
    here = model.bodies_of(0)
    assert np.abs(client.physics.state.joint_q[here] - turned(client, 0, 0.1)).max() < 1e-3
    assert bunch in client.physics.support_tracker, "it moves by its newest record"
    assert 0 not in client.physics.dormant_bunches
    client.tick()


def tree_at_rest(client: Client, tree: int, *, authority: int, turn: float) -> tuple[RetainedRecord, bool]:
    """A record of a tree that rests with every joint turned by ``turn`` [rad]."""
    size = client.model.tree_size[tree]
    q = turned(client, tree, turn)
    states = TreeStates(
        0.0,
        np.array([tree]),
        np.array([1]),
        np.array([authority]),
        np.array([RESTING]),
        np.array([size]),
        q,
        np.zeros((size, 3)),
    )
    (payload,), _ = encode_trees(states)
    return RetainedRecord(tree, 1, authority, "ada", trees=payload), True


def turned(client: Client, tree: int, turn: float) -> np.ndarray:
    """Joint rotations [n, 4] of a settled tree, each turned by ``turn`` [rad] about y."""
    settled = client.model.joint_settled[client.model.bodies_of(tree)]
    return frames.multiply(frames.exp(np.array([0.0, turn, 0.0])), settled)
