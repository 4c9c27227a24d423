"""A stock ROS node in a process of its own. It receives the topics of clients, and records the time of their first
message and the number of messages."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from typing import Any

from vinesim.client.processes.child_process import REPORT_TIMEOUT, START_TIMEOUT, Process, ProcessGroup

TopicReport = dict[str, dict[str, Any]]
"""Statistics by topic, as :mod:`vinesim.ros.tools.topic_monitor` prints them."""


class RosListener:
    """Subscribes to named topics as they appear. Raises :class:`ProcessFailed` if its process ends."""

    def __init__(
        self,
        group: ProcessGroup,
        topics: Sequence[str],
        once: Sequence[str] = (),
        events: Sequence[str] = (),
        arrivals: pathlib.Path | None = None,
    ) -> None:
        """``once``: topics from which it unsubscribes after their first message. ``events``: topics that may stay
        silent. ``arrivals``: file for the times of every message, see :attr:`TopicStats.arrivals`."""
        self.topics = (*topics, *once)
        words = [word for topic in (*topics, *events) for word in ("--topic", topic)]
        words += [word for topic in once for word in ("--once", topic)]
        words += [] if arrivals is None else ["--arrivals", str(arrivals)]
        self._process: Process = group.start(
            "ROS listener", "-m", "vinesim.ros.tools.topic_monitor", "--announce", *words
        )
        self.listens_since: float | None = None
        """Wall time at which it began to look for topics [s since the epoch]; None before."""
        self.first: dict[str, float] = {}
        """Wall time of the first message of each topic that has come [s since the epoch]."""

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.child.pid

    @property
    def started(self) -> float:
        """Wall time at which its process was started [s since the epoch]."""
        return self._process.started

    def wait_until_listening(self) -> None:
        """Wait until the node subscribes to topics that appear."""
        while self.listens_since is None:
            self._read(json.loads(self._process.next_line(START_TIMEOUT)))

    def missing(self) -> list[str]:
        """Topics without any message yet, in the order in which they were named. Topics of events are left out."""
        for line in self._process.new_lines():
            self._read(json.loads(line))
        return [topic for topic in self.topics if topic not in self.first]

    def _read(self, announcement: dict[str, Any]) -> None:
        if "listening" in announcement:
            self.listens_since = announcement["listening"]
        else:
            self.first[announcement["topic"]] = announcement["first"]

    def restart(self) -> None:
        """Reset all counts: rates and losses are counted from now on."""
        self._process.write_line("restart")

    def stop(self) -> None:
        """End all counts, and the process."""
        self._process.write_line("stop")

    def report(self) -> TopicReport:
        """Statistics of all messages that came until :meth:`stop` or, if it was not called, until now."""
        *_, report = self._process.remaining_output(REPORT_TIMEOUT).splitlines()
        return json.loads(report)
