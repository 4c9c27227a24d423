"""Which ROS 2 this process uses: wheels in the Python environment, or a sourced installation of any distribution.

Nothing here lists distributions. What an installation contains is read from its folders, as ament does.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import pathlib
import re
import sys
import sysconfig

PREFIXES_VARIABLE = "AMENT_PREFIX_PATH"
"""Environment variable with the folders of a sourced ROS 2, overlays first."""
DISTRIBUTION_VARIABLE = "ROS_DISTRO"
"""Environment variable with the name of a sourced distribution."""
_WHEEL = re.compile(r"ros-([a-z]+)-rclpy", re.ASCII)
"""Name of the Python package that brings the wheels of a distribution."""


def is_of_wheels() -> bool:
    """Returns whether ROS 2 is installed as wheels in this Python environment."""
    return importlib.util.find_spec("ros_wheels_bootstrapper") is not None


def sourced_prefixes() -> tuple[pathlib.Path, ...]:
    """Returns the folders of a sourced ROS 2, overlays first; empty if nothing is sourced."""
    return tuple(pathlib.Path(part) for part in os.environ.get(PREFIXES_VARIABLE, "").split(os.pathsep) if part)


def prefixes() -> tuple[pathlib.Path, ...]:
    """Returns the folders with ``lib``, ``share`` and ``include`` of ROS 2, overlays first. Wheels, and packages of the
    Python environment itself such as conda's, lie in ``sys.prefix``."""
    return sourced_prefixes() or (pathlib.Path(sys.prefix),)


def find(relative: str) -> pathlib.Path | None:
    """Returns the first file or folder with the path ``relative`` in one of :func:`prefixes`; None if there is none."""
    return next((place for prefix in prefixes() if (place := prefix / relative).exists()), None)


def library_folders() -> list[pathlib.Path]:
    """Returns the folders with the libraries of ROS 2, overlays first."""
    architecture = sysconfig.get_config_var("MULTIARCH") or ""
    folders = (prefix / "lib" / part for prefix in prefixes() for part in dict.fromkeys(("", architecture)))
    return [folder for folder in folders if folder.is_dir()]


def version(package: str) -> str:
    """Returns the version of a package by its manifest; ``"-"`` if it has none."""
    manifest = find(f"share/{package}/package.xml")
    found = None if manifest is None else re.search(r"<version[^>]*>([^<]+)<", manifest.read_text())
    return "-" if found is None else found[1].strip()


def middlewares() -> list[str]:
    """Returns the names of the ROS middlewares (``rmw_...``) that are installed, in alphabetical order."""
    resources = [prefix / "share" / "ament_index" / "resource_index" / "rmw_typesupport" for prefix in prefixes()]
    names = {file.name for folder in resources if folder.is_dir() for file in folder.iterdir()}
    return sorted(names - {"rmw_implementation"})  # this one only loads another


def fast_dds_version() -> int:
    """Returns the major version of Fast DDS: 3 if its library has the name of version 3, else 2."""
    return 3 if any(next(folder.glob("libfastdds.so*"), None) for folder in library_folders()) else 2


def distribution() -> str:
    """Returns the name of the distribution, such as jazzy; ``"unknown"`` if nothing tells it."""
    if sourced_prefixes() or not is_of_wheels():
        return os.environ.get(DISTRIBUTION_VARIABLE) or "unknown"
    names = (each.metadata["Name"] or "" for each in importlib.metadata.distributions())
    return next((found[1] for name in names if (found := _WHEEL.fullmatch(name))), "unknown")


def place() -> pathlib.Path:
    """Returns the folder of ROS 2: the prefix that contains rclpy, or the first one if none does."""
    spec = importlib.util.find_spec("rclpy")
    origin = pathlib.Path(spec.origin) if spec is not None and spec.origin else None
    return next((prefix for prefix in prefixes() if origin is not None and prefix in origin.parents), prefixes()[0])


def pythons() -> list[str]:
    """Returns the versions of Python, such as 3.12, for which the sourced ROS 2 has packages."""
    found = (folder.name for prefix in sourced_prefixes() for folder in (prefix / "lib").glob("python3.*"))
    return sorted({name.removeprefix("python") for name in found})


def install_command(package: str) -> str:
    """Returns the command that installs a missing package of a sourced ROS 2, by the names of apt and conda."""
    tool = "conda" if any((prefix / "conda-meta").is_dir() for prefix in prefixes()) else "apt"
    return f"{tool} install ros-{distribution()}-{package.replace('_', '-')}"
