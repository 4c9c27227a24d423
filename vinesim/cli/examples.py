"""``vinesim examples``: copies the examples, notebooks, ROS files and data files that ship with vinesim."""

from __future__ import annotations

import filecmp
import pathlib
import shutil

from vinesim.core.data_files import user_folders
from vinesim.core.errors import UsageError, writing

CONTENTS = {
    "examples": "scripts for Python and ROS 2, canes, bunches and plants for the commands",
    "notebooks": "longer studies with plots, each ends with a check",
    "ros": "configurations for RViz and Foxglove, launch file, parameters",
    "data": "scenes, plants, robots and sensors to start from; names such as demo mean vinesim's own files",
}
"""Folders that the command copies, with their contents."""

NOT_COPIED = {"__pycache__", ".ipynb_checkpoints"}
"""Folders that Python and Jupyter write beside files."""


def copy(out: pathlib.Path, force: bool) -> int:
    """Copy the folders of :data:`CONTENTS` into ``out``, and print what was written. Returns the exit code.

    A file of the user is never replaced, unless ``force`` is set: nothing is written if a file in ``out`` differs.

    Raises:
        UsageError: if ``out`` is a file, or if a file differs and ``force`` is not set.
        WriteError: if a file cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: is a file; name a folder")
    copies = [(source, out / name / part) for name, folder in user_folders().items() for source, part in _files(folder)]
    new = [(source, target) for source, target in copies if not target.exists()]
    differs = [(source, target) for source, target in copies if target.exists() and not _is_equal(source, target)]
    if differs and not force:
        more = f" and {len(differs) - 1} more differ" if len(differs) > 1 else " differs"
        raise UsageError(f"{differs[0][1]}{more} from the file of vinesim; --force replaces, or give another --out")
    for source, target in new + differs:
        with writing(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
    for name in user_folders():
        count = sum(target.is_relative_to(out / name) for _, target in new + differs)
        counted = "no change" if count == 0 else "1 file" if count == 1 else f"{count} files"
        print(f"{counted} in {out / name}: {CONTENTS[name]}")
    print(f"begin with: python {out / 'examples' / 'first_cane.py'}")
    return 0


def _files(folder: pathlib.Path) -> list[tuple[pathlib.Path, pathlib.Path]]:
    """Returns all files below ``folder``, each with its path relative to ``folder``."""
    found = [(path, path.relative_to(folder)) for path in sorted(folder.rglob("*")) if path.is_file()]
    return [(path, part) for path, part in found if not NOT_COPIED & set(part.parts)]


def _is_equal(source: pathlib.Path, target: pathlib.Path) -> bool:
    """Whether ``target`` is a file with the bytes of ``source``."""
    return target.is_file() and filecmp.cmp(source, target, shallow=False)
