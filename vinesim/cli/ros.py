"""``vinesim ros``."""

from __future__ import annotations

import pathlib

from vinesim.ros import middleware


def build(quiet: bool, wheel: pathlib.Path | None) -> int:
    """Make the message packages without an official wheel importable, or write wheels of them; the exit code.

    ``quiet``: print nothing, and no error if ROS is not installed. ``wheel``: folder for wheels; None installs.
    """
    reason = middleware.unavailable_reason()
    if reason is not None:
        if not quiet:
            print(f"ROS 2 is not usable here: {reason}")
        return 0 if quiet else 3
    from vinesim.ros.messages import message_packages, package_wheel

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
