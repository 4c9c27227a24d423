"""Options of ``vinesim bench`` and of ``python -m benchmarks``."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vinesim.cli.bench import BENCHES, NoSuchBench, run


def test_rows_are_of_the_bench_live_and_have_names() -> None:
    with pytest.raises(NoSuchBench, match="no row 'picture'; there are: demo"):
        run(["live"], as_json=True, rows=["picture"])
    with pytest.raises(NoSuchBench, match="leave it out"):
        run(["plants"], as_json=True, rows=["demo"])


def test_no_bench_lists_all_names() -> None:
    with pytest.raises(NoSuchBench, match="give one or more benches; there are: plants, contact") as refused:
        run([], as_json=True)
    assert str(refused.value).count(",") == len(BENCHES) - 1


def test_a_bench_without_such_a_name_is_refused_with_all_names() -> None:
    with pytest.raises(NoSuchBench, match="no bench 'soak'; there are: plants, contact") as refused:
        run(["plants", "soak"], as_json=True)
    assert str(refused.value).count(",") == len(BENCHES) - 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["soak", "--minutes", "0"], "--minutes is 0: give more than 0"),
        (["soak", "--real-time-factor", "2"], "--real-time-factor is 2: give 0.01 to 1"),
        (["kill", "--times", "0"], "--times is 0: give 1 or more"),
        (["fuzz", "--false-messages", "-1"], "--false-messages is -1: give 0 or more"),
    ],
)
def test_unfit_options_of_a_benchmark_are_refused_in_one_line(words: list[str], message: str) -> None:
    done = subprocess.run([sys.executable, "-m", "benchmarks", *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, f"benchmarks: {message}\n")
