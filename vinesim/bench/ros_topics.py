"""``vinesim bench ros``: topics of a real robot client as another process receives them, its actions and its resets.

Three processes run: a client as users start it, with physics and renderer; a stock node that subscribes to the topics
of every step; and a third one that subscribes to the same topics and to pictures and clouds, until it is stopped with
SIGSTOP.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from vinesim.bench import stock_publisher
from vinesim.bench.live_client import CLOCK, DEPTH, LIDAR, RGB, RosMissing, own_processes
from vinesim.bench.ros_resets import RESETS, measure_resets
from vinesim.client.programs import START_TIMEOUT, Program, ProgramGroup, RosListener
from vinesim.client.rate_loop import TickLog
from vinesim.ros import middleware
from vinesim.scene.values import Measurement

PERIOD = 0.01
"""Period of the measured topics; a message with a longer delay counts as late [s]."""
TOPICS = (
    CLOCK,
    "/joint_states",
    "/tf",
    "/mobile_base_controller/odom",
    "/base_imu",
    "/wrist_left_ft/wrench",
    "/wrist_right_ft/wrench",
    "/vine/contacts",
)
"""Topics that vinebot publishes in every step."""
JOINTS = 21
"""Number of joints in a message of the stock publisher, equal to that of vinebot."""
WINDOW = 20.0
"""Duration of the measurement before the third process is stopped, and again afterwards [s]."""
SETTLING = 3.0
"""Time from the first messages to the measurement, and again after the stop [s]."""
POLL_PERIOD = 0.05
ON_TIME = 98.0
LATENCY = 10.0
"""Largest accepted 99th percentile of the time from publisher to subscriber [ms]. ``ON_TIME`` is the smallest accepted
share of messages on time [%]."""
GOALS = 50
CANCELS = 10
PREEMPTS = 10
ACTION_TIMEOUT = 180.0
"""Time limit of one goal [s]."""
GOAL_TOLERANCE = 0.01
"""Largest accepted distance of a joint from its goal [rad, m]."""


@dataclasses.dataclass(frozen=True)
class Arrivals:
    """Messages of one topic as a subscriber received them; each array is [message] int64."""

    arrival: np.ndarray
    """[ns] Time of arrival since the epoch."""
    sent: np.ndarray
    """[ns] Time of sending since the epoch."""
    stamp: np.ndarray
    """[ns] Stamp of the message."""
    number: np.ndarray
    """The publisher's count of its messages, from 1 on."""

    def between(self, since: float, until: float) -> Arrivals:
        """Returns the messages that arrived in a span of time [s since the epoch]."""
        part = slice(*np.searchsorted(self.arrival, (round(since * 1e9), round(until * 1e9))))
        return Arrivals(self.arrival[part], self.sent[part], self.stamp[part], self.number[part])

    @property
    def lost(self) -> int:
        """Number of messages between the first and the last that did not arrive."""
        return 0 if len(self.number) == 0 else int(self.number[-1] - self.number[0]) + 1 - len(self.number)


def load_arrivals(path: pathlib.Path) -> dict[str, Arrivals]:
    """Returns the arrivals that ``topic_monitor --arrivals`` wrote, by topic."""
    with np.load(path) as archive:
        return {topic: Arrivals(*archive[topic].T) for topic in archive.files}


def delay_ms(messages: Arrivals, clock: Arrivals, memory: int = 100) -> np.ndarray:
    """Returns the delay of each message from the time at which it was due until it arrived [message] ms.

    A message is due at its stamp. The offset between stamps and wall time follows from the fastest of the last
    ``memory`` messages of ``clock``, which counts as undelayed.
    """
    offsets = (clock.arrival - clock.stamp).astype(float)
    padded = np.r_[np.full(memory - 1, np.inf), offsets]
    quickest = np.lib.stride_tricks.sliding_window_view(padded, memory).min(1)
    newest = np.clip(np.searchsorted(clock.arrival, messages.arrival, "right") - 1, 0, None)
    return 1e-6 * (messages.arrival - messages.stamp - quickest[newest])


def share_on_time(delays: np.ndarray, seconds: float) -> float:
    """Returns the percentage of the messages due in ``seconds`` [s] that arrived within one period of their stamp; at
    most 100."""
    return min(100.0, 100.0 * np.count_nonzero(delays <= 1e3 * PERIOD) / round(seconds / PERIOD))


def topic_rows(case: str, heard: Mapping[str, Arrivals], since: float, until: float) -> Iterator[Measurement]:
    """Yields the timeliness of every topic in a span of time [s since the epoch]."""
    latencies = []
    lost = 0
    for topic in TOPICS:
        part = heard[topic].between(since, until)
        share = share_on_time(delay_ms(part, heard[CLOCK]), until - since)
        yield at_least(f"{case}: {topic} on time", share, "%", ON_TIME)
        latencies.append(1e-6 * (part.arrival - part.sent))
        lost += part.lost
    p50, p99 = np.percentile(np.concatenate(latencies), (50, 99))
    yield Measurement("ros", f"{case}: from publisher to subscriber, p50", float(p50), "ms")
    yield at_most(f"{case}: from publisher to subscriber, p99", float(p99), "ms", LATENCY)
    intervals = np.abs(1e-6 * np.diff(heard["/joint_states"].between(since, until).arrival) - 1e3 * PERIOD)
    yield at_most(
        f"{case}: interval of /joint_states less 10 ms, p99", float(np.percentile(intervals, 99)), "ms", LATENCY
    )
    stock = heard[stock_publisher.TOPIC]
    part = stock.between(since, until)
    peer = share_on_time(delay_ms(part, stock), until - since)
    ours = share_on_time(delay_ms(heard["/joint_states"].between(since, until), heard[CLOCK]), until - since)
    yield Measurement(
        "ros",
        f"{case}: late or lost of /joint_states",
        100.0 - ours,
        "%",
        "stock rclpy timer",
        100.0 - peer,
        (100.0 - peer) / (100.0 - ours) if ours < 100.0 else None,
    )
    yield Measurement("ros", f"{case}: lost of {len(TOPICS)} topics", lost, "messages")


def loss_rows(heard: Mapping[str, Arrivals], published: Mapping[str, int], dropped: int) -> Iterator[Measurement]:
    """Yields rows that account for every message of the publisher's own count over the whole run: received, lost, or
    sent before the subscription or after the last received message."""
    received = sum(len(heard[topic].number) for topic in TOPICS)
    lost = sum(heard[topic].lost for topic in TOPICS)
    before = sum(int(heard[topic].number[0]) - 1 for topic in TOPICS)
    sent = sum(published[topic] for topic in TOPICS)
    after = sum(abs(published[topic] - int(heard[topic].number[-1])) for topic in TOPICS)
    yield Measurement("ros", "whole run: sent by the publisher's count", sent, "messages")
    yield Measurement("ros", "whole run: received", received, "messages")
    yield Measurement("ros", "whole run: lost on the way, by gaps in the numbers", lost, "messages")
    yield Measurement("ros", "whole run: sent before the subscription was there", before, "messages")
    yield Measurement("ros", "whole run: sent after the last that was received", after, "messages")
    yield at_most("whole run: in neither count", abs(sent - received - lost - before - after), "messages", 0.0)
    yield Measurement("ros", "whole run: steps that found no room on the way to the ROS process", dropped, "messages")


def action_rows(rows: list[dict[str, Any]]) -> Iterator[Measurement]:
    """Yields counts and largest errors of the results that :mod:`vinesim.bench.goal_sender` printed."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in ("goal", "cancel", "preempt", "end")}
    for kind, name in (("goal", "goals"), ("cancel", "cancels"), ("preempt", "preempts")):
        right = sum(row["right"] for row in kinds[kind])
        yield at_least(f"{name}: right codes", right, f"of {len(kinds[kind])}", len(kinds[kind]))
    off = max(row["off"] for row in (*kinds["goal"], *kinds["preempt"]))
    yield at_most("goals: farthest joint from its goal", off, "rad, m", GOAL_TOLERANCE)
    wanted = max(row["wanted_velocity_off"] for row in kinds["goal"])
    yield at_most("goals: controllers' velocity less that of the splines", wanted, "rad/s, m/s", 0.05)
    measured = [row["velocity_off"] for row in kinds["goal"] if row["waypoints"] > 1]
    if measured:
        yield Measurement(
            "ros", "goals: joints' velocity at waypoints less the given, largest", max(measured), "rad/s, m/s"
        )
        yield Measurement(
            "ros",
            "goals: joints' velocity at waypoints less the given, median",
            float(np.median(measured)),
            "rad/s, m/s",
        )
    yield Measurement("ros", "goals: fastest joint", max(row["fastest"] for row in kinds["goal"]), "rad/s, m/s")
    yield at_most(
        "cancels: motion in the second half of a second after",
        max(r["drift"] for r in kinds["cancel"]),
        "rad, m",
        0.005,
    )
    end = kinds["end"][0]
    yield at_most("goals whose handles a server knows for good", end["known"], "goals", 0.0)
    yield Measurement("ros", "goals: all handles forgotten after the end of the last goal", end["s"], "s")


def ros(announce: Callable[[str], None], window: float = WINDOW) -> Iterator[Measurement]:
    """Measure topics, actions and resets; topics are measured twice for ``window`` [s]. Raises :class:`RosMissing` or
    :class:`ProgramFailed` if that fails."""
    if (reason := middleware.unavailable_reason()) is not None:
        raise RosMissing(reason)
    with own_processes() as group, tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        announce(f"topics: a client, a subscriber, and one that stops; about {2 * (window + SETTLING) + 10:.0f} s")
        yield from _measure_topics(group, folder, window)
        announce(f"actions: {GOALS} goals, {CANCELS} cancels, {PREEMPTS} preempts; about 200 s")
        yield from _measure_actions(group)
        announce(f"resets: {RESETS} by simulation_interfaces; about 150 s")
        yield from measure_resets(group)


def _measure_topics(group: ProgramGroup, folder: pathlib.Path, window: float) -> Iterator[Measurement]:
    """Measure topics while a third process reads them, then after that process has stopped reading."""
    arrivals = folder / "arrivals.npz"
    log = folder / "ticks.npz"
    listener = RosListener(group, (*TOPICS, stock_publisher.TOPIC), arrivals=arrivals)
    other = RosListener(group, (*TOPICS, RGB, DEPTH, LIDAR))
    for one in (listener, other):
        one.wait_until_listening()
    stock = group.start("stock publisher", "-m", "vinesim.bench.stock_publisher", str(JOINTS), str(PERIOD))
    client = _start_client(group, "--tick-log", str(log), "--out", str(folder))
    deadline = time.monotonic() + START_TIMEOUT
    while missing := [*listener.missing(), *other.missing()]:
        client.new_lines()
        if time.monotonic() > deadline:
            raise client.fault(f"no message of {', '.join(missing)} within {START_TIMEOUT:.0f} s")
        time.sleep(POLL_PERIOD)
    spans = [_rest(client, SETTLING, window)]
    os.kill(other.pid, signal.SIGSTOP)
    try:
        spans.append(_rest(client, SETTLING, window))
    finally:
        os.kill(other.pid, signal.SIGCONT)
    stock.finish()
    client.finish()
    time.sleep(1.0)  # the newest messages are on their way
    listener.stop()
    listener.report()
    other.stop()
    heard = load_arrivals(arrivals)
    ticks = TickLog.load(log)
    for case, (since, until, begin) in zip(("all read", "one stopped"), spans, strict=True):
        yield from topic_rows(case, heard, since, until)
        loop = ticks.between(begin, begin + until - since)
        yield at_least(f"{case}: ticks", loop["tick_hz"], "Hz", 99.9)
        yield Measurement("ros", f"{case}: tick, p99", loop["tick_p99_ms"], "ms")
    report = json.loads((folder / "report.json").read_text())
    published = {topic if topic == CLOCK else f"/{topic}": count for topic, count in report["topics"].items()}
    dropped = {topic if topic == CLOCK else f"/{topic}": count for topic, count in report["ros_dropped"].items()}
    yield from loss_rows(heard, published, sum(dropped.get(topic, 0) for topic in TOPICS))


def _measure_actions(group: ProgramGroup) -> Iterator[Measurement]:
    """Measure goals of a stock action client that runs in a process of its own."""
    client = _start_client(group)
    sender = group.start(
        "goal sender",
        "-m",
        "vinesim.bench.goal_sender",
        "--goals",
        str(GOALS),
        "--cancels",
        str(CANCELS),
        "--preempts",
        str(PREEMPTS),
    )
    rows: list[dict[str, Any]] = []
    while not rows or rows[-1]["kind"] != "end":
        rows.append(json.loads(sender.next_line(START_TIMEOUT if not rows else ACTION_TIMEOUT)))
        client.new_lines()
    client.finish()
    yield from action_rows(rows)


def _start_client(group: ProgramGroup, *options: str) -> Program:
    return group.start("client", "-m", "vinesim", "client", "--role", "robot", "--status", "json", *options)


def _rest(client: Program, settling: float, window: float) -> tuple[float, float, float]:
    """Wait for ``settling`` and ``window`` [s]. Returns begin and end of the window as wall times [s since the epoch],
    and its begin on the monotonic clock [s]."""
    time.sleep(settling)
    since = time.time()
    begin = time.monotonic()
    while time.monotonic() < begin + window:
        client.new_lines()
        time.sleep(POLL_PERIOD)
    return since, since + window, begin


def at_most(case: str, value: float, unit: str, bar: float) -> Measurement:
    """Returns a row whose value should be at most ``bar``; its ratio is 1 or more if it is."""
    return Measurement("ros", case, value, unit, "bar, at most", bar, bar / value if value > 0.0 else None)


def at_least(case: str, value: float, unit: str, bar: float) -> Measurement:
    """Returns a row whose value should be at least ``bar``; its ratio is 1 or more if it is."""
    return Measurement("ros", case, value, unit, "bar, at least", bar, value / bar)
