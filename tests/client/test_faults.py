"""Faults are counted where a user sees them, and logged once."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.cli.client_session import status_line
from vinesim.client.client import Client
from vinesim.client.faults import DESCRIPTIONS
from vinesim.client.rate_loop import RateLoop
from vinesim.client.status import Status
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene

WITHOUT_SENSORS = {"frames_dropped": 0, "messages_dropped": 0}


@pytest.fixture
def client() -> Client:
    scene, hub = load_scene("demo"), MemoryHub()
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    return Client(
        scene, model, load_description("vinebot"), hub.bus("robot"), name="robot", pose=spawn_pose(scene, 0)
    )  # fmt: skip


def test_a_client_without_faults_has_none(client) -> None:
    client.tick()
    values = Status(client, RateLoop(0.01)).current()
    assert values["faults"] == {}
    assert "FAULTS" not in status_line(values)


def test_a_tree_that_is_stopped_is_counted_shown_and_logged_once(client, caplog) -> None:
    caplog.set_level(logging.WARNING)
    status = Status(client, RateLoop(0.01))
    for _ in range(2):
        client.physics.plants.wake(0)
        client.physics.state.joint_qd[0] = np.nan
        client.tick()
        values = status.current()
    assert values["faults"] == {"trees_stopped": 2}
    assert status_line(values).endswith("FAULTS: 2 trees stopped")
    assert status.report()["faults"] == {"trees_stopped": 2}
    assert [r.getMessage() for r in caplog.records if "trees_stopped" in r.getMessage()] == [
        f"1 {DESCRIPTIONS['trees_stopped']} (further ones are only counted: trees_stopped)"
    ]


def test_what_cannot_be_read_from_another_actor_is_counted(client) -> None:
    client.replicator.counters.malformed += 3
    assert Status(client, RateLoop(0.01)).current()["faults"] == {"messages_refused": 3}
    assert set(client.physics.faults) <= set(DESCRIPTIONS)
