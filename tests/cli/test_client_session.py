"""A client process: the world that it enters, and what its loop says when its GPU fails."""

from __future__ import annotations

import contextlib
import threading
from types import SimpleNamespace

import pytest

from tests.support.waiting import wait
from vinesim.cli import client_session
from vinesim.cli.client_session import ClientSession
from vinesim.net.server.server import Server
from vinesim.plants.device_buffers import DeviceLost


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> ClientSession:
    """A session whose loop fails at once as a kernel launch does."""

    def fail(*_: object) -> None:
        raise RuntimeError("CUDA error 700: an illegal memory access")

    monkeypatch.setattr(client_session, "run_loop", fail)
    monkeypatch.setattr(client_session, "Status", lambda *_: SimpleNamespace(current=dict))
    one = ClientSession.__new__(ClientSession)
    one.options = SimpleNamespace(
        device="cuda:0", status="none", seconds=None, tick_log=None, connect=None, real_time_factor=1.0
    )
    one._stop = threading.Event()
    one._stack = contextlib.ExitStack()
    return one


CLIENT = SimpleNamespace(
    physics=SimpleNamespace(dt=0.01, time=12.5), tick=lambda: None, pace_limits=[], held=lambda: ""
)


def test_a_gpu_that_fails_under_the_plants_ends_the_client_in_one_line(session, monkeypatch):
    monkeypatch.setattr(client_session, "device_fault", lambda _: "Warp finds no NVIDIA GPU here")
    with session._stack, pytest.raises(DeviceLost, match=r"cuda:0 failed after 12\.5 s: Warp finds no NVIDIA GPU"):
        session.run(CLIENT)
    assert DeviceLost.exit_code == 3


def test_clients_in_different_worlds_of_one_server_do_not_meet(session):
    with session._stack, Server("tcp/127.0.0.1:0") as server:
        for world, name in (("north", "ada"), ("south", "bob"), ("south", "eva")):
            session.options = SimpleNamespace(connect=server.endpoint, tls=None, world=world)
            bus = session.bus(name)
        wait(lambda: server.actors == ["north/ada", "south/bob", "south/eva"], "three actors in two worlds")
        wait(lambda: bus.alive() == {"bob", "eva"}, "those of the south to meet")


def test_a_failure_beside_a_gpu_that_works_is_not_blamed_on_it(session, monkeypatch):
    monkeypatch.setattr(client_session, "device_fault", lambda _: None)
    with session._stack, pytest.raises(RuntimeError, match="error 700") as failure:
        session.run(CLIENT)
    assert not isinstance(failure.value, DeviceLost)
