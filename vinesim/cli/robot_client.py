"""``vinesim client``: join a vineyard as one actor."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import pathlib
import re
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from vinesim.errors import UsageError

if TYPE_CHECKING:
    from vinesim.client.rate_loop import RateLoop

log = logging.getLogger(__name__)

SWITCH_INTERVAL = 2e-4
"""How long another thread may hold the interpreter lock when the tick wants it [s]; Python's own is 5 ms."""
STATUS_PERIOD = 1.0
"""Between two status lines [s]."""


def run(
    *, role: str, name: str | None, connect: str | None, tls: pathlib.Path | None, scene: str, seed: int | None,
    robot: list[str] | None,
    spawn: int, place: tuple[float, float, float] | None, back: float, namespace: str, ros: bool, push: int | None,
    job: str | None, watch: int | None, near: float, jitter_buffer: float,
    device: str,
    threads: int, seconds: float | None, out: pathlib.Path | None, status: str, sensor_hz: float | None,
    renderer: str,
) -> int:  # fmt: skip
    """Build the client from its options, tick until told to stop, then write what was asked for."""
    if role != "robot":
        raise UsageError(f"role {role!r} is none of robot, human, spectator; give one of them")
    if status not in ("text", "json", "none"):
        raise UsageError(f"--status {status!r}: give text, json or none")
    if tls is not None and connect is None:
        raise UsageError(f"--tls {tls} without a server: give --connect tls/HOST:7447")

    from vinesim.physics.plants.device_buffers import find_device
    from vinesim.sensors.raster import renderers

    find_device(device)  # refused before anything is built
    renderers.check_renderer(renderer)
    if threads > 1 and device != "cpu":
        raise UsageError(f"--threads {threads} --device {device}: threads are for the CPU; leave one of the two out")

    # The tick gives the interpreter lock away at every kernel launch, and must get it back within a fraction of a tick.
    sys.setswitchinterval(SWITCH_INTERVAL)
    stop = threading.Event()

    from vinesim.client.client import Client
    from vinesim.client.rate_loop import RateLoop
    from vinesim.client.recording.trace import Trace
    from vinesim.client.sensing.sensor_process import SensorProcess
    from vinesim.client.status import Status
    from vinesim.client.tasks.start_poses import start_pose, validate_bunch, with_start_pose
    from vinesim.client.tasks.tasks import DriveTo, LookAt, plan_task, validate_task_name
    from vinesim.net.transport.bus import MemoryHub
    from vinesim.robot.description.description import load_description as load_robot
    from vinesim.robot.tasks.push import PushBunch
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed

    validate_task_name(job)
    plan = with_seed(load_scene(scene), seed)
    descriptions = [load_robot(one) for one in robot or ["vinebot"]]
    if place is not None:
        plan = with_start_pose(plan, *place)
        spawn = 0
    model = generate(plan)
    start = start_pose(plan, spawn, back)
    if job is not None:
        begin, start = plan_task(job, model, start_pose(plan, spawn))
        back = 0.0
    name = name or f"robot-{os.getpid()}"
    names = [name] if len(descriptions) == 1 else [f"{name}_{i + 1}" for i in range(len(descriptions))]
    for bunch in (push, watch):
        validate_bunch(model, bunch)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)

    with contextlib.ExitStack() as stack:
        hub = MemoryHub()

        def bus(name: str) -> Any:
            if connect is None:
                return stack.enter_context(hub.bus(name))
            from vinesim.net.transport.zenoh_bus import ZenohBus

            return stack.enter_context(ZenohBus(name, connect=connect, certificates=tls))

        perceptions = [
            stack.enter_context(
                SensorProcess(
                    one, plan, model, description,
                    namespace=namespace if len(names) == 1 else "/".join(filter(None, (namespace, ros_name(one)))),
                    ros=ros, keep_pictures=out is not None and i == 0, sensor_hz=sensor_hz,
                    clock=not namespace and i == 0, renderer=renderer,
                )
            )
            for i, (one, description) in enumerate(zip(names, descriptions, strict=True))
        ]  # fmt: skip
        senses = perceptions[0]
        client = Client(
            plan, model, descriptions[0], bus(names[0]), name=names[0], pose=start, interest_radius=near,
            jitter_buffer=1e-3 * jitter_buffer, device=device,
            threads=threads, executor=stack.enter_context(ThreadPoolExecutor(1, "arrivals")),
        )  # fmt: skip
        for i in range(1, len(names)):
            client.add_robot(descriptions[i], names[i], start_pose(plan, spawn, back, i), bus(names[i]))
        stack.callback(client.leave)
        for one, perception in zip(names, perceptions, strict=True):
            perception.attach(client, client.robots[one])
        pace = RateLoop(client.physics.dt)
        watched = watch if watch is not None else push
        if watched is not None:
            body = int(model.bunch_body[watched])
            client.trace = Trace(model, watched, client.physics.state.body_q[body].copy(), 1 << 17)
        if back > 0.0:
            client.pre_step += [
                DriveTo(mine, start_pose(plan, spawn, queue=i)) for i, mine in enumerate(client.robots.values())
            ]
        if push is not None and client.trace is not None:
            reach = PushBunch(client.robot, client.side_of(client.trace.centre()), client.trace.centre)
            client.pre_step.append(reach.control)
        script = None
        if job is not None:
            script = begin(client.physics, client.robot)
            client.pre_step.append(script.control)
            client.frame_score = script.frame_score
            client.pre_step.append(LookAt(client.robot, script.focus))
        elif client.trace is not None:
            client.pre_step.append(LookAt(client.robot, client.trace.centre))
        reporter = Status(client, pace, senses.sent_messages, script)
        speaker = threading.Thread(
            target=report_status, args=(reporter, senses.publish_diagnostics, status, stop), name="status"
        )
        speaker.start()
        stack.callback(speaker.join)
        stack.callback(stop.set)
        done = (lambda: False) if script is None else (lambda: script.is_done)
        tick_until(stop, client.tick, pace, seconds, client.physics.dt, done)
        if out is not None:
            report = reporter.report() | senses.report()
            if script is not None:
                report["job"] = script.report()
            senses.save_picture(out)
            if client.trace is not None:
                client.trace.rows().save(out / "trace.npz")
            save_report(out, report)
    return 0


def tick_until(
    stop: threading.Event, tick: Callable[[], None], pace: RateLoop, seconds: float | None, dt: float,
    done: Callable[[], bool] = lambda: False,
) -> None:  # fmt: skip
    """Tick in time until told to ``stop`` (Ctrl-C and SIGTERM do), for so many ``seconds``, or until it is ``done``."""
    gc.collect()
    gc.freeze()  # what lives now lives to the end; the collector need not look at it in a tick
    # until here Ctrl-C simply interrupts; from now on it ends the run in order
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    limit = None if seconds is None else round(seconds / dt)
    while not (stop.is_set() or pace.ticks == limit or done()):
        pace.begin()
        tick()
        pace.end()


def save_report(out: pathlib.Path, report: dict[str, Any]) -> None:
    """Write ``report.json``, whole or not at all."""
    partial = out / "report.json.part"
    partial.write_text(json.dumps(report, indent=2) + "\n")
    partial.replace(out / "report.json")


def ros_name(name: str) -> str:
    """An actor's name as ROS allows it in topics."""
    return re.sub(r"\W", "_", name)


def report_status(reporter: Any, diagnose: Callable[[dict], None], status: str, stop: threading.Event) -> None:
    """Once a second, say how it goes: to the terminal, and to whoever wants to ``diagnose``."""
    try:
        while not stop.wait(STATUS_PERIOD):
            figures = reporter.now()
            diagnose(figures)
            if status == "json":
                print(json.dumps(figures), flush=True)
            elif status == "text":
                company = ", ".join(figures["others"]) or "nobody"
                print(
                    f"{figures['time']:7.1f} s  {figures['tick_hz']:6.2f} Hz  p99 {figures['tick_p99_ms']:5.2f} ms  "
                    f"awake {figures['awake']:3d}  force {figures['force']:6.2f} N  "
                    f"in {figures['bytes_in']} B  out {figures['bytes_out']} B  with {company}",
                    flush=True,
                )
    except BrokenPipeError:  # whoever listened is gone: that ends the run, not the log
        stop.set()
