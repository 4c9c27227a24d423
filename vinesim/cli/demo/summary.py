"""Writes ``summary.json`` of a demo from the reports of its clients."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import re
import shutil
import time
from collections.abc import Mapping
from typing import Any, Self

from rich.table import Table

from vinesim.cli.demo.progress import PICKER, VISITOR
from vinesim.client.rate_loop import TickLog
from vinesim.client.recording import bunch_trace
from vinesim.client.recording.bunch_trace import Rows, remote_error
from vinesim.core.errors import writing

SMALL_TOPICS = ("/clock", "/joint_states", "/tf")
"""Topics that are published in every step and that every ROS program needs."""
PICTURES = r"(?!/visitor/).*/(rgb|depth)/image_raw"
"""Regular expression for the topics of the picker's colour and depth pictures."""
SCANS = r"(?!/visitor/).*(?<!/depth)/points"
"""Regular expression for the topics of the picker's scans."""
LOOP_KEYS = ("tick_hz", "tick_p50_ms", "tick_p99_ms", "overruns", "real_time_factor")


@dataclasses.dataclass(frozen=True)
class Window:
    """The measured part of a run, in times of ``time.monotonic`` [s]."""

    since: float
    until: float = float("inf")

    @property
    def is_open(self) -> bool:
        """Whether the window has no end yet."""
        return self.until == float("inf")

    @classmethod
    def begin(cls) -> Self:
        """Returns a window that begins now."""
        return cls(time.monotonic())

    def end(self) -> Window:
        """Returns this window with its end at the present time."""
        return dataclasses.replace(self, until=time.monotonic())


def write_summary(out: pathlib.Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json`` atomically, and copy the picker's pictures next to it."""
    with writing(out):
        partial = out / "summary.json.part"
        partial.write_text(json.dumps(summary, indent=2) + "\n")
        partial.replace(out / "summary.json")
        for picture in (out / PICKER).glob("*.png"):
            shutil.copyfile(picture, out / picture.name)


def report_of(out: pathlib.Path, name: str) -> dict[str, Any]:
    """Returns the report that a client has written."""
    return json.loads((out / name / "report.json").read_text())


def push_summary(
    out: pathlib.Path,
    bunch: int,
    received: dict[str, Any],
    *,
    no_ros: str | None,
    scene: str,
    seed: int,
    seconds: float,
    window: Window,
    starts: Mapping[str, float],
) -> dict[str, Any]:
    """Returns the measurements of a push, and draws ``touch.png``.

    ``received``: statistics of the listener, by topic. ``starts``: times from the demo's start to the first event of
    each client and topic [s].
    """
    reports = {name: report_of(out, name) for name in (PICKER, VISITOR)}
    traces = {name: Rows.load(out / name / "trace.npz") for name in (PICKER, VISITOR)}
    with writing(out / "touch.png"):
        bunch_trace.touch(out / "touch.png", traces, f"bunch {bunch}, pushed by {PICKER}, seen by {VISITOR}")
    touch_keys = (
        "touch_to_motion_ticks",
        "force_peak_n",
        "environment_bytes_when_far",
        "ticks_touching_when_far",
        "environment_bytes_out",
    )
    loops = {name: TickLog.load(out / name / "ticks.npz").between(window.since, window.until) for name in reports}
    lost = lost_messages(received, reports[PICKER])
    simulated = loops[PICKER]["real_time_factor"] * (window.until - window.since)
    return {
        "scene": scene,
        "seed": seed,
        "seconds": seconds,
        "bunch": bunch,
        "start_s": dict(starts),
        **loops[PICKER],
        "pace_cause": reports[PICKER]["pace_cause"],
        "steps_skipped": sum(one["steps_skipped"] for one in reports.values()),
        "lost": lost["count"],
        "pictures_per_simulated_second": least_rate(received, PICTURES, simulated),
        "scans_per_simulated_second": least_rate(received, SCANS, simulated),
        **{key: reports[PICKER][key] for key in touch_keys},
        "fruit": reports[PICKER]["fruit"],
        "loops": loops,
        "remote_displacement_error_mm": remote_error(traces[PICKER], traces[VISITOR]),
        "ros": no_ros or "used",
        "ros_received": {topic: entry["count"] for topic, entry in sorted(received.items())},
        "ros_hz": {topic: entry["hz"] for topic, entry in sorted(received.items())},
        "ros_lost": lost,
        "ros_detail": received,
        "clients": reports,
    }


def lost_messages(received: Mapping[str, Mapping[str, Any]], report: Mapping[str, Any]) -> dict[str, Any]:
    """Returns how many messages of :data:`SMALL_TOPICS` were lost on the way, according to the listener, and before
    sending.

    Messages lost before sending are counted over the whole run of the robot with this ``report``. ``share`` is the
    fraction of lost messages among all expected messages.
    """
    dropped = report.get("ros_dropped", {})
    topics = [topic for topic in SMALL_TOPICS if topic in received]
    lost = {
        topic: {
            "on_the_way": received[topic]["lost"] or 0,
            "before_sending": sum(dropped.get(name, 0) for name in (topic, topic.removeprefix("/"))),
        }
        for topic in topics
    }
    count = sum(sum(entry.values()) for entry in lost.values())
    total = count + sum(received[topic]["count"] for topic in topics)
    return {"topics": lost, "count": count, "share": count / total if total else None}


def least_rate(received: Mapping[str, Mapping[str, Any]], pattern: str, simulated: float) -> float | None:
    """Returns the lowest message rate among the topics that match ``pattern`` [Hz of simulated time]; None without such
    topics.

    ``simulated``: duration of the run in simulated time [s].
    """
    counts = [entry["count"] for topic, entry in received.items() if re.fullmatch(pattern, topic)]
    return min(counts) / simulated if counts else None


def push_table(summary: dict[str, Any]) -> Table:
    """Returns a table with the most important values of :func:`push_summary`."""
    error = summary["remote_displacement_error_mm"]
    lost = summary["ros_lost"]["share"]
    pictures, scans = (summary[f"{kind}_per_simulated_second"] for kind in ("pictures", "scans"))
    table = Table(title="what was measured", title_justify="left", show_header=False)
    for label, text in (
        ("ready", f"{summary['start_s']['ready']:.1f} s after the start"),
        *(
            (f"tick rate of {name}", f"{loop['tick_hz']:.2f} Hz, p99 {loop['tick_p99_ms']:.2f} ms of 10")
            for name, loop in summary["loops"].items()
        ),
        ("real-time factor", f"{summary['real_time_factor']:.3f} {summary['pace_cause']}"),
        ("steps skipped", f"{summary['steps_skipped']}"),
        (
            "pictures with depth, scans",
            "none came"
            if pictures is None or scans is None
            else f"{pictures:.1f} and {scans:.1f} in each simulated second",
        ),
        *(
            (topic, f"{entry['hz'] or 0.0:.1f} Hz, {entry['slowest_second']} in the slowest second")
            for topic, entry in summary["ros_detail"].items()
            if topic in SMALL_TOPICS or topic.endswith(("rgb/image_raw", "depth/image_raw", "/points"))
            if entry["count"]
        ),
        ("touch to motion", f"{summary['touch_to_motion_ticks']} ticks"),
        ("largest force", f"{summary['force_peak_n']:.1f} N"),
        (
            "error of the remote copy",
            # the visitor starts beyond the interest radius and reaches it after about ten seconds
            f"the visitor was not near in {summary['seconds']:.0f} s, give more --seconds"
            if error is None
            else f"{error['p50']:.1f} mm median, {error['p95']:.1f} p95",
        ),
        ("bytes of touched plants, no actor near", f"{summary['environment_bytes_when_far']}"),
        ("ROS messages received by a stock node", f"{sum(summary['ros_received'].values())}"),
        ("lost of /clock, /joint_states, /tf", "none came" if lost is None else f"{100.0 * lost:.2f} %"),
    ):
        table.add_row(label, text)
    return table


def job_summary(
    out: pathlib.Path,
    job: str,
    done_key: str,
    *,
    scene: str,
    seed: int,
    robot: str,
    no_ros: str | None,
    with_visitor: bool,
    is_stopped: bool,
) -> dict[str, Any]:
    """Returns the measurements of a task. ``done_key``: name of the boolean that tells whether the task was done;
    ``is_stopped``: whether the user has stopped the demo."""
    report = report_of(out, PICKER)
    done = bool(report["job"]["succeeded"])
    reason = report["job"]["reason"]
    if not done and not reason:
        phase = report["job"]["phase"]
        over = f"{report['time']:.0f} s were over at {phase!r}; give more --seconds"
        reason = f"stopped at {phase!r} before the end" if is_stopped else over
    summary = {
        "scene": scene,
        "seed": seed,
        "robot": robot,
        "job": job,
        done_key: done,
        "reason": reason,
        "seconds": report["time"],
        "ros": no_ros or "used",
        "detail": report["job"],
        **{key: report[key] for key in LOOP_KEYS},
        "bunches_picked": report["bunches_picked"],
        "fruit": report["fruit"],
    }
    if with_visitor:
        visitor = report_of(out, VISITOR)
        sent = {family: report["network"][family]["bytes_out"] for family in ("environment", "event", "fact")}
        rate = sum(sent.values()) / max(report["time"], 1e-9)
        summary["told_visitor"] = {"bytes": sent, "bytes_per_s": rate}
        summary["visitor"] = {key: visitor[key] for key in ("bunches_picked", "tick_hz", "tick_p99_ms", "network")}
    return summary
