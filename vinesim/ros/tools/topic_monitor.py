"""A monitor of ROS topics: subscribes with stock rclpy and reports counts, rates, latencies and losses.

``python -m vinesim.ros.tools.topic_monitor --seconds 10`` subscribes to every topic (``--topic`` names some) and
prints one JSON object: per topic the type and its hash, messages, rate, bytes, the median time from publishing to here
(the age,
for what was latched), the messages lost (gaps in the publisher's numbering) and whether the stamps ever went back.
Without ``--seconds`` it runs until its standard input is closed.

It takes messages in their serialised form, so that counting costs next to nothing; the first one of every topic is
deserialised, to check that it is well-formed. It runs without vinesim's middleware profile, as any other node.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import json
import pathlib
import statistics
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

DISCOVERY_PERIOD = 0.2
"""Time between two searches for new topics [s]."""
EXCLUDED_TOPICS = ("/rosout", "/parameter_events")
"""Topics of every node, not monitored unless named."""


class TopicStats:
    """Statistics of one topic."""

    def __init__(self, type_name: str, type_hash: str, message: type, publishers: int) -> None:
        self.type_name, self.type_hash = type_name, type_hash
        self.publishers = publishers
        self.count = self.bytes = self.lost = 0
        self.first = self.last = 0.0
        self.stamps_rise = True
        self._message = message
        self._stamp_at = _stamp_offset(message)
        self._stamp = (-1, 0)
        self._sequence: int | None = None
        self._latencies: deque[int] = deque(maxlen=10_000)

    def add(self, message: bytes, info: dict[str, Any]) -> None:
        """Count one serialised message with its meta-data from the middleware."""
        now = time.time_ns()
        if not self.count:
            from rclpy.serialization import deserialize_message

            deserialize_message(message, self._message)
            self.first = now * 1e-9
        self.last = now * 1e-9
        self.count += 1
        self.bytes += len(message)
        self._latencies.append(now - info["source_timestamp"])
        sequence = info["publication_sequence_number"]
        if sequence is not None:
            if self._sequence is not None:
                self.lost += max(sequence - self._sequence - 1, 0)
            self._sequence = sequence
        if self._stamp_at is not None and len(message) >= self._stamp_at + 8:
            order = "<" if message[1] & 1 else ">"
            stamp = struct.unpack_from(order + "iI", message, self._stamp_at)
            self.stamps_rise &= stamp >= self._stamp
            self._stamp = stamp

    def report(self) -> dict[str, Any]:
        """The statistics as plain values; ``lost`` is None if several publishers number their messages apart."""
        span = self.last - self.first
        return {
            "type": self.type_name,
            "type_hash": self.type_hash,
            "count": self.count,
            "hz": round((self.count - 1) / span, 2) if self.count > 1 and span > 0.0 else None,
            "bytes": self.bytes,
            "latency_ms": round(statistics.median(self._latencies) * 1e-6, 3) if self._latencies else None,
            "lost": self.lost if self.publishers <= 1 else None,
            "stamps_rise": self.stamps_rise if self._stamp_at is not None else None,
        }


class TopicMonitor:
    """Subscribes to topics as they appear."""

    def __init__(self, topics: Sequence[str] = ()) -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self.stats: dict[str, TopicStats] = {}
        self._topics = tuple(topics)
        self._context = Context()
        self._context.init([])
        self._node = Node("topic_monitor", context=self._context, enable_rosout=False, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def run(self, until: threading.Event, seconds: float | None) -> None:
        """Count messages until the event, or for so many ``seconds`` [s] after the first message."""
        next_look = 0.0
        deadline = None
        while not until.is_set() and (deadline is None or time.monotonic() < deadline):
            if time.monotonic() >= next_look:
                self._discover()
                next_look = time.monotonic() + DISCOVERY_PERIOD
            self._executor.spin_once(timeout_sec=DISCOVERY_PERIOD)
            if seconds is not None and deadline is None and any(topic.count for topic in self.stats.values()):
                deadline = time.monotonic() + seconds

    def report(self) -> dict[str, dict[str, Any]]:
        """The statistics of each topic."""
        return {name: topic.report() for name, topic in sorted(self.stats.items())}

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()

    def _discover(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            is_monitored = name in self._topics if self._topics else name not in EXCLUDED_TOPICS
            if is_monitored and name not in self.stats:
                self._subscribe(name, types[0])

    def _subscribe(self, name: str, type_name: str) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offered = self._node.get_publishers_info_by_topic(name)
        message = _message_class(type_name)
        if not offered or message is None:
            return
        # The strictest that every publisher offers, as `ros2 topic hz` does.
        reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in offered)
        latched = all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in offered)
        qos = QoSProfile(
            depth=20,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        topic = TopicStats(type_name, str(offered[0].topic_type_hash), message, len(offered))
        self.stats[name] = topic
        add: Any = topic.add  # rclpy hands over what the signature has room for, its annotations know less
        self._node.create_subscription(message, name, add, qos, raw=True)


def _message_class(type_name: str) -> type | None:
    """The class of ``package/msg/Name``, or None if its package is not installed."""
    package, kind, name = type_name.split("/")
    with contextlib.suppress(ImportError, AttributeError):
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    return None


def _stamp_offset(message: Any) -> int | None:
    """Where the (first) stamp lies in the serialised message, if it begins with one."""
    first = next(iter(message.get_fields_and_field_types().values()), "")
    if first in ("std_msgs/Header", "builtin_interfaces/Time"):
        return 4
    return 8 if first == "sequence<geometry_msgs/TransformStamped>" else None


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Options of the command line."""

    topics: list[str]
    seconds: float | None
    out: pathlib.Path | None


def parse(arguments: Sequence[str] | None = None) -> Arguments:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m vinesim.ros.tools.topic_monitor", description="Count what arrives on ROS topics."
    )
    parser.add_argument("--topic", action="append", default=[], help="monitor this one only (may be repeated)")
    parser.add_argument("--seconds", type=float, help="from the first message on; default: until stdin is closed")
    parser.add_argument("--out", type=pathlib.Path, help="write the JSON here instead of to stdout")
    given = parser.parse_args(arguments)
    return Arguments(given.topic, given.seconds, given.out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Monitor and report; the exit status."""
    given = parse(arguments)
    reason = middleware.unavailable_reason()
    if reason is not None:
        sys.stderr.write(reason + "\n")
        return 2
    middleware.clear_profile()
    message_packages.ensure_importable(["tf2_msgs"])
    stop = threading.Event()
    if given.seconds is None:
        threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    monitor = TopicMonitor(given.topics)
    with contextlib.suppress(KeyboardInterrupt):
        monitor.run(stop, given.seconds)
    text = json.dumps(monitor.report(), indent=1)
    monitor.close()
    if given.out is None:
        sys.stdout.write(text + "\n")
    else:
        given.out.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
