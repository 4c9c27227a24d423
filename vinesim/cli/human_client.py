"""``vinesim client --role human``: join a vineyard as a person, moved by a script until there is a headset."""

from __future__ import annotations

import contextlib
import os
import pathlib
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from vinesim.avatar.scripted_human import ScriptedHuman


def run(
    *, name: str | None, connect: str | None, tls: pathlib.Path | None, scene: str, seed: int | None, spawn: int,
    place: tuple[float, float, float] | None, walk: tuple[float, float] | None, reach: int | None, height: float,
    near: float, jitter_buffer: float, device: str, threads: int, seconds: float | None, out: pathlib.Path | None,
    status: str, **_: Any,
) -> int:  # fmt: skip
    """Walk, reach for a bunch, hold it and pull at it, let go; until told to stop. Then write report.json."""
    from vinesim.avatar.scripted_human import ScriptedHuman
    from vinesim.cli.robot_client import SWITCH_INTERVAL, report_status, save_report, tick_until
    from vinesim.client.client import Client
    from vinesim.client.rate_loop import RateLoop
    from vinesim.client.recording.trace import Trace
    from vinesim.client.status import Status
    from vinesim.client.tasks.start_poses import bunch_centres, start_pose, validate_bunch, with_start_pose
    from vinesim.errors import UsageError
    from vinesim.net.transport.bus import MemoryHub
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed

    if status not in ("text", "json", "none"):
        raise UsageError(f"--status {status!r}: give text, json or none")
    sys.setswitchinterval(SWITCH_INTERVAL)
    plan = with_seed(load_scene(scene), seed)
    if place is not None:
        plan, spawn = with_start_pose(plan, *place), 0
    model = generate(plan)
    validate_bunch(model, reach)
    name = name or f"human-{os.getpid()}"
    start = start_pose(plan, spawn)
    walker = ScriptedHuman(start, height)
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        if connect is None:
            bus: Any = stack.enter_context(MemoryHub().bus(name))
        else:
            from vinesim.net.transport.zenoh_bus import ZenohBus

            bus = stack.enter_context(ZenohBus(name, connect=connect, certificates=tls))
        client = Client(
            plan, model, None, bus, name=name, pose=start, source=walker, height=height, interest_radius=near,
            jitter_buffer=1e-3 * jitter_buffer, device=device, threads=threads,
            executor=stack.enter_context(ThreadPoolExecutor(1, "arrivals")),
        )  # fmt: skip
        stack.callback(client.leave)
        if walk is not None:
            walker.do(walker.walk(walk))
        if reach is not None:
            body = int(model.bunch_body[reach])
            client.trace = trace = Trace(model, reach, client.physics.state.body_q[body].copy(), 1 << 17)
            if walk is None:
                walker.do(walker.walk(standing_place(bunch_centres(model)[reach], start)))
            walker.do(pull_repeatedly(walker, trace.centre))
        pace = RateLoop(client.physics.dt)
        reporter = Status(client, pace)
        speaker = threading.Thread(target=report_status, args=(reporter, lambda _: None, status, stop), name="status")
        speaker.start()
        stack.callback(speaker.join)
        stack.callback(stop.set)
        tick_until(stop, client.tick, pace, seconds, client.physics.dt)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if client.trace is not None:
                client.trace.rows().save(out / "trace.npz")
            save_report(out, reporter.report())
    return 0


def pull_repeatedly(walker: ScriptedHuman, point: Callable[[], np.ndarray]) -> Iterator[None]:
    """Hold what is at a point, pull at it, let it go; for ever."""
    while True:
        yield from walker.reach("right", point)
        yield from walker.wait(0.5)
        yield from walker.withdraw("right", 0.3)
        yield from walker.wait(1.0)
        yield from walker.release("right")
        yield from walker.withdraw("right")
        yield from walker.wait(1.5)


def standing_place(bunch: np.ndarray, start: np.ndarray) -> tuple[float, float]:
    """A place to stand within reach of a bunch [3], on the side of ``start`` [7]."""
    way = bunch[:2] - start[:2]
    length = float(np.linalg.norm(way))
    x, y = bunch[:2] - way * min(1.0, 0.55 / max(length, 1e-9))
    return float(x), float(y)
