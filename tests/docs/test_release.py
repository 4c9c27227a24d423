"""What is published: wheel, sdist, long description and container file."""

from __future__ import annotations

import pathlib
import re
import shlex
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import HeaderParser
from importlib import metadata

import pytest

from tests.docs.test_commands import parse
from tests.support.installation import build
from tests.support.page_blocks import ROOT
from vinesim.core.version import __version__

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SHIPPED = ("examples", "notebooks", "ros", "data")
"""Folders that ``vinesim examples`` copies."""


def tracked(folder: str) -> set[str]:
    listed = subprocess.run(["git", "ls-files", "-z", folder], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(filter(None, listed.stdout.split("\0")))


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> tuple[pathlib.Path, pathlib.Path]:
    """Wheel and sdist."""
    folder = tmp_path_factory.mktemp("published")
    build(folder, "wheel", "sdist")
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


@pytest.mark.slow
def test_the_wheel_has_what_users_need(published):
    names = set(zipfile.ZipFile(published[0]).namelist())
    assert {f"vinesim/user_files/{name}" for folder in SHIPPED[:3] for name in tracked(folder)} <= names
    assert {f"vinesim/{name}" for name in tracked("data")} <= names
    assert tracked("vinesim") <= names
    assert "vinesim/web/page/vendor/three.module.js" in names
    assert "vinesim/web/page/vendor/LICENSE" in names, "the licence of three.js goes with it"
    assert f"vinesim-{__version__}.dist-info/licenses/LICENSE" in names
    foreign = [name for name in names if not name.startswith(("vinesim/", f"vinesim-{__version__}.dist-info/"))]
    assert not foreign
    assert not [name for name in names if "__pycache__" in name or ".ipynb_checkpoints" in name]


@pytest.mark.slow
def test_the_sdist_is_the_checkout(published):
    """Without what only the repository uses, so that its tests run and wheels can be built from it."""
    with tarfile.open(published[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    missing = {name for name in tracked(".") if name not in names}
    assert {name for name in missing if not name.startswith((".ci/", ".github/", ".dockerignore"))} == set()
    assert "vinesim/web/page/vendor/three.module.js" in names, "a wheel built from it needs no npm"


@pytest.mark.slow
def test_twine_has_no_objection(published):
    command = [sys.executable, "-m", "twine", "check", "--strict", *map(str, published)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_long_description_has_no_link_into_a_checkout(published):
    with zipfile.ZipFile(published[0]) as wheel:
        fields = HeaderParser().parsestr(wheel.read(f"vinesim-{__version__}.dist-info/METADATA").decode())
    text = fields.get_payload()
    assert fields["Description-Content-Type"] == "text/markdown"
    assert "## Install" in text
    for address in re.findall(r"\]\(([^)]*)\)", text):
        assert re.match(r"https?://", address), address
    for name in re.findall(r"(?<!!)\[([A-Z]\w+)\](?!\()", text):
        assert re.search(rf"^\[{name}\]: http", text, re.M), f"[{name}] leads nowhere"
    assert "<!--" not in text, "comments are for tests of the pages"


def test_links_become_absolute_where_the_sources_are_public():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from metadata_hook import long_description
    finally:
        sys.path.pop(0)
    readme = "see [a](docs/a.md), [b](https://b.c) and\n\n![picture](docs/p.png)\n"
    assert long_description(readme, "https://h/v1") == (
        "see [a](https://h/v1/docs/a.md), [b](https://b.c) and\n\n![picture](https://h/v1/docs/p.png)\n"
    )
    assert long_description(readme, None) == "see a, [b](https://b.c) and"


def test_classifiers_are_those_of_the_index_and_agree_with_the_supported_versions_of_python():
    from trove_classifiers import classifiers

    given = PROJECT["classifiers"]
    assert set(given) <= set(classifiers)
    versions = sorted(entry.rpartition(" ")[2] for entry in given if re.search(r"Python :: 3\.\d+$", entry))
    assert versions == ["3.11", "3.12", "3.13"]
    assert PROJECT["requires-python"] == ">=3.11"
    assert not [entry for entry in given if entry.startswith("License ::")], "the licence is an expression (PEP 639)"


def test_pip_adds_an_extra_to_an_installed_vinesim_without_looking_for_vinesim():
    """As messages of vinesim and the pages advise, also before it is on an index."""
    if metadata.version("vinesim") != __version__:
        pytest.fail("the installed vinesim has another version; make setup")
    command = [sys.executable, "-m", "pip", "install", "--no-index", "--dry-run", "--disable-pip-version-check"]
    done = subprocess.run([*command, "vinesim[tune]"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Requirement already satisfied: vinesim[tune]" in done.stdout


PACKAGES = {"nodejs", "npm", "g++", "python3-venv", "python3-dev"}
"""Packages of Debian and Ubuntu that container files install."""
CONTAINER_FILES = {"Dockerfile": r"python:3\.1[123]-slim-bookworm( AS \w+)?", "ros/install/Dockerfile": r"\$\{ROS\}"}
"""Container files, and for each a pattern of its base image."""


def instructions(file: str) -> list[tuple[str, str]]:
    """Instructions of a container file with their arguments."""
    text = re.sub(r"^#.*\n", "", (ROOT / file).read_text(), flags=re.M).replace("\\\n", " ")
    return [(name, rest.strip()) for line in text.splitlines() if line for name, _, rest in [line.partition(" ")]]


@pytest.mark.parametrize("file", CONTAINER_FILES)
def test_a_container_file_has_known_instructions_and_sources_that_exist(file):
    known = {"ARG", "FROM", "RUN", "COPY", "ENV", "WORKDIR", "VOLUME", "CMD"}
    assert {name for name, _ in instructions(file)} <= known
    stages = {rest.split(" AS ")[1] for name, rest in instructions(file) if name == "FROM" and " AS " in rest}
    for name, rest in instructions(file):
        if name == "COPY":
            words = rest.split()
            if words[0].startswith("--from="):
                assert words[0].removeprefix("--from=") in stages
            else:
                assert (ROOT / words[0]).exists(), rest
        if name == "FROM":
            assert re.fullmatch(CONTAINER_FILES[file], rest)


@pytest.mark.parametrize("file", CONTAINER_FILES)
def test_the_commands_of_a_container_file_exist(file):
    """Shell that parses, commands of vinesim with their options, modules that exist, packages of Debian."""
    import importlib.util
    import json

    run = [rest for name, rest in instructions(file) if name == "RUN"]
    (last,) = [shlex.join(json.loads(rest)) for name, rest in instructions(file) if name == "CMD"]
    for command in (*run, last):
        done = subprocess.run(["bash", "-n", "-c", command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        for part in command.split(" && "):
            words = shlex.split(part)
            if words[0] == "vinesim":
                parse(shlex.join(words[1:]))
            elif words[:2] == ["python", "-m"]:
                assert importlib.util.find_spec(words[2]), part
            else:
                assert words[0] in ("apt-get", "rm", "pip", "/vineyard/bin/pip", ".") or words[2] == "venv", part
            if words[:2] == ["apt-get", "install"]:
                assert {word for word in words[2:] if not word.startswith("-")} <= PACKAGES


def test_the_title_of_the_site_has_the_version():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import docs_hooks
    finally:
        sys.path.pop(0)

    class Config:
        site_name = "vinesim"

    assert docs_hooks.on_config(Config()).site_name == f"vinesim {__version__}"


@pytest.mark.long
def test_a_wheel_is_built_from_the_sdist_without_npm(published, tmp_path):
    with tarfile.open(published[1]) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(tmp_path / "out")],
        cwd=source,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (again,) = (tmp_path / "out").glob("*.whl")
    assert set(zipfile.ZipFile(again).namelist()) == set(zipfile.ZipFile(published[0]).namelist())
