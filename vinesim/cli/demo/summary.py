"""``summary.json`` of a demo, from the reports of its clients."""

from __future__ import annotations

import json
import pathlib
import shutil
from typing import Any

from rich.table import Table

from vinesim.cli.demo.progress import PICKER, VISITOR
from vinesim.client.recording import contact_force_plot
from vinesim.client.recording.bunch_trace import Rows, remote_error

LOOP_KEYS = ("tick_hz", "tick_p50_ms", "tick_p99_ms", "overruns", "real_time_factor")


def write_summary(out: pathlib.Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json``, whole or not at all, and copy the picker's pictures beside it."""
    for picture in (out / PICKER).glob("*.png"):
        shutil.copyfile(picture, out / picture.name)
    partial = out / "summary.json.part"
    partial.write_text(json.dumps(summary, indent=2) + "\n")
    partial.replace(out / "summary.json")


def report_of(out: pathlib.Path, name: str) -> dict[str, Any]:
    """The report that a client has written."""
    return json.loads((out / name / "report.json").read_text())


def push_summary(
    out: pathlib.Path, bunch: int, received: dict[str, Any], no_ros: str | None, scene: str, seed: int, seconds: float
) -> dict[str, Any]:
    """What was measured of a push; draws ``touch.png``. ``received``: statistics of the topic monitor, by topic."""
    reports = {name: report_of(out, name) for name in (PICKER, VISITOR)}
    traces = {name: Rows.load(out / name / "trace.npz") for name in (PICKER, VISITOR)}
    contact_force_plot.touch(out / "touch.png", traces, f"bunch {bunch}, pushed by {PICKER}, seen by {VISITOR}")
    touch_keys = (
        "touch_to_motion_ticks", "force_peak_n", "environment_bytes_when_far", "ticks_touching_when_far",
        "environment_bytes_out",
    )  # fmt: skip
    return {
        "scene": scene, "seed": seed, "seconds": seconds, "bunch": bunch,
        **{key: reports[PICKER][key] for key in (*LOOP_KEYS, *touch_keys)},
        "remote_displacement_error_mm": remote_error(traces[PICKER], traces[VISITOR]),
        "ros": no_ros or "used",
        "ros_received": {topic: entry["count"] for topic, entry in sorted(received.items())},
        "ros_detail": received,
        "clients": reports,
    }  # fmt: skip


def push_table(summary: dict[str, Any]) -> Table:
    """The most important values of :func:`push_summary`, to print."""
    error = summary["remote_displacement_error_mm"]
    table = Table(title="what was measured", title_justify="left", show_header=False)
    for label, text in (
        ("tick rate", f"{summary['tick_hz']:.2f} Hz, p99 {summary['tick_p99_ms']:.2f} ms of 10"),
        ("real-time factor", f"{summary['real_time_factor']:.4f}"),
        ("touch to motion", f"{summary['touch_to_motion_ticks']} ticks"),
        ("largest force", f"{summary['force_peak_n']:.1f} N"),
        (
            "error of the remote copy",
            "never compared" if error is None else f"{error['p50']:.1f} mm median, {error['p95']:.1f} p95",
        ),
        ("bytes of touched plants, nobody near", f"{summary['environment_bytes_when_far']}"),
        ("ROS messages received by a stock node", f"{sum(summary['ros_received'].values())}"),
    ):
        table.add_row(label, text)
    return table


def job_summary(
    out: pathlib.Path, job: str, done_key: str, *, scene: str, seed: int, robot: str, no_ros: str | None,
    with_visitor: bool,
) -> dict[str, Any]:  # fmt: skip
    """What was measured of a job; ``done_key`` names the boolean that tells whether it was done."""
    report = report_of(out, PICKER)
    done = bool(report["job"]["succeeded"])
    reason = report["job"]["reason"] or ("" if done else f"stopped at {report['job']['phase']!r} before the end")
    summary = {
        "scene": scene, "seed": seed, "robot": robot, "job": job, done_key: done, "reason": reason,
        "seconds": report["time"], "ros": no_ros or "used", "detail": report["job"],
        **{key: report[key] for key in LOOP_KEYS}, "bunches_picked": report["bunches_picked"],
    }  # fmt: skip
    if with_visitor:
        visitor = report_of(out, VISITOR)
        sent = {family: report["network"][family]["bytes_out"] for family in ("environment", "event", "fact")}
        rate = sum(sent.values()) / max(report["time"], 1e-9)
        summary["told_visitor"] = {"bytes": sent, "bytes_per_s": rate}
        summary["visitor"] = {key: visitor[key] for key in ("bunches_picked", "tick_hz", "tick_p99_ms", "network")}
    return summary
