"""Commands of vinesim in the pages are accepted as they stand there; tests/docs/test_blocks.py runs them."""

import functools
import pathlib
import re
import shlex

import pytest
import typer.main

from tests.support.page_blocks import FENCE, PAGES, blocks_of
from vinesim.cli import app
from vinesim.cli.bench import BENCHES

pytestmark = pytest.mark.slow


def shell_lines(page: pathlib.Path) -> list[str]:
    """Lines of the blocks of shell in a page, continued ones as one."""
    blocks = [block.text for block in blocks_of(page) if block.language == "sh"]
    return [line for text in blocks for line in text.replace("\\\n", " ").splitlines()]


def commands_of(page: pathlib.Path) -> list[str]:
    """What a page's blocks of shell give to ``vinesim``, in their order, without comments."""
    found = []
    for line in shell_lines(page):
        if re.match(r"\s*(\S*/)?vinesim\s", line):
            words = shlex.split(line, comments=True)[1:]
            found.append(shlex.join(word for word in words if word != "..."))
    return found


def commands() -> list[str]:
    """Those of all pages."""
    return sorted({line for page in PAGES for line in commands_of(page)})


def commands_in_prose() -> list[str]:
    """What sentences, tables and headings give to ``vinesim``; such a command need not be complete."""
    found = set()
    for page in PAGES:
        found |= set(re.findall(r"`vinesim\s+([^`]+)`", FENCE.sub("", page.read_text())))
    return sorted(" ".join(line.split()) for line in found if not re.match(r"[.A-Z]", line))


@functools.cache
def typer_command() -> typer.main.TyperCommand:
    """All commands, built once."""
    return typer.main.get_command(app)


def resolve(line: str) -> tuple[typer.main.TyperCommand, typer.Context, list[str]]:
    """The command that a line names, its context and the words that it is given; a usage error of click's if there is
    none."""
    command = typer_command()
    words = shlex.split(line)
    context = command.context_class(command)
    while hasattr(command, "resolve_command") and words and not words[0].startswith("-"):
        name, command, words = command.resolve_command(context, words)
        context = command.context_class(command, parent=context, info_name=name)
    return command, context, words


def parse(line: str) -> None:
    """Parse a command's words as the command line does, without running it; a usage error of click's if it fails."""
    command, context, words = resolve(line)
    command.parse_args(context, words)


def unknown_options(line: str) -> list[str]:
    """Options of a line that its command does not have."""
    command, context, words = resolve(line)
    known = {name for option in command.get_params(context) for name in (*option.opts, *option.secondary_opts)}
    options = [word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)]  # a number may be negative
    return [name for name in options if name not in known]


def test_commands_of_the_pages_are_accepted():
    found = []
    for line in commands():
        try:
            parse(line)
        except Exception as error:
            found.append(f"vinesim {line}: {error}")
        if line.startswith("bench "):
            names = [word for word in shlex.split(line)[1:] if not word.startswith("-")]
            if names[0] not in BENCHES:
                found.append(f"vinesim {line}: no bench is named {names[0]}")
    assert not found, "\n".join(found)


def test_commands_in_sentences_have_these_options():
    found = []
    for line in commands_in_prose():
        found += [f"vinesim {line}: no such option: {name}" for name in unknown_options(line)]
        if line.startswith("bench ") and line.split()[1] not in BENCHES:
            found.append(f"vinesim {line}: no such bench")
    assert not found, "\n".join(found)


def test_no_command_of_a_page_is_overlooked():
    """Every line of shell that runs ``vinesim`` begins with it, so that :func:`commands_of` sees it."""
    for page in PAGES:
        for line in shell_lines(page):
            if line.startswith("docker "):
                continue  # the name of an image
            said = shlex.split(line, comments=True) if re.match(r"\s*(\S*/)?vinesim\s", line) else []
            rest = line.partition("#")[0].partition("//")[0] if not said else shlex.join(said[1:])
            assert not re.search(r"(^|[\s;&|/])vinesim\s", rest), f"{page.name}: {line}"


def test_a_wrong_option_would_be_found():
    assert unknown_options("client --role human --no-such-option") == ["--no-such-option"]
    assert len(commands_in_prose()) > 20
    assert len(commands()) > 20
    for wrong in ("client --no-such-option", "render demo --size", "nothing", "scene paint demo"):
        with pytest.raises(Exception, match=r"No such|requires an argument") as refused:
            parse(wrong)
        assert "UsageError" in {one.__name__ for one in type(refused.value).__mro__}
