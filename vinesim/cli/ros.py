"""``vinesim ros``: builds message packages, records topics and plays them."""

from __future__ import annotations

import pathlib
import threading
import time

from vinesim.cli.signals import stop_at_signals
from vinesim.core.errors import UsageError
from vinesim.net.recording.mcap_writer import free_path
from vinesim.ros import middleware

PROGRESS_PERIOD = 2.0
"""Wall time between two lines of progress [s]."""


def build(quiet: bool, wheel: pathlib.Path | None) -> int:
    """Build the message packages without an official wheel and install them, or write their wheels. Returns the exit
    code.

    ``quiet``: print nothing, and no error if ROS is not installed. ``wheel``: folder for wheels; None: install the
    packages.
    """
    reason = middleware.unavailable_reason()
    if reason is not None:
        if not quiet:
            print(f"ROS 2 is not usable here: {reason}")
        return 0 if quiet else 3
    from vinesim.ros.messages import message_packages
    from vinesim.ros.messages import message_packages as package_wheel

    places = {package: message_packages.place_of_official(package) for package in message_packages.available_packages()}
    missing = [package for package, place in places.items() if place is None]
    if wheel is not None:
        message_packages.build(missing)
        lines = {package: f"wheel {package_wheel.write(package, wheel)}" for package in missing}
    else:
        package_wheel.install([package for package in missing if not message_packages.is_installed(package)])
        lines = {
            package: f"installed; pip uninstall {package_wheel.distribution(package)} removes it" for package in missing
        }
    if not quiet:
        for package, place in places.items():
            print(f"{package}: {lines.get(package, f'the official one is there, {place}')}")
    return 0


def record(path: pathlib.Path, topics: list[str], seconds: float | None) -> int:
    """Record topics until Ctrl-C or for ``seconds`` [s]; returns the exit code."""
    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
        return 3
    from vinesim.ros.tools.bag_recorder import BagRecorder

    stop = stop_at_signals(threading.Event())
    path = free_path(path)
    began = told = time.monotonic()
    with BagRecorder(path, topics) as recorder:
        print(f"recording into {path}; Ctrl-C ends it", flush=True)
        while not stop.is_set() and (seconds is None or time.monotonic() - began < seconds):
            recorder.spin()
            if time.monotonic() - told >= PROGRESS_PERIOD:
                told = time.monotonic()
                print(
                    f"{told - began:.0f} s: {recorder.counts.total()} messages of {len(recorder.counts)} topics",
                    flush=True,
                )
    print(f"{path}: {recorder.counts.total()} messages of {len(recorder.counts)} topics")
    return 0


def play(path: pathlib.Path, rate: float) -> int:
    """Publish a recording's topics again. Returns the exit code."""
    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
        return 3
    from vinesim.ros.tools import bag_player

    stop = stop_at_signals(threading.Event())
    print(f"playing {path}", flush=True)
    try:
        played = bag_player.play(path, rate=rate, is_stopped=stop.is_set)
    except bag_player.BagError as error:
        raise UsageError(str(error)) from None
    print(f"{path}: {played.total()} messages of {len(played)} topics")
    return 0
