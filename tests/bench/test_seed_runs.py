"""Seeds of a benchmark in several processes: the same lines as in one, each recorded once."""

from __future__ import annotations

import functools
import json
import pathlib

import pytest

from benchmarks.support.seed_runs import Line, SeedRuns
from vinesim.core.errors import UsageError


def squared(seed: int, asked: pathlib.Path) -> Line:
    with asked.open("a") as file:
        file.write(f"{seed}\n")
    return {"square": seed * seed}


def summary(line: Line) -> str:
    return f"square {line['square']}"


def runs(folder: pathlib.Path, size: str) -> SeedRuns:
    work = functools.partial(squared, asked=folder / "asked")
    return SeedRuns(work, {"benchmark": "squares", "size": size}, summary, print, folder / "record.jsonl")


@pytest.mark.slow
def test_processes_give_the_same_lines_as_one_process_and_each_seed_runs_once(tmp_path: pathlib.Path):
    first = runs(tmp_path, "small").lines([3, 1], jobs=1)
    both = runs(tmp_path, "small").lines([1, 2, 3, 4], jobs=2)
    assert [line["square"] for line in both] == [1, 4, 9, 16]
    assert (both[2], both[0]) == tuple(first)
    recorded = [json.loads(line) for line in (tmp_path / "record.jsonl").read_text().splitlines()]
    assert sorted(line["seed"] for line in recorded) == [1, 2, 3, 4]
    assert all(line["cpu_seconds"] >= 0.0 for line in recorded)
    assert sorted((tmp_path / "asked").read_text().split()) == ["1", "2", "3", "4"]


def test_lines_of_another_run_are_not_taken(tmp_path: pathlib.Path):
    runs(tmp_path, "small").lines([1])
    assert runs(tmp_path, "large").lines([1])[0]["size"] == "large"
    assert (tmp_path / "asked").read_text().split() == ["1", "1"]


def test_a_broken_line_is_named(tmp_path: pathlib.Path):
    runs(tmp_path, "small").lines([1])
    with (tmp_path / "record.jsonl").open("a") as file:
        file.write('{"benchmark": "squ')
    with pytest.raises(UsageError, match=r"record\.jsonl, line 2: no JSON .*; remove this line"):
        runs(tmp_path, "small").lines([1])
