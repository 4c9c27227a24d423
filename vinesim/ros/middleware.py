"""Whether ROS 2 can be used in this process, and the settings of its middleware.

ROS 2 comes from wheels (``pip install 'vinesim[ros]'``) or from a sourced installation, never from both: the wheels
start Python a second time to put their libraries on ``LD_LIBRARY_PATH``, in no particular order; beside a sourced
/opt/ros it would be undefined which library is loaded.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import pathlib
import sys

from vinesim.ros.dead_segments import remove_dead_segments

PROFILE_FILE = pathlib.Path(__file__).resolve().parent / "shared_memory.xml"
"""Fast DDS profile with a shared-memory segment that large messages fit into."""

SMALL_PROFILE_FILE = PROFILE_FILE.with_name("small_messages.xml")
"""The same with an eighth of the memory, for processes that send no pictures or clouds."""

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
WHEEL_MIDDLEWARE = "rmw_fastrtps_cpp"
"""The only middleware among the wheels."""


class RosUnavailableError(RuntimeError):
    """ROS 2 cannot be used in this process; the text says why and what to do."""


def unavailable_reason() -> str | None:
    """None if ROS 2 can be used here, else one line that says why not and names the remedy."""
    wheels = importlib.util.find_spec("ros_wheels_bootstrapper") is not None
    sourced = os.environ.get("AMENT_PREFIX_PATH", "")
    if wheels and sourced:
        return (
            f"ROS 2 is installed here as wheels and sourced from {sourced.split(os.pathsep)[0]} as well, and which "
            "libraries would be loaded is chance; start from a shell where nothing is sourced, or use an environment "
            "without the extra vinesim[ros]"
        )
    if wheels and str(pathlib.Path(sys.prefix) / "lib") not in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
        return (
            "the ROS 2 wheels did not get to set LD_LIBRARY_PATH (Python was started with -S or -I, or by a program of "
            "another environment); start Python plainly, or unset _ROS_WHEELS_BOOTSTRAP_COMPLETE"
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


def configure(*, large_messages: bool = True) -> None:
    """Set the environment for the first ROS context; :class:`RosUnavailableError` if ROS cannot be used.

    Shared memory that killed processes left is removed.
    ``large_messages``: whether the process sends pictures or clouds. A profile that the user has chosen stays.
    """
    reason = unavailable_reason()
    if reason is not None:
        raise RosUnavailableError(reason)
    remove_dead_segments()
    os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE_FILE if large_messages else SMALL_PROFILE_FILE))


def clear_profile() -> None:
    """Remove vinesim's own profile again, to run as a program that knows nothing of vinesim."""
    if os.environ.get(PROFILE_VARIABLE) in (str(PROFILE_FILE), str(SMALL_PROFILE_FILE)):
        del os.environ[PROFILE_VARIABLE]
