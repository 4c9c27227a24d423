"""One client as users start it, and a stock ROS node that measures when, how often and how late the client's messages
arrive."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import Any

from vinesim.client.programs import EXIT_TIMEOUT, START_TIMEOUT, ProgramGroup, RosListener, TopicReport, program_group
from vinesim.client.rate_loop import TickLog
from vinesim.ros import middleware

POLL_PERIOD = 0.02
"""Wall time between two checks for first messages [s]."""
RGB = "/head_front_camera/rgb/image_raw"
DEPTH = "/head_front_camera/depth/image_raw"
LIDAR = "/lidar/points"
"""Topic of vinebot's lidar; ``RGB`` and ``DEPTH`` are topics of its front camera."""
CLOCK = "/clock"


class RosMissing(RuntimeError):
    """The measurement needs ROS 2; the text explains why ROS 2 cannot be used."""

    exit_code = 3


@dataclasses.dataclass(frozen=True)
class LiveRun:
    """Measurements of a client."""

    first: dict[str, float]
    """Time from the client's start to the first message of each topic [s]."""
    topics: TopicReport
    """Statistics of each topic, from the time at which all topics had a message."""
    loop: dict[str, float]
    """Rate and work of the client's ticks in the same time as ``topics``: see :meth:`TickLog.between`."""
    status: dict[str, Any]
    """The client's last status line."""


@contextlib.contextmanager
def own_processes(**environ: str) -> Iterator[ProgramGroup]:
    """Yields a group for processes in a ROS domain of their own, unless the user has set one. When the context ends,
    each process gets time to end its own children."""
    domain = {} if "ROS_DOMAIN_ID" in os.environ else {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}
    with program_group(3.0 * EXIT_TIMEOUT, **domain, **environ) as group:
        yield group


def run_client(options: Sequence[str], topics: Sequence[str], seconds: float, **environ: str) -> LiveRun:
    """Start ``vinesim client OPTIONS``, subscribe to ``topics``, and measure for ``seconds`` once all topics have a
    message.

    ``environ`` is added to the client's environment. Raises :class:`RosMissing`, or :class:`ProgramFailed` if the
    client ends or a topic stays silent.
    """
    if (reason := middleware.unavailable_reason()) is not None:
        raise RosMissing(reason)
    with own_processes(**environ) as group, tempfile.TemporaryDirectory() as folder:
        log = pathlib.Path(folder) / "ticks.npz"
        listener = RosListener(group, topics)
        listener.wait_until_listening()
        client = group.start(
            "client",
            "-m",
            "vinesim",
            "client",
            "--role",
            "robot",
            "--status",
            "json",
            "--tick-log",
            str(log),
            *options,
        )
        deadline = time.monotonic() + START_TIMEOUT
        status: dict[str, Any] = {}
        while missing := listener.missing():
            for line in client.new_lines():
                status = json.loads(line)
            if time.monotonic() > deadline:
                raise client.fault(f"no message of {', '.join(missing)} within {START_TIMEOUT:.0f} s")
            time.sleep(POLL_PERIOD)
        listener.restart()
        since = time.monotonic()
        while time.monotonic() < since + seconds:
            for line in client.new_lines():
                status = json.loads(line)
            time.sleep(POLL_PERIOD)
        until = time.monotonic()
        listener.stop()
        client.finish()
        first = {topic: moment - client.started for topic, moment in listener.first.items()}
        return LiveRun(first, listener.report(), TickLog.load(log).between(since, until), status)
