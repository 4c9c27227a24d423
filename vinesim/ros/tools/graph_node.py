"""A node that inspects and uses a running ROS graph: topics and services whose types it learns from the graph."""

from __future__ import annotations

import difflib
import os
import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_full_topic_name import validate_full_topic_name

from vinesim.core.errors import UsageError
from vinesim.core.progress import ProgressLine
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.ros.names import ros_namespace
from vinesim.ros.tools.subscribing import message_class, offered_qos

DISCOVERY_TIME = 10.0
"""Longest time in which a named topic or service must appear [s]."""
SETTLED = 3.5
"""Time without a new topic after which the list of topics counts as complete [s].

DERIVED: a participant of Fast DDS announces itself every 3 s, and its first announcements can be lost on a busy
machine.
"""
SILENCE = 5.0
"""Time without any topic after which the list of topics counts as empty [s]."""
OWN_TOPIC = "/parameter_events"
"""Topic that every node publishes, this one as well."""
POLL_PERIOD = 0.05
"""Longest time between two checks whether the program is to stop [s]."""
QUEUE_DEPTH = 100
"""History depth of subscriptions."""


class TypeMissingError(RuntimeError):
    """A topic or service whose type is in no installed package. The message names both."""

    exit_code = 3


class NoAnswerError(RuntimeError):
    """A service that did not answer in time. The message names the service."""

    exit_code = 4


class GraphNode:
    """A node of its own context. It is a context manager, which leaves the graph at its end.

    All waiting ends early when ``is_stopped()`` returns True.
    """

    def __init__(self, is_stopped: Callable[[], bool], namespace: str = "") -> None:
        """``namespace``: in which relative names are. Raises :class:`vinesim.core.errors.UsageError` for an invalid
        one."""
        namespace = ros_namespace(namespace)
        middleware.configure(large_messages=False)
        message_packages.ensure_importable(message_packages.available_packages())
        self._is_stopped = is_stopped
        self._classes: dict[str, type] = {}
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(
            "vinesim_tool",
            context=self._context,
            namespace=namespace,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._namespace = self._node.get_namespace().rstrip("/")
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def topics(self) -> list[tuple[str, str, int, int]]:
        """Returns name, type, number of publishers and number of subscribers of each topic in the namespace, sorted by
        name, once no topic has appeared for :data:`SETTLED` seconds. Topics of actions are left out, as by
        ``ros2 topic list``."""
        found: dict[str, list[str]] = {}
        began = changed = time.monotonic()
        with ProgressLine() as progress:
            while not self._is_stopped() and time.monotonic() < (changed + SETTLED if found else began + SILENCE):
                self.spin()
                now = {
                    name: types
                    for name, types in self._node.get_topic_names_and_types()
                    if name.startswith(f"{self._namespace}/") and name != OWN_TOPIC and "/_action/" not in name
                }
                if now.keys() - found.keys():
                    changed = time.monotonic()
                found = now
                progress.show(f"looking for topics: {len(found)} so far")
        return [
            (name, types[0], self._node.count_publishers(name), self._node.count_subscribers(name))
            for name, types in sorted(found.items())
        ]

    def subscribe(self, topic: str) -> Iterator[tuple[bytes, dict[str, Any]] | None]:
        """Subscribe with a QoS that all publishers of the topic offer. Yields each message, serialised and with the
        metadata of the middleware, or None if no message arrived within :data:`POLL_PERIOD`; ends when the program is
        to stop."""
        name = self._full_name(topic)
        self._await("topic", name, lambda: self._node.count_publishers(name) > 0)
        if self._is_stopped():
            return
        message = _class_of(name, dict(self._node.get_topic_names_and_types())[name])
        self._classes[name] = message
        offered = self._node.get_publishers_info_by_topic(name)
        subscription = self._node.create_subscription(
            message, name, lambda _: None, offered_qos(offered, QUEUE_DEPTH), raw=True
        )
        while not self._is_stopped():
            # Taken directly: an executor would discard the metadata.
            taken = subscription.handle.take_message(message, True)
            if taken is None:
                self._sleep_until(lambda: False, 0.2 * POLL_PERIOD)
            yield taken

    def message(self, topic: str, serialised: bytes) -> Any:
        """Returns a message that :meth:`subscribe` yielded for the topic, deserialised."""
        return deserialize_message(serialised, self._classes[self._full_name(topic)])

    def publish(self, topic: str, make: Callable[[type], Any], rate: float, type_name: str | None) -> Iterator[int]:
        """Publish a message ``rate`` times a second until the program is to stop. Yields the number of messages sent.

        ``make``: makes the message of a class. ``type_name``: the message type; None: that of the topic, which must
        then have a subscriber or publisher.
        """
        name = self._full_name(topic)
        if type_name is None:
            known: dict[str, list[str]] = {}

            def has_appeared() -> bool:
                known.update(self._node.get_topic_names_and_types())
                return name in known

            self._await("subscriber", name, has_appeared)
            if self._is_stopped():
                return
            message_type = _class_of(name, known[name])
        else:
            message_type = _class_of(name, [type_name])
        message = make(message_type)
        subscribers = self._node.get_subscriptions_info_by_topic(name)
        wants_latched = any(one.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in subscribers)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if wants_latched else DurabilityPolicy.VOLATILE
        publisher = self._node.create_publisher(message_type, name, QoSProfile(depth=10, durability=durability))
        self._sleep_until(lambda: publisher.get_subscription_count() > 0, SETTLED)
        sent = 0
        due = time.monotonic()
        try:
            while not self._is_stopped():
                publisher.publish(message)
                sent += 1
                yield sent
                due = max(due + 1.0 / rate, time.monotonic() - 1.0)
                self._sleep_until(lambda due=due: time.monotonic() >= due, 1.0 / rate)
        finally:
            publisher.wait_for_all_acked(Duration(seconds=SETTLED))

    def call(self, service: str, make: Callable[[type], Any], timeout: float) -> Any | None:
        """Call a service. Returns the response, or None if the program is to stop.

        ``make``: makes the request of a class. ``timeout``: longest time until the response [s]. Raises
        :class:`NoAnswerError` after that time.
        """
        name = self._full_name(service, is_service=True)
        known: dict[str, list[str]] = {}

        def has_appeared() -> bool:
            known.update(self._node.get_service_names_and_types())
            return name in known

        self._await("service", name, has_appeared)
        if self._is_stopped():
            return None
        service_type: Any = _class_of(name, known[name])
        request = make(service_type.Request)
        client = self._node.create_client(service_type, name)
        # The server's reader of requests and its writer of responses are discovered one after the other.
        end = time.monotonic() + timeout
        self._sleep_until(client.service_is_ready, timeout)
        future = client.call_async(request)
        with ProgressLine() as progress:
            while not future.done() and time.monotonic() < end and not self._is_stopped():
                self.spin()
                progress.show(f"waiting for the response of {name}")
        if future.done():
            return future.result()
        if self._is_stopped():
            return None
        raise NoAnswerError(f"{name} has not answered for {timeout:g} s; give more time by --timeout")

    def spin(self) -> None:
        """Handle one event of the graph, or wait up to :data:`POLL_PERIOD` for one."""
        self._executor.spin_once(timeout_sec=POLL_PERIOD)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _full_name(self, name: str, *, is_service: bool = False) -> str:
        """Returns a name with the namespace. Raises UsageError for an invalid name."""
        try:
            full = expand_topic_name(name, self._node.get_name(), self._node.get_namespace())
            validate_full_topic_name(full, is_service=is_service)
        except (InvalidTopicNameException, InvalidServiceNameException, ValueError):
            what = "service" if is_service else "topic"
            raise UsageError(f"{name!r} is no name of a {what}; give letters, digits, _ and /") from None
        return full

    def _await(self, what: str, name: str, is_there: Callable[[], bool]) -> None:
        """Wait until a topic or service has appeared. Raises UsageError after :data:`DISCOVERY_TIME`."""
        end = time.monotonic() + DISCOVERY_TIME
        with ProgressLine() as progress:
            while not is_there() and not self._is_stopped():
                if time.monotonic() > end:
                    raise UsageError(self._not_found(what, name))
                self.spin()
                progress.show(f"waiting for the {what} {'of ' if what == 'subscriber' else ''}{name}")

    def _not_found(self, what: str, name: str) -> str:
        is_topic = what != "service"
        names = self._node.get_topic_names_and_types() if is_topic else self._node.get_service_names_and_types()
        close = [one for one in difflib.get_close_matches(name, [one for one, _ in names]) if one != name]
        gone, remedy = {
            "topic": ("publishes the topic", "vinesim ros topics lists all topics"),
            "service": ("offers the service", "start its node, or set the domain of the node"),
            "subscriber": ("subscribes to the topic", "start the subscriber first, or give the type by --type"),
        }[what]
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        return f"nobody {gone} {name} in ROS_DOMAIN_ID {domain}; {f'do you mean {close[0]}?' if close else remedy}"

    def _sleep_until(self, is_done: Callable[[], bool], seconds: float) -> None:
        """Sleep until ``is_done()`` or the program is to stop, at most for a time [s]."""
        end = time.monotonic() + seconds
        while not is_done() and not self._is_stopped() and (left := end - time.monotonic()) > 0.0:
            time.sleep(min(left, 0.1 * POLL_PERIOD))


def _class_of(name: str, types: list[str]) -> type:
    """Returns the class of the (first) type of a topic or service. Raises an error if there is none."""
    if types[0].count("/") != 2:
        raise UsageError(f"{types[0]!r} is no type; give package/msg/Name, such as std_msgs/msg/String")
    found = message_class(types[0])
    if found is None:
        package = types[0].partition("/")[0]
        raise TypeMissingError(
            f"{name} has the type {types[0]}, which is not installed here; install the package {package} for ROS 2"
        )
    return found
