"""Disk cache of arrays that take long to compute. The key of an entry is a name and a digest of all inputs of the
computation, its code included.

    arrays = load_or_make("soil", digest, make)

The folder is ``$VINESIM_CACHE`` if that is set, else ``vinesim`` in the user's folder for caches: ``$XDG_CACHE_HOME``
or ``~/.cache``, ``~/Library/Caches`` on macOS, ``%LOCALAPPDATA%`` on Windows. It may be deleted at any time.

When several processes miss the same entry, one makes it and the others wait. A file ends with a digest of its name and
of all its bytes. A file whose digest differs is never read; one line names it, and it is made anew. If the folder
cannot be written, everything is computed without a cache after one warning.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pathlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import IO

import numpy as np

from vinesim.core.progress import ProgressLine

log = logging.getLogger(__name__)

MAX_SIZE = 1 << 30
"""Largest total size of the entries [bytes]. When it is exceeded, the least recently used entries are deleted."""
LOCK_TIMEOUT = 120.0
"""Longest time to wait for another process that is computing an entry [s]; this process then computes the entry too."""
_LEFTOVER_AGE = 3600.0
"""Age above which a temporary file is treated as left over from a killed process [s]."""
_POLL_PERIOD = 0.02
"""Time between two attempts to get a lock [s]."""

_MARK = b"vscache1"
"""Format of the files: begins the last bytes of a file, before the digest of its content."""
_DIGEST_SIZE = 32
_TAIL_SIZE = len(_MARK) + _DIGEST_SIZE

Arrays = dict[str, np.ndarray]

_warned = threading.Event()


def folder() -> pathlib.Path:
    """Returns the folder of the cache; it need not exist."""
    if chosen := os.environ.get("VINESIM_CACHE"):
        return pathlib.Path(chosen)
    return user_folder() / "vinesim"


def user_folder() -> pathlib.Path:
    """Returns the folder in which this user's programs keep their caches; it need not exist."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return pathlib.Path(base).expanduser()


def load_or_make(name: str, digest: str, make: Callable[[], Mapping[str, np.ndarray]]) -> Arrays:
    """Returns the arrays that ``make`` computes, from the cache if it has them.

    Args:
        name: name of the arrays; part of the file's name.
        digest: digest of everything that the arrays are computed from, the code included: see :func:`source_digest`.
        make: computes them. Called once, and only if no entry is found; its errors are passed on.
    """
    try:
        place = folder()
    except RuntimeError as error:  # no home folder
        _warn(error)
        return dict(make())
    path = place / f"{name}-{digest}.npz"
    if (found := _read(path)) is not None:
        return found
    with exclusive(path.stem):
        if (found := _read(path, logging.DEBUG)) is not None:  # another process has made it meanwhile
            return found
        arrays = dict(make())
        _write(path, arrays)
    return arrays


def load(name: str, digest: str) -> Arrays | None:
    """Returns the arrays stored by :func:`keep` or :func:`load_or_make`; None if the file is missing or broken."""
    try:
        return _read(folder() / f"{name}-{digest}.npz")
    except RuntimeError as error:  # no home folder
        _warn(error)
        return None


def keep(name: str, digest: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Store arrays in the cache. Warns once if the folder cannot be written."""
    try:
        _write(folder() / f"{name}-{digest}.npz", dict(arrays))
    except RuntimeError as error:
        _warn(error)


def source_digest(*sources: pathlib.Path | str | bytes) -> str:
    """Returns a digest (16 hex digits) of files, of all ``*.py`` and ``*.toml`` files below folders, of texts and
    bytes.

    The digest includes the format of the cache's files, and the version of NumPy, because results may differ in the
    last bit between versions.
    """
    h = hashlib.blake2b(_MARK + np.__version__.encode(), digest_size=8)
    for source in sources:
        if isinstance(source, pathlib.Path):
            files = [source]
            if source.is_dir():
                files = sorted(f for f in source.rglob("*") if f.suffix in (".py", ".toml"))
            parts = [part for f in files for part in (f.name.encode(), f.read_bytes())]
        else:
            parts = [source.encode() if isinstance(source, str) else source]
        for part in parts:
            h.update(len(part).to_bytes(8, "little") + part)
    return h.hexdigest()


def _warn(error: Exception) -> None:
    """Warn, once in each process, that the cache cannot be used."""
    if not _warned.is_set():
        _warned.set()
        log.warning("no cache on disk, so every start computes its tables again (set VINESIM_CACHE): %s", error)


def _read(path: pathlib.Path, level: int = logging.WARNING) -> Arrays | None:
    """Returns the arrays of a file; None if the file is missing or broken. One line of this ``level`` names a broken
    file."""
    try:
        with open(path, "rb") as file:
            end = file.seek(0, os.SEEK_END) - _TAIL_SIZE
            if end < 0:
                raise ValueError("it is cut off")
            file.seek(end)
            tail = file.read(_TAIL_SIZE)
            file.seek(0)
            if tail != _tail(path.stem, file, end):
                raise ValueError("its content does not fit its digest")
            file.seek(0)
            with np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
    except (FileNotFoundError, NotADirectoryError):
        return None
    except Exception as error:  # a file that another version of NumPy wrote can raise anything
        log.log(level, "%s is broken and is made anew: %s", path, " ".join(str(error).split()) or type(error).__name__)
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # the time of last use, for _prune
    return arrays


def _tail(stem: str, file: IO[bytes], length: int) -> bytes:
    """Returns what follows the next ``length`` bytes of a file whose name without suffix is ``stem``."""
    digest = hashlib.blake2b(stem.encode() + b"\0", digest_size=_DIGEST_SIZE)
    while length > 0 and (block := file.read(min(length, 1 << 20))):
        digest.update(block)
        length -= len(block)
    return _MARK + digest.digest()


def _write(path: pathlib.Path, arrays: Arrays) -> None:
    """Write the arrays to a temporary file, then rename it to ``path``, so that readers find the whole file or none."""
    if sum(array.nbytes for array in arrays.values()) > MAX_SIZE:
        return
    draft = path.with_name(f"{path.stem}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(draft, "w+b") as file:
                np.savez(file, **arrays)  # pyright: ignore[reportArgumentType] the stub of savez takes bools only
                end = file.seek(0, os.SEEK_END)
                file.seek(0)
                tail = _tail(path.stem, file, end)
                file.seek(end)
                file.write(tail)
            os.replace(draft, path)
        except BaseException:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)
            raise
        _prune(path.parent)
    except OSError as error:
        _warn(error)


def _prune(place: pathlib.Path) -> None:
    """Delete files left by killed processes, then the least recently used entries until the total size is at most
    :data:`MAX_SIZE`.
    """
    now = time.time()
    entries = []
    for file in place.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process prunes as well
            stat = file.stat()
            if file.suffix == ".npz":
                entries.append((stat.st_mtime, stat.st_size, file))
            elif file.suffix in (".tmp", ".lock") and now - stat.st_mtime > _LEFTOVER_AGE:
                file.unlink(missing_ok=True)
    size = sum(entry[1] for entry in entries)
    for _, own, file in sorted(entries)[:-1]:
        if size <= MAX_SIZE:
            return
        file.unlink(missing_ok=True)
        size -= own


@contextlib.contextmanager
def exclusive(name: str, timeout: float | None = None, waiting_for: str = "") -> Iterator[bool]:
    """Hold the lock ``name``, which excludes other processes; yields whether this process had to wait for it.

    The operating system releases the lock when the process ends, also after a crash. The context is entered without the
    lock if the file system has no locks, or if ``timeout`` [s] (default :data:`LOCK_TIMEOUT`) has passed.
    ``waiting_for``: text for the log after a second of waiting.
    """
    timeout = LOCK_TIMEOUT if timeout is None else timeout
    start = time.monotonic()
    waited = False
    with ProgressLine() as line:
        while (lock := try_exclusive(name)) is None:
            waited = True
            line.show(f"waiting for {waiting_for or f'another process that makes {name}'}")
            if time.monotonic() > start + timeout:
                log.warning("another process has held %s for %.0f s; going on without it", name, timeout)
                lock = contextlib.ExitStack()
                break
            time.sleep(_POLL_PERIOD)
    with lock:
        yield waited


def try_exclusive(name: str) -> contextlib.ExitStack | None:
    """Take the lock that :func:`exclusive` takes, without waiting. Close the result to release it. Returns None if
    another process holds the lock."""
    lock = contextlib.ExitStack()
    try:
        path = folder() / f"{name}.lock"
        path.parent.mkdir(parents=True, exist_ok=True)
        file = lock.enter_context(open(path, "ab"))  # noqa: SIM115 entered
    except (OSError, RuntimeError) as error:
        _warn(error)
        return lock
    if _try_lock(file):
        return lock
    lock.close()
    return None


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: IO[bytes]) -> bool:
        file.seek(0)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _try_lock(file: IO[bytes]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:  # a file system without locks
            _warn(error)
            return True
        return True
