"""Plays a recording of ROS topics, of vinesim or rosbag2, at the recorded pace."""

from __future__ import annotations

import logging
import pathlib
import re
import time
from collections import Counter
from collections.abc import Callable

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from vinesim.core.bag_files import Bag, BagError, open_bag
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.ros.tools.subscribing import message_class

log = logging.getLogger(__name__)

DISCOVERY_TIME = 1.0
"""Time between the creation of the publishers and the first message, in which subscribers discover them [s]."""


def play(path: pathlib.Path, *, rate: float = 1.0, is_stopped: Callable[[], bool] = lambda: False) -> Counter[str]:
    """Publish all messages of a recording, ``rate`` times as fast as recorded. Returns the number of published messages
    by topic.

    ``path``: an MCAP or SQLite file, or a rosbag2 folder. ``is_stopped`` is called before each message; when it returns
    True, playing ends. Damage of the recording is logged; the messages before it are played. Raises
    :class:`vinesim.core.bag_files.BagError` if there is no recording of ROS topics.
    """
    bag = open_bag(path)
    if not any(topic.encoding == "cdr" for topic in bag.topics.values()):
        if bag.topics:
            raise BagError(f"{path}: has no messages of ROS 2; play a recording of 'vinesim record' by: vinesim replay")
        raise BagError(f"{path}: {bag.damage.removeprefix(f'{path}: ') or 'has no topics'}; give another recording")
    if known := bag.damage:
        log.warning("%s; the messages before are played", known)
    middleware.configure()
    message_packages.ensure_importable(message_packages.available_packages())
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        played = _play(bag, rclpy.create_node("vinesim_player", context=context), rate, is_stopped)
    finally:
        context.shutdown()
    if bag.damage != known:
        log.warning("%s; the messages before were played", bag.damage)
    return played


def _play(bag: Bag, node: Node, rate: float, is_stopped: Callable[[], bool]) -> Counter[str]:
    publishers = {}
    for name, topic in bag.topics.items():
        message = message_class(topic.type_name) if topic.encoding == "cdr" else None
        if message is None:
            log.warning("%s is not played: no package with %s is installed", name, topic.type_name or topic.encoding)
            continue
        latched = re.search(r"durability: (transient_local|1)\b", topic.qos) is not None  # version 8 wrote numbers
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        publishers[name] = node.create_publisher(message, name, qos)
    time.sleep(DISCOVERY_TIME)
    played: Counter[str] = Counter()
    first = None
    began = time.monotonic()
    for name, recorded, data in bag.messages():
        if is_stopped():
            break
        if name not in publishers:
            continue
        first = recorded if first is None else first
        due = began + 1e-9 * (recorded - first) / rate
        while (wait := due - time.monotonic()) > 0.0 and not is_stopped():
            time.sleep(min(wait, 0.1))
        publishers[name].publish(data)
        played[name] += 1
    return played
