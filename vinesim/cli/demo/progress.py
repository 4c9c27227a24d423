"""Progress display of a running demo: a live table, or one line in each second."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from vinesim.client.programs import REPORT_TIMEOUT, Program
from vinesim.net.pace import describe

PICKER = "picker"
"""Name of the robot that pushes a bunch or does a task."""
VISITOR = "visitor"
"""Name of the robot that approaches and watches."""

Statuses = dict[str, dict[str, Any]]
"""The newest status of each client, by name."""


def show_progress(
    picker: Program,
    visitor: Program | None,
    server: Program,
    newest: Statuses,
    console: Console,
    headless: bool,
    is_over: Callable[[Statuses], bool] = lambda _: False,
) -> None:
    """Show the status of both clients until the picker ends. If ``is_over(newest)`` is true, the picker is interrupted.

    Raises :class:`ProgramFailed` if any process ends too early or the picker fails.
    """
    live = contextlib.nullcontext() if headless or not console.is_terminal else Live(console=console, transient=True)
    with live as view:
        while True:
            with contextlib.suppress(queue.Empty):
                while visitor is not None and (line := visitor.stdout_lines.get_nowait()):
                    newest[VISITOR] = json.loads(line)
            try:
                line = picker.stdout_lines.get(timeout=0.5)
            except queue.Empty:
                line = None
            if line == "":
                with contextlib.suppress(subprocess.TimeoutExpired):
                    picker.child.wait(REPORT_TIMEOUT)
                if picker.child.returncode != 0:
                    raise picker.failure()
                return
            for process in (visitor, server):
                if process is not None and process.child.poll() is not None:
                    raise process.failure()
            if line is not None:
                newest[PICKER] = json.loads(line)
                if view is not None:
                    view.update(status_table(newest))
                else:
                    console.print(status_line(newest[PICKER]), highlight=False, soft_wrap=True)
                if is_over(newest):
                    picker.interrupt()


def status_line(status: dict[str, Any]) -> str:
    """Returns the picker's status as one line."""
    common = (
        f"{status['time']:6.1f} s  {status['tick_hz']:6.2f} Hz  p99 {status['tick_p99_ms']:5.2f} ms  "
        f"awake {status['awake']:3d}  force {status['force']:6.2f} N  {pace(status)}"
    )
    if status["phase"]:
        return common + status["phase"]
    return common + (
        f"moved {status['displacement_mm']:6.1f} mm  out {status['bytes_out']:7d} B  "
        f"env {status['environment_bytes_out']:6d} B"
    )


def pace(status: dict[str, Any]) -> str:
    """Returns a text about the real-time factor and its cause, followed by two blanks; empty in real time."""
    text = describe(status["target_real_time_factor"], status["pace_cause"])
    return f"{text}  " if text else ""


def status_table(newest: Statuses) -> Table:
    """Returns a table with the newest status of all clients, side by side."""
    table = Table(title="vinesim demo", title_justify="left")
    table.add_column("")
    for name in newest:
        table.add_column(name, justify="right", min_width=14)
    rows = (
        ("time [s]", "time", ".1f"),
        ("tick rate [Hz]", "tick_hz", ".2f"),
        ("tick p99 [ms]", "tick_p99_ms", ".2f"),
        ("real-time factor", "target_real_time_factor", ".2f"),
        ("limited by", "pace_cause", "s"),
        ("awake plants", "awake", "d"),
        ("contact force [N]", "force", ".2f"),
        ("bunch moved [mm]", "displacement_mm", ".1f"),
        ("bytes in", "bytes_in", "d"),
        ("bytes out", "bytes_out", "d"),
        ("of these environment", "environment_bytes_out", "d"),
    )
    for label, key, form in rows:
        table.add_row(label, *(format(status[key], form) for status in newest.values()))
    if any(status["phase"] for status in newest.values()):
        table.add_row("job", *(status["phase"] for status in newest.values()))
    for topic in sorted({topic for status in newest.values() for topic in status["topics"]}):
        table.add_row(topic, *(f"{status['topics'].get(topic, 0.0):.1f} Hz" for status in newest.values()))
    return table
