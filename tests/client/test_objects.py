"""Shared objects of a client: retained records of boxes by several authors, contradictory ones included."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.client.client import Client
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.codec.messages import RetainedRecord
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
        scene, generate(scene), load_description("vinebot"), MemoryHub().bus("robot"), name="robot",
        pose=spawn_pose(scene, 0),
    )  # fmt: skip


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


def test_a_box_in_a_box_is_moved_by_whoever_carries_the_lower_one(client) -> None:
    client.objects.receive(Inbox(records=[at_rest(FIRST, "box/1", "ada"), at_rest(SECOND, "eva/gripper", "bob")]))
    assert client.objects._is_moved_remotely("box/1")
    assert client.objects._supporting_actor(FIRST) == "eva"
    client.objects.receive(Inbox(records=[at_rest(SECOND, "robot/gripper", "bob")]))
    assert not client.objects._is_moved_remotely("box/1")
    client.objects.receive(Inbox(records=[at_rest(SECOND, "", "bob")]))
    assert client.objects._supporting_actor(FIRST) == "bob"
