"""Every example runs unchanged, uses only ``import vinesim``, has at most forty lines and prints its result."""

import ast
import pathlib
import re
import sys

import pytest

from tests.support import programs
from tests.support.waiting import deadline

pytestmark = pytest.mark.slow

ROOT = pathlib.Path(__file__).parents[1]
FILES = sorted((ROOT / "examples").glob("*.py"))
MAX_LINES = 40


def run(name: str, folder: pathlib.Path, *arguments: str) -> str:
    """Output of an example, run in its own folder."""
    done = programs.run(
        [sys.executable, str(ROOT / "examples" / name), *arguments], cwd=folder, timeout=deadline(240.0)
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_an_example_is_short_and_uses_the_public_interface_alone(file):
    text = file.read_text()
    assert len(text.splitlines()) < MAX_LINES
    imported = {
        alias.name if isinstance(node, ast.Import) else node.module
        for node in ast.walk(ast.parse(text))
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    assert imported <= {"vinesim", "numpy", "sys"}


def test_first_cane(tmp_path):
    lines = run("first_cane.py", tmp_path).splitlines()
    sags = [float(re.search(r"sags by +([\d.]+) mm", line)[1]) for line in lines]
    assert len(sags) == 6
    assert 60.0 < sags[-1] < 100.0
    assert lines[-1].endswith("kinetic energy 0.00e+00 J")


def test_push_with_robot(tmp_path):
    printed = run("push_with_robot.py", tmp_path)
    force, way = map(float, re.search(r"up to ([\d.]+) N; the tip moved by (\d+) cm", printed).groups())
    assert 1.0 < force < 100.0
    assert 10.0 <= way <= 60.0


def test_one_picture(tmp_path):
    printed = run("one_picture.py", tmp_path, "160", "120")
    bunches = int(re.search(r"160 x 120, (\d+) bunches in sight", printed)[1])
    assert 10 <= bunches <= 60
    assert (tmp_path / "picture.npz").stat().st_size > 10_000


def test_one_lidar_scan(tmp_path):
    found = re.search(r"^(\d+) points .* (\d+) of them on leaves, (\d+) on", run("one_lidar_scan.py", tmp_path))
    points, leaves, bunches = map(int, found.groups())
    assert points > 20_000
    assert leaves > 0.15 * points
    assert bunches > 0.05 * points


def test_dataset(tmp_path):
    printed = run("dataset.py", tmp_path, "2")
    assert int(re.search(r"^2 pictures with (\d+) bunches", printed)[1]) > 20
    assert len(list(tmp_path.glob("picture_*.npz"))) == 2


def test_python_client(tmp_path):
    way, present = re.search(r"ada drive (\d+) cm; present: (.*)$", run("python_client.py", tmp_path)).groups()
    assert 25 <= int(way) <= 60
    assert present == "bob, ada"
