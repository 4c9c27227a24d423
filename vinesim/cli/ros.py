"""``vinesim ros``: builds message packages, records and plays topics, and uses a running ROS graph."""

from __future__ import annotations

import itertools
import os
import pathlib
import statistics
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from vinesim.cli.signals import stop_at_signals
from vinesim.core.bag_files import BagError
from vinesim.core.errors import UsageError
from vinesim.net.recording.mcap_writer import free_path
from vinesim.ros import middleware

PROGRESS_PERIOD = 2.0
"""Wall time between two lines of progress [s]."""


def build(quiet: bool, wheel: pathlib.Path | None) -> int:
    """Build the message packages without an official wheel and install them, or write their wheels. Returns the exit
    code.

    ``quiet``: print nothing, and no error if ROS is not installed. ``wheel``: folder for wheels; None: install the
    packages.
    """
    reason = middleware.unavailable_reason()
    if reason is not None:
        if not quiet:
            print(f"ROS 2 is not usable here: {reason}")
        return 0 if quiet else 3
    from vinesim.ros.messages import message_packages
    from vinesim.ros.messages import message_packages as package_wheel

    places = {package: message_packages.place_of_official(package) for package in message_packages.available_packages()}
    missing = [package for package, place in places.items() if place is None]
    if wheel is not None:
        message_packages.build(missing)
        lines = {package: f"wheel {package_wheel.write(package, wheel)}" for package in missing}
    else:
        package_wheel.install([package for package in missing if not message_packages.is_installed(package)])
        lines = {
            package: f"installed; pip uninstall {package_wheel.distribution(package)} removes it" for package in missing
        }
    if not quiet:
        for package, place in places.items():
            print(f"{package}: {lines.get(package, f'the official one is there, {place}')}")
    return 0


def record(path: pathlib.Path, topics: list[str], seconds: float | None) -> int:
    """Record topics until Ctrl-C or for ``seconds`` [s]; returns the exit code."""
    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
        return 3
    from vinesim.ros.tools.bag_recorder import BagRecorder

    stop = stop_at_signals(threading.Event())
    path = free_path(path)
    began = told = time.monotonic()
    with BagRecorder(path, topics) as recorder:
        print(f"recording into {path}; Ctrl-C ends it", flush=True)
        while not stop.is_set() and (seconds is None or time.monotonic() - began < seconds):
            recorder.spin()
            if time.monotonic() - told >= PROGRESS_PERIOD:
                told = time.monotonic()
                print(
                    f"{told - began:.0f} s: {recorder.counts.total()} messages of {len(recorder.counts)} topics",
                    flush=True,
                )
    print(f"{path}: {recorder.counts.total()} messages of {len(recorder.counts)} topics")
    return 0


def play(path: pathlib.Path, rate: float) -> int:
    """Publish a recording's topics again. Returns the exit code."""
    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
        return 3
    from vinesim.ros.tools import bag_player

    stop = stop_at_signals(threading.Event())
    print(f"playing {path}", flush=True)
    try:
        played = bag_player.play(path, rate=rate, is_stopped=stop.is_set)
    except BagError as error:
        raise UsageError(str(error)) from None
    print(f"{path}: {played.total()} messages of {len(played)} topics")
    return 0


REPORT_PERIOD = 1.0
"""Wall time between two lines of ``vinesim ros hz`` [s]."""
HZ_WINDOW = 10_000
"""Largest number of messages over which ``vinesim ros hz`` computes the rate, as in ``ros2 topic hz``."""


def _is_ros_missing() -> bool:
    """Returns whether ROS 2 cannot be used here, and then prints the reason."""
    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
    return reason is not None


def topics(namespace: str, with_types: bool) -> int:
    """Print the topics. Returns the exit code."""
    if _is_ros_missing():
        return 3
    from vinesim.ros.tools.graph_node import GraphNode

    stop = stop_at_signals(threading.Event())
    with GraphNode(stop.is_set, namespace) as node:
        found = node.topics()
    if stop.is_set():
        return 130
    if not found:
        where = f"namespace {namespace.strip('/')} of " if namespace else ""
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        print(
            f"no topics in {where}ROS_DOMAIN_ID {domain}; start a robot, or set the domain of the robot",
            file=sys.stderr,
        )
    width = max((len(name) for name, *_ in found), default=0)
    for name, type_name, publishers, subscribers in found:
        print(f"{name:{width}}  {type_name}  {publishers} -> {subscribers}" if with_types else name)
    return 0


def hz(topic: str, namespace: str, seconds: float | None) -> int:
    """Print the rate of a topic once a second until Ctrl-C or for ``seconds`` [s]. Returns the exit code."""
    if _is_ros_missing():
        return 3
    from vinesim.ros.tools.graph_node import GraphNode

    stop = stop_at_signals(threading.Event())
    times: deque[int] = deque(maxlen=HZ_WINDOW)
    count = told = 0
    reported: float | None = None
    began: float | None = None
    with GraphNode(stop.is_set, namespace) as node:
        for taken in node.subscribe(topic):
            now = time.monotonic()
            reported = now if reported is None else reported
            if taken is not None:
                began = now if began is None else began
                count += 1
                times.append(taken[1].get("received_timestamp") or time.time_ns())
            is_over = began is not None and seconds is not None and now - began >= seconds
            if now - reported >= REPORT_PERIOD or is_over:
                reported = now
                print(_rate(times) if count > told else "no new messages", flush=True)
                told = count
            if is_over:
                break
    return 0 if times else 130


def _rate(times: Sequence[int]) -> str:
    """Returns the rate of messages and the smallest and largest time between two of them, from their arrival times
    [ns]."""
    gaps = [1e-6 * (after - before) for before, after in itertools.pairwise(times)]
    if not gaps or not sum(gaps):
        return "1 message"
    return (
        f"{1e3 * len(gaps) / sum(gaps):.2f} Hz  gaps {min(gaps):.1f} to {max(gaps):.1f} ms, "
        f"standard deviation {statistics.pstdev(gaps):.1f} ms, {len(times)} messages"
    )


def echo(topic: str, namespace: str, field: str | None, once: bool, full: bool) -> int:
    """Print the messages of a topic as YAML until Ctrl-C. Returns the exit code."""
    if _is_ros_missing():
        return 3
    from vinesim.ros.tools.graph_node import GraphNode
    from vinesim.ros.tools.plain_values import field_of, to_plain

    stop = stop_at_signals(threading.Event())
    with GraphNode(stop.is_set, namespace) as node:
        for taken in node.subscribe(topic):
            if taken is None:
                continue
            message = node.message(topic, taken[0])
            print(_yaml(to_plain(field_of(message, field) if field else message, full=full)) + "---", flush=True)
            if once:
                return 0
    return 130 if once else 0


def publish(topic: str, values: str, namespace: str, type_name: str | None, rate: float, once: bool) -> int:
    """Publish a message until Ctrl-C, or once. Returns the exit code."""
    if _is_ros_missing():
        return 3
    from vinesim.ros.tools.graph_node import GraphNode
    from vinesim.ros.tools.plain_values import from_plain

    plain = _parsed(values)
    stop = stop_at_signals(threading.Event())
    sent = 0
    with GraphNode(stop.is_set, namespace) as node:
        for sent in node.publish(topic, lambda kind: from_plain(kind, plain), rate, type_name):
            if sent == 1:
                print(f"publishing to {topic}" + ("" if once else f" at {rate:g} Hz; Ctrl-C ends it"), flush=True)
            if once:
                break
    return 0 if sent else 130


def call(service: str, values: str, namespace: str, timeout: float) -> int:
    """Call a service and print the response as YAML. Returns the exit code."""
    if _is_ros_missing():
        return 3
    from vinesim.ros.tools.graph_node import GraphNode
    from vinesim.ros.tools.plain_values import from_plain, to_plain

    plain = _parsed(values)
    stop = stop_at_signals(threading.Event())
    with GraphNode(stop.is_set, namespace) as node:
        response = node.call(service, lambda kind: from_plain(kind, plain), timeout)
    if response is None:
        return 130
    print(_yaml(to_plain(response, full=True)), end="", flush=True)
    return 0


def _parsed(values: str) -> Any:
    """Returns the values in a text of JSON, or of YAML, which has JSON in it. Raises UsageError for any other text."""
    import yaml

    try:
        return yaml.safe_load(values)
    except yaml.YAMLError as bad:
        reason = getattr(bad, "problem", None) or "it cannot be read"
        raise UsageError(f"{values!r} is no JSON: {reason}; quote it, as in '{{\"data\": true}}'") from None


def _yaml(values: Any) -> str:
    """Returns plain values as YAML, innermost lists and dicts on one line."""
    import yaml

    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=10_000, allow_unicode=True)
    return text.removesuffix("...\n")
