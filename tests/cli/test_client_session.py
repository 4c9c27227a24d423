"""A client process: the world that it enters, and what its loop says when its GPU fails."""

from __future__ import annotations

import contextlib
import json
import pathlib
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.waiting import wait
from vinesim.cli import client_session
from vinesim.cli.client_session import ClientSession, save_report
from vinesim.cli.demo.summary import LOOP_KEYS, job_summary
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
    one._page = None
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


def test_a_report_is_valid_json_whatever_its_numbers_are(tmp_path: pathlib.Path) -> None:
    save_report(tmp_path, {"off": float("nan"), "peak": [np.float64("inf"), np.float64(1.5)], "count": np.int64(3)})
    report = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert report == {"off": None, "peak": [None, 1.5], "count": 3}


@pytest.mark.parametrize(
    ("is_stopped", "reason"),
    [(True, "stopped at 'reach' before the end"), (False, "70 s were over at 'reach'; give more --seconds")],
)
def test_the_summary_of_a_task_says_whether_its_time_was_over(
    tmp_path: pathlib.Path, is_stopped: bool, reason: str
) -> None:
    (tmp_path / "picker").mkdir()
    job = {"succeeded": False, "reason": "", "phase": "reach"}
    save_report(
        tmp_path / "picker",
        {"job": job, "time": 70.0, "bunches_picked": 0, "fruit": {}} | dict.fromkeys(LOOP_KEYS, 1.0),
    )
    given = {"scene": "winter_spur", "seed": 1, "robot": "vinebot", "no_ros": None, "with_visitor": False}
    summary = job_summary(tmp_path, "prune", "pruned", **given, is_stopped=is_stopped)
    assert (summary["pruned"], summary["reason"]) == (False, reason)
