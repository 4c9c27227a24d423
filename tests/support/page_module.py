"""Modules of the page in a real browser, without a page: for tests of their functions."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, cast

from benchmarks.support.browser import Page
from vinesim.web.page_server import PageServer, World


class _NoWorld:
    """Nothing to show: only the page's files are asked for."""


@contextlib.contextmanager
def page_module(page: Page, name: str, *imported: str) -> Iterator[Callable[[str], Any]]:
    """A function that evaluates a script in which what is ``imported`` from a module is known, and gives its value."""
    with PageServer(cast(World, _NoWorld())) as server:
        page.open(server.address + "check.js")  # a script that is opened as a page is only shown
        yield lambda script: page.run(
            f"import('{server.address}{name}').then(({{ {', '.join(imported)} }}) => {{ {script} }})"
        )
