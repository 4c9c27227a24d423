"""``vinesim bench live``: measures programs started as users start them, in one run, each figure against its budget.

Clients, demo and commands are real processes on this machine; a stock ROS node counts pictures and small messages.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vinesim.bench.live_client import CLOCK, DEPTH, LIDAR, RGB, LiveRun, own_processes, run_client
from vinesim.scene.values import Measurement

RUN_TIME = 20.0
"""Duration of the measurement of a client or a demo [s]."""
COMMAND_TIMEOUT = 600.0
"""Time limit for one command [s]."""
SMALL_TOPICS = ("/clock", "/joint_states", "/tf")
GENERATE = (
    "import sys, time; from vinesim.scene.generation.vineyard import generate; "
    "from vinesim.scene.spec import load_scene; scene = load_scene(sys.argv[1]); "
    "start = time.perf_counter(); generate(scene); print(time.perf_counter() - start)"
)
"""Python program that prints the time that the generation of a scene takes [s]."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of the benchmark ``live``: figures that are measured together, in one run of programs."""

    about: str
    seconds: float
    """Typical duration of the row on two cores [s]."""
    measure: Callable[[], Iterator[Measurement]]


def at_most(case: str, value: float, unit: str, budget: float) -> Measurement:
    """Returns a measurement whose value should be at most ``budget``; its ratio is 1 or more if it is."""
    return Measurement("live", case, value, unit, "budget, at most", budget, budget / value if value > 0.0 else None)


def at_least(case: str, value: float, unit: str, budget: float) -> Measurement:
    """Returns a measurement whose value should be at least ``budget``; its ratio is 1 or more if it is."""
    return Measurement("live", case, value, unit, "budget, at least", budget, value / budget)


def measure_demo() -> Iterator[Measurement]:
    """Measure ``vinesim demo``: a server, two clients with their sensors, and a listener."""
    with tempfile.TemporaryDirectory() as folder:
        run_command("demo", "--headless", "--seconds", str(RUN_TIME), "--out", folder)
        summary = json.loads((pathlib.Path(folder) / "summary.json").read_text())
    yield at_most("demo: from start to cameras and lidars of both", summary["start_s"]["ready"], "s", 6.0)
    for name, loop in summary["loops"].items():
        yield at_least(f"demo: ticks of {name}", loop["tick_hz"], "Hz", 99.9)
        yield Measurement("live", f"demo: tick of {name}, p50", loop["tick_p50_ms"], "ms")
        yield at_most(f"demo: tick of {name}, p99", loop["tick_p99_ms"], "ms", 10.0)
        yield at_least(f"demo: real-time factor of {name}", loop["real_time_factor"], "1", 0.999)
    topics = summary["ros_detail"]
    for topic, budget in ((RGB, 8.0), (DEPTH, 8.0), (LIDAR, 5.0)):
        yield at_least(f"demo: {topic}", _hz(topics, topic), "Hz", budget)
        yield at_least(f"demo: {topic}, in the slowest second", _slowest(topics, topic), "1", budget)
    for topic in SMALL_TOPICS:
        yield at_least(f"demo: {topic}", _hz(topics, topic), "Hz", 98.0)
    share = summary["ros_lost"]["share"]
    yield at_most(f"demo: lost of {', '.join(SMALL_TOPICS)}", 100.0 * (1.0 if share is None else share), "%", 0.5)


def measure_camera() -> Iterator[Measurement]:
    """Measure a client alone whose pictures have a subscriber; kernels and models are cached."""
    run = run_client((), (CLOCK, RGB, DEPTH), RUN_TIME)
    yield at_most("client: from start to first picture, warm", max(run.first[RGB], run.first[DEPTH]), "s", 3.0)
    yield from _client_rows("client, camera", run, camera=15.0)


def measure_lidar() -> Iterator[Measurement]:
    """Measure a client alone whose pictures and scans have subscribers; kernels and models are cached."""
    run = run_client((), (CLOCK, RGB, DEPTH, LIDAR), RUN_TIME)
    yield from _client_rows("client, camera and lidar", run, camera=10.0)
    yield at_least("client, camera and lidar: /lidar/points", _hz(run.topics, LIDAR), "Hz", 9.8)
    yield from _age_rows("client, camera and lidar: /lidar/points", run.topics[LIDAR], None)


def measure_cold() -> Iterator[Measurement]:
    """Measure a client on a machine that has never run one: kernels are compiled, caches are empty."""
    with tempfile.TemporaryDirectory() as cache:
        run = run_client((), (RGB, DEPTH), 1.0, WARP_CACHE_PATH=cache, VINESIM_CACHE=cache)
    yield at_most("client: from start to first picture, cold", max(run.first[RGB], run.first[DEPTH]), "s", 30.0)


def measure_tendone() -> Iterator[Measurement]:
    """Measure a client alone in ``tendone``, the largest shipped vineyard."""
    run = run_client(("--scene", "tendone"), (CLOCK, RGB, DEPTH), RUN_TIME)
    yield at_most("tendone: from start to first picture", max(run.first[RGB], run.first[DEPTH]), "s", 10.0)
    yield at_most("tendone: tick, p50", run.loop["tick_p50_ms"], "ms", 2.0)
    yield Measurement("live", "tendone: tick, p99", run.loop["tick_p99_ms"], "ms")
    for topic in (RGB, DEPTH):
        yield at_least(f"tendone: {topic}", _hz(run.topics, topic), "Hz", 8.0)


def measure_start() -> Iterator[Measurement]:
    """Measure ``vinesim render`` with and without ``--path``, and the parts of a start, with warm caches."""
    from vinesim.bench.start import start_measurements

    return start_measurements()


def measure_generation() -> Iterator[Measurement]:
    """Measure the generation of scenes in one process, and their loading from the cache in another."""
    for scene, fresh, cached in (("demo", 0.3, 0.1), ("tendone", 2.0, 0.5)):
        with tempfile.TemporaryDirectory() as cache:
            for case, budget in (("generate", fresh), ("generate, cached", cached)):
                with own_processes(VINESIM_CACHE=cache) as group:
                    process = group.start("generate", "-c", GENERATE, scene)
                    took = float(process.next_line(COMMAND_TIMEOUT))
                yield at_most(f"{case} {scene}", took, "s", budget)


def measure_tick() -> Iterator[Measurement]:
    """Measure whole ticks of clients, paced and back to back."""
    from vinesim.bench.client_tick import client_measurements

    return client_measurements()


ROWS = {
    "demo": Row("vinesim demo: start, ticks, sensors, 100 Hz topics, losses", 45.0, measure_demo),
    "camera": Row("client alone, camera: start to first picture, rate, age, tick", 35.0, measure_camera),
    "lidar": Row("client alone, camera and lidar", 35.0, measure_lidar),
    "tendone": Row("client alone in tendone", 45.0, measure_tendone),
    "start": Row("vinesim render with and without --path, parts of a start", 90.0, measure_start),
    "generate": Row("demo and tendone generated, then read from the cache", 20.0, measure_generation),
    "tick": Row("whole ticks, paced and back to back, of one robot and of ten", 110.0, measure_tick),
    "cold": Row("client alone with empty caches: compiles every kernel", 180.0, measure_cold),
}
"""Rows by the name that ``--row`` takes, in the order in which they are measured."""


def live(rows: Sequence[str], announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Measure the named rows of :data:`ROWS`, or all of them. ``announce`` is called with a line of text before each
    row.

    Raises :class:`ProgramFailed` or :class:`RosMissing` if a row fails.
    """
    chosen = [name for name in ROWS if not rows or name in rows]
    left = sum(ROWS[name].seconds for name in chosen)
    for number, name in enumerate(chosen, 1):
        row = ROWS[name]
        announce(f"{number} of {len(chosen)}, {name}: {row.about}; about {left:.0f} s left")
        yield from row.measure()
        left -= row.seconds


def run_command(*arguments: str) -> float:
    """Returns the time that ``vinesim ARGUMENTS`` takes [s]. Raises :class:`ProgramFailed` unless it ends with exit
    code 0."""
    with own_processes() as group:
        process = group.start(f"vinesim {arguments[0]}", "-m", "vinesim", *arguments)
        start = time.perf_counter()
        try:
            process.child.wait(COMMAND_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise process.fault(f"{process.name} took longer than {COMMAND_TIMEOUT:.0f} s") from None
        if process.child.returncode:
            raise process.failure()
        return time.perf_counter() - start


def _client_rows(case: str, run: LiveRun, camera: float) -> Iterator[Measurement]:
    """Yields rates and ages of pictures, whose rate should be at least ``camera`` [Hz], and the tick of the same
    client."""
    for topic in (RGB, DEPTH):
        yield at_least(f"{case}: {topic}", _hz(run.topics, topic), "Hz", camera)
        yield from _age_rows(f"{case}: {topic}", run.topics[topic])
    yield at_least(f"{case}: ticks", run.loop["tick_hz"], "Hz", 99.9)
    yield Measurement("live", f"{case}: tick, p50", run.loop["tick_p50_ms"], "ms")
    yield at_most(f"{case}: tick, p99", run.loop["tick_p99_ms"], "ms", 5.0)


def _age_rows(case: str, topic: dict[str, Any], budget: float | None = 100.0) -> Iterator[Measurement]:
    """Yields the age of messages at arrival: simulated time on /clock since their stamp. A scan is stamped when its
    revolution begins."""
    age = topic["age_ms"]
    if age is not None:
        median = f"{case}, age at arrival, p50"
        if budget is not None:
            yield at_most(median, age["p50"], "ms", budget)
        else:
            yield Measurement("live", median, age["p50"], "ms")
        yield Measurement("live", f"{case}, age at arrival, p95", age["p95"], "ms")


def _hz(topics: dict[str, Any], topic: str) -> float:
    return topics.get(topic, {}).get("hz") or 0.0


def _slowest(topics: dict[str, Any], topic: str) -> float:
    return float(topics.get(topic, {}).get("slowest_second") or 0)
