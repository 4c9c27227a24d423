"""A bunch that was picked where it overlaps canes or a pole stays among them on every client, also on one that joins
later."""

from __future__ import annotations

import numpy as np
import pytest

from tests.laws.test_sleep import settled
from tests.support.contact_scenes import cane
from tests.support.shared_vineyard import World
from vinesim.client.recording.state_digest import lasting_digest
from vinesim.scene.builder import assemble
from vinesim.scene.ids import FIXED_PIECES, Organ
from vinesim.scene.model import Model

pytestmark = pytest.mark.slow

LENGTH = 0.17
"""[m] Of the bunch."""


def close_to_the_ground(overlapped: str) -> Model:
    """A bunch that hangs 1 mm above the ground, and 1 cm deep in two pairs of level canes (trees 1 to 4), or in a
    pole."""
    alone = assemble([cane((0.0, 0.0, 1.0), bunch=0.4)])
    top = alone.forward_kinematics(alone.joint_settled)[alone.bunch_body[0], :3]
    carrier = cane((0.0, 0.0, 1.0 + LENGTH + 0.001 - top[2]), bunch=0.4)
    foot = np.array([top[0], 0.0, 0.0])
    if overlapped == "pole":
        beside = foot + np.array([0.0, 0.065, 0.0])
        pole = {
            "fixed_start": [beside],
            "fixed_end": [beside + np.array([0.0, 0.0, 0.5])],
            "fixed_radius": [[0.03, 0.03]],
        }
        return assemble([carrier], **pole, fixed_organ=[int(Organ.POLE)], fixed_index=[0])
    along = [settled(foot + np.array([-0.5, side, 0.04]), radius=0.012) for side in (-0.03, 0.03)]
    across = [
        settled(foot + np.array([side, -0.5, 0.075]), radius=0.012, heading=0.5 * np.pi) for side in (-0.03, 0.03)
    ]
    return assemble([carrier, *along, *across])


@pytest.mark.parametrize(("overlapped", "passed"), [("canes", (1, 2, 3, 4)), ("pole", (FIXED_PIECES,))])
def test_a_late_client_lets_a_bunch_pass_what_it_passes(overlapped: str, passed: tuple[int, ...]) -> None:
    world = World(close_to_the_ground(overlapped))
    ada = world.join("ada", 0.25, -1.5)
    bob = world.join("bob", 1.0, -2.0)
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    ada.physics.pick(0)
    world.run(0.1)
    world.until(lambda: not any(client.objects.moving for client in (ada, bob)), 30.0)
    assert ada.physics.contact_solver.passed_by(0) == passed
    carl = world.join("carl", 1.0, 1.5)
    world.until(lambda: 0 in carl.physics.rigid.free_bunches, 5.0)
    world.run(5.0)
    clients = (ada, bob, carl)
    for client in clients:
        assert client.physics.contact_solver.passed_by(0) == passed
        assert client.objects.moving == []
    poses = [client.physics.rigid.bunch_pose(0) for client in clients]
    np.testing.assert_allclose(poses, np.broadcast_to(poses[0], (3, 7)), atol=1e-4)
    assert len({lasting_digest(client.physics) for client in clients}) == 1
