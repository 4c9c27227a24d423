"""The loop of a client process: what it says when its GPU fails."""

from __future__ import annotations

import contextlib
import threading
from types import SimpleNamespace

import pytest

from vinesim.cli import client_session
from vinesim.cli.client_session import ClientSession
from vinesim.physics.plants.device_buffers import DeviceLost


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> ClientSession:
    """A session whose loop fails at once as a kernel launch does."""

    def fail(*_: object) -> None:
        raise RuntimeError("CUDA error 700: an illegal memory access")

    monkeypatch.setattr(client_session, "run_loop", fail)
    monkeypatch.setattr(client_session, "Status", lambda *_: SimpleNamespace(current=dict))
    one = ClientSession.__new__(ClientSession)
    one.options = SimpleNamespace(device="cuda:0", status="none", seconds=None, tick_log=None, connect=None)
    one._stop, one._stack = threading.Event(), contextlib.ExitStack()
    return one


CLIENT = SimpleNamespace(physics=SimpleNamespace(dt=0.01, time=12.5), tick=lambda: None)


def test_a_gpu_that_fails_under_the_plants_ends_the_client_in_one_line(session, monkeypatch):
    monkeypatch.setattr(client_session, "device_fault", lambda _: "Warp sees no NVIDIA GPU here")
    with session._stack, pytest.raises(DeviceLost, match=r"cuda:0 failed after 12\.5 s: Warp sees no NVIDIA GPU"):
        session.run(CLIENT)
    assert DeviceLost.exit_code == 3


def test_a_failure_beside_a_gpu_that_works_is_not_blamed_on_it(session, monkeypatch):
    monkeypatch.setattr(client_session, "device_fault", lambda _: None)
    with session._stack, pytest.raises(RuntimeError, match="error 700") as failure:
        session.run(CLIENT)
    assert not isinstance(failure.value, DeviceLost)
