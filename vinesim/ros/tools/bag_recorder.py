"""Records ROS topics into an MCAP file as rosbag2 does (profile ``ros2``), without rosbag2.

Messages are stored serialised, as they arrive. The file contains the definitions of their types, so any MCAP reader for
ROS 2 can decode them. Topics that appear during the recording are recorded, too.
"""

from __future__ import annotations

import logging
import pathlib
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Self

import rclpy
from mcap.writer import Writer
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from vinesim.core.errors import writing
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.ros.messages.definitions import UnknownTypeError, message_definition
from vinesim.ros.tools.subscribing import message_class, offered_qos

log = logging.getLogger(__name__)

DISCOVERY_PERIOD = 0.2
"""Time between two searches for new topics [s]."""
EXCLUDED = ("/rosout", "/parameter_events")
"""Topics that every node publishes. They are recorded only if they are named."""
QUEUE_DEPTH = 1000
"""History depth of the subscriptions."""


class BagRecorder:
    """Subscribes to topics and writes their messages to a file. It is a context manager; the file is complete at its
    end."""

    def __init__(self, path: pathlib.Path, topics: Sequence[str] = ()) -> None:
        """``topics``: topic names, or regular expressions that match a whole name; all topics if empty.

        Raises :class:`vinesim.core.errors.WriteError` if the file cannot be written.
        """
        middleware.configure()
        message_packages.ensure_importable(message_packages.available_packages())
        self._patterns = [re.compile(topic) for topic in topics]
        self.counts: Counter[str] = Counter()
        """Number of messages written, by topic."""
        self.unknown: set[str] = set()
        """Message types whose package is not installed. Their topics are not recorded."""
        self._path = path
        with writing(path):
            self._file = path.open("wb")
            self._writer = Writer(self._file)
            self._writer.start(profile="ros2", library="vinesim")
        self._schemas: dict[str, int] = {}
        self._subscriptions: dict[str, Any] = {}
        self._next_discovery = 0.0
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("vinesim_recorder", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def spin(self, timeout: float = 0.05) -> None:
        """Search for new topics when this is due. Then write the next message, or wait up to ``timeout`` [s] for
        one."""
        if time.monotonic() >= self._next_discovery:
            self._next_discovery = time.monotonic() + DISCOVERY_PERIOD
            for name, types in self._node.get_topic_names_and_types():
                if name not in self._subscriptions and self._is_wanted(name):
                    self._subscribe(name, types[0])
        with writing(self._path):
            self._executor.spin_once(timeout_sec=timeout)

    def _is_wanted(self, name: str) -> bool:
        if self._patterns:
            return any(pattern.fullmatch(name) for pattern in self._patterns)
        return name not in EXCLUDED and "/_action/" not in name

    def _subscribe(self, name: str, type_name: str) -> None:
        offered = self._node.get_publishers_info_by_topic(name)
        if not offered:
            return
        message = message_class(type_name)
        try:
            schema = self._schema(type_name) if message is not None else None
        except UnknownTypeError:
            schema = None
        if schema is None:
            if type_name not in self.unknown:
                log.warning("%s is not recorded: no package with %s is installed", name, type_name)
            self.unknown.add(type_name)
            self._subscriptions[name] = None
            return
        qos = offered_qos(offered, QUEUE_DEPTH)
        channel = self._writer.register_channel(
            topic=name,
            message_encoding="cdr",
            schema_id=schema,
            metadata={"offered_qos_profiles": _qos_text(qos)},
        )
        self._subscriptions[name] = self._node.create_subscription(
            message, name, self._taker(name, channel), qos, raw=True
        )

    def _taker(self, name: str, channel: int) -> Callable[[bytes], None]:
        def take(message: bytes) -> None:
            now = time.time_ns()
            self._writer.add_message(channel, log_time=now, data=message, publish_time=now)
            self.counts[name] += 1

        return take

    def _schema(self, type_name: str) -> int:
        if type_name not in self._schemas:
            text = message_definition(type_name).encode()
            self._schemas[type_name] = self._writer.register_schema(name=type_name, encoding="ros2msg", data=text)
        return self._schemas[type_name]

    def close(self) -> None:
        """Leave the ROS graph and complete the file."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()
        with writing(self._path):
            self._writer.finish()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _qos_text(qos: QoSProfile) -> str:
    """Returns the QoS of a channel as rosbag2 writes it (version 9 of its metadata)."""
    reliable = qos.reliability == ReliabilityPolicy.RELIABLE
    latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return (
        f"- history: keep_last\n  depth: {1 if latched else 10}\n  reliability: "
        f"{'reliable' if reliable else 'best_effort'}\n  durability: {'transient_local' if latched else 'volatile'}\n"
        "  deadline:\n    sec: 0\n    nsec: 0\n  lifespan:\n    sec: 0\n    nsec: 0\n  liveliness: automatic\n"
        "  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n  avoid_ros_namespace_conventions: false\n"
    )
