"""Every code block of README.md and docs/ is complete and correct, and runs from the place that its page names."""

from __future__ import annotations

import ast
import dataclasses
import os
import pathlib
import re
import shutil
import subprocess
import tomllib

import pytest

from tests.support import page_runner
from tests.support.installation import OF_THE_TESTS, Installation, build
from tests.support.page_blocks import CHECKOUT, EMPTY, EXAMPLES, NOT_HERE, PAGES, ROOT, Block, all_blocks

LANGUAGES = {"sh", "python", "toml", "json5", "text"}
PROGRAMS = {"vinesim", "python", "python3", "make", "pip", "docker", ".", "ros2", "rosdep", "colcon", "sudo", "source"}
"""Programs that pages call."""
SHORT = {"docs/multispectral.md"}
"""Pages whose blocks ``make test`` runs; ``make test-long`` runs the others."""

BLOCKS = all_blocks()


def is_run(block: Block) -> bool:
    return block.language in ("sh", "python") and block.place in (EMPTY, EXAMPLES, CHECKOUT)


def test_pages_have_no_fence_outside_a_block():
    """Every fence begins or ends a block, so that no block is overlooked."""
    for page in PAGES:
        name = str(page.relative_to(ROOT))
        fences = re.findall(r"^ *(?:```|~~~)", page.read_text(), re.M)
        assert len(fences) == 2 * sum(block.page == name for block in BLOCKS), name
        places = re.findall(r"<!-- place:", page.read_text())
        marked = [
            block for block in BLOCKS if block.page == name and (block.place != EMPTY or block.alone or block.beside)
        ]
        assert len(places) == len(marked), f"{name}: a place is not directly before a block, or is the default"


def test_every_block_has_a_language_and_a_known_place():
    for block in BLOCKS:
        assert block.language in LANGUAGES, f"{block}: language {block.language!r}"
        known = block.place in (EMPTY, EXAMPLES, CHECKOUT, *NOT_HERE)
        assert known or block.place.startswith("tests/"), f"{block}: place {block.place!r}"


def test_the_page_names_commands_that_run_beside_a_block_before_it():
    for block in BLOCKS:
        before = "\n".join((ROOT / block.page).read_text().splitlines()[: block.line - 2])
        assert all(command in before for command in block.beside), block


def test_every_reason_not_to_run_a_block_is_needed():
    assert {block.place for block in BLOCKS} >= set(NOT_HERE)


def test_tests_that_run_a_block_name_its_page():
    for block in BLOCKS:
        if block.place.startswith("tests/"):
            assert pathlib.Path(block.page).name in (ROOT / block.place).read_text(), block


def test_pages_tell_the_reader_where_to_stand():
    """A reader does not see the places, so the page says them."""
    for block in BLOCKS:
        text = (ROOT / block.page).read_text()
        if block.place == EXAMPLES:
            assert "`vinesim examples`" in text, f"{block}: the page does not say where examples/ comes from"
        if block.place == CHECKOUT:
            assert "checkout" in text, f"{block}: the page does not say that the block needs a checkout"


def test_shell_is_well_formed_and_calls_known_programs():
    for block in BLOCKS:
        if block.language == "sh":
            done = subprocess.run(["bash", "-n", "-c", block.text], capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{block}: {done.stderr}"
            assert {line.split()[0] for line in block.lines()} <= PROGRAMS, block


def test_targets_of_make_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for block in BLOCKS:
        for line in block.lines() if block.language == "sh" else []:
            if line.startswith("make "):
                assert line.split()[1] in targets, f"{block}: {line}"


def test_extras_that_pages_and_messages_name_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    files = [*PAGES, *(ROOT / "vinesim").rglob("*.py"), ROOT / "Dockerfile", *(ROOT / "notebooks").glob("*")]
    named = [
        (file.name, extra.strip())
        for file in files
        for group in re.findall(r"pip install[^\n`]*?\[([a-z, ]+)\]", file.read_text())
        for extra in group.split(",")
    ]
    assert len(named) > 10
    assert [(name, extra) for name, extra in named if extra not in extras] == []


def test_python_compiles():
    for block in BLOCKS:
        if block.language == "python":
            ast.parse(block.text, str(block))


def test_data_is_well_formed():
    import zenoh

    for block in BLOCKS:
        if block.language == "toml":
            tomllib.loads(block.text)
        if block.language == "json5":
            zenoh.Config.from_json5(block.text)


@pytest.fixture(scope="session")
def installation(tmp_path_factory):
    """An environment with the wheel of this checkout."""
    wheels = build(tmp_path_factory.mktemp("wheel"), "wheel")
    return Installation(tmp_path_factory.mktemp("environment"), wheels[0])


@pytest.fixture(scope="session")
def checkout(tmp_path_factory):
    """A copy of this checkout without its environments, so that pages may install into it."""
    folder = tmp_path_factory.mktemp("checkout") / "vinesim"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    shutil.copytree(ROOT / "vinesim/web/page/vendor", folder / "vinesim/web/page/vendor")
    yield folder
    shutil.rmtree(folder)  # two environments: 3 GB


def pages_that_run() -> list:
    """Parameters of a test: pages with blocks that run. They use the usual port of a server, one after the other."""
    found = []
    for name in dict.fromkeys(block.page for block in BLOCKS if is_run(block)):
        marks = [pytest.mark.slow, pytest.mark.ros, pytest.mark.xdist_group("port 7377")]
        marks += [] if name in SHORT else [pytest.mark.long]
        found.append(pytest.param(name, id=name, marks=marks))
    return found


@pytest.mark.parametrize("page", pages_that_run())
def test_the_blocks_of_a_page_run(page, tmp_path, installation, request):
    """In their order, as printed, in a folder for each place of the page."""
    environment = installation.environment()
    bare = {name: value for name, value in os.environ.items() if name not in OF_THE_TESTS}
    bare["PIP_NO_COMPILE"] = "1"  # bytecode of 130 packages, of which little is used
    for number, block in enumerate(block for block in BLOCKS if block.page == page and is_run(block)):
        parts = [dataclasses.replace(block, text=line) for line in block.lines()] if block.alone else [block]
        for row, part in enumerate(parts):
            if block.place == CHECKOUT:
                page_runner.run_script(part, request.getfixturevalue("checkout"), bare)
                continue
            folder = tmp_path / (f"{number}-{row}" if block.alone else block.place)
            if not folder.exists():
                folder.mkdir()
                if block.place == EXAMPLES:
                    page_runner.run_line("vinesim examples", folder, environment)
            run = page_runner.run_python if block.language == "python" else page_runner.run_shell
            run(part, folder, environment)
            if block.alone:
                shutil.rmtree(folder)
