"""Whether ROS 2 can be used in this process, and the settings of its middleware.

ROS 2 comes from wheels (``pip install 'vinesim[ros]'``) or from a sourced installation, never from both. The wheels
start Python a second time to put their libraries on ``LD_LIBRARY_PATH``, in no particular order. If /opt/ros were
sourced as well, it would be undefined which library is loaded.
"""

from __future__ import annotations

import importlib
import os
import pathlib
import platform
import sys

from vinesim.ros import installation
from vinesim.ros.dead_segments import remove_dead_segments

FOLDER = pathlib.Path(__file__).resolve().parent

MIDDLEWARE_VARIABLE = "RMW_IMPLEMENTATION"
"""Environment variable with the name of the ROS middleware."""
PROFILE_VARIABLES = {"FASTRTPS_DEFAULT_PROFILES_FILE": 2, "FASTDDS_DEFAULT_PROFILES_FILE": 3}
"""Environment variables with the path of the Fast DDS profile, and the major version of Fast DDS that reads them.
Kilted warns of the variable of version 2, so only one is set."""
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Environment variable with the discovery range of ROS 2."""
LOCALHOST_VARIABLE = "ROS_LOCALHOST_ONLY"
"""Older environment variable for the discovery range. If it is 1, the range is LOCALHOST, whatever
:data:`RANGE_VARIABLE` holds."""


class RosUnavailableError(RuntimeError):
    """ROS 2 cannot be used in this process. The message gives the reason and the remedy."""


def unavailable_reason() -> str | None:
    """Returns None if ROS 2 can be used in this process, else one line with the reason and the remedy."""
    sourced = installation.sourced_prefixes()
    if wheels := installation.is_of_wheels():
        if sourced:
            return (
                f"ROS 2 is installed here as wheels and sourced from {sourced[0]} as well, so it is "
                "undefined which libraries are loaded; start from a shell where nothing is sourced, or use an "
                "environment without the extra vinesim[ros]"
            )
        if str(pathlib.Path(sys.prefix) / "lib") not in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
            return (
                "the ROS 2 wheels could not set LD_LIBRARY_PATH (Python was started with -S or -I, or by a program of "
                "another environment); start Python without these options, or unset _ROS_WHEELS_BOOTSTRAP_COMPLETE"
            )
    chosen = os.environ.get(MIDDLEWARE_VARIABLE, "")
    installed = installation.middlewares()
    if chosen and installed and chosen not in installed:
        place = "the ROS 2 wheels have" if wheels else f"the ROS 2 in {installation.place()} has"
        return (
            f"{MIDDLEWARE_VARIABLE} is {chosen!r}, but {place} only {', '.join(installed)}; unset it"
            f"{'' if wheels else f', or {installation.install_command(chosen)}'}"
        )
    try:
        for module in ("rclpy.node", "sensor_msgs.msg"):
            importlib.import_module(module)
    except ImportError as error:
        return _import_fault(str(error).splitlines()[0])
    return None


def _import_fault(reason: str) -> str:
    """Returns why ROS 2 cannot be imported, and the remedy. ``reason``: what Python says."""
    sourced = installation.sourced_prefixes()
    if not sourced:
        return f"ROS 2 is missing ({reason}); pip install 'vinesim[ros]', or source a ROS 2 installation"
    own = ".".join(platform.python_version_tuple()[:2])
    others = installation.pythons()
    if others and own not in others:
        return (
            f"the ROS 2 sourced from {sourced[0]} has packages for Python {' and '.join(others)}, and this is Python "
            f"{own} ({reason}); install vinesim in an environment of Python {others[-1]}"
        )
    return f"the ROS 2 sourced from {sourced[0]} cannot be imported ({reason}); source its setup.bash again"


def profile_file(*, large_messages: bool, local: bool, version: int = 2) -> pathlib.Path:
    """Returns the Fast DDS profile for a process. ``large_messages``: whether the profile has a shared-memory
    segment into which large messages fit; otherwise it uses UDP only, which never waits for stopped subscribers.
    ``local``: whether all peers are on this machine. ``version``: major version of Fast DDS, 2 or 3. Version 3 refuses
    a file with the names of version 2."""
    kind = "shared_memory" if large_messages else "udp"
    return FOLDER / f"{kind}{'_loopback' if local else ''}{'_fast_dds_3' if version == 3 else ''}.xml"


OWN_PROFILES = {
    str(profile_file(large_messages=large, local=local, version=version)): (large, local)
    for large in (False, True)
    for local in (False, True)
    for version in PROFILE_VARIABLES.values()
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
    chosen = _profile()
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
    version = installation.fast_dds_version()
    (variable,) = (name for name, reader in PROFILE_VARIABLES.items() if reader == version)
    os.environ[variable] = str(profile_file(large_messages=large, local=local, version=version))


def _profile() -> str:
    """Returns the path of the Fast DDS profile in the environment; empty if there is none. A profile that the user has
    chosen comes first, whichever variable names it."""
    named = [path for variable in PROFILE_VARIABLES if (path := os.environ.get(variable))]
    return min(named, key=lambda path: path in OWN_PROFILES, default="")


def asks_for_acknowledgements() -> bool:
    """Returns whether publishers request acknowledgements from their subscribers many times a second, as set by
    vinesim's profile without large messages. Otherwise Fast DDS requests them every three seconds."""
    large, _ = OWN_PROFILES.get(_profile(), (True, False))
    return uses_fast_dds() and not large


def name() -> str:
    """Returns the name of the ROS middleware of this process, such as ``rmw_fastrtps_cpp``."""
    from rclpy.utilities import get_rmw_implementation_identifier

    return get_rmw_implementation_identifier()


def uses_fast_dds() -> bool:
    """Returns whether this process uses Fast DDS as its middleware."""
    return name().startswith("rmw_fastrtps")


def discovers_this_machine_only() -> bool:
    """Returns whether the environment variables limit discovery to peers on this machine."""
    return os.environ.get(LOCALHOST_VARIABLE) == "1" or os.environ.get(RANGE_VARIABLE, "").upper() == "LOCALHOST"


def clear_profile() -> None:
    """Remove vinesim's own Fast DDS profile from the environment, so that this process runs like any other ROS
    program."""
    profile = _profile()
    if profile in OWN_PROFILES:
        for variable in PROFILE_VARIABLES:
            os.environ.pop(variable, None)
        if OWN_PROFILES[profile][1]:
            os.environ[RANGE_VARIABLE] = "LOCALHOST"
