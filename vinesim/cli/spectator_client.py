"""``vinesim client --role spectator``: look at a vineyard and touch nothing."""

from __future__ import annotations

import contextlib
import os
import pathlib
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np


def run(
    *, name: str | None, connect: str | None, tls: pathlib.Path | None, scene: str, seed: int | None, spawn: int,
    place: tuple[float, float, float] | None, near: float, device: str, threads: int, seconds: float | None,
    out: pathlib.Path | None, status: str, sensor_hz: float | None,
    renderer: str, **_: Any,
) -> int:  # fmt: skip
    """Look until told to stop; pictures go to ``out``."""
    from vinesim.cli.robot_client import report_status, tick_until
    from vinesim.client.rate_loop import RateLoop
    from vinesim.client.spectator import PictureWriter, Spectator, standing_view
    from vinesim.client.status import Status
    from vinesim.client.tasks.start_poses import spawn_pose
    from vinesim.errors import UsageError
    from vinesim.net.transport.bus import MemoryHub
    from vinesim.net.transport.zenoh_bus import ZenohBus
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed
    from vinesim.sensors.raster import renderers

    if status not in ("text", "json", "none"):
        raise UsageError(f"--status {status!r}: give text, json or none")
    if tls is not None and connect is None:
        raise UsageError(f"--tls {tls} without a server: give --connect tls/HOST:7447")
    renderers.check_renderer(renderer)
    plan = with_seed(load_scene(scene), seed)
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
            plan, model, None, bus, name=name, pose=standing_view(*place), interest_radius=near, device=device, threads=threads,
            executor=stack.enter_context(ThreadPoolExecutor(1, "arrivals")),
        )  # fmt: skip
        pictures = None if out is None else PictureWriter(spectator, out, 1.0 / (sensor_hz or 1.0), renderer)
        stop = threading.Event()
        pace = RateLoop(spectator.physics.dt)
        reporter = Status(spectator, pace)
        speaker = threading.Thread(target=report_status, args=(reporter, lambda _: None, status, stop), name="status")
        speaker.start()
        stack.callback(speaker.join)
        stack.callback(stop.set)
        tick_until(stop, spectator.tick, pace, seconds, spectator.physics.dt)
        if pictures is not None:
            pictures.save(spectator)
    return 0
