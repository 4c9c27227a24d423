"""Helpers to subscribe to a topic whose type is not known in advance: its message class, and a QoS that all its
publishers offer."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterable

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo


def message_class(type_name: str) -> type | None:
    """Returns the class of a message type ``package/msg/Name``, or None if its package is not installed."""
    package, kind, name = type_name.split("/")
    with contextlib.suppress(ImportError, AttributeError):
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    return None


def offered_qos(publishers: Iterable[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Returns the strictest QoS that every publisher offers, chosen as in ``ros2 topic hz``. ``depth``: history
    depth."""
    offered = [one.qos_profile for one in publishers]
    reliable = all(one.reliability == ReliabilityPolicy.RELIABLE for one in offered)
    latched = all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
