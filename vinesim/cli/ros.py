"""``vinesim ros``."""

from __future__ import annotations

from vinesim.ros import middleware


def build(quiet: bool) -> int:
    """Build the message packages without a wheel; the exit code. ``quiet``: no error if ROS is not installed."""
    reason = middleware.unavailable_reason()
    if reason is not None:
        if not quiet:
            print(f"ROS 2 is not usable here: {reason}")
        return 0 if quiet else 3
    from vinesim.ros.messages import message_packages

    for package in message_packages.available_packages():
        message_packages.build(package)
    if not quiet:
        print(f"ROS message packages ready: {', '.join(message_packages.available_packages())}")
    return 0
