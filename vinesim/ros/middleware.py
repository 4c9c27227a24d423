"""Whether ROS 2 can be used in this process, and the settings of its middleware.

ROS 2 comes from wheels (``pip install 'vinesim[ros]'``) or from a sourced installation, never from both. The wheels
start Python a second time to put their libraries on ``LD_LIBRARY_PATH``, in no particular order. If /opt/ros were
sourced as well, it would be undefined which library is loaded.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import pathlib
import sys

from vinesim.ros.dead_segments import remove_dead_segments

FOLDER = pathlib.Path(__file__).resolve().parent

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
"""Environment variable with the path of the Fast DDS profile."""
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Environment variable with the discovery range of ROS 2."""
LOCALHOST_VARIABLE = "ROS_LOCALHOST_ONLY"
"""Older environment variable for the discovery range. If it is 1, the range is LOCALHOST, whatever
:data:`RANGE_VARIABLE` holds."""
WHEEL_MIDDLEWARE = "rmw_fastrtps_cpp"
"""Name of the only ROS middleware that the wheels contain."""


class RosUnavailableError(RuntimeError):
    """ROS 2 cannot be used in this process. The message gives the reason and the remedy."""


def unavailable_reason() -> str | None:
    """Returns None if ROS 2 can be used in this process, else one line with the reason and the remedy."""
    wheels = importlib.util.find_spec("ros_wheels_bootstrapper") is not None
    sourced = os.environ.get("AMENT_PREFIX_PATH", "")
    if wheels and sourced:
        return (
            f"ROS 2 is installed here as wheels and sourced from {sourced.split(os.pathsep)[0]} as well, so it is "
            "undefined which libraries are loaded; start from a shell where nothing is sourced, or use an environment "
            "without the extra vinesim[ros]"
        )
    if wheels and str(pathlib.Path(sys.prefix) / "lib") not in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
        return (
            "the ROS 2 wheels could not set LD_LIBRARY_PATH (Python was started with -S or -I, or by a program of "
            "another environment); start Python without these options, or unset _ROS_WHEELS_BOOTSTRAP_COMPLETE"
        )
    chosen = os.environ.get("RMW_IMPLEMENTATION", WHEEL_MIDDLEWARE)
    if wheels and chosen != WHEEL_MIDDLEWARE:
        return f"RMW_IMPLEMENTATION is {chosen!r}, but the ROS 2 wheels have {WHEEL_MIDDLEWARE!r} only; unset it"
    try:
        for module in ("rclpy.node", "sensor_msgs.msg"):
            importlib.import_module(module)
    except ImportError as error:
        reason = str(error).splitlines()[0]
        return f"ROS 2 is missing ({reason}); pip install 'vinesim[ros]', or source a ROS 2 Jazzy installation"
    return None


def profile_file(*, large_messages: bool, local: bool) -> pathlib.Path:
    """Returns the Fast DDS profile for a process. ``large_messages``: whether the profile has a shared-memory
    segment into which large messages fit; otherwise it uses UDP only, which never waits for stopped subscribers.
    ``local``: whether all peers are on this machine."""
    return FOLDER / f"{'shared_memory' if large_messages else 'udp'}{'_loopback' if local else ''}.xml"


OWN_PROFILES = {
    str(profile_file(large_messages=large, local=local)): (large, local)
    for large in (False, True)
    for local in (False, True)
}
"""vinesim's own Fast DDS profiles: path -> (large messages, peers on this machine only)."""


def configure(*, large_messages: bool | None = None) -> None:
    """Set the environment variables of the middleware, before the first ROS context is created. Raises
    :class:`RosUnavailableError` if ROS cannot be used.

    Also removes shared memory that killed processes left. ``large_messages``: whether the process publishes pictures or
    clouds. None: as in the previous call, True in the first one. A profile that the user has chosen is kept.
    """
    reason = unavailable_reason()
    if reason is not None:
        raise RosUnavailableError(reason)
    remove_dead_segments()
    chosen = os.environ.get(PROFILE_VARIABLE, "")
    if not uses_fast_dds() or (chosen and chosen not in OWN_PROFILES):
        return
    large, local = OWN_PROFILES.get(chosen, (True, False))
    if large_messages is not None:
        large = large_messages
    if discovers_this_machine_only() and not os.environ.get("ROS_STATIC_PEERS"):
        # With LOCALHOST, rmw_fastrtps would add its own transports to those of the profile, shared memory among them.
        # So the profile limits discovery to this machine instead.
        os.environ[RANGE_VARIABLE] = "SYSTEM_DEFAULT"
        os.environ.pop(LOCALHOST_VARIABLE, None)
        local = True
    os.environ[PROFILE_VARIABLE] = str(profile_file(large_messages=large, local=local))


def asks_for_acknowledgements() -> bool:
    """Returns whether publishers request acknowledgements from their subscribers many times a second, as set by
    vinesim's profile without large messages. Otherwise Fast DDS requests them every three seconds."""
    large, _ = OWN_PROFILES.get(os.environ.get(PROFILE_VARIABLE, ""), (True, False))
    return uses_fast_dds() and not large


def uses_fast_dds() -> bool:
    """Returns whether this process uses Fast DDS as its middleware."""
    from rclpy.utilities import get_rmw_implementation_identifier

    return get_rmw_implementation_identifier().startswith("rmw_fastrtps")


def discovers_this_machine_only() -> bool:
    """Returns whether the environment variables limit discovery to peers on this machine."""
    return os.environ.get(LOCALHOST_VARIABLE) == "1" or os.environ.get(RANGE_VARIABLE, "").upper() == "LOCALHOST"


def clear_profile() -> None:
    """Remove vinesim's own Fast DDS profile from the environment, so that this process runs like any other ROS
    program."""
    profile = os.environ.get(PROFILE_VARIABLE, "")
    if profile in OWN_PROFILES:
        del os.environ[PROFILE_VARIABLE]
        if OWN_PROFILES[profile][1]:
            os.environ[RANGE_VARIABLE] = "LOCALHOST"
