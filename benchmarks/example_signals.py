"""``python -m benchmarks example_signals``: sends SIGINT and SIGTERM to the ROS examples at random moments, and checks
that they end in order (Linux).

The examples run against a real client. A signal comes up to :data:`LONGEST_RUN` after the example has set its handlers,
so some signals come while ROS starts. A run ends in order if its exit code is 0, and if its output has no traceback and
no error of ROS. On a machine with many other processes, the wall time until the end measures these processes as well;
the processor time does not.
"""

from __future__ import annotations

import os
import pathlib
import resource
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.support.example_programs import NAMES, handles_sigterm, start_example
from vinesim.client.programs import START_TIMEOUT, RosListener, program_group
from vinesim.scene.values import Measurement

BOUND = 2.0
"""Largest accepted time from the signal to the end of the process [s]."""
LONGEST_END = 60.0
"""Time after which an example that still runs is killed [s]."""
LONGEST_RUN = 4.0
"""Signals come at random moments within this time [s]."""
UNCLEAN = ("Traceback", "Error", "Exception", "invalid")
"""Words in the output of an example that did not end in order."""


def example_signals(
    runs: int, seed: int = 1, announce: Callable[[str], None] = lambda _: None, names: Sequence[str] = NAMES
) -> Iterator[Measurement]:
    """Run each example ``runs`` times, half of them with SIGINT, half with SIGTERM. Yields for each example how many
    runs ended in order, how many ended within :data:`BOUND`, and the longest times until the end."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": folder,
        }
        rng = np.random.default_rng(seed)
        with program_group() as group:
            listener = RosListener(group, (), once=["/joint_states"])
            group.start(
                *("client", "-m", "vinesim", "client", "--role", "robot", "--scene", "harvest", "--status", "none")
            )
            while listener.missing():
                time.sleep(0.1)
            listener.stop()
            for name in names:
                faults: list[str] = []
                ends: list[tuple[float, float]] = []
                for run in range(runs):
                    number = (signal.SIGINT, signal.SIGTERM)[run % 2]
                    delay = float(rng.uniform(0.0, LONGEST_RUN))
                    *times, fault = end_by_signal(name, number, delay, pathlib.Path(folder))
                    ends.append((times[0], times[1]))
                    if fault:
                        faults.append(f"{number.name} after {delay:.2f} s: {fault}")
                        announce(f"{name}: {faults[-1]}")
                longest, busiest = (max(column) for column in zip(*ends, strict=True))
                announce(f"{name}: {runs - len(faults)} of {runs} in order, at most {longest:.2f} s")
                in_time = sum(took <= BOUND for took, _ in ends)
                for what, count in ("in order", runs - len(faults)), (f"within {BOUND:g} s", in_time):
                    case = f"{name}: ends {what}"
                    yield Measurement("example_signals", case, count, "runs", "bar", runs, count / runs)
                yield Measurement(
                    "example_signals", f"{name}: longest end", longest, "s", "bar", BOUND, BOUND / max(longest, 1e-9)
                )
                load = f"load {os.getloadavg()[0]:.0f} on {os.cpu_count()} cores"
                yield Measurement("example_signals", f"{name}: most processor time of an end; {load}", busiest, "s")


def end_by_signal(name: str, number: signal.Signals, delay: float, folder: pathlib.Path) -> tuple[float, float, str]:
    """Start an example and send it a signal ``delay`` [s] after it has set its handlers. Returns wall time
    and processor time from the signal to the end [s], and what was wrong, an empty text if nothing was."""
    with (folder / "output").open("w+") as output:
        example = start_example(name, folder=folder, output=output)
        try:
            started = time.monotonic()
            while not handles_sigterm(example.pid):
                if example.poll() is not None or time.monotonic() > started + START_TIMEOUT:
                    output.seek(0)
                    return 0.0, 0.0, f"did not start: {' '.join(output.read().split())[-300:]}"
                time.sleep(0.002)
            time.sleep(delay)
            busy = _processor_time(example.pid) + _children_time()
            sent = time.monotonic()
            example.send_signal(number)
            try:
                code = example.wait(LONGEST_END)
            except subprocess.TimeoutExpired:
                return time.monotonic() - sent, 0.0, "still runs"
            took = time.monotonic() - sent
            busy = _children_time() - busy
        finally:
            example.kill()
            example.wait()
        output.seek(0)
        text = output.read()
    if code != 0 or any(word in text for word in UNCLEAN):
        return took, busy, f"exit code {code}: {' '.join(text.split())[-300:]}"
    return took, busy, ""


def _processor_time(process: int) -> float:
    """Returns the processor time that a process has used [s]."""
    fields = pathlib.Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _children_time() -> float:
    """Returns the processor time of all ended child processes [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
