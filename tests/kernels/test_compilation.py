"""Kernels are compiled once, whoever starts at the same time, and progress is shown."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys

import pytest

PACKAGE = "sensing"
"""Small: three modules."""

PROGRAM = f"""
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
from vinesim.kernels.compilation import compile_kernels
print("compiled", compile_kernels(({PACKAGE!r},)), flush=True)
"""


def start(cache: pathlib.Path) -> subprocess.Popen[str]:
    environment = os.environ | {"WARP_CACHE_PATH": str(cache / "warp"), "VINESIM_CACHE": str(cache / "vinesim")}
    return subprocess.Popen([sys.executable, "-c", PROGRAM], env=environment, stdout=subprocess.PIPE, text=True)


def compiled(process: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """How many modules it compiled, and what it wrote before."""
    words = process.communicate()[0].splitlines()
    assert process.returncode == 0
    return int(words[-1].removeprefix("compiled ")), words[:-1]


@pytest.mark.long
def test_of_processes_that_start_together_one_compiles(tmp_path: pathlib.Path) -> None:
    results = [compiled(process) for process in [start(tmp_path) for _ in range(2)]]
    counts = sorted(count for count, _ in results)
    assert counts[0] == 0
    assert counts[1] >= 2
    lines = next(words for count, words in results if count)
    for number in range(1, counts[1] + 1):
        assert sum(f"({number} of {counts[1]})" in line for line in lines) == 1
    assert all(line.startswith("compiling kernels for cpu: sensing.") for line in lines)

    assert compiled(start(tmp_path)) == (0, [])
    lost = next((tmp_path / "warp").glob("*/wp_vinesim.kernels.sensing.lidar*"))
    shutil.rmtree(lost)
    count, lines = compiled(start(tmp_path))
    assert count == 1
    assert "lidar" in lines[0]


@pytest.mark.long
def test_a_cache_that_cannot_be_made_is_replaced_for_this_time(tmp_path: pathlib.Path) -> None:
    (tmp_path / "warp").write_text("not a folder")
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "warp"), "TMPDIR": str(tmp_path)}
    program = PROGRAM.replace(f"({PACKAGE!r},)", "('human_kinematics',)")
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert "compiled 1" in done.stdout
    assert (done.stdout + done.stderr).count("set WARP_CACHE_PATH") == 1
    assert list(tmp_path.glob("vinesim-kernels-*/*/wp_vinesim.kernels.human_kinematics*"))
