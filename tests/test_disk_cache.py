"""The cache on disk returns what was computed, also with damaged files and other processes."""

from __future__ import annotations

import errno
import logging
import multiprocessing
import os
import pathlib
import signal
import threading
import time
from multiprocessing.connection import Connection

import numpy as np
import pytest

from tests.support.waiting import wait
from vinesim.core import disk_cache
from vinesim.core.disk_cache import load_or_make, source_digest

ARRAYS = {
    "a": np.arange(12, dtype=np.int8).reshape(3, 4),
    "b": np.array([0.1, -0.0, np.inf, 5e-324]),
    "c": np.zeros((0, 3), np.float32),
}


@pytest.fixture(autouse=True)
def cache(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(disk_cache, "_warned", threading.Event())
    return tmp_path / "cache"


class Maker:
    """Makes :data:`ARRAYS` and counts how often."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return dict(ARRAYS)


def assert_same(found: dict[str, np.ndarray]) -> None:
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].dtype, found[name].shape, found[name].tobytes()) == (
            array.dtype,
            array.shape,
            array.tobytes(),
        )
        assert found[name].flags.writeable


def entry(cache: pathlib.Path) -> pathlib.Path:
    (path,) = cache.glob("*.npz")
    return path


def test_an_entry_is_made_once_and_read_bitwise(cache: pathlib.Path) -> None:
    make = Maker()
    for _ in range(3):
        assert_same(load_or_make("table", "0", make))
    assert make.calls == 1
    assert not list(cache.glob("*.tmp"))


def test_another_digest_or_name_is_another_entry() -> None:
    make = Maker()
    for name, digest in (("table", "0"), ("table", "1"), ("other", "0")):
        load_or_make(name, digest, make)
    assert make.calls == 3


@pytest.mark.parametrize("keep", [0, 10, 0.5, -1], ids=["empty", "ten bytes", "half", "all but the last byte"])
def test_a_truncated_file_is_made_anew(cache: pathlib.Path, keep: float) -> None:
    make = Maker()
    load_or_make("table", "0", make)
    whole = entry(cache).read_bytes()
    entry(cache).write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 2
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 2


def test_a_changed_bit_of_an_array_is_found(cache: pathlib.Path) -> None:
    make = Maker()
    load_or_make("table", "0", make)
    data = bytearray(entry(cache).read_bytes())
    data[data.index(ARRAYS["a"].tobytes()) + 5] ^= 1
    entry(cache).write_bytes(data)
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 2


def test_a_wrong_byte_anywhere_is_found_and_told_in_one_line(
    cache: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also in the head of an array, where NumPy's reader raises errors of Python's tokenizer."""
    load_or_make("table", "0", Maker())
    path = entry(cache)
    whole = path.read_bytes()
    for at in (*range(0, len(whole), 7), whole.index(b"}"), len(whole) - 1):
        make = Maker()
        path.write_bytes(whole[:at] + bytes((whole[at] ^ 0x5D,)) + whole[at + 1 :])
        caplog.clear()
        assert_same(load_or_make("table", "0", make))
        assert make.calls == 1
        (line,) = [record.getMessage() for record in caplog.records]
        assert str(path) in line
        assert "is made anew" in line
        assert "\n" not in line
        assert path.read_bytes() == whole


def test_a_file_under_another_name_is_not_read(cache: pathlib.Path) -> None:
    load_or_make("table", "0", lambda: {"a": np.ones(3)})
    entry(cache).rename(cache / "table-1.npz")
    make = Maker()
    assert_same(load_or_make("table", "1", make))
    assert make.calls == 1


def test_a_pickle_is_never_loaded(cache: pathlib.Path) -> None:
    make = Maker()
    load_or_make("table", "0", make)

    class Trap:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(cache / "trapped"),)

    np.savez(entry(cache).open("wb"), a=np.array([Trap()], object))
    assert_same(load_or_make("table", "0", make))
    assert not (cache / "trapped").exists()


def test_a_failure_of_the_maker_is_passed_on_and_leaves_nothing(cache: pathlib.Path) -> None:
    def fail() -> dict[str, np.ndarray]:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        load_or_make("table", "0", fail)
    assert not list(cache.glob("*.npz"))
    assert_same(load_or_make("table", "0", Maker()))


def test_a_folder_that_cannot_be_made_costs_one_warning(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "file" / "cache"))
    make = Maker()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert_same(load_or_make("table", "0", make))
    assert make.calls == 3
    assert [r.message.split(",")[0] for r in caplog.records] == ["no cache on disk"]


def test_a_read_only_folder_is_read_without_a_warning(
    cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def open_read_only(path: pathlib.Path, mode: str = "r", *more: object, **others: object) -> object:
        if set(mode) & set("wax+"):  # what a read-only file system says; permissions do not stop root
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return open(path, mode, *more, **others)  # type: ignore[call-overload]

    make = Maker()
    load_or_make("table", "0", make)
    monkeypatch.setattr(disk_cache, "open", open_read_only, raising=False)
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 1
    assert not caplog.records
    assert_same(load_or_make("table", "1", make))
    assert len(caplog.records) == 1


def test_a_full_disk_costs_one_warning(
    cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(file: object, **_: object) -> None:
        file.write(b"PK half")  # type: ignore[attr-defined]
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    for _ in range(2):
        assert_same(load_or_make("table", "0", Maker()))
    assert len(caplog.records) == 1
    assert "No space left" in caplog.text
    assert not list(cache.glob("*.npz"))
    assert not list(cache.glob("*.tmp"))


def test_entries_used_last_stay_when_the_cache_is_too_large(
    cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = {"a": np.zeros(1000, np.uint8)}
    monkeypatch.setattr(disk_cache, "MAX_SIZE", 4 * 1500)
    for i in range(4):
        load_or_make("table", str(i), lambda: table)
        os.utime(cache / f"table-{i}.npz", (1000.0 + i, 1000.0 + i))
    load_or_make("table", "0", lambda: table)  # used: now the newest
    (cache / "table-9.7.tmp").write_bytes(b"left by a process that was killed")
    os.utime(cache / "table-9.7.tmp", (1000.0, 1000.0))
    load_or_make("table", "4", lambda: table)
    assert sorted(p.name for p in cache.glob("*.npz")) == [f"table-{i}.npz" for i in (0, 2, 3, 4)]
    assert not list(cache.glob("*.tmp"))


def _make_slowly(place: str, pipe: Connection) -> None:
    """In another process: load or make an entry; report when it makes one, then wait for a message to continue."""
    os.environ["VINESIM_CACHE"] = place

    def make() -> dict[str, np.ndarray]:
        pipe.send("making")
        pipe.recv()
        return dict(ARRAYS)

    assert_same(load_or_make("table", "0", make))
    pipe.send("done")


def start(cache: pathlib.Path) -> tuple[multiprocessing.process.BaseProcess, Connection]:
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    process = context.Process(target=_make_slowly, args=(str(cache), other))
    process.start()
    other.close()
    return process, pipe


def test_of_two_processes_one_makes_an_entry_and_the_other_waits(cache: pathlib.Path) -> None:
    first, first_pipe = start(cache)
    assert first_pipe.recv() == "making"
    second, second_pipe = start(cache)
    found: list[dict[str, np.ndarray]] = []
    make = Maker()
    here = threading.Thread(target=lambda: found.append(load_or_make("table", "0", make)))
    here.start()
    assert not second_pipe.poll(1.0)  # it would report within a second of its start
    assert not found
    first_pipe.send("go on")
    assert (first_pipe.recv(), second_pipe.recv()) == ("done", "done")
    here.join()
    assert_same(found[0])
    assert make.calls == 0
    for process in (first, second):
        process.join()
        assert process.exitcode == 0


def test_a_process_killed_while_making_delays_no_other(cache: pathlib.Path) -> None:
    process, pipe = start(cache)
    assert pipe.recv() == "making"
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    make = Maker()
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 1


def test_a_lock_that_is_held_for_too_long_is_ignored(cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_cache, "LOCK_TIMEOUT", 0.1)
    process, pipe = start(cache)
    assert pipe.recv() == "making"
    make = Maker()
    assert_same(load_or_make("table", "0", make))
    assert make.calls == 1
    pipe.send("go on")
    process.join()
    assert process.exitcode == 0


def test_exclusive_returns_whether_it_waited(cache: pathlib.Path) -> None:
    entered = threading.Event()
    leave = threading.Event()
    waited = []

    def hold() -> None:
        with disk_cache.exclusive("work"):
            entered.set()
            leave.wait()

    def enter() -> None:
        with disk_cache.exclusive("work") as one:
            waited.append(one)

    holder = threading.Thread(target=hold)
    waiter = threading.Thread(target=enter)
    holder.start()
    entered.wait()
    waiter.start()
    time.sleep(0.1)
    assert not waited
    leave.set()
    wait(lambda: bool(waited), "the lock")
    assert waited == [True]
    with disk_cache.exclusive("work") as again:
        assert not again
    holder.join()
    waiter.join()


def test_the_digest_follows_every_byte_of_the_sources(tmp_path: pathlib.Path) -> None:
    (tmp_path / "code.py").write_text("a = 1")
    (tmp_path / "data.toml").write_text("b = 1")
    before = source_digest(tmp_path, "text")
    assert before == source_digest(tmp_path, "text")
    assert before != source_digest(tmp_path, "other")
    (tmp_path / "notes.txt").write_text("neither code nor data")
    assert before == source_digest(tmp_path, "text")
    (tmp_path / "data.toml").write_text("b = 2")
    assert before != source_digest(tmp_path, "text")


def test_the_folder_is_where_the_platform_has_its_caches(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert disk_cache.folder() == tmp_path / "cache"
    monkeypatch.delenv("VINESIM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setattr(disk_cache.sys, "platform", "linux")
    assert disk_cache.folder() == tmp_path / "xdg" / "vinesim"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert disk_cache.folder() == pathlib.Path.home() / ".cache" / "vinesim"
