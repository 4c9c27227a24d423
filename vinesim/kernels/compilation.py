"""Compilation of kernels before their first launch: each module once, by processes on all cores, with progress.

Warp compiles a module at its first launch and caches the result on disk. Without this module, processes that start
together would each compile the same modules one after another, without a message. With :func:`compile_kernels` the
first process starts compiler processes, and every process waits only for the modules that it needs.
"""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import functools
import hashlib
import importlib
import json
import logging
import os
import pathlib
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import warp as wp

import vinesim.kernels
from vinesim.core import disk_cache, progress
from vinesim.core.progress import ProgressLine
from vinesim.core.thread_pool import usable_cores

log = logging.getLogger(__name__)

PHYSICS_PACKAGES = (
    "plants",
    "wires",
    "contact",
    "rigid",
    "robot",
)
"""Packages of the kernels that a physics step needs."""
SENSOR_PACKAGES = ("raster", "lidar", "stereo", "shading")
"""Packages of the kernels of cameras and lidars."""
TIMEOUT = 600.0
"""Time [s] to wait for compilers of other processes before this process starts its own."""
MAX_COMPILERS = 12
"""Largest number of compiler processes. More would not be faster, because the longest module takes as long."""
NICENESS = 10
"""Niceness of compilers while they compile modules for later, so that running clients have priority."""
ATTEMPTS = 2
"""Number of attempts to compile a module if the compiler process dies."""
POLL_PERIOD = 0.05
"""Time [s] between two checks for modules that other processes have compiled."""
LEFTOVER_AGE = 3600.0
"""Age [s] from which a compiler's working folder is deleted, as a leftover of a killed compiler."""
_PREFIX = "vinesim.kernels."
_KERNEL = re.compile(rb"^@wp\.kernel|_kernel\(__name__,", re.MULTILINE)
"""Regular expression that matches the definition of a kernel in a module's source."""
_CUDA_ONLY = (
    "plants.lean_prediction",
    "raster.cuda_raster",
)
_CPU_ONLY = (
    "plants.eight_trees",
    "contact.delassus",
    "contact.forces",
    "contact.islands",
    "contact.jacobians",
    "contact.narrowphase_plants",
    "contact.narrowphase_rigid",
    "contact.projected_gauss_seidel",
    "contact.sleeping_trees",
    "contact.sweep_order",
    "rigid.joint_servos",
    "wires.wire_contacts",
    "wires.wire_shapes",
)
"""Modules whose kernels are never launched on a GPU; some contain native code with CPU vectors."""


def compile_kernels(packages: Sequence[str] = (), device: str = "cpu", *, then: Sequence[str] = ()) -> int:
    """Wait until the kernels of ``packages`` of :mod:`vinesim.kernels` (all by default) are compiled.

    They are compiled for the CPU, and also for ``device`` (``"cpu"``, ``"cuda"``, ``"cuda:N"``), which must exist.
    Returns the number of modules that compilers of this process compiled for the CPU: 0 if other processes compile
    them, or if all are in Warp's cache, which takes a few milliseconds to check. Compilers of this process afterwards
    compile the packages in ``then``, while this process runs on without waiting for them.

    A module that cannot be compiled is logged; Warp compiles it again at its first launch and raises the error.
    """
    if device != "cpu":
        with disk_cache.exclusive("kernels-cuda", TIMEOUT, waiting_for="another process that compiles kernels"):
            _compile_for_gpu(module_names(packages, without=_CPU_ONLY), device)
    names = module_names(packages)
    later = [name for name in module_names(then) if name not in names] if then else []
    compiled = CompiledModules()
    if not compiled.missing([*names, *later]):
        return 0
    if not os.access(wp.config.kernel_cache_dir, os.W_OK):
        vinesim.kernels.use_temporary_cache(f"{wp.config.kernel_cache_dir} is read-only")
        compiled = CompiledModules()
    compilers: Compilers | None = None
    deadline = time.monotonic() + TIMEOUT
    with ProgressLine() as line:
        while (missing := compiled.missing(names)) or (compilers is None and later):
            if compilers is None:
                lock = disk_cache.try_exclusive("kernels")
                if lock is None and missing and time.monotonic() > deadline:
                    log.warning("other processes have compiled kernels for %.0f s; compiling them here too", TIMEOUT)
                    lock = contextlib.ExitStack()
                if lock is not None:
                    missing = compiled.missing(names)
                    compilers = Compilers(missing, compiled.missing(later), compiled, lock)
                elif not missing:  # another process compiles the modules for later
                    break
            if compilers is not None and not compilers.awaited(missing):
                break
            line.show(f"compiling kernels, only once: {len(names) - len(missing)} of {len(names)} done")
            time.sleep(POLL_PERIOD)
    return 0 if compilers is None else compilers.count(names)


class CompiledModules:
    """The list of compiled modules in Warp's cache, for this version of the kernels.

    For each compiled module, the cache contains a small file with the name of the module's folder and a digest of its
    code. A module whose code has another digest is damaged. It is deleted, which one line tells, and counts as not
    compiled.
    """

    def __init__(self) -> None:
        self._intact: set[str] = set()
        """Modules whose digest this object has compared."""
        self._cache = pathlib.Path(wp.config.kernel_cache_dir)
        h = hashlib.blake2b(wp.get_cpu_kernel_cache_key().encode(), digest_size=8)
        for name, source in _sources().items():
            h.update(name.encode() + source)
        self._folder = self._cache / f"vinesim-{h.hexdigest()}"

    def missing(self, names: Sequence[str]) -> list[str]:
        """Returns the modules in ``names`` that are not in Warp's cache, in the order of ``names``."""
        return [name for name in names if not self._is_there(name)]

    def _is_there(self, name: str) -> bool:
        if name in self._intact:
            return True
        record = self._folder / name
        try:
            module, _, digest = record.read_text().partition(" ")
            folder = self._cache / module
            if not folder.is_dir() or not digest:  # earlier releases wrote no digest
                return False
            if _digest(folder) == digest:
                self._intact.add(name)
                return True
        except (OSError, UnicodeDecodeError):
            return False
        log.warning("the compiled kernels in %s are damaged: compiling them again", folder)
        with contextlib.suppress(OSError):
            record.unlink()
            if folder.parent == self._cache and folder.name.startswith("wp_"):  # the record may be damaged itself
                shutil.rmtree(folder)
        return False

    def add(self, name: str, folder: str) -> None:
        """Record that module ``name`` is compiled, in ``folder`` of Warp's cache."""
        with contextlib.suppress(OSError):  # without the record the module is compiled again at the next start
            self._folder.mkdir(exist_ok=True)
            draft = self._folder / f"{name}.{os.getpid()}.part"
            draft.write_text(f"{folder} {_digest(self._cache / folder)}")
            draft.replace(self._folder / name)

    def delete_leftovers(self) -> None:
        """Delete the working folders of compilers that were killed while they compiled."""
        for folder in self._cache.glob(f"wp_{_PREFIX}*_p[0-9]*_t[0-9]*"):
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > LEFTOVER_AGE:
                    shutil.rmtree(folder)


def _digest(folder: pathlib.Path) -> str:
    """Returns a digest of the code for the CPU in a folder of Warp's cache, and of whether its description can be
    read."""
    h = hashlib.blake2b(digest_size=16)
    for file in sorted(folder.glob("*.o")):
        h.update(file.read_bytes())
    for file in sorted(folder.glob("*.meta")):
        try:
            json.loads(file.read_bytes())
        except ValueError:
            h.update(b"unreadable")
    return h.hexdigest()


class Compilers:
    """A pool of compiler processes. Each one is served by a thread of this process and compiles one module at a
    time."""

    def __init__(
        self, names: Sequence[str], later: Sequence[str], compiled: CompiledModules, lock: contextlib.ExitStack
    ) -> None:
        """Start to compile the modules ``names`` in this order, then the modules ``later`` at low priority.

        ``compiled``: records of compiled modules; ``lock``: closed when all modules are compiled.
        """
        self._compiled = compiled
        names = [*names, *later]
        self._queue = collections.deque(names)
        self._later = frozenset(later)
        self._awaited = set(names)
        self._done: set[str] = set()
        self._deaths: collections.Counter[str] = collections.Counter()
        self._state = threading.Lock()
        self._held = lock
        compiled.delete_leftovers()
        self._threads = min(usable_cores(), len(names), MAX_COMPILERS)
        if not names:
            lock.close()
        for number in range(self._threads):
            threading.Thread(target=self._feed, name=f"compiler {number}", daemon=True).start()

    def awaited(self, names: Sequence[str]) -> list[str]:
        """Returns the modules in ``names`` that are still to be compiled. All others are compiled or have failed."""
        with self._state:
            return [name for name in names if name in self._awaited]

    def count(self, names: Sequence[str]) -> int:
        """Returns the number of modules in ``names`` that this pool has compiled."""
        with self._state:
            return len(self._done.intersection(names))

    def _feed(self) -> None:
        """Send modules to one compiler process until none is left; start another process if it dies (one thread
        each)."""
        process = None
        try:
            while (name := self._next()) is not None:
                process = process or _start_compiler()
                if name in self._later and hasattr(os, "setpriority"):
                    with contextlib.suppress(OSError):  # the process has just died
                        os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
                answer = _ask(process, name)
                if answer is None:
                    code = process.wait()
                    process = None
                    self._take_back(name, f"the compiler ended with exit code {code}")
                elif "failure" in answer:
                    self._end(name, answer["failure"])
                else:
                    self._compiled.add(name, answer["folder"])
                    self._end(name)
        except OSError as error:  # no process could be started
            log.warning("kernels cannot be compiled in advance (no compiler process starts): %s", error)
        finally:
            if process is not None:
                _close(process)
            with self._state:
                self._threads -= 1
                if self._threads == 0:
                    self._awaited.clear()
                    self._held.close()

    def _next(self) -> str | None:
        with self._state:
            return self._queue.popleft() if self._queue else None

    def _take_back(self, name: str, reason: str) -> None:
        with self._state:
            self._deaths[name] += 1
            again = self._deaths[name] < ATTEMPTS
            if again:
                self._queue.appendleft(name)
        if not again:
            self._end(name, reason)

    def _end(self, name: str, failure: str = "") -> None:
        if failure:
            log.warning("kernel module %s was not compiled in advance: %s", name, failure)
        with self._state:
            self._awaited.discard(name)
            if not failure:
                self._done.add(name)


def _start_compiler() -> subprocess.Popen[str]:
    """Start :mod:`vinesim.kernels.compiler_process` in its own process group, so that Ctrl-C does not reach it."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "vinesim.kernels.compiler_process"],
        stdin=subprocess.PIPE,
        text=True,
        stdout=subprocess.PIPE,
        env=environment,
        **({"process_group": 0} if os.name == "posix" else {}),
    )


def _ask(process: subprocess.Popen[str], name: str) -> dict[str, str] | None:
    """Let a compiler process compile module ``name``. Returns its answer (``folder`` or ``failure``); None if it
    died."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(_PREFIX + name + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())
    except (BrokenPipeError, ValueError):
        return None


def _close(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(OSError):
        process.communicate()


def _compile_for_gpu(names: Sequence[str], device: str) -> None:
    """Compile modules for a GPU in threads on all cores, or load them if they are compiled.

    Threads suffice, because Warp's CUDA compiler releases Python's interpreter lock.
    """
    modules = [wp.get_module(importlib.import_module(_PREFIX + name).__name__) for name in names]
    with ProgressLine() as line, concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
        works = [pool.submit(wp.force_load, device, [module], max_workers=0) for module in modules]
        for number, work in enumerate(concurrent.futures.as_completed(works)):
            work.result()
            line.show(f"compiling kernels for {device}: {number + 1} of {len(names)} done")


def module_names(packages: Sequence[str] = (), without: Sequence[str] = _CUDA_ONLY) -> list[str]:
    """Returns the names of all modules with kernels in ``packages`` of :mod:`vinesim.kernels` (all by default).

    ``packages`` may also contain names of single modules; modules in ``without`` are left out. Modules are roughly
    sorted from long to short, so that no core waits for a long last one.
    """
    found = {
        name: len(source)
        for name, source in _sources().items()
        if _KERNEL.search(source)
        if name not in without
        if not packages or name.split(".")[0] in packages or name in packages
    }
    return sorted(found, key=lambda name: -found[name])


@functools.cache
def _sources() -> dict[str, bytes]:
    """Returns the source of each module of :mod:`vinesim.kernels`, by its dotted name relative to that package."""
    root = pathlib.Path(vinesim.kernels.__path__[0])
    return {
        ".".join(file.relative_to(root).with_suffix("").parts): file.read_bytes() for file in sorted(root.rglob("*.py"))
    }


if __name__ == "__main__":  # compile all kernels, for tools/setup
    progress.show_on(sys.stderr)
    compile_kernels()
