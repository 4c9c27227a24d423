"""``vinesim bench eyes``: the 100 Hz tick of a robot in real time, while its camera is looked through and while not."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

from vinesim.client.client import Client
from vinesim.client.rate_loop import RateLoop
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.sensing.sensor_process import SensorProcess
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.start_poses import find_reachable_bunch, spawn_pose, start_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

RUN_TIME = 8.0
"""Real time of one run [s]; each kind is run twice, in turn."""
WARMUP_STEPS = 100
"""Ticks before the count begins."""


@dataclasses.dataclass
class _Run:
    p50: float
    p99: float
    overruns: int
    hz: float
    frames: float
    dropped: float


def _run(pictures: bool) -> _Run:
    """One robot pushes a bunch again and again, and its head follows with the camera."""
    plan = load_scene("demo")
    model = generate(plan)
    description = load_robot("vinebot")
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(MemoryHub().bus("robot"))
        senses = stack.enter_context(
            SensorProcess("robot", plan, model, description, ros=False, keep_pictures=pictures)
        )
        arrivals = stack.enter_context(ThreadPoolExecutor(1, "arrivals"))
        client = Client(plan, model, description, bus, name="robot", pose=start_pose(plan, 0), executor=arrivals)
        stack.callback(client.leave)
        senses.attach(client)
        bunch = find_reachable_bunch(model, spawn_pose(plan, 0))
        body = int(model.bunch_body[bunch])
        client.trace = Trace(model, bunch, client.physics.state.body_q[body].copy(), 1 << 14)
        reach = PushBunch(client.robot, client.side_of(client.trace.centre()), client.trace.centre)
        client.pre_step += [reach.control, LookAt(client.robot, client.trace.centre)]
        warm, pace = RateLoop(client.physics.dt), RateLoop(client.physics.dt)
        camera = description.cameras[0].name
        before = {"frames": 0, "frames_dropped": 0}
        for beat, ticks in ((warm, WARMUP_STEPS), (pace, round(RUN_TIME / client.physics.dt))):
            if beat is pace:
                before = {key: counts.get(camera, 0) for key, counts in senses.report().items() if key in before}
            for _ in range(ticks):
                beat.begin()
                client.tick()
                beat.end()
        after = {key: counts.get(camera, 0) for key, counts in senses.report().items() if key in before}
        span = pace.elapsed
        p50, p99 = pace.work_ms(50, 99)
    rate = {key: (after.get(key, 0) - before.get(key, 0)) / span for key in ("frames", "frames_dropped")}
    return _Run(p50, p99, pace.overruns, pace.hz, rate["frames"], rate["frames_dropped"])


def eyes() -> Iterator[Measurement]:
    """Steps and pictures per second; the peer is the same client without a camera subscriber."""
    runs = {False: [], True: []}
    for pictures in (False, True, False, True):
        runs[pictures].append(_run(pictures))
    blind, seeing = (min(runs[k], key=lambda r: r.p99) for k in (False, True))
    peer = "no pictures"
    yield Measurement("eyes", "tick p50", seeing.p50, "ms", peer, blind.p50, blind.p50 / seeing.p50)
    yield Measurement("eyes", "tick p99", seeing.p99, "ms", peer, blind.p99, blind.p99 / seeing.p99)
    yield Measurement("eyes", "ticks a second", seeing.hz, "Hz", peer, blind.hz, seeing.hz / blind.hz)
    yield Measurement("eyes", f"ticks over 10 ms in {RUN_TIME:g} s", seeing.overruns, "1", peer, blind.overruns, None)
    yield Measurement("eyes", "pictures 640x480 a second, of 30 asked for", seeing.frames, "Hz")
    yield Measurement("eyes", "pictures dropped a second", seeing.dropped, "Hz")
