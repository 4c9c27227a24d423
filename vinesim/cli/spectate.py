"""``vinesim client --role spectator``: look at a vineyard and touch nothing."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

STATUS_PERIOD = 1.0
"""Between two status lines [s]."""


def run(
    *, name: str | None, connect: str | None, tls: pathlib.Path | None, scene: str, seed: int | None, spawn: int,
    place: tuple[float, float, float] | None, near: float, device: str, threads: int, seconds: float | None,
    out: pathlib.Path | None, status: str, sensor_hz: float | None, **_: Any,
) -> int:  # fmt: skip
    """Look until told to stop; pictures go to ``out``."""
    from vinesim.cli.join import WrongUse
    from vinesim.client.pace import Pace
    from vinesim.client.places import spawn_pose
    from vinesim.client.spectator import Pictures, Spectator, viewpoint
    from vinesim.client.status import Status
    from vinesim.net.bus import MemoryHub
    from vinesim.net.zenoh_bus import ZenohBus
    from vinesim.world.generate import generate
    from vinesim.world.scene import load, reseeded

    if status not in ("text", "json", "none"):
        raise WrongUse(f"--status {status!r}: give text, json or none")
    if tls is not None and connect is None:
        raise WrongUse(f"--tls {tls} without a server: give --connect tls/HOST:7447")
    plan = reseeded(load(scene), seed)
    if place is None:
        start = spawn_pose(plan, spawn)
        place = float(start[0]), float(start[1]), 2.0 * float(np.arctan2(start[5], start[6]))
    model = generate(plan)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    name = name or f"spectator-{os.getpid()}"
    with contextlib.ExitStack() as stack:
        bus: Any = MemoryHub().bus(name)
        if connect is not None:
            bus = stack.enter_context(ZenohBus(name, connect=connect, certificates=tls))
        spectator = Spectator(
            plan, model, None, bus, name=name, pose=viewpoint(*place), near=near, device=device, threads=threads,
            executor=stack.enter_context(ThreadPoolExecutor(1, "arrivals")),
        )  # fmt: skip
        pictures = None if out is None else Pictures(spectator, out, 1.0 / (sensor_hz or 1.0))
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        pace = Pace(spectator.physics.dt)
        reporter = Status(spectator, pace)
        said, limit = 0.0, None if seconds is None else round(seconds / spectator.physics.dt)
        while not (stop.is_set() or pace.ticks == limit):
            pace.begin()
            spectator.tick()
            pace.end()
            if status != "none" and pace.elapsed >= said + STATUS_PERIOD:
                said = pace.elapsed
                figures = reporter.now()
                company = ", ".join(figures["others"]) or "nobody"
                words = f"{figures['time']:7.1f} s  {figures['tick_hz']:6.2f} Hz  awake {figures['awake']:3d}  "
                words += f"in {figures['bytes_in']} B  out {figures['bytes_out']} B  sees {company}"
                try:
                    print(json.dumps(figures) if status == "json" else words, flush=True)
                except BrokenPipeError:  # whoever listened is gone
                    break
        if pictures is not None:
            pictures.save(spectator)
    return 0
