"""Finds what a robot file refers to: packages of ROS, models of Gazebo, and the files in them.

A package is searched in the sourced workspaces (``AMENT_PREFIX_PATH``, then ``ROS_PACKAGE_PATH``), then in the folders
above the robot file, then among installed wheels.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import logging
import os
import pathlib
import re
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator

from vinesim.core import disk_cache
from vinesim.scene.triangles import digest_of

log = logging.getLogger(__name__)

MODEL_PATHS = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH")
"""Environment variables with the folders in which Gazebo searches ``model://``."""
CRAWL_DEPTH = 4
"""Number of levels of folders below an entry of ``ROS_PACKAGE_PATH`` in which packages are searched."""
RELATIVE_LEVELS = 2
"""Number of folders above that of the robot file in which a relative path is searched, too."""
DOWNLOAD_TIMEOUT = 10.0
"""Longest time to wait for a server of a mesh [s]."""
MAX_DOWNLOAD = 64 << 20
"""Largest size of a mesh that is downloaded [B]."""
_INDEX = "share/ament_index/resource_index/packages"
_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")


def find_resource(uri: str, file: pathlib.Path) -> pathlib.Path | None:
    """Returns the file that a robot ``file`` names by ``uri``; None if it is missing.

    ``uri`` is ``package://``, ``model://``, ``file://``, ``http://`` or ``https://``, or a path relative to the folder
    of ``file`` or to one above. A file on a server is downloaded into the cache.
    """
    scheme, separator, rest = uri.partition("://")
    scheme = scheme.lower() if separator else ""
    if scheme in ("http", "https"):
        return _download(uri)
    if scheme in ("package", "model"):
        for path in dict.fromkeys((urllib.parse.unquote(rest), rest)):
            name, _, inside = path.replace("\\", "/").partition("/")
            copied = file.resolve().parents  # a package that was copied into a folder of another name
            for folder in (*_named_folders(scheme, name, file), *copied):
                if (folder / inside).is_file():
                    return (folder / inside).resolve()
            if (found := find_installed(path)) is not None:
                return found
        return None
    path = uri if not scheme else rest
    for above in (file.parent, *file.resolve().parents[1 : 1 + RELATIVE_LEVELS]):
        for candidate in dict.fromkeys((path, urllib.parse.unquote(path), path.replace("\\", "/"))):
            found = above / candidate.removeprefix("localhost")  # file://localhost/... is a form of file:///...
            if found.is_file():
                return found.resolve()
    return None


def find_package(name: str, file: pathlib.Path) -> pathlib.Path | None:
    """Returns the folder of a package of ROS (its ``share`` folder, if it is installed); None if it is missing."""
    return next(_named_folders("package", name, file), None)


def ros_address(uri: str, found: pathlib.Path) -> str:
    """Returns an address at which other programs on this machine find the file ``found`` by the rules of
    resource_retriever: ``uri`` itself if it is such an address, else the path with ``file://``."""
    scheme, separator, rest = uri.partition("://")
    if separator and scheme in ("http", "https"):
        return uri
    if separator and scheme == "package":
        name, _, inside = rest.partition("/")
        for prefix in _entries("AMENT_PREFIX_PATH"):  # the first prefix with the package counts, as in ament_index
            if (prefix / _INDEX / name).is_file():
                return uri if (prefix / "share" / name / inside).is_file() else found.as_uri()
    if separator and scheme == "file" and rest.startswith("/") and pathlib.Path(urllib.parse.unquote(rest)).is_file():
        return uri
    return found.as_uri()


def find_installed(path: str) -> pathlib.Path | None:
    """Returns the path of a file that a cmeel wheel (such as example-robot-data) installed in ``share``; None if it
    is missing."""
    roots = [pathlib.Path(sys.prefix) / "share"]
    cmeel = importlib.util.find_spec("cmeel")
    if cmeel is not None and cmeel.origin:
        roots.append(pathlib.Path(cmeel.origin).parent.parent / "cmeel.prefix" / "share")
    roots += [pathlib.Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    return next((root / path for root in roots if (root / path).is_file()), None)


def _entries(variable: str) -> list[pathlib.Path]:
    """Returns the existing folders of an environment variable with a list of paths."""
    entries = [pathlib.Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry]
    return [entry for entry in entries if entry.is_dir()]


def _named_folders(scheme: str, name: str, file: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields the folders that may be the package or model ``name``, in the order of the search."""
    if scheme == "model":
        for variable in MODEL_PATHS:
            for entry in _entries(variable):
                yield from _existing(entry / name, entry if entry.name == name else None)
    for prefix in _entries("AMENT_PREFIX_PATH"):
        yield from _existing(prefix / "share" / name)
    for entry in _entries("ROS_PACKAGE_PATH"):
        yield from _existing(_crawl(entry).get(name), entry / name)
    for above in file.resolve().parents:
        if above.name == name or _package_name(above) == name:
            yield above
        yield from _existing(above / name, above / "share" / name, above / "src" / name, above / "install" / name)
        yield from _existing(above / "install" / name / "share" / name, above / "install" / "share" / name)
    for above in file.resolve().parents[:4]:  # a package beside the file's own, in a folder that has several
        yield from sorted(one for one in above.glob(f"*/{name}") if one.is_dir())


def _existing(*folders: pathlib.Path | None) -> Iterator[pathlib.Path]:
    yield from (folder for folder in folders if folder is not None and folder.is_dir())


def _package_name(folder: pathlib.Path) -> str | None:
    """Returns the name in the ``package.xml`` of a folder; None if it has none."""
    try:
        found = _NAME.search((folder / "package.xml").read_text(errors="replace"))
    except OSError:
        return None
    return found.group(1) if found else None


@functools.lru_cache(16)
def _crawl(entry: pathlib.Path) -> dict[str, pathlib.Path]:
    """Returns the packages below an entry of ``ROS_PACKAGE_PATH``, by name. A package contains no other package."""
    found: dict[str, pathlib.Path] = {}
    waiting = [(entry, 0)]
    while waiting:
        folder, depth = waiting.pop(0)
        if (name := _package_name(folder)) is not None:
            found.setdefault(name, folder)
        elif depth < CRAWL_DEPTH:
            try:
                waiting += [(one, depth + 1) for one in sorted(folder.iterdir()) if one.is_dir()]
            except OSError:
                continue
    return found


def _download(uri: str) -> pathlib.Path | None:
    """Returns a file of a server, from the cache if it has it; None if the server does not give it."""
    suffix = pathlib.PurePosixPath(urllib.parse.urlsplit(uri).path).suffix
    kept = disk_cache.folder() / "downloads" / f"{digest_of(uri.encode())}{suffix}"
    digest = kept.with_name(f"{kept.name}.digest")
    if kept.is_file():
        with contextlib.suppress(OSError):
            if digest.read_text("ascii", "replace") == digest_of(kept.read_bytes()):
                return kept
        log.warning("%s is broken and is downloaded anew", kept)
    try:
        with urllib.request.urlopen(uri, timeout=DOWNLOAD_TIMEOUT) as answer:
            content = answer.read(MAX_DOWNLOAD + 1)
        if len(content) > MAX_DOWNLOAD:
            return None
        kept.parent.mkdir(parents=True, exist_ok=True)
        for file, written in ((kept, content), (digest, digest_of(content).encode())):
            part = file.with_name(f"{file.name}.{os.getpid()}")
            part.write_bytes(written)
            part.replace(file)
    except (OSError, urllib.error.URLError, ValueError):
        return None
    return kept
