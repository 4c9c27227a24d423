"""Tests of one group run in one process: what shares a costly fixture sets it up once."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.waiting import deadline

TESTS = """
import pytest

@pytest.fixture(scope="module")
def costly():
    return 1

@pytest.mark.parametrize("i", range(6))
def test_that_shares(costly, i):
    pass
"""


@pytest.mark.long
def test_tests_that_share_a_fixture_run_in_one_process(tmp_path: Path) -> None:
    """pytest 9.2 ignored the groups that pytest-xdist 3.8 sets, without a word."""
    conftest = (Path(__file__).parents[1] / "conftest.py").read_text()
    (tmp_path / "conftest.py").write_text(conftest)
    (tmp_path / "test_shared.py").write_text(TESTS)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n",
        "2",
        "--dist",
        "loadgroup",
        "-vv",
        "-p",
        "no:cacheprovider",
        str(tmp_path),
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=deadline(300.0))
    workers = re.findall(r"\[(gw\d)\] .* PASSED", done.stdout)
    assert len(workers) == 6, done.stdout + done.stderr
    assert len(set(workers)) == 1
