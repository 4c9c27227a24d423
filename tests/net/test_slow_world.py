"""Worlds that run slower than real time, as their server says: copies stay as near as in real time."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest

from benchmarks.support.fake_client import FakeClient, tree_row
from tests.support.waiting import wait
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.codec.header import MessageError
from vinesim.net.server.server import Server
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene.values import POINT_NAMES, HumanUpdate

DT = 0.01
START = 1e6
"""Of the worlds' time [s]."""
SWING = 0.3
RATE = 4.0
"""Of a hand: amplitude [m] and angular frequency [rad/s]; 1.2 m/s at most."""


class Person(FakeClient):
    """A person whose hand swings with the time of the world, which is simulated time."""

    def pose(self, now: float) -> HumanUpdate:
        """The velocity is that of simulated time, as a simulation has no other."""
        time = self.replicator.network_time(now)
        if self.replicator.step_time is not None:
            time = self.replicator.step_time()
        velocity = np.zeros((len(POINT_NAMES), 6))
        velocity[2, 2] = SWING * RATE * np.cos(RATE * time)
        still = super().pose(now)
        assert isinstance(still, HumanUpdate)
        left = frames.pose(self.place + np.array([0.0, 0.0, height_of_hand(time)]))
        return HumanUpdate(self.name, now, dataclasses.replace(still.pose, left=left), velocity)


def height_of_hand(time: float) -> float:
    return 1.1 + SWING * np.sin(RATE * time)


class World:
    """Two people, and a server whose time passes ``factor`` times as fast as real time."""

    def __init__(self, factor: float) -> None:
        self.hub = MemoryHub(delay=0.02)
        self.factor = factor
        self._begun = 0.0
        self._time = START
        self.hub.bus("server").declare_queryable(
            "clock/*",
            lambda asked: encode_time(decode_time(asked)[0], self.time, self.factor, real=self.hub.time),
        )
        model = tree_row(2)
        self.ada, self.bob = (
            Person(self.hub.bus(name), model, (x, 0.0), kind="human") for name, x in (("ada", 1.0), ("bob", 2.0))
        )

    @property
    def time(self) -> float:
        return self._time + self.factor * (self.hub.time - self._begun)

    def change(self, factor: float) -> None:
        """As by a server that is started again with another factor."""
        self._time = self.time
        self._begun = self.hub.time
        self.factor = factor

    def run(self, steps: int) -> float:
        """Step both clients at the factor; how far bob's copy of ada's hand was from it at most [m]."""
        worst = 0.0
        for _ in range(steps):
            self.hub.advance(DT / self.factor)
            for client in (self.ada, self.bob):
                client.tick(self.hub.time)
            if (copy := self.bob.robots.get("ada")) is not None:
                assert isinstance(copy, HumanUpdate)
                worst = max(worst, abs(copy.pose.left[2] - height_of_hand(self.time)))
        return worst


@pytest.mark.parametrize("factor", [1.0, 0.2, 0.05])
def test_a_copy_in_a_slow_world_is_where_the_hand_is(factor: float) -> None:
    """A copy that took velocities of simulated time for those of real time would lead by up to 0.15 s: 180 mm."""
    world = World(factor)
    world.run(200)
    for client in (world.ada, world.bob):
        assert client.replicator.real_time_factor == factor
        assert client.replicator.network_time(world.hub.time) == pytest.approx(world.time, abs=0.021 * factor)
        assert client.replicator.round_trip == pytest.approx(0.04, abs=DT / factor)
    assert world.run(500) < 0.02


def test_copies_move_evenly_although_steps_come_in_bursts() -> None:
    """Each client makes ten steps at once, ten times a second, in turns: what bob's step shows of ada's hand is where
    it was at the time of that step, and moves no further in one step than the hand does."""
    world = World(1.0)
    world.run(200)
    times = {client.name: world.time for client in (world.ada, world.bob)}
    for client in (world.ada, world.bob):
        client.replicator.step_time = lambda name=client.name: times[name]
    shown: list[tuple[float, float]] = []
    for turn in range(100):
        client = (world.ada, world.bob)[turn % 2]
        for _ in range(10):
            client.tick(world.hub.time)
            if client is world.bob and turn > 20:
                copy = world.bob.robots["ada"]
                assert isinstance(copy, HumanUpdate)
                shown.append((times["bob"], copy.pose.left[2]))
            times[client.name] += DT
        world.hub.advance(0.05)
    time, height = np.array(shown).T
    assert np.diff(time) == pytest.approx(DT, abs=1e-6)
    assert np.abs(height - height_of_hand(time)).max() < 0.03
    assert np.abs(np.diff(height)).max() < 2.0 * SWING * RATE * DT


def test_clients_follow_a_server_that_comes_back_with_another_factor() -> None:
    world = World(1.0)
    world.run(200)
    world.change(0.1)
    world.run(400)
    assert world.ada.replicator.real_time_factor == 0.1
    assert world.bob.replicator.network_time(world.hub.time) == pytest.approx(world.time, abs=0.01)
    assert world.run(300) < 0.02
    assert (world.ada.left_at, world.bob.left_at) == ({}, {})


def test_a_client_learns_the_factor_of_its_server() -> None:
    """By the messages of a real server; its time passes as slowly."""
    with Server("tcp/127.0.0.1:0", real_time_factor=0.25) as server, ZenohBus("ada", connect=server.endpoint) as bus:
        client = FakeClient(bus, tree_row(1), (0.0, 0.0))

        def knows() -> bool:
            client.tick(time.monotonic())
            return client.replicator.has_clock

        wait(knows, "the clock of the server")
        assert client.replicator.real_time_factor == 0.25
        before = server.time
        now = time.monotonic()
        away = client.replicator.network_time(now) - before
        assert abs(away) < 0.25 * (client.replicator.round_trip or 0.0) + (server.time - before) + 0.05


@pytest.mark.parametrize("factor", [0.0, 1.5, float("nan")])
def test_a_server_refuses_a_factor_that_no_client_would_believe(factor: float) -> None:
    with pytest.raises(UsageError, match=r"real-time factor is .*: give auto, or 0\.01 to 1"):
        Server("tcp/127.0.0.1:0", real_time_factor=factor)


def test_a_linked_server_has_no_factor_of_its_own() -> None:
    with pytest.raises(UsageError, match="--real-time-factor"):
        Server("tcp/127.0.0.1:0", connect=["tcp/127.0.0.1:1"], real_time_factor=0.5)


@pytest.mark.parametrize("factor", [0.0, -1.0, 1.5, float("nan"), float("inf")])
def test_an_impossible_factor_is_not_believed(factor: float) -> None:
    with pytest.raises(MessageError, match="real-time factor"):
        decode_time(encode_time(1.0, 2.0, factor))
