"""Corrupted files of every kind end with one line, and nothing wrong is accepted."""

from __future__ import annotations

import pathlib
import time

import pytest

from benchmarks import file_fuzz

KINDS = ["cache", "journal", "recording", "bag", "scene", "urdf", "robot TOML", "mtg", "ply", "plant"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_corrupted_file_is_refused_with_one_line_or_read_rightly(tmp_path: pathlib.Path, kind: str) -> None:
    """A hundred here; ``python -m benchmarks file_fuzz`` reads ten thousand of each kind."""
    done = file_fuzz.run(file_fuzz.make_kinds(tmp_path)[kind], 100, seed=3, folder=tmp_path)
    assert not done.failures
    assert (done.tracebacks, done.wrong, done.hangs) == (0, 0, 0)
    assert done.accepted + done.refused == done.count == 100
    assert done.refused > 0


def test_the_fuzz_finds_a_reader_that_fails(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A traceback, wrong content, an answer in two lines and a hang are each counted as such."""
    answers = iter(["accept", "traceback", "wrong", "lines", "hang"])

    def read(path: pathlib.Path) -> bool:
        match next(answers):
            case "traceback":
                raise IndexError("list index out of range")
            case "wrong":
                raise file_fuzz.WrongContent("another number")
            case "lines":
                raise ValueError("two\nlines")
            case "hang":
                time.sleep(60.0)
        return True

    monkeypatch.setattr(file_fuzz, "DEADLINE", 0.05)
    kind = file_fuzz.Kind(".x", (b"content 1",), read, (ValueError,))
    done = file_fuzz.run(kind, 4, seed=0, folder=tmp_path)
    assert (done.tracebacks, done.wrong, done.hangs) == (2, 1, 1)
    assert len(done.failures) == 4
