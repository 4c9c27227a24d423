"""Finds the data files that ship with vinesim: scenes, robots, cameras, lidars, plants."""

from __future__ import annotations

import pathlib

from vinesim.core.errors import one_line

USER_FOLDERS = ("examples", "notebooks", "ros")
"""Names of the folders for users other than ``data``; a wheel contains them in ``vinesim/user_files``."""


class DataFileNotFound(FileNotFoundError):
    """Raised when a name is neither an existing file nor a data file of vinesim. The message lists the known names."""


def data_dir() -> pathlib.Path:
    """Returns the folder ``data`` of vinesim: inside the installed package, or next to the package in a checkout."""
    package = pathlib.Path(__file__).resolve().parent.parent
    return next(d for d in (package / "data", package.parent / "data") if d.is_dir())


def user_folders() -> dict[str, pathlib.Path]:
    """Returns the folders of files for users by name: :data:`USER_FOLDERS` and ``data``. They are inside the installed
    package, or next to the package in a checkout."""
    package = pathlib.Path(__file__).resolve().parent.parent
    place = package / "user_files" if (package / "user_files").is_dir() else package.parent
    return {name: place / name for name in USER_FOLDERS} | {"data": data_dir()}


def is_file(path: pathlib.Path) -> bool:
    """Returns whether there is a file at a path that a user gave; also of a path that no file can have."""
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def find_data_file(kind: str, name: str, suffix: str) -> pathlib.Path:
    """Returns the path ``name`` if that file exists, else ``data/<kind>/<name><suffix>``. Raises
    :class:`DataFileNotFound` if neither exists."""
    given = pathlib.Path(name)
    if is_file(given):
        return given
    shipped = data_dir() / kind / (name if name.endswith(suffix) else name + suffix)
    if is_file(shipped):
        return shipped
    known = ", ".join(sorted(p.stem for p in (data_dir() / kind).glob(f"*{suffix}"))) or "none"
    raise DataFileNotFound(
        one_line(f"no file {name!r} and none of that name in data/{kind}; give a path or one of: {known}")
    )
