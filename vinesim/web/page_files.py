"""Where the page's files are, and whether all that the page needs is there."""

from __future__ import annotations

import importlib.util
import pathlib

from vinesim.core.errors import UsageError

PAGE = pathlib.Path(__file__).parent / "page"
THREE = PAGE / "vendor" / "three.module.js"
"""From the npm packages, by ``tools/build_page``."""


def missing() -> str | None:
    """What the page lacks and how to mend that, in one line; None: nothing."""
    if importlib.util.find_spec("aiohttp") is None:
        return "the page needs aiohttp: pip install 'vinesim[web]'"
    if not THREE.is_file():
        return "the page is not built: install Node.js with npm, then run tools/build_page"
    return None


def check() -> None:
    """Raise :class:`UsageError` if the page lacks anything."""
    if (text := missing()) is not None:
        raise UsageError(text)
