"""Versions of the list of bodies: compared by content, sent once, and never mixed up."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from vinesim.client.processes.rigid_visual_list import VisualListReceiver, VisualListSender
from vinesim.scene.ids import Organ
from vinesim.scene.values import RigidVisual


def body(name: str, shapes: tuple = ()) -> RigidVisual:
    return RigidVisual(name, Organ.ROBOT, 1, shapes)


@pytest.fixture
def link():
    """Both ends of the way, and what takes a message over it."""
    sender = VisualListSender()
    receiver = VisualListReceiver()

    def pass_on(visuals: tuple[RigidVisual, ...]):
        message = sender.update(visuals)
        if message is not None:
            receiver.take(pickle.loads(pickle.dumps(message)))
        return message

    yield sender, receiver, pass_on
    if receiver.memory is not None:
        receiver.memory.close()
    sender.close()


def test_a_list_that_was_only_made_anew_keeps_its_version(link):
    sender, receiver, pass_on = link
    shapes = (object, 1)
    pass_on((body("a", shapes), body("b")))
    shown = receiver.visuals
    assert pass_on((body("a", shapes), body("b"))) is None
    assert sender.version == receiver.version == 1
    assert receiver.visuals is shown


def test_only_new_bodies_are_sent_and_the_order_is_kept(link):
    _, receiver, pass_on = link
    a = body("a")
    b = body("b")
    c = body("c")
    pass_on((a, b))
    assert [v.name for v in pass_on((c, a, b)).new.values()] == ["c"]
    assert receiver.visuals == (c, a, b)
    assert not pass_on((b,)).new
    assert receiver.visuals == (b,)
    assert len(pass_on((a, b)).new) == 1  # forgotten at both ends, so sent again
    assert receiver.visuals == (a, b)
    assert receiver.version == 4


def test_the_empty_list_is_a_version_too(link):
    _, receiver, pass_on = link
    pass_on(())
    assert receiver.version == 1
    assert receiver.memory is not None


def test_room_for_poses_grows_with_the_list(link):
    sender, receiver, pass_on = link
    pass_on((body("a"),))
    capacity = sender.capacity
    many = tuple(body(f"link_{i}") for i in range(3 * capacity))
    assert pass_on(many).visual_q is not None
    sender.memory["visual_q"][: len(many)] = np.arange(len(many))[:, None]
    assert receiver.memory["visual_q"][len(many) - 1, 6] == len(many) - 1
    assert pass_on(many[1:]).visual_q is None
