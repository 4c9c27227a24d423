"""Base class of all ROS 2 nodes of vinesim: topics with message counts, a receiving thread, and an orderly shutdown.

A message is built only if its topic has subscribers. With :meth:`Node.has_subscribers` the simulation can also skip the
computation of its content.
"""

from __future__ import annotations

import logging
import pathlib
import threading
import time as wall
from collections.abc import Iterable, Mapping
from typing import Any, Self

import rclpy
import rclpy.node
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace
from rclpy.validate_node_name import validate_node_name
from rclpy.validate_topic_name import validate_topic_name

from vinesim.ros import middleware
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import EVERY_STEP, RELIABLE, Topic

log = logging.getLogger(__name__)

SUBSCRIPTION_COUNT_PERIOD = 0.1
"""Wall time between two counts of subscribers [s]. A new subscriber waits at most this long for its first message."""


class Node:
    """A ROS 2 node under ``namespace``. Several nodes may exist in one process. Each has its own ROS context, or shares
    the context of another node (``beside``). A node is a context manager, which calls :meth:`close` at its end.

    Raises :class:`middleware.RosUnavailableError`, :class:`message_packages.InterfacesError`, or :class:`ValueError`
    for a name that ROS does not allow. Their messages have one line.
    """

    def __init__(
        self,
        name: str,
        namespace: str,
        topics: Iterable[str],
        params_file: pathlib.Path | None = None,
        parameters: Mapping[str, Any] | None = None,
        *,
        beside: Node | None = None,
    ) -> None:
        """``topics``: topic names given by the user, which are checked before anything starts. ``params_file``: YAML
        file with values of parameters, as for ``--params-file`` of ROS 2. ``parameters``: values that were set in an
        earlier run of the node, by name of the parameter. ``beside``: a node whose ROS context this one shares and
        that is closed later than this one; a context of its own takes 8 MB and seven threads."""
        try:
            validate_node_name(name)
            validate_namespace(f"/{namespace}" if namespace else "/")
            for topic in topics:
                validate_topic_name(topic)
        except NameValidationException as error:
            # The second line of rclpy's message marks a wrong letter.
            raise ValueError(" ".join(str(error).replace("^", "").split())) from error
        middleware.configure()
        self._topics: dict[str, Topic] = {}
        self._closing = threading.Event()
        self._owns_context = beside is None
        self._context = Context() if beside is None else beside._context
        if self._owns_context:
            # No signal handlers: the client handles SIGINT. No arguments: sys.argv is vinesim's own.
            rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._node = self._create(name, namespace, params_file)
            try:
                self._parameters = Parameters(self._node, parameters)
                self._open()
                self._parameters.apply()
            except BaseException:
                # Without this, the publishers would stay in the ROS graph for as long as the error is referenced.
                self._node.destroy_node()
                raise
        except BaseException:
            self._end_context()
            raise
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._threads = [threading.Thread(target=self._receive, name=f"ros receive {name}", daemon=True)]
        self._threads += self._own_threads(name)
        for thread in self._threads:
            thread.start()

    def _create(self, name: str, namespace: str, params_file: pathlib.Path | None) -> rclpy.node.Node:
        given = [] if params_file is None else ["--ros-args", "--params-file", str(params_file)]
        try:
            return rclpy.create_node(name, context=self._context, namespace=namespace or None, cli_args=given)
        except RuntimeError as error:
            if params_file is None:
                raise
            raise ValueError(f"{params_file} is no ROS 2 parameter file: {' '.join(str(error).split())}") from error

    def _open(self) -> None:
        """Create publishers and subscriptions. Subclasses override this method."""

    def _own_threads(self, name: str) -> list[threading.Thread]:
        """Returns the threads that a subclass needs in addition to the receiving thread. They must end once
        ``_closing`` is set and :meth:`_wake` was called."""
        return []

    def _wake(self) -> None:
        """Wake the threads of :meth:`_own_threads`, so that they notice that the node closes."""

    def _look_around(self) -> None:
        """Do the regular work of a subclass, such as a search for other publishers. The receiving thread calls this
        method every :data:`SUBSCRIPTION_COUNT_PERIOD`; subclasses override it."""

    def has_subscribers(self, family: str) -> bool:
        """Returns whether a topic, or any topic below it, has subscribers. ``family``: a topic or the first part of a
        topic's name, such as ``"head_front_camera/depth"``, ``"lidar"`` or ``"tf"``.

        The count is at most :data:`SUBSCRIPTION_COUNT_PERIOD` old. Raises :class:`ValueError` for an unknown topic.
        """
        below = family.rstrip("/") + "/"
        topics = [topic for name, topic in self._topics.items() if (name + "/").startswith(below)]
        if not topics:
            raise ValueError(f"no topic {family!r}; there are: {', '.join(sorted(self._topics))}")
        return any(topic.subscription_count for topic in topics)

    @property
    def set_parameters(self) -> dict[str, Any]:
        """Values of the parameters that were ever set, by name. Each change creates a new dictionary."""
        return self._parameters.set_by_user

    @property
    def sent(self) -> dict[str, int]:
        """Number of messages sent so far, by topic."""
        return {name: topic.sent for name, topic in self._topics.items()}

    @property
    def dropped(self) -> dict[str, int]:
        """Number of messages that were replaced by newer ones before they were sent, or that could not be built or
        sent, by topic."""
        return {name: topic.dropped for name, topic in self._topics.items()}

    def close(self) -> None:
        """Leave the ROS graph and wait until the node's threads have ended. A second call does nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._wake()
        self._executor.wake()
        for thread in self._threads:
            thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._end_context()

    def _end_context(self) -> None:
        if self._owns_context:
            self._context.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _advertise(self, message: type, name: str, qos: QoSProfile = RELIABLE) -> Topic:
        topic = Topic(name, self._node.create_publisher(message, name, qos), is_of_every_step=qos is EVERY_STEP)
        if (before := self._topics.get(name)) is not None:
            topic.sent = before.sent
            topic.dropped = before.dropped
        self._topics[name] = topic
        return topic

    def _withdraw(self, topic: Topic) -> None:
        """Remove a topic's publisher from the ROS graph. The topic's message counts are kept."""
        topic.close()
        self._node.destroy_publisher(topic.publisher)

    def _receive(self) -> None:
        """Body of the receiving thread: handle commands and the services that every node has, and count subscribers."""
        next_count = 0.0
        while not self._closing.is_set() and self._context.ok():
            try:
                self._executor.spin_once(timeout_sec=SUBSCRIPTION_COUNT_PERIOD)
            except Exception:
                log.exception("a ROS callback failed; the node continues")
            if wall.monotonic() >= next_count:
                self._look_around()
                for topic in list(self._topics.values()):
                    topic.update_subscription_count()
                next_count = wall.monotonic() + SUBSCRIPTION_COUNT_PERIOD
