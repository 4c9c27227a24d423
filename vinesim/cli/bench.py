"""``vinesim bench``: measurements compared with a peer, printed as text or as one JSON object a line."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator, Sequence

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


def _start() -> Iterator[Measurement]:
    from vinesim.bench.start import start_measurements

    return start_measurements()


def _camera() -> Iterator[Measurement]:
    from vinesim.bench.camera import camera

    return camera()


def _lidar() -> Iterator[Measurement]:
    from vinesim.bench.lidar import lidar

    return lidar()


def _live(rows: Sequence[str] = ()) -> Iterator[Measurement]:
    from vinesim.bench.live import ROWS, live

    if unknown := sorted(set(rows) - ROWS.keys()):
        raise NoSuchBench(f"bench live has no row {unknown[0]!r}; there are: {', '.join(ROWS)}")
    return live(rows, _announce)


def _ros() -> Iterator[Measurement]:
    from vinesim.bench.ros_topics import ros

    return ros(_announce)


def _tune() -> Iterator[Measurement]:
    from vinesim.bench.tuning import tuning

    return tuning(_announce)


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


RAISED = {
    "torso_lift_joint": 0.45,
    **{f"arm_{side}_{i}_joint": q for side in ("left", "right") for i, q in ((1, 0.6), (2, 0.1), (4, 1.8))},
}
"""Joint positions with which vinebot's hands are among the vines [m, rad], by joint."""

BENCHES: dict[str, Callable[[], Iterator[Measurement]]] = {
    "plants": _plants,
    "contact": _contact,
    "tick": _tick,
    "start": _start,
    "camera": _camera,
    "lidar": _lidar,
    "live": _live,
    "ros": _ros,
    "tune": _tune,
}


class NoSuchBench(ValueError):
    """No benchmark has the given name; the text lists all names."""


def print_measurement(one: Measurement, as_json: bool) -> None:
    """Print one measurement as one line on standard output."""
    if as_json:
        print(json.dumps(dataclasses.asdict(one)), flush=True)
        return
    peer = f"   {one.peer} {one.peer_value:.4g} {one.unit}, ratio {one.ratio:.3g}" if one.ratio is not None else ""
    print(f"{one.bench:10s} {one.case:44s} {one.value:10.4g} {one.unit}{peer}", flush=True)


def run(names: list[str], as_json: bool, rows: Sequence[str] = ()) -> int:
    """Run the named benchmarks in order and print their measurements as they come. Returns the exit code.

    ``rows``: rows of the benchmark ``live``; all of them if empty.
    """
    if not names:
        raise NoSuchBench(f"give one or more benches; there are: {', '.join(BENCHES)}")
    if rows and "live" not in names:
        raise NoSuchBench("--row chooses rows of the bench live; leave it out")
    for name in names:
        if name not in BENCHES:
            raise NoSuchBench(f"no bench {name!r}; there are: {', '.join(BENCHES)}")
    for name in names:
        for one in _live(rows) if name == "live" else BENCHES[name]():
            print_measurement(one, as_json)
    return 0
