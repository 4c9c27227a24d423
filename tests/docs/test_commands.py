"""Commands of vinesim in the pages are accepted as they stand there, and Python in the pages runs."""

import os
import pathlib
import re
import shlex
import subprocess
import sys

import pytest
import typer.main

from tests.client.test_recorder import World
from vinesim.cli import app
from vinesim.cli.bench import BENCHES

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.S | re.M)
ELSEWHERE = {"docs/gradients.md", "docs/sensors.md", "README.md"}
"""Pages whose Python other tests run: test_gradients, test_reconstruction, test_docs."""


def commands() -> list[str]:
    """Every line of a block of shell that runs ``vinesim``, without comments."""
    found = []
    for page in PAGES:
        for language, block in BLOCK.findall(page.read_text()):
            if language in ("", "sh", "bash", "console"):
                for line in block.replace("\\\n", " ").splitlines():
                    if re.match(r"\s*(\S*/)?vinesim\s", line):
                        words = shlex.split(line, comments=True)[1:]
                        found.append(shlex.join(word for word in words if word != "..."))
    return sorted(set(found))


def parse(line: str) -> None:
    """Parse a command's words as the command line does, without running it; a usage error of click's if it fails."""
    command, words = typer.main.get_command(app), shlex.split(line)
    context = command.context_class(command)
    while hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        context = command.context_class(command, parent=context, info_name=name)
    command.parse_args(context, words)


@pytest.mark.parametrize("line", commands())
def test_a_command_of_the_pages_is_accepted(line):
    parse(line)
    if line.startswith("bench "):
        names = [word for word in shlex.split(line)[1:] if not word.startswith("-")]
        assert names[0] in BENCHES


def test_a_wrong_option_would_be_found():
    assert len(commands()) > 20
    for wrong in ("client --no-such-option", "render demo --size", "nothing", "scene paint demo"):
        with pytest.raises(Exception, match=r"No such|requires an argument") as refused:
            parse(wrong)
        assert "UsageError" in {one.__name__ for one in type(refused.value).__mro__}


def python_pages() -> list[pathlib.Path]:
    return [
        page for page in PAGES
        if str(page.relative_to(ROOT)) not in ELSEWHERE
        and any(language == "python" for language, _ in BLOCK.findall(page.read_text()))
    ]  # fmt: skip


@pytest.mark.parametrize("page", python_pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_of_a_page_runs(page, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    if page.name == "recording.md":
        world = World(tmp_path / "run.mcap")
        world.run(0.2)
        world.recorded()
    for language, code in BLOCK.findall(page.read_text()):
        if language == "python":
            done = subprocess.run(
                [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            assert done.stdout.strip(), code
