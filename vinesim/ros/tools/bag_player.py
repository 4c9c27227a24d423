"""Plays an MCAP file of ROS topics (profile ``ros2``), recorded by vinesim or rosbag2, at the recorded pace."""

from __future__ import annotations

import logging
import pathlib
import struct
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import rclpy
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.ros.tools.subscribing import message_class

log = logging.getLogger(__name__)

DISCOVERY_TIME = 1.0
"""Time between the creation of the publishers and the first message, in which subscribers discover them [s]."""


class BagError(ValueError):
    """A file that is no recording of ROS topics. The message names the file and the reason."""


def play(path: pathlib.Path, *, rate: float = 1.0, is_stopped: Callable[[], bool] = lambda: False) -> Counter[str]:
    """Publish all messages of a file, ``rate`` times as fast as recorded. Returns the number of published messages by
    topic.

    ``is_stopped`` is called before each message; when it returns True, playing ends. Raises :class:`BagError` if the
    file is no recording of ROS topics.
    """
    middleware.configure()
    message_packages.ensure_importable(message_packages.available_packages())
    try:
        stream = path.open("rb")
    except OSError as bad:
        raise BagError(f"{path}: {bad.strerror}; give a recording") from None
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with stream:
            return _play(make_reader(stream), rclpy.create_node("vinesim_player", context=context), rate, is_stopped)
    except (McapError, struct.error) as bad:  # struct.error if the file is shorter than a header
        raise BagError(f"{path}: {bad or 'it is empty'}; give a recording of ROS topics") from None
    finally:
        context.shutdown()


def _play(reader: Any, node: Node, rate: float, is_stopped: Callable[[], bool]) -> Counter[str]:
    summary = reader.get_summary()
    if summary is None or reader.get_header().profile != "ros2":
        raise McapError("its profile is not ros2")
    publishers = {}
    for channel in summary.channels.values():
        name = summary.schemas[channel.schema_id].name
        message = message_class(name)
        if message is None:
            log.warning("%s is not played: no package with %s is installed", channel.topic, name)
            continue
        latched = "durability: transient_local" in channel.metadata.get("offered_qos_profiles", "")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        publishers[channel.topic] = node.create_publisher(message, channel.topic, qos)
    time.sleep(DISCOVERY_TIME)
    played: Counter[str] = Counter()
    first = None
    began = time.monotonic()
    for _, channel, message in reader.iter_messages():
        if is_stopped():
            break
        if channel.topic not in publishers:
            continue
        first = message.log_time if first is None else first
        due = began + 1e-9 * (message.log_time - first) / rate
        while (wait := due - time.monotonic()) > 0.0 and not is_stopped():
            time.sleep(min(wait, 0.1))
        publishers[channel.topic].publish(message.data)
        played[channel.topic] += 1
    return played
