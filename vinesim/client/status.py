"""Status of a client, for display once a second, and its report at the end of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vinesim.client.client import Client
from vinesim.client.faults import FaultLog, count_faults
from vinesim.client.rate_loop import RateLoop
from vinesim.client.recording.bunch_trace import touch_to_motion
from vinesim.client.vine_events import fruit_report
from vinesim.robot.tasks.task import Task

_WITHOUT_SENSORS = {
    "sensors_ready": True,
    "sensors_awaited": [],
    "frames_delivered": 0,
    "frames_dropped": 0,
    "messages_dropped": 0,
    "sound_lost": 0,
    "sensor_restarts": 0,
    "ros_restarts": 0,
    "sensor_restart_s": 0.0,
    "processes": {},
}
"""Sensor part of the status of a client without sensors."""


class Status:
    """Measurements of a running client. It only reads the client, and may be used from another thread."""

    def __init__(
        self,
        client: Client,
        rate_loop: RateLoop,
        sent: Callable[[], dict[str, int]] | None = None,
        task: Task | None = None,
        sensors: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        """``sent()`` returns the number of ROS messages sent so far, by topic. ``task``: the robot's task, or None.
        ``sensors()`` returns the status of the sensors."""
        self.client = client
        self.rate_loop = rate_loop
        self._task = task
        self._sensors = sensors
        self._fault_log = FaultLog()
        self._sent: Callable[[], dict[str, int]] = sent or dict
        self._before: dict[str, int] = {}
        self._before_time = 0.0
        self._before_ticks = 0
        self._frames_before = (0, 0)
        """Numbers of delivered and dropped frames at the last call of :meth:`current`."""

    def current(self) -> dict[str, Any]:
        """Returns the present values, for JSON. Rates of topics and recent values cover the time since the last call.

        Recent faults are the kinds that occurred within the last minute.
        """
        client = self.client
        loop = self.rate_loop
        sent = dict(self._sent())
        time = loop.elapsed
        span = max(time - self._before_time, 1e-9)
        rates = {topic: (count - self._before.get(topic, 0)) / span for topic, count in sent.items() if count}
        recent_factor = (loop.ticks - self._before_ticks) * loop.dt / span
        self._before, self._before_time, self._before_ticks = sent, time, loop.ticks
        traffic = self.client.replicator.counters
        families = (traffic.actor, traffic.environment, traffic.event)
        p50, p99 = loop.work_ms(50, 99)
        faults = count_faults(client, loop.dropped)
        recent_faults = self._fault_log.update(faults, time)
        sensors = _WITHOUT_SENSORS | self._sensors()
        frames = sensors["frames_delivered"], sensors["frames_dropped"]
        delivered, missed = (now - before for now, before in zip(frames, self._frames_before, strict=True))
        self._frames_before = frames
        force = np.sum([np.linalg.norm(c.force) for c in client.physics.contacts if c.actor == client.name] or [0.0])
        return {
            "name": client.name,
            "time": client.physics.time,
            "world_time": client.physics.time + client.world_time.offset,
            "tick_hz": loop.hz,
            "tick_p50_ms": p50,
            "tick_p99_ms": p99,
            "overruns": loop.overruns,
            "real_time_factor": loop.real_time_factor,
            "recent_real_time_factor": recent_factor,
            "target_real_time_factor": loop.target_factor,
            "pace_cause": loop.clock.cause,
            "steps_skipped": loop.dropped,
            "awake": len(client.physics.plants.awake),
            "force": float(force),
            "displacement_mm": 1e3 * client.trace.displacement if client.trace is not None else 0.0,
            "bytes_in": sum(family.bytes_in for family in families),
            "bytes_out": sum(family.bytes_out for family in families),
            "environment_bytes_in": traffic.environment.bytes_in,
            "environment_bytes_out": traffic.environment.bytes_out,
            "unfinished_solves": client.physics.contact_solver.impulses.unfinished,
            "faults": faults,
            "recent_faults": recent_faults,
            "network": network_trouble(client),
            "round_trip_ms": None if (trip := client.replicator.round_trip) is None else 1e3 * trip,
            "sound_dropped": client.sound.dropped,
            "bunches_picked": int((~client.physics.state.bunch_attached).sum()),
            "phase": "" if self._task is None else self._task.phase,
            "others": sorted({*client.remote_actors, *client.far_actors()}),
            "topics": rates,
            "frame_rate": delivered / span,
            "frame_rate_asked": (delivered + missed) / span,
            **sensors,
        }

    def report(self) -> dict[str, Any]:
        """Returns the values at the end of a run, with counts of messages and the evaluation of the trace."""
        client = self.client
        values = self.current()
        values["topics"] = dict(self._sent())
        values |= {
            "environment_bytes_when_far": client.interest_audit.bytes,
            "ticks_touching_when_far": client.interest_audit.ticks_touching,
            "fruit": fruit_report(client.physics),
            "malformed": client.replicator.counters.malformed,
            "network": client.replicator.counters.to_report(),
        }
        if client.trace is not None:
            rows = client.trace.rows()
            values["touch_to_motion_ticks"] = touch_to_motion(rows)
            values["force_peak_n"] = float(np.linalg.norm(rows.force, axis=1).max(initial=0.0))
            values["displacement_peak_mm"] = 1e3 * float(np.linalg.norm(rows.displacement, axis=1).max(initial=0.0))
        return values


def network_trouble(client: Client) -> str:
    """Returns the reason why an actor of the client has no network now (for the first such actor), or "" if all have
    it."""
    return next((text for one in client.replicators.values() if (text := one.bus.status_message)), "")
