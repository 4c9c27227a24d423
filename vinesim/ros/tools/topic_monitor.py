"""A monitor of ROS topics: subscribes with stock rclpy and reports counts, rates, latencies, ages and losses.

``python -m vinesim.ros.tools.topic_monitor --seconds 10`` subscribes to every topic (or to those given by ``--topic``)
and prints one JSON object. For each topic it contains the type and its hash, the number of messages, the rate, the
smallest number of messages in any second, bytes, the median time from publishing to arrival (for latched messages:
their age), the age of the header stamp at arrival by /clock, the number of lost messages (gaps in the publisher's
sequence numbers), and whether the stamps never decreased. Without ``--seconds`` the monitor runs until its standard
input is closed. Meanwhile a line "restart" on standard input resets the counts. For a line "counts" the monitor prints
the number of messages of each topic, as a JSON object on one line.

With ``--announce`` the monitor prints a JSON object on one line when it starts to listen and for the first message of
every topic; its report is on one line, too. With ``--once TOPIC`` it ends the subscription to a topic after the first
message, so that the topic costs its publisher nothing more. With ``--arrivals FILE`` it writes sending time, arrival
time, stamp and number of each message: one array [message, 4] int64 per topic, see :attr:`TopicStats.arrivals`.

A hundred times a second the monitor takes all waiting messages of every topic in serialised form, so that counting
costs little. The first message of every topic is deserialised, to check that it is well-formed. The arrival time is the
one at which the middleware of this process receives a message. The monitor runs without vinesim's middleware profile,
like any other node.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import pathlib
import queue
import statistics
import struct
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vinesim.core import allocator
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

DISCOVERY_PERIOD = 0.05
"""Time between two searches for new topics, until all named topics are found [s]."""
EXCLUDED_TOPICS = ("/rosout", "/parameter_events")
"""Topics that every node publishes. They are monitored only if they are named."""
CLOCK = "/clock"
POLL_PERIOD = 0.01
"""Time between two checks for waiting messages [s]."""
QUEUE_DEPTH = 1000
"""History depth of the subscriptions: several seconds of a topic that is published in every step."""
LARGE_QUEUE_DEPTH = 10
"""History depth of the subscriptions to :data:`LARGE_TYPES`, which take much memory: rclpy's default."""
LARGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
"""Message types with large messages."""


class SimulationClock:
    """Estimates simulated time from the last hundred messages of /clock. They also yield its rate, since a world may
    run slower than real time. The message with the smallest delay is assumed to have none."""

    def __init__(self) -> None:
        self._messages: deque[tuple[int, int]] = deque(maxlen=100)
        """Arrival time and stamp of each message [ns]."""
        self._line: tuple[float, int, int] | None = None
        """Simulated time per real time [1], and arrival time and stamp [ns] of the message with the smallest delay.
        None: to be computed again, because a message was added."""

    def add(self, arrival: int, stamp: int) -> None:
        """Add a /clock message with simulated time ``stamp`` [ns] that arrived at wall time ``arrival`` [ns]."""
        self._messages.append((arrival, stamp))
        self._line = None

    def age(self, arrival: int, stamp: int) -> int | None:
        """Returns the simulated time from ``stamp`` [ns] to the wall time ``arrival`` [ns]; None if no /clock
        message has arrived."""
        if not self._messages:
            return None
        if self._line is None:
            (first, begin) = self._messages[0]
            (last, end) = self._messages[-1]
            rate = (end - begin) / (last - first) if last > first else 1.0
            self._line = rate, *max(self._messages, key=lambda one: one[1] - begin - rate * (one[0] - first))
        rate, quickest, its_stamp = self._line
        return its_stamp - stamp + round(rate * (arrival - quickest))


class TopicStats:
    """Statistics of one topic. ``message``: class of its messages. ``publishers``: number of its publishers.
    ``clock``: estimate of simulated time, for the age of header stamps."""

    def __init__(
        self, type_name: str, type_hash: str, message: type, publishers: int, clock: SimulationClock | None = None
    ) -> None:
        self.type_name = type_name
        self.type_hash = type_hash
        self.publishers = publishers
        self.first: float | None = None
        """Wall time of the first message [s since the epoch]."""
        self.is_clock = False
        """Whether the messages of this topic are added to ``clock``."""
        self._clock = clock or SimulationClock()
        self._message = message
        self._stamp_at = _stamp_offset(message)
        self._stamp = (-1, 0)
        self._sequence: int | None = None
        self.arrivals: list[tuple[int, int, int, int]] | None = None
        """Arrival time, sending time and stamp [ns], and sequence number of each message; -1 for a missing stamp or
        number. None: not recorded."""
        self.restart(None)

    def restart(self, since: float | None) -> None:
        """Reset all counts. Rates are then computed from the wall time ``since`` [s], or from the next message on if
        it is None."""
        self.since = since
        self.count = self.bytes = self.lost = 0
        self.stamps_rise = True
        self._by_second: Counter[int] = Counter()
        self._latencies: deque[int] = deque(maxlen=10_000)
        self._ages: deque[int] = deque(maxlen=10_000)

    def add(self, message: bytes, info: dict[str, Any]) -> None:
        """Count one serialised message. ``info``: its metadata from the middleware."""
        now = info.get("received_timestamp") or time.time_ns()
        if self.first is None:
            from rclpy.serialization import deserialize_message

            deserialize_message(message, self._message)
            self.first = now * 1e-9
        if self.since is None:
            self.since = now * 1e-9
        self.count += 1
        self.bytes += len(message)
        self._by_second[int(now * 1e-9 - self.since)] += 1
        self._latencies.append(now - info["source_timestamp"])
        sequence = info["publication_sequence_number"]
        if sequence is not None:
            if self._sequence is not None:
                self.lost += max(sequence - self._sequence - 1, 0)
            self._sequence = sequence
        simulated = -1
        if self._stamp_at is not None and len(message) >= self._stamp_at + 8:
            stamp = struct.unpack_from(("<" if message[1] & 1 else ">") + "iI", message, self._stamp_at)
            simulated = self._add_stamp(now, stamp)
        if self.arrivals is not None:
            self.arrivals.append((now, info["source_timestamp"], simulated, -1 if sequence is None else sequence))

    def _add_stamp(self, now: int, stamp: tuple[int, int]) -> int:
        """Add the stamp (seconds, nanoseconds) of a message that arrived at ``now`` [ns]. Returns the stamp in ns."""
        self.stamps_rise &= stamp >= self._stamp
        self._stamp = stamp
        simulated = stamp[0] * 1_000_000_000 + stamp[1]
        if self.is_clock:
            self._clock.add(now, simulated)
        if (age := self._clock.age(now, simulated)) is not None:
            self._ages.append(age)
        return simulated

    def report(self, until: float | None = None) -> dict[str, Any]:
        """Returns the statistics until the wall time ``until`` [s] as plain values. ``lost`` is None if the topic
        has several publishers, since each numbers its own messages."""
        now = time.time_ns() * 1e-9 if until is None else until
        span = 0.0 if self.since is None else now - self.since
        return {
            "type": self.type_name,
            "type_hash": self.type_hash,
            "first": self.first,
            "count": self.count,
            "hz": round(self.count / span, 2) if self.count > 1 and span > 0.0 else None,
            "slowest_second": min((self._by_second[i] for i in range(int(span))), default=None) if self.count else None,
            "bytes": self.bytes,
            "latency_ms": round(statistics.median(self._latencies) * 1e-6, 3) if self._latencies else None,
            "age_ms": _percentiles_ms(self._ages),
            "lost": self.lost if self.publishers <= 1 else None,
            "stamps_rise": self.stamps_rise if self._stamp_at is not None else None,
        }


class TopicMonitor:
    """Subscribes to topics as they appear, and counts their messages."""

    def __init__(
        self,
        topics: Sequence[str] = (),
        once: Sequence[str] = (),
        announce: Callable[[str, float], None] | None = None,
        queue_depth: int | None = None,
        arrivals: bool = False,
    ) -> None:
        """``topics``, ``once``: names of topics; all topics if both are empty. Those in ``once`` are monitored until
        their first message. ``announce``: called with each topic and the wall time of its first message [s].
        ``queue_depth``: history depth; None: :data:`QUEUE_DEPTH` or :data:`LARGE_QUEUE_DEPTH`. ``arrivals``: whether
        the times of every message are recorded."""
        from rclpy.context import Context
        from rclpy.node import Node

        self.stats: dict[str, TopicStats] = {}
        self._topics = {*topics, *once}
        self._once = set(once)
        self._announce = announce
        self._queue_depth = queue_depth
        self._keeps_arrivals = arrivals
        self._unannounced: set[str] = set()
        self._clock = SimulationClock()
        self._context = Context()
        self._context.init([])
        self._node = Node("topic_monitor", context=self._context, enable_rosout=False, start_parameter_services=False)
        self._subscriptions: dict[str, Any] = {}

    def run(self, requests: queue.SimpleQueue[str], seconds: float | None) -> None:
        """Count messages and obey requests, until the request "stop" or until ``seconds`` [s] after the first
        message."""
        next_look = 0.0
        deadline = None
        while deadline is None or time.monotonic() < deadline:
            if time.monotonic() >= next_look and not (self._topics and self._topics <= self.stats.keys()):
                self._discover()
                next_look = time.monotonic() + DISCOVERY_PERIOD
            time.sleep(POLL_PERIOD)
            self._take()
            if self._unannounced:
                self._announce_first()
            if seconds is not None and deadline is None and any(topic.count for topic in self.stats.values()):
                deadline = time.monotonic() + seconds
            while not requests.empty():
                match requests.get():
                    case "stop":
                        return
                    case "counts":
                        _print_line({"counts": {name: topic.count for name, topic in self.stats.items()}})
                    case _:
                        self.restart()

    def _take(self) -> None:
        """Count all waiting messages. This takes them directly, because an executor would take one at a time and
        check all topics each time."""
        for name, subscription in self._subscriptions.items():
            take = subscription.handle.take_message
            message = subscription.msg_type
            add = self.stats[name].add
            while (taken := take(message, True)) is not None:
                add(*taken)

    def restart(self) -> None:
        """Reset all counts."""
        now = time.time()
        for topic in self.stats.values():
            topic.restart(now)

    def report(self) -> dict[str, dict[str, Any]]:
        """Returns the statistics of each topic, by topic."""
        now = time.time()
        return {name: topic.report(now) for name, topic in sorted(self.stats.items())}

    def save_arrivals(self, path: pathlib.Path) -> None:
        """Write the times of every message: one array [message, 4] int64 per topic, see :attr:`TopicStats.arrivals`."""
        rows: dict[str, Any] = {n: np.array(t.arrivals, np.int64).reshape(-1, 4) for n, t in self.stats.items()}
        np.savez(path, **rows)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._node.destroy_node()
        self._context.shutdown()

    def _discover(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            is_hidden = name in EXCLUDED_TOPICS or "/_action/" in name
            is_monitored = name in self._topics if self._topics else not is_hidden
            if is_monitored and name not in self.stats:
                self._subscribe(name, types[0])

    def _subscribe(self, name: str, type_name: str) -> None:
        from vinesim.ros.tools.subscribing import message_class, offered_qos

        offered = self._node.get_publishers_info_by_topic(name)
        message = message_class(type_name)
        if not offered or message is None:
            return
        depth = self._queue_depth or (LARGE_QUEUE_DEPTH if type_name in LARGE_TYPES else QUEUE_DEPTH)
        topic = TopicStats(type_name, str(offered[0].topic_type_hash), message, len(offered), self._clock)
        topic.is_clock = name == CLOCK
        topic.arrivals = [] if self._keeps_arrivals else None
        self.stats[name] = topic
        self._unannounced.add(name)
        self._subscriptions[name] = self._node.create_subscription(
            message, name, lambda _: None, offered_qos(offered, depth), raw=True
        )

    def _announce_first(self) -> None:
        """Announce the topics whose first message has arrived, and end the subscriptions that were for one message
        only."""
        for name in [name for name in self._unannounced if self.stats[name].first is not None]:
            self._unannounced.remove(name)
            if self._announce is not None:
                self._announce(name, self.stats[name].first or 0.0)
            if name in self._once:
                self._node.destroy_subscription(self._subscriptions.pop(name))


def _percentiles_ms(times: Sequence[int]) -> dict[str, float] | None:
    """Median and 95th percentile [ms] of times [ns]; None if there are none."""
    if not times:
        return None
    ordered = sorted(times)
    return {f"p{p}": round(ordered[min(p * len(ordered) // 100, len(ordered) - 1)] * 1e-6, 3) for p in (50, 95)}


def _stamp_offset(message: Any) -> int | None:
    """Returns the offset of the (first) stamp in a serialised message [B], or None if the message does not begin
    with a stamp."""
    first = next(iter(message.get_fields_and_field_types().values()), "")
    if first in ("std_msgs/Header", "builtin_interfaces/Time"):
        return 4
    return 8 if first == "sequence<geometry_msgs/TransformStamped>" else None


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Options of the command line."""

    topics: list[str]
    once: list[str]
    announce: bool
    queue: int | None
    seconds: float | None
    out: pathlib.Path | None
    arrivals: pathlib.Path | None


def parse(arguments: Sequence[str] | None = None) -> Arguments:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m vinesim.ros.tools.topic_monitor", description="Count what arrives on ROS topics."
    )
    parser.add_argument("--topic", action="append", default=[], help="monitor only this topic (may be repeated)")
    parser.add_argument("--once", action="append", default=[], help="monitor until its first message (may be repeated)")
    parser.add_argument("--announce", action="store_true", help="print a JSON line for each topic's first message")
    parser.add_argument("--queue", type=int, help="history depth of the subscriptions")
    parser.add_argument("--seconds", type=float, help="duration from the first message; default: until stdin closes")
    parser.add_argument("--out", type=pathlib.Path, help="write the JSON here instead of to stdout")
    parser.add_argument("--arrivals", type=pathlib.Path, help="write the times of every message here (.npz)")
    given = parser.parse_args(arguments)
    return Arguments(given.topic, given.once, given.announce, given.queue, given.seconds, given.out, given.arrivals)


def main(arguments: Sequence[str] | None = None) -> int:
    """Monitor topics and write the report. Returns the exit status."""
    given = parse(arguments)
    reason = middleware.unavailable_reason()
    if reason is not None:
        sys.stderr.write(reason + "\n")
        return 2
    allocator.trim_regularly()
    middleware.clear_profile()
    message_packages.ensure_importable(["tf2_msgs", "vision_msgs", "audio_common_msgs"])
    requests: queue.SimpleQueue[str] = queue.SimpleQueue()
    if given.seconds is None:
        threading.Thread(target=_read_requests, args=(requests,), daemon=True).start()
    announce = _print_first if given.announce else None
    monitor = TopicMonitor(given.topics, given.once, announce, given.queue, given.arrivals is not None)
    if given.announce:
        _print_line({"listening": time.time()})
    with contextlib.suppress(KeyboardInterrupt):
        monitor.run(requests, given.seconds)
    text = json.dumps(monitor.report(), indent=None if given.announce else 1)
    monitor.close()
    if given.arrivals is not None:
        monitor.save_arrivals(given.arrivals)
    if given.out is None:
        sys.stdout.write(text + "\n")
    else:
        given.out.write_text(text)
    return 0


def _read_requests(requests: queue.SimpleQueue[str]) -> None:
    """Put each line of standard input into ``requests``, and "stop" at the end of the input."""
    for line in sys.stdin:
        requests.put(line.strip())
    requests.put("stop")


def _print_first(topic: str, first: float) -> None:
    _print_line({"topic": topic, "first": first})


def _print_line(values: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
