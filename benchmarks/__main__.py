"""``python -m benchmarks NAME``: runs one benchmark and prints a line for each measurement, as ``vinesim bench``
does."""

from __future__ import annotations

import argparse
import importlib
import os
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.support.announcement import announce
from benchmarks.transfer import OPTIONS as TRANSFER_OPTIONS
from vinesim.cli.bench import print_measurement
from vinesim.core.errors import UsageError
from vinesim.scene.values import Measurement


def _call(path: str) -> Callable[..., Iterator[Measurement]]:
    """Import a module of this package, and return the function that ``path``, "module:name", stands for."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"benchmarks.{module}"), name)


def _asleep() -> Iterator[Measurement]:
    from vinesim.robot.description.loader import load_description

    return _call("vineyard:sleeping_measurements")(load_description("vinebot").to_spec("robot"))


def _picking(by: str, seeds: int, first: int, record: pathlib.Path | None, jobs: int) -> Iterator[Measurement]:
    _require(("seeds", seeds, 1), ("first", first, 0), ("jobs", jobs, 1))
    return _call("picking:picking")(by, range(first, first + seeds), record, jobs, announce)


def _pruning(
    by: str, seeds: int, first: int, spurs: int, record: pathlib.Path | None, jobs: int
) -> Iterator[Measurement]:
    _require(("seeds", seeds, 1), ("first", first, 0), ("spurs", spurs, 0), ("jobs", jobs, 1))
    return _call("pruning:pruning")(by, range(first, first + seeds), spurs, record, jobs, announce)


def _require(*options: tuple[str, int, int]) -> None:
    """Raise :class:`UsageError` for the first option, as name, value and least value, that is too small."""
    for option, value, least in options:
        if value < least:
            raise UsageError(f"--{option} is {value}: give {least} or more")


def _shared_harvest(scene: str, minutes: float, period: float, seed: int, replays: int) -> Iterator[Measurement]:
    for option, value, least in (("seed", seed, 0), ("replays", replays, 0)):
        if value < least:
            raise UsageError(f"--{option} is {value}: give {least} or more")
    for option, value in (("minutes", minutes), ("period", period)):
        if not 0.0 < value < 1e4:
            raise UsageError(f"--{option} is {value:g}: give more than 0, below 10000")
    return _call("shared_harvest:shared_harvest")(scene, minutes, period, seed, replays, announce)


def _kill(times: int, seed: int) -> Iterator[Measurement]:
    if times < 1:
        raise UsageError(f"--times is {times}: give 1 or more")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    return _call("kill:kill")(times, seed, announce)


def _example_signals(runs: int, seed: int) -> Iterator[Measurement]:
    if runs < 1:
        raise UsageError(f"--runs is {runs}: give 1 or more")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    return _call("example_signals:example_signals")(runs, seed, announce)


def _fuzz(messages: int, false_messages: int, seed: int) -> Iterator[Measurement]:
    for option, value in (("messages", messages), ("false-messages", false_messages), ("seed", seed)):
        if value < 0:
            raise UsageError(f"--{option} is {value}: give 0 or more")
    return _call("message_fuzz:fuzz")(messages, false_messages, seed)


def _file_fuzz(files: int, seed: int, first: int, kinds: str) -> Iterator[Measurement]:
    for option, value in (("files", files), ("seed", seed), ("first", first)):
        if value < 0:
            raise UsageError(f"--{option} is {value}: give 0 or more")
    return _call("file_fuzz:file_fuzz")(files, seed, first, kinds, announce)


def _many_actors(
    clients: int,
    apart: float,
    seconds: float,
    processes: int,
    real_time_factor: float | None,
    limit: float,
    simulated: str,
) -> Iterator[Measurement]:
    for option, value, least in (
        ("clients", clients, 0),
        ("apart", apart, 1.0),
        ("seconds", seconds, 0.1),
        ("processes", processes, 1),
        ("limit", limit, 1.0),
    ):
        if value < least:
            raise UsageError(f"--{option} is {value:g}: give {least:g} or more")
    if real_time_factor is not None and not 0.01 <= real_time_factor <= 1.0:
        raise UsageError(f"--real-time-factor is {real_time_factor:g}: give 0.01 to 1")
    try:
        counts = [int(word) for word in simulated.split(",") if word]
    except ValueError:
        raise UsageError(f"--simulated is {simulated!r}: give numbers with commas between them") from None
    if any(count < 2 for count in counts):
        raise UsageError(f"--simulated is {simulated!r}: give numbers of 2 or more")
    return _call("many_actors:many_actors")(
        clients, apart, seconds, processes, real_time_factor, limit, counts, announce
    )


def _soak(
    minutes: float,
    real_time_factor: float | None,
    robots: int,
    people: int,
    sensor_hz: float,
    kill_every: float,
    record: pathlib.Path | None,
) -> Iterator[Measurement]:
    if minutes <= 0.0:
        raise UsageError(f"--minutes is {minutes:g}: give more than 0")
    if real_time_factor is not None and not 0.01 <= real_time_factor <= 1.0:
        raise UsageError(f"--real-time-factor is {real_time_factor:g}: give 0.01 to 1")
    if robots < 1:
        raise UsageError(f"--robots is {robots}: give 1 or more")
    if people < 0:
        raise UsageError(f"--people is {people}: give 0 or more")
    if sensor_hz <= 0.0:
        raise UsageError(f"--sensor-hz is {sensor_hz:g}: give more than 0")
    if kill_every < 0.0:
        raise UsageError(f"--kill-every is {kill_every:g}: give 0 or more")
    cast = _call("soak:Cast")(
        robots=robots,
        people=people,
        real_time_factor=real_time_factor,
        sensor_hz=sensor_hz,
        kill_every=kill_every,
    )
    return _call("soak:soak")(cast, minutes, record, announce)


def _joins(joins: int) -> Iterator[Measurement]:
    if joins < 1:
        raise UsageError(f"--joins is {joins}: give 1 or more")
    return _call("joins:joins")(joins, announce)


def _starvation(times: int, seed: int) -> Iterator[Measurement]:
    for option, value, least in (("times", times, 1), ("seed", seed, 0)):
        if value < least:
            raise UsageError(f"--{option} is {value}: give {least} or more")
    return _call("starvation:starvation")(times, seed, announce)


def _hostile_actor(minutes: float, seed: int) -> Iterator[Measurement]:
    if minutes <= 0.0:
        raise UsageError(f"--minutes is {minutes:g}: give more than 0")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    return _call("hostile_actor:hostile_actor")(minutes, seed, announce)


def _coverage(seeds: int, first: int, plants: str, tracks: str) -> Iterator[Measurement]:
    if seeds < 1:
        raise UsageError(f"--seeds is {seeds}: give 1 or more")
    if first < 0:
        raise UsageError(f"--first is {first}: give 0 or more")
    return _call("coverage:coverage")(seeds, first, plants, tracks, announce)


def _later(path: str) -> Callable[..., Iterator[Measurement]]:
    return lambda **options: _call(path)(**options)


BENCHMARKS: dict[str, tuple[Callable[..., Iterator[Measurement]], str, dict[str, dict[str, Any]]]] = {
    "asleep": (_asleep, "a step of a vineyard of ten thousand bunches, of which twenty trees are awake", {}),
    "picking": (
        _picking,
        "pick every bunch within reach of a start place, in simulated time",
        {
            "by": {"default": "truth", "choices": ["truth", "cameras"], "help": "what the robot knows of the plants"},
            "seeds": {"type": int, "default": 1, "help": "number of vineyards"},
            "first": {"type": int, "default": 7, "help": "seed of the first vineyard"},
            "record": {"type": pathlib.Path, "help": "file of results by seed; seeds that it has are not run again"},
            "jobs": {"type": int, "default": 1, "help": "number of processes, each with a seed at a time"},
        },
    ),
    "pruning": (
        _pruning,
        "prune a dormant vine by rule, in simulated time",
        {
            "by": {"default": "truth", "choices": ["truth", "cameras"], "help": "what the robot knows of the plants"},
            "seeds": {"type": int, "default": 1, "help": "number of vineyards"},
            "first": {"type": int, "default": 1, "help": "seed of the first vineyard"},
            "spurs": {"type": int, "default": 0, "help": "largest number of spurs of each vine; 0: all"},
            "record": {"type": pathlib.Path, "help": "file of results by seed; seeds that it has are not run again"},
            "jobs": {"type": int, "default": 1, "help": "number of processes, each with a seed at a time"},
        },
    ),
    "shared_harvest": (
        _shared_harvest,
        "two clients prune, pick, tie and bend one vine, a third joins late: are all equal by hash, and a replay?",
        {
            "scene": {"default": "vsp", "help": "scene whose first vine is worked on"},
            "minutes": {"type": float, "default": 10.0, "help": "simulated time of the work"},
            "period": {"type": float, "default": 4.0, "help": "time between two pieces of work [s]"},
            "seed": {"type": int, "default": 1, "help": "seed of the work and of the network"},
            "replays": {"type": int, "default": 2, "help": "number of replays of the recording"},
        },
    ),
    "sensors": (
        _later("sensor_accuracy:sensors"),
        "what modelled sensors measure, compared with the truth",
        {"plot": {"type": pathlib.Path, "help": "folder for the plots"}},
    ),
    "perception": (
        _later("perception:perception"),
        "surfaces, registrations, bunches and berries from depth, compared with the truth",
        {},
    ),
    "sync": (
        _later("replication_delay:sync"),
        "effect of network delay on contacts and copies, in simulated time",
        {"plot": {"type": pathlib.Path, "help": "PNG file to draw"}},
    ),
    "coverage": (
        _coverage,
        "share of fits whose 90 %% interval contains the true value, for canes and bunches",
        {
            "seeds": {"type": int, "default": 50, "help": "number of fits of each plant"},
            "first": {"type": int, "default": 0, "help": "first seed"},
            "plants": {"default": "both", "choices": ["both", "cane", "bunch"], "help": "plants that are fitted"},
            "tracks": {"default": "marker", "choices": ["marker", "rgbd"], "help": "what is tracked"},
        },
    ),
    "traffic": (_later("traffic:traffic"), "bytes that a client of a full vineyard receives and sends", {}),
    "load": (_later("router_load:load"), "many clients on one router, and on two linked routers", {}),
    "actors": (_later("many_actors:actors"), "64 robots and people with bodies: are all clients equal at the end?", {}),
    "many_actors": (
        _many_actors,
        "hundreds of whole clients over three linked routers, and a thousand actors without physics",
        {
            "clients": {"type": int, "default": 300, "help": "number of whole clients; 0: none"},
            "apart": {"type": float, "default": 8.0, "help": "distance of neighbours [m]"},
            "seconds": {"type": float, "default": 2.0, "help": "measured simulated time [s]"},
            "processes": {
                "type": int,
                "default": os.cpu_count() or 1,
                "help": "number of processes that share the clients (default: one a core)",
            },
            "real-time-factor": {
                "type": float,
                "help": "rate of the world's time (default: as fast as all clients can follow)",
            },
            "limit": {"type": float, "default": 3600.0, "help": "real time after which it gives up [s]"},
            "simulated": {"default": "30,100,300,1000", "help": "numbers of actors without physics; empty: none"},
        },
    ),
    "link": (_later("touch_latency:link"), "real clients over emulated links; needs root", {}),
    "sound": (_later("sound_delay:sound"), "delay of alarms and voices between two clients, in simulated time", {}),
    "page": (_later("page_latency:page"), "delay from an input of a person to the state that shows it", {}),
    "voice": (_later("voice_delay:voice"), "delay from the microphone of one browser to the sound of another", {}),
    "fuzz": (
        _fuzz,
        "effect of corrupted messages, and of well-formed false ones",
        {
            "messages": {"type": int, "default": 100_000, "help": "number of corrupted messages"},
            "false-messages": {
                "type": int,
                "default": 0,
                "help": "number of series of false messages (needs hypothesis)",
            },
            "seed": {"type": int, "default": 0, "help": "seed; runs with different seeds are parts of a long one"},
        },
    ),
    "file_fuzz": (
        _file_fuzz,
        "read corrupted caches, journals, recordings, scenes, robots and plants",
        {
            "files": {"type": int, "default": 10_000, "help": "number of files of each kind"},
            "seed": {"type": int, "default": 1, "help": "seed of the faults"},
            "first": {"type": int, "default": 0, "help": "number of the first file"},
            "kinds": {"default": "", "help": "names of kinds with commas between them (default: all)"},
        },
    ),
    "kill": (
        _kill,
        "kill programs at random moments and check that all others go on",
        {
            "times": {"type": int, "default": 50, "help": "number of programs that are killed"},
            "seed": {"type": int, "default": 1, "help": "seed of the order and the moments"},
        },
    ),
    "example_signals": (
        _example_signals,
        "end the ROS examples by SIGINT and SIGTERM at random moments (Linux)",
        {
            "runs": {"type": int, "default": 50, "help": "number of runs of each example"},
            "seed": {"type": int, "default": 1, "help": "seed of the moments"},
        },
    ),
    "robot_files": (
        _later("robot_files:robot_files"),
        "load, stand and visibility of all robot files below folders",
        {"folders": {"nargs": "+", "metavar": "FOLDER", "help": "folder with robot files, or one file"}},
    ),
    "transfer": (
        _later("transfer:transfer"),
        "train a detector on synthetic pictures and on photographs, and test both on photographs (GPU)",
        TRANSFER_OPTIONS,
    ),
    "picture_statistics": (
        _later("picture_statistics:picture_statistics"),
        "colours, noise and shapes in synthetic pictures beside those in photographs",
        {
            "photos": {"required": True, "help": "folder of photographs with masks"},
            "synthetic": {"action": "append", "required": True, "help": "folder of `vinesim dataset`; may be repeated"},
            "limit": {"type": int, "help": "read at most this number of pictures of each synthetic folder"},
            "out": {"help": "file for the table in Markdown"},
        },
    ),
    "hostile_actor": (
        _hostile_actor,
        "an admitted actor tries everything that it may: processor time of a step of another client (Linux)",
        {
            "minutes": {"type": float, "default": 10.0, "help": "time under attack"},
            "seed": {"type": int, "default": 0, "help": "seed of the broken messages"},
        },
    ),
    "joins": (
        _joins,
        "memory of a server and of a client while people join and leave (Linux)",
        {"joins": {"type": int, "default": 3000, "help": "number of people"}},
    ),
    "starvation": (
        _starvation,
        "clients and servers that get no processor time for a while: time until all are served (Linux)",
        {
            "times": {"type": int, "default": 100, "help": "number of times"},
            "seed": {"type": int, "default": 0, "help": "seed of the durations"},
        },
    ),
    "soak": (
        _soak,
        "delivery, open files, memory, recovery of the server and publishing in a long run (Linux)",
        {
            "minutes": {"type": float, "default": 60.0, "help": "measured time"},
            "real-time-factor": {
                "type": float,
                "help": "rate of the world's time (default: as fast as all clients can follow)",
            },
            "robots": {"type": int, "default": 4, "help": "number of robots"},
            "people": {"type": int, "default": 2, "help": "number of people"},
            "sensor-hz": {"type": float, "default": 1.0, "help": "rate of each robot's pictures in real time"},
            "kill-every": {
                "type": float,
                "default": 0.0,
                "help": "minutes between two kills of the server, which starts again at once; 0: none",
            },
            "record": {"type": pathlib.Path, "help": "file of the figures so far, written every five minutes"},
        },
    ),
}
"""Function, description and command-line options of each benchmark, by name."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="name", required=True, metavar="NAME")
    for name, (_, text, options) in BENCHMARKS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--json", action="store_true", help="print one JSON object a line")
        for option, settings in options.items():
            command.add_argument(option if "nargs" in settings else f"--{option}", **settings)
    return parser


def main(words: list[str] | None = None) -> int:
    """Run the benchmark that the command line ``words`` name, print its measurements as they come, and return the exit
    code."""
    options = vars(_parser().parse_args(words))
    measure, _, _ = BENCHMARKS[options.pop("name")]
    as_json = options.pop("json")
    try:
        for one in measure(**options):
            print_measurement(one, as_json)
    except UsageError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if (code := getattr(error, "exit_code", None)) is None:
            raise
        print(f"benchmarks: {error}", file=sys.stderr)
        return code
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line of vinesim sets these variables
    os.environ.setdefault("MUJOCO_GL", "disable")
    sys.exit(main())
