"""Location of the page's files, and a check that none is missing."""

from __future__ import annotations

import importlib.util
import pathlib

from vinesim.core.errors import UsageError

PAGE = pathlib.Path(__file__).parent / "page"
THREE = PAGE / "vendor" / "three.module.js"
"""Path of three.js, which ``tools/build_page`` copies from the npm packages."""


def served() -> dict[str, pathlib.Path]:
    """Returns the files that browsers may load, by path below the page's address: the page, its scripts and
    three.js. What else is in the folders, such as lists of npm packages, is not served."""
    scripts = [*PAGE.glob("*.js"), *(PAGE / "vendor").glob("*.js")]
    return {path.relative_to(PAGE).as_posix(): path for path in (PAGE / "index.html", *scripts)}


def missing() -> str | None:
    """Returns the missing files of the page and the remedy in one line; None if nothing is missing."""
    if importlib.util.find_spec("aiohttp") is None:
        return "the page needs aiohttp: pip install 'vinesim[web]'"
    if not THREE.is_file():
        return "the page is not built: install Node.js with npm, then run tools/build_page"
    return None


def check() -> None:
    """Raise :class:`UsageError` if files of the page are missing."""
    if (text := missing()) is not None:
        raise UsageError(text)
