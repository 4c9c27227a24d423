"""Jobs in a client: planned from the scene, begun with its robot, done tick by tick; nobody on the network needed."""

from __future__ import annotations

import pytest

from vinesim.client import places
from vinesim.client.client import Client
from vinesim.client.jobs import LookAt, UnknownJob, plan_job
from vinesim.net.bus import MemoryHub
from vinesim.robot.description import load as load_robot
from vinesim.robot.exchange import Exchange
from vinesim.robot.pick import Pick
from vinesim.robot.script import Script
from vinesim.world.generate import generate
from vinesim.world.scene import load


def client_with(job: str, robot: str, spawn: int) -> tuple[Client, Script]:
    scene = load("harvest")
    model = generate(scene)
    begin, start = plan_job(job, model, places.spawn_pose(scene, spawn))
    now = iter(range(1_000_000))
    client = Client(
        scene, model, load_robot(robot), MemoryHub().bus("worker"), name="worker", pose=start,
        clock=lambda: 0.01 * next(now),
    )  # fmt: skip
    script = begin(client.physics, client.robot)
    client.jobs += [script.control, LookAt(client.robot, script.focus)]
    return client, script


def test_a_client_picks():
    client, script = client_with("pick", "vinebot", 0)
    assert isinstance(script, Pick)
    while not script.done and script.phase != "tuck":
        client.tick()
    assert not script.reason
    assert client.physics.rigid.loose == (script.task.bunch,)
    # the bunch is in its hand, and its trouble is its own: the client goes on
    assert script.report()["phases_s"]["cut"] < 0.1


def test_a_client_exchanges():
    client, script = client_with("exchange", "logistic", 1)
    assert isinstance(script, Exchange)
    for _ in range(200):
        client.tick()
    assert not script.reason
    assert script.phase == "to the empty box"
    assert len(client.physics.rigid.loose) == script.report()["bunches"] == 6


def test_an_unknown_job_is_told():
    scene = load("harvest")
    with pytest.raises(UnknownJob, match="no job 'dance'; give pick or exchange"):
        plan_job("dance", generate(scene), places.spawn_pose(scene, 0))
