"""What a demo says while it waits for its clients."""

from __future__ import annotations

import queue
from types import SimpleNamespace
from typing import Any, cast

from vinesim.cli.demo.readiness import progress_of
from vinesim.client.programs import Program


def client(*stderr: str) -> Program:
    return cast(Program, SimpleNamespace(stderr_tail=list(stderr), stdout_lines=queue.Queue()))


def test_the_line_says_what_the_first_waiting_client_does() -> None:
    clients = {
        "picker": client("vinesim: compiling kernels, only once: 3 of 31 done"),
        "visitor": client("vinesim: compiling kernels, only once: 4 of 31 done"),
    }
    newest: dict[str, dict[str, Any]] = {}
    assert progress_of(clients, newest) == "compiling kernels, only once: 3 of 31 done"
    newest["picker"] = {"sensors_awaited": ["picker: compiling kernels, only once: 1 of 16 done"]}
    assert progress_of(clients, newest) == "picker: compiling kernels, only once: 1 of 16 done"
    newest["picker"] = {"sensors_awaited": ["picker: head_front_camera"]}
    assert progress_of(clients, newest) == "compiling kernels, only once: 4 of 31 done"


def test_warnings_do_not_greet_a_newcomer() -> None:
    warning = "2026-01-01 00:00:00,000 WARNING vinesim.client.faults: 26 steps were skipped"
    assert progress_of({"picker": client(warning)}, {}) == ""
    assert progress_of({"picker": client(warning)}, {"picker": {"sensors_awaited": []}}) == ""
