"""``python -m benchmarks soak``: what it reads from /proc, and a short run of real programs."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
from typing import cast

import numpy as np
import pytest

from benchmarks import soak
from benchmarks.soak import Cast, SoakResult, _Run, measurements, run_soak, settle
from vinesim.bench.process_memory import ProcessHistory, ProcessSample, ProcessSampler, sample_process
from vinesim.client.programs import Program, ProgramFailed

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/smaps_rollup"), reason="needs /proc of Linux")


def history(own: list[float], period: float = 60.0, handles: list[int] | None = None) -> ProcessHistory:
    """Samples ``period`` [s] apart."""
    counts = handles or [5] * len(own)
    samples = [
        ProcessSample(memory=value, own=value, threads=3, handles=n) for value, n in zip(own, counts, strict=True)
    ]
    return ProcessHistory([100.0 + period * i for i in range(len(own))], samples)


def test_growth_is_the_slope_of_the_own_memory() -> None:
    """2 MB a minute are 120 MB an hour; what alternates about a mean does not grow."""
    assert history([50.0 + 2.0 * i for i in range(10)]).growth() == pytest.approx(120.0)
    assert abs(history([50.0, 51.0, 51.0, 50.0] * 5).growth()) < 1.0
    assert history([50.0]).growth() == 0.0


def test_handles_that_pile_up_are_seen() -> None:
    """A process that opens a file now and then has more of them in the second half; one that closes them has not."""
    assert history([1.0] * 6, handles=[5, 5, 6, 6, 7, 7]).change("handles") == 1
    assert history([1.0] * 6, handles=[5, 6, 5, 6, 5, 6]).change("handles") == 0


def test_processes_that_end_or_get_another_name_while_memory_settles_are_no_error() -> None:
    """An hour's figures are not lost for a process that was there for its first minutes only."""
    steady = history([50.0] * 30)
    brief = history([50.0] * 3)
    found, ended = settle(
        {("client", 1): steady, ("python", 2): brief, ("standby", 2): steady, ("helper", 3): brief},
        100.0,
        700.0,
        1840.0,
    )
    assert list(found) == [("client", 1), ("standby", 2)]
    assert ended == {"helper 3 ended": 1}
    assert len(list(measurements(SoakResult(found, ended, 100.0)))) == 11


def test_a_process_that_is_started_again_settles_from_its_own_start() -> None:
    """What it takes while it starts is no growth: 20 MB a minute for five minutes, then nothing."""
    late = history([20.0 * min(i, 5) for i in range(30)])
    late = ProcessHistory([time + 900.0 for time in late.times], late.samples)
    found, _ = settle({("standby", 1): late}, 100.0, 700.0, 2700.0)
    assert found["standby", 1].growth() == pytest.approx(0.0, abs=1e-9)
    assert found["standby", 1].times[0] == 1600.0


def test_samples_follow_what_a_process_takes() -> None:
    """40 MB that are written, and files that are open, are in the sample; a child is found by its name."""
    code = "\n".join(
        (
            "import sys, multiprocessing.resource_tracker as tracker",
            "tracker.ensure_running()",
            "print('ready', flush=True); sys.stdin.readline()",
            "block = bytearray(b'x') * 40_000_000; files = [open('/dev/null') for _ in range(7)]",
            "print('taken', flush=True); sys.stdin.readline()",
        )
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        before = sample_process(child.pid)
        child.stdin.write("\n")
        child.stdin.flush()
        assert child.stdout.readline() == "taken\n"
        after = sample_process(child.pid)
        assert 37.0 < after.own - before.own < 42.0
        assert after.memory >= after.own
        assert (after.handles - before.handles, after.threads) == (7, 1)
        sampler = ProcessSampler([("parent", child.pid)])
        sampler.sample(1.0)
        assert sampler.memory() > after.own
        assert sorted(kind for kind, _ in sampler.histories) == ["parent", "resource tracker"]
        child.stdin.close()
    sampler.sample(2.0)
    assert sampler.memory() == 0.0, "a process that has ended takes nothing"
    assert [one.times for one in sampler.histories.values()] == [[1.0], [1.0]]


def test_a_client_that_ends_badly_does_not_cost_the_figures(tmp_path: pathlib.Path) -> None:
    """Of a client that is killed at the end, the last status counts, and that it wrote no report."""

    class Killed:
        def interrupt(self) -> None: ...

        def finish(self) -> None:
            raise ProgramFailed("ended with exit code -9")

    run = _Run.__new__(_Run)
    run._folder = tmp_path
    run._figures = {"malformed": 0, "refused": 1}
    run.clients = {"robot_1": cast(Program, Killed())}
    run._refused = run._malformed = 0
    run._newest = {"robot_1": {"faults": {"messages_refused": 3}, "sensor_restarts": 2}}
    counts = run.end()
    assert counts.pop("robot_1 without a report (ended with exit code -9)") == 1
    assert {name: count for name, count in counts.items() if count} == {
        "refused, server": 1,
        "messages_refused, clients": 3,
        "sensor_restarts, clients": 2,
    }


@pytest.mark.long
def test_a_short_run_is_clean(monkeypatch) -> None:
    """One robot, one person and a recorder, six samples: hardly a thread or a file more, nothing malformed."""
    monkeypatch.setattr(soak, "SAMPLE_PERIOD", 2.0)
    result = run_soak(Cast(robots=1, people=1), 0.2, lambda line: None)
    kinds = {kind for kind, _ in result.histories}
    assert {"server", "robot client", "sensor process", "person's client", "recorder"} <= kinds
    changes = {
        (kind, what): one.change(what) for (kind, _), one in result.histories.items() for what in ("threads", "handles")
    }
    # Zenoh and DDS start and end threads of their own; a leak in each round would be more
    assert max(changes.values()) <= 6, changes
    counts = result.counts
    assert {name: n for name, n in counts.items() if n and not name.startswith("steps_skipped")} == {}
    rows = list(measurements(result))
    assert all(np.isfinite(row.value) for row in rows)
    assert any(row.case.startswith("robot client: growth") for row in rows)
