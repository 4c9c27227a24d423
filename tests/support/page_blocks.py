"""Fenced blocks of README.md and docs/, with the place from which each runs.

A comment directly before a block names its place: ``<!-- place: examples -->``. Without one the place is an empty
folder, in an environment in which vinesim is installed. A page shares one folder between its blocks of one place.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import textwrap

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

EMPTY, EXAMPLES, CHECKOUT = "an empty folder", "examples", "checkout"
"""Places from which tests run blocks: an empty folder, a folder that ``vinesim examples`` has filled, a checkout."""

NOT_HERE = {
    "a computer with ROS 2 Jazzy from apt": "the wheels of ROS 2 have no command ros2",
    "two computers": "names the addresses of two computers; tests/net/ links servers over emulated networks",
    "a computer with Docker, in a checkout": "tests have no Docker; tests/docs/test_release.py checks the file",
    "the test machine": "make test runs these tests, and would start itself",
}
"""Places from which no test runs a block, with the reason. A place may also be the path of the test that runs it."""

ALONE = ", each line alone"
"""Behind a place: the block is a list, from which a reader picks one line."""

BESIDE = ", beside "
"""Behind a place, before the commands that run in other terminals at that time, separated by semicolons."""

FENCE = re.compile(r"(?:<!-- place: ([^\n]*?) -->\n)?^( *)```([^\n]*)\n(.*?)^\2```$", re.S | re.M)


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    """Path of the page in the checkout."""
    line: int
    """Line number of the fence, from 1."""
    language: str
    text: str
    """Content without the page's indentation."""
    place: str
    """Where the block runs: one of the constants above, a key of :data:`NOT_HERE`, or the path of a test."""
    alone: bool
    """Whether each line runs alone, in a folder of its own."""
    beside: tuple[str, ...]
    """Commands that run meanwhile, each in a terminal of its own."""

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    def lines(self) -> list[str]:
        """Commands of a block of shell: continued lines as one, without comments and empty lines."""
        joined = self.text.replace("\\\n", " ").splitlines()
        return [line for text in joined if (line := re.sub(r"(^|\s)#\s.*$", "", text).strip())]


def blocks_of(page: pathlib.Path) -> list[Block]:
    """Returns the blocks of a page in their order."""
    text = page.read_text()
    found = []
    for match in FENCE.finditer(text):
        place, _, commands = (match[1] or EMPTY).partition(BESIDE)
        beside = tuple(filter(None, commands.split("; ")))
        line = text.count("\n", 0, match.start(2)) + 1
        name = str(page.relative_to(ROOT))
        content = textwrap.dedent(match[4])
        alone = place.endswith(ALONE)
        found.append(Block(name, line, match[3], content, place.removesuffix(ALONE), alone, beside))
    return found


def all_blocks() -> list[Block]:
    """Returns the blocks of all pages."""
    return [block for page in PAGES for block in blocks_of(page)]
