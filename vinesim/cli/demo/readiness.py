"""Waits until server, clients, sensors and listener of a demo are ready, and shows what is still missing."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console

from vinesim.cli.demo.progress import Statuses
from vinesim.client.programs import Program, ProgramFailed, RosListener

POLL_PERIOD = 0.05
"""Wall time between two checks whether all programs, sensors and topics of the demo are ready [s]."""
PROGRESS_MARK = "vinesim: "
"""Prefix of the lines in which a process reports its progress."""
LINE_PERIOD = 5.0
"""Wall time between two lines where a line cannot be updated, as in a log file [s]."""


def wait_until_ready(
    clients: Mapping[str, Program],
    others: list[Program],
    listener: RosListener | None,
    newest: Statuses,
    describe: Callable[[str], str],
    console: Console,
    timeout: float,
) -> dict[str, float]:
    """Wait until every client steps and every topic of the listener has had a message.

    Returns the wall time of each first event [s since the epoch] by name of the client or topic. ``describe`` returns a
    text for a missing topic. Raises :class:`ProgramFailed` if a process ends, or after ``timeout`` [s].
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
            # sensors are listed only after all clients step
            missing += [] if missing else dict.fromkeys(describe(topic) for topic in topics)
            if not missing:
                return ready | ({} if listener is None else listener.first)
            waited = time.monotonic() - begin
            if waited > timeout:
                raise ProgramFailed(f"not ready after {timeout:.0f} s: {', '.join(missing)}")
            doing = progress_of(clients, newest)
            show(f"{waited:3.0f} s: waiting for {', '.join(missing)}{f' ({doing})' if doing else ''}")
            time.sleep(POLL_PERIOD)


def progress_of(clients: Mapping[str, Program], newest: Statuses) -> str:
    """Returns the progress text of the first client that waits for something, such as the number of compiled kernels.

    All clients wait for the same kernels. Other output of clients, such as warnings, is left out.
    """
    for name, process in clients.items():
        if name in newest:  # this client steps, but its sensors are not ready yet
            awaited = newest[name].get("sensors_awaited", [])
            lines = [text for text in awaited if "compiling" in text]
        else:
            lines = [line for line in process.stderr_tail if line.startswith(PROGRESS_MARK)]
        if lines:
            return lines[-1].removeprefix(PROGRESS_MARK)
    return ""


@contextlib.contextmanager
def _waiting_line(console: Console) -> Iterator[Callable[[str], None]]:
    """Yields a function that shows a text: in one updated line on a terminal, otherwise as a new line every few
    seconds."""
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
