"""``vinesim bench``: measurements beside a peer, one JSON object a line."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import sys
from collections.abc import Callable, Iterator, Sequence

from vinesim.errors import UsageError
from vinesim.scene.values import Measurement


def _plants() -> Iterator[Measurement]:
    from vinesim.bench.plants import plant_measurements

    return plant_measurements()


def _contact() -> Iterator[Measurement]:
    from vinesim.bench.contact import contact_measurements

    return contact_measurements()


def _tick() -> Iterator[Measurement]:
    from vinesim.bench.client_tick import client_measurements
    from vinesim.bench.contact import step_measurements
    from vinesim.robot.description.loader import load_description

    robot = load_description("vinebot")
    raised = robot.home.copy()
    for joint, position in RAISED.items():
        raised[robot.joints.index(joint)] = position
    yield from client_measurements()
    yield from step_measurements(robot.to_spec("robot"), raised)


def _asleep() -> Iterator[Measurement]:
    from vinesim.bench.vineyard import sleeping_measurements
    from vinesim.robot.description.loader import load_description

    return sleeping_measurements(load_description("vinebot").to_spec("robot"))


def _start() -> Iterator[Measurement]:
    from vinesim.bench.start import start_measurements

    return start_measurements()


def _picking() -> Iterator[Measurement]:
    from vinesim.bench.picking import picking

    return picking()


def _camera() -> Iterator[Measurement]:
    from vinesim.bench.camera import camera

    return camera()


def _lidar() -> Iterator[Measurement]:
    from vinesim.bench.lidar import lidar

    return lidar()


def _sensors(plot: pathlib.Path | None = None) -> Iterator[Measurement]:
    from vinesim.bench.sensor_accuracy import sensors

    return sensors(plot)


def _sync(plot: pathlib.Path | None = None) -> Iterator[Measurement]:
    from vinesim.bench.replication_delay import sync

    return sync(plot=plot)


def _traffic() -> Iterator[Measurement]:
    from vinesim.bench.traffic import traffic

    return traffic()


def _load() -> Iterator[Measurement]:
    from vinesim.bench.router_load import load

    return load()


def _actors() -> Iterator[Measurement]:
    from vinesim.bench.many_actors import actors

    return actors()


def _fuzz(messages: int = 100_000, lies: int = 0) -> Iterator[Measurement]:
    from vinesim.bench.message_fuzz import fuzz

    for option, value in (("messages", messages), ("lies", lies)):
        if value < 0:
            raise UsageError(f"--{option} is {value}: give 0 or more")
    return fuzz(messages, lies)


def _link() -> Iterator[Measurement]:
    from vinesim.bench.touch_latency import link

    return link()


def _live(rows: Sequence[str] = ()) -> Iterator[Measurement]:
    from vinesim.bench.live import ROWS, live

    if unknown := sorted(set(rows) - ROWS.keys()):
        raise NoSuchBench(f"bench live has no row {unknown[0]!r}; there are: {', '.join(ROWS)}")
    return live(rows, _announce)


def _sound() -> Iterator[Measurement]:
    from vinesim.bench.sound_delay import sound

    return sound()


def _page() -> Iterator[Measurement]:
    from vinesim.bench.page_latency import page

    return page()


def _voice() -> Iterator[Measurement]:
    from vinesim.bench.voice_delay import voice

    return voice()


def _ros() -> Iterator[Measurement]:
    from vinesim.bench.ros_topics import ros

    return ros(_announce)


def _kill(times: int = 50, seed: int = 1) -> Iterator[Measurement]:
    from vinesim.bench.kill import kill

    if times < 1:
        raise UsageError(f"--times is {times}: give 1 or more")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    return kill(times, seed, _announce)


def _tune() -> Iterator[Measurement]:
    from vinesim.bench.tuning import tuning

    return tuning(_announce)


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _soak(minutes: float | None = None, real_time_factor: float | None = None) -> Iterator[Measurement]:
    from vinesim.bench.soak import MINUTES, soak

    return soak(MINUTES if minutes is None else minutes, real_time_factor, _announce)


RAISED = {
    "torso_lift_joint": 0.45,
    **{f"arm_{side}_{i}_joint": q for side in ("left", "right") for i, q in ((1, 0.6), (2, 0.1), (4, 1.8))},
}
"""Joint positions that put vinebot's hands among the vines [m, rad]."""

BENCHES: dict[str, Callable[[], Iterator[Measurement]]] = {
    "plants": _plants,
    "contact": _contact,
    "tick": _tick,
    "asleep": _asleep,
    "start": _start,
    "picking": _picking,
    "camera": _camera,
    "lidar": _lidar,
    "sensors": _sensors,
    "live": _live,
    "ros": _ros,
    "page": _page,
    "voice": _voice,
    "sound": _sound,
    "sync": _sync,
    "link": _link,
    "traffic": _traffic,
    "load": _load,
    "actors": _actors,
    "fuzz": _fuzz,
    "kill": _kill,
    "soak": _soak,
    "tune": _tune,
}


class NoSuchBench(ValueError):
    """There is no benchmark of that name; the text lists all."""


def _measurements(
    name: str,
    plot: pathlib.Path | None,
    rows: Sequence[str],
    minutes: float | None,
    real_time_factor: float | None,
    times: int,
    seed: int,
    messages: int,
    lies: int,
) -> Iterator[Measurement]:
    drawn = {"sync": _sync, "sensors": _sensors}.get(name)
    try:
        if name == "live":
            yield from _live(rows)
        elif name == "soak":
            yield from _soak(minutes, real_time_factor)
        elif name == "kill":
            yield from _kill(times, seed)
        elif name == "fuzz":
            yield from _fuzz(messages, lies)
        else:
            yield from drawn(plot) if drawn else BENCHES[name]()
    except ModuleNotFoundError as missing:
        if not (missing.name or "").startswith(("vinesim.bench.support", "hypothesis")):
            raise
        raise NoSuchBench(
            f"bench {name} needs load generators that are not installed; run it in a checkout of vinesim"
        ) from None


def run(
    names: list[str], as_json: bool, plot: pathlib.Path | None = None, rows: Sequence[str] = (),
    minutes: float | None = None, real_time_factor: float | None = None, times: int = 50, seed: int = 1,
    messages: int = 100_000, lies: int = 0,
) -> int:  # fmt: skip
    """Run the named benchmarks in order and print their measurements as they come; the exit code.

    ``plot``: the file that sync draws, or the folder for the plots of sensors; ``rows`` of live, all if there are none;
    ``minutes`` and ``real_time_factor`` of soak; ``times`` and ``seed`` of kill; ``messages`` and ``lies`` of fuzz.
    """
    if rows and "live" not in names:
        raise NoSuchBench("--row chooses rows of the bench live; leave it out")
    if minutes is not None and "soak" not in names:
        raise NoSuchBench("--minutes is how long the bench soak runs; leave it out")
    if real_time_factor is not None and "soak" not in names:
        raise NoSuchBench("--real-time-factor is how fast the world of the bench soak runs; leave it out")
    for name in names:
        if name not in BENCHES:
            raise NoSuchBench(f"no bench {name!r}; there are: {', '.join(BENCHES)}")
    for name in names:
        for m in _measurements(name, plot, rows, minutes, real_time_factor, times, seed, messages, lies):
            if as_json:
                print(json.dumps(dataclasses.asdict(m)), flush=True)
            else:
                beside = f"   {m.peer} {m.peer_value:.4g} {m.unit}, ratio {m.ratio:.3g}" if m.ratio is not None else ""
                print(f"{m.bench:10s} {m.case:44s} {m.value:10.4g} {m.unit}{beside}", flush=True)
    return 0
