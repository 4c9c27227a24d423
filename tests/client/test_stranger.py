"""Robots of strangers: counted before they are parsed, loaded in a process that ends, in time linear in their links."""

from __future__ import annotations

import cProfile
import pstats
import threading

import numpy as np
import pytest

from tests.client.test_spawner import DeferredExecutor, hello, update_at, world
from tests.support.waiting import wait
from vinesim.client.remote import stranger
from vinesim.client.remote.spawner import RemoteSpawner
from vinesim.client.remote.stranger import StrangerLoader
from vinesim.core import frames
from vinesim.net.codec.control import (
    DESCRIPTION,
    Hello,
    decode_description,
    decode_hello,
    description_digest,
    encode_hello,
    pack,
)
from vinesim.net.codec.header import MessageError
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene.robot_limits import MAX_DEPTH, MAX_LINKS, urdf_objection
from vinesim.scene.values import RobotUpdate

HELLO = 16

LINK = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def chain(links: int, kind: str = "revolute") -> str:
    """A URDF of links in a row."""
    parts = [f'<link name="l{i}">{LINK}</link>' for i in range(links)]
    parts += [
        f'<joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/><child link="l{i}"/><origin xyz="0.1 0 0"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="10" velocity="1"/></joint>'
        for i in range(1, links)
    ]
    return f'<robot name="chain">{"".join(parts)}</robot>'


def calls(links: int, path) -> int:
    """Number of function calls in which a chain is loaded: a measure of work that no other load of the machine
    changes."""
    file = path / f"chain{links}.urdf"
    file.write_text(chain(links))
    with cProfile.Profile() as profile:
        load_description(file, is_remote=True)
    return pstats.Stats(profile).total_calls


def test_a_robot_loads_in_time_linear_in_its_links(tmp_path):
    calls(20, tmp_path)
    few, many = calls(60, tmp_path), calls(240, tmp_path)
    assert many < 5.0 * few


def test_weights_of_a_chain_are_those_of_statics(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(chain(5).replace('xyz="0 0 1"', 'xyz="0 1 0"').replace('effort="10"', 'effort="0.001"'))
    drives = load_description(file, is_remote=True).drives
    lever = [sum(0.1 * k for k in range(5 - i)) for i in range(1, 5)]  # of the links beyond joint i, 1 kg each
    assert [drive.effort for drive in drives] == pytest.approx([9.80665 * metres + 0.001 for metres in lever])


@pytest.mark.parametrize(
    ("urdf", "what"),
    [
        (chain(2000), f"2000 links, at most {MAX_LINKS}"),
        (chain(3).replace("link", "a:link").replace("<a:link", "<b:link") * 400, "links, at most"),
        ("<robot>" + "<collision/>" * 5000 + "</robot>", "5000 shapes"),
        ("<robot>" + "<x/>" * 40_000 + "</robot>", "XML elements"),
        ("<x>" * (MAX_DEPTH + 1), "deep"),
        ('<?xml version="1.0" encoding="utf-7"?><robot name="a">+ADw-link/+AD4-</robot>', "declaration"),
        ("<!DOCTYPE robot><robot/>", "document type"),
        ("<robot><link name='a'", "well-formed"),
    ],
)
def test_a_greeting_with_too_large_a_robot_is_refused_unparsed(urdf, what):
    assert what in urdf_objection(urdf)
    with pytest.raises(MessageError, match="URDF"):
        decode_hello(pack(HELLO, Hello("guest", urdf=urdf)))
    payload = pack(DESCRIPTION, (urdf, ""))
    with pytest.raises(MessageError, match="URDF"):
        decode_description(payload, description_digest(payload))
    with pytest.raises(MessageError, match="URDF"):
        encode_hello(Hello("guest", urdf=urdf))


@pytest.mark.parametrize("robot", ["vinebot", "logistic"])
def test_shipped_robots_are_within_the_limits(robot):
    assert urdf_objection(load_description(robot).urdf) == ""


@pytest.fixture
def loader():
    with StrangerLoader() as made:
        yield made


def test_a_process_loads_a_robot_as_this_process_does(loader):
    sent = Hello("guest", robot="chain", urdf=chain(4), joints=3)
    apart, here = loader.load(sent), stranger.load_sent(sent)
    assert (apart.drives, apart.urdf, apart.groups) == (here.drives, here.urdf, here.groups)
    np.testing.assert_array_equal(apart.fixed_poses, here.fixed_poses)
    with pytest.raises(DescriptionError, match=r"two parents|loop"):
        loader.load(Hello("guest", urdf=chain(3).replace('parent link="l0"', 'parent link="l2"')))


def test_a_robot_that_takes_too_long_is_refused_and_others_are_shown(monkeypatch):
    vinebot = load_description("vinebot")
    physics = world(vinebot)
    with StrangerLoader(timeout=0.01) as impatient:
        with pytest.raises(DescriptionError, match=r"within 0.01 s"):
            impatient.load(Hello("slow", urdf=chain(3)))
        executor = DeferredExecutor()
        spawner = RemoteSpawner(physics.rigid, vinebot, executor, loader=impatient)
        spawner.enqueue(Hello("slow", urdf=chain(3), joints=2, index=9))
        spawner.enqueue(hello(vinebot))
        slow = RobotUpdate("slow", 0.0, frames.pose([3.0, 0.0, 0.0]), np.zeros(6), np.zeros(2), np.zeros(2))
        updates = {"slow": slow, "guest": update_at(vinebot, 0.1)}
        shown = {}

        def step() -> bool:
            shown.update(spawner.spawn(updates))
            executor.work()
            return "slow" not in spawner and "guest" in shown

        wait(step, "the honest robot, and the end of the slow one")
    assert "slow" not in shown


def test_processes_are_killed_at_the_end():
    with StrangerLoader() as made:
        future = made.submit(made.load, Hello("guest", urdf=chain(400)))
        wait(lambda: made._running or future.done(), "a process")
        running = list(made._running)
    assert all(process.returncode is not None for process in running)
    assert not any(thread.name.startswith("strangers' robots") for thread in threading.enumerate())
