"""Lockstep: pictures, scans and states of two runs are equal to the bit, however busy the machine is."""

from __future__ import annotations

import json
import multiprocessing
import pathlib
import sys

import pytest

from tests.support import programs
from tests.support.waiting import deadline

pytestmark = pytest.mark.slow

SECONDS = 0.6
"""Of simulated time."""


def spin() -> None:
    """Keep a core busy."""
    while True:
        pass


def run(out: pathlib.Path, *options: str) -> dict:
    """The report of a robot that reaches for a bunch."""
    words = ["client", "--role", "robot", "--push", "36", "--no-ros", "--seconds", str(SECONDS), "--status", "none"]
    done = programs.run(
        [sys.executable, "-m", "vinesim", *words, "--out", str(out), *options],
        timeout=deadline(),
    )
    assert done.returncode == 0, done.stderr
    return json.loads((out / "report.json").read_text())


def test_two_runs_in_lockstep_are_equal_to_the_bit_on_an_idle_and_on_a_busy_machine(tmp_path) -> None:
    idle = run(tmp_path / "idle", "--sensors", "lockstep")
    busy = [multiprocessing.Process(target=spin, daemon=True) for _ in range(3)]
    try:
        for process in busy:
            process.start()
        loaded = run(tmp_path / "busy", "--sensors", "lockstep")
    finally:
        for process in busy:
            process.kill()
            process.join()
    for report in (idle, loaded):
        assert report["steps_skipped"] == 0
        assert report["frames"]["head_front_camera"] == pytest.approx(30.0 * SECONDS, abs=1), "the camera's own rate"
        assert report["frames"]["lidar"] == pytest.approx(10.0 * SECONDS, abs=1)
    assert set(idle["frame_digests"]) == {"head_front_camera", "lidar"}
    assert loaded["frame_digests"] == idle["frame_digests"]
    assert loaded["state_digest"] == idle["state_digest"]
