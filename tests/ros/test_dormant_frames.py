"""Canes and buds of dormant vines have frames in ``/tf_environment``, where they are."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from vinesim.ros.messages import message_packages

message_packages.ensure_importable(["tf2_msgs"])

from tf2_msgs.msg import TFMessage

from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.processes.ros_process import RosProcess
from vinesim.client.rate_loop import RateLoop
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path) -> Iterator[StockNode]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with StockNode() as node:
        yield node


def test_canes_and_buds_have_frames(peer: StockNode) -> None:
    scene = load_scene("winter_spur")
    scene = msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=1, vines=2))
    vinebot = load_description("vinebot")
    model = generate(scene)
    hub = MemoryHub()
    heard: list[TFMessage] = []
    with RosProcess("robot", model, vinebot) as process:
        client = Client(scene, model, vinebot, hub.bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        process.attach(client)
        peer.node.create_subscription(TFMessage, "/tf_environment", heard.append, 10)
        loop = RateLoop(client.physics.dt)

        def step() -> None:
            loop.begin()
            client.tick()
            loop.end()
            peer.spin(0.0)

        wait_until(lambda: len(heard) > 1, step)
        body_q = client.physics.state.body_q.astype(float)
    found = {one.child_frame_id: one.transform for one in heard[-1].transforms}
    buds = model.nodes.bud_poses(body_q)
    assert {f"cane_{cane:05d}" for cane in range(len(model.canes.body))} <= set(found)
    assert sum(name.startswith("bud_") for name in found) == len(buds)
    wanted = {f"cane_{cane:05d}": body_q[body] for cane, body in enumerate(model.canes.body)}
    wanted |= {f"bud_{bud:05d}": pose for bud, pose in enumerate(buds)}
    for name, pose in wanted.items():
        at, turn = found[name].translation, found[name].rotation
        np.testing.assert_allclose([at.x, at.y, at.z], pose[:3], atol=1e-4)
        assert abs(np.dot([turn.x, turn.y, turn.z, turn.w], pose[3:])) > 1.0 - 1e-6
