"""Waiting until server, clients, sensors and listener of a demo are all ready, and saying what is still missing."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console

from vinesim.cli.demo.progress import Statuses
from vinesim.client.processes.child_process import Process, ProcessFailed
from vinesim.client.processes.ros_listener import RosListener

POLL_PERIOD = 0.05
"""Wall time between two looks at what is still missing [s]."""
PROGRESS_MARK = "vinesim: "
"""Before what a process says of its progress."""
LINE_PERIOD = 5.0
"""Wall time between two lines where no line can be updated [s]."""


def wait_until_ready(
    clients: Mapping[str, Process],
    others: list[Process],
    listener: RosListener | None,
    newest: Statuses,
    describe: Callable[[str], str],
    console: Console,
    timeout: float,
) -> dict[str, float]:
    """Wait until every client steps and every topic of the listener had a message.

    Returns the wall time of each of these first events [s since the epoch], clients by name and topics by theirs.
    ``describe`` names what a topic belongs to. :class:`ProcessFailed` if a process ends, or after ``timeout`` [s].
    """
    ready: dict[str, float] = {}
    with _waiting_line(console) as show:
        begin = time.monotonic()
        while True:
            for name, process in clients.items():
                for line in process.new_lines():
                    newest[name] = json.loads(line)
                    ready.setdefault(name, time.time())
            for process in others:
                if process.child.poll() is not None:
                    raise process.failure()
            topics = [] if listener is None else listener.missing()
            missing = [name for name in clients if name not in ready]
            # a client that does not step yet stands for its sensors
            missing += [] if missing else dict.fromkeys(describe(topic) for topic in topics)
            if not missing:
                return ready | ({} if listener is None else listener.first)
            waited = time.monotonic() - begin
            if waited > timeout:
                raise ProcessFailed(f"not ready after {timeout:.0f} s: {', '.join(missing)}")
            doing = progress_of(clients, newest)
            show(f"{waited:3.0f} s: waiting for {', '.join(missing)}{f' ({doing})' if doing else ''}")
            time.sleep(POLL_PERIOD)


def progress_of(clients: Mapping[str, Process], newest: Statuses) -> str:
    """What the first client that waits for something says of it, such as how many kernels are compiled.

    All clients wait for the same kernels. What else they print, such as warnings, is not for one who waits.
    """
    for name, process in clients.items():
        if name in newest:  # it steps, and its sensors are to join
            awaited = newest[name].get("sensors_awaited", [])
            lines = [text for text in awaited if "compiling" in text]
        else:
            lines = [line for line in process.stderr_tail if line.startswith(PROGRESS_MARK)]
        if lines:
            return lines[-1].removeprefix(PROGRESS_MARK)
    return ""


@contextlib.contextmanager
def _waiting_line(console: Console) -> Iterator[Callable[[str], None]]:
    """A function that shows a text: on a terminal in one line that it updates, else every few seconds."""
    if console.is_terminal:
        with console.status("") as status:
            yield status.update
        return
    next_line = time.monotonic() + LINE_PERIOD

    def show(text: str) -> None:
        nonlocal next_line
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + LINE_PERIOD
            console.print(text, highlight=False, soft_wrap=True)

    yield show
