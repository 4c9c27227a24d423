"""Compilation of kernels before they are needed: each module once, by processes on all cores, with progress.

Warp compiles a module at its first launch and keeps the result on disk. Processes that start together would each
compile the same modules, in silence and one after the other. With :func:`compile_kernels` the first of them starts
compilers, and each of them waits only for the modules that it needs.
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
"""[s] How long other processes may take to compile before this process compiles as well."""
MAX_COMPILERS = 12
"""Largest number of compilers. More would only wait for the longest module."""
NICENESS = 10
"""Niceness of compilers while they compile modules that nothing waits for: loops of running clients come first."""
ATTEMPTS = 2
"""Number of compilers to which a module is given in turn if they die while compiling it."""
POLL_PERIOD = 0.05
"""[s] Time between two checks of what other processes have compiled."""
LEFTOVER_AGE = 3600.0
"""[s] Age from which a compiler's working folder is taken to be left over from a killed compiler."""
_PREFIX = "vinesim.kernels."
_KERNEL = re.compile(rb"^@wp\.kernel|_kernel\(__name__,", re.MULTILINE)
"""Matches the definition of a kernel in a module's source."""
_CUDA_ONLY = (
    "plants.lean_prediction",
    "contact.tree_delassus",
    "contact.tree_islands",
    "contact.tree_narrowphase",
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
"""Modules whose kernels are never launched on a GPU; some have vectors of a CPU in native code."""


def compile_kernels(packages: Sequence[str] = (), device: str = "cpu", *, then: Sequence[str] = ()) -> int:
    """Return when the kernels of some ``packages`` of :mod:`vinesim.kernels` are compiled, of all unless given.

    For the CPU always, and for ``device`` (``"cpu"``, ``"cuda"``, ``"cuda:N"``; it must be there). Returns how many
    modules this process had compiled for the CPU meanwhile: 0 where others compile, and where all are in Warp's cache,
    which takes a few milliseconds to find. If it starts compilers, those also compile the packages in ``then``, after
    the others and without being waited for, as long as this process runs.

    A module that cannot be compiled is logged; Warp tries again at its first launch, and raises what is wrong with it.
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
                elif not missing:  # others compile what comes later
                    break
            if compilers is not None and not compilers.awaited(missing):
                break
            line.show(f"compiling kernels, only once: {len(names) - len(missing)} of {len(names)} done")
            time.sleep(POLL_PERIOD)
    return 0 if compilers is None else compilers.count(names)


class CompiledModules:
    """Tells which modules of this version of the kernels are in Warp's cache, where each has a file that names its
    folder.
    """

    def __init__(self) -> None:
        self._cache = pathlib.Path(wp.config.kernel_cache_dir)
        h = hashlib.blake2b(wp.get_cpu_kernel_cache_key().encode(), digest_size=8)
        for name, source in _sources().items():
            h.update(name.encode() + source)
        self._folder = self._cache / f"vinesim-{h.hexdigest()}"

    def missing(self, names: Sequence[str]) -> list[str]:
        """Returns the modules of ``names`` that are not in the cache, in their order."""
        return [name for name in names if not self._is_there(name)]

    def _is_there(self, name: str) -> bool:
        try:
            return (self._cache / (self._folder / name).read_text()).is_dir()
        except OSError:
            return False

    def add(self, name: str, folder: str) -> None:
        """Record that a module is in a ``folder`` of Warp's cache."""
        with contextlib.suppress(OSError):  # then the next start looks again
            self._folder.mkdir(exist_ok=True)
            draft = self._folder / f"{name}.{os.getpid()}.part"
            draft.write_text(folder)
            draft.replace(self._folder / name)

    def delete_leftovers(self) -> None:
        """Delete the folders of compilers that were killed while they compiled."""
        for folder in self._cache.glob(f"wp_{_PREFIX}*_p[0-9]*_t[0-9]*"):
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > LEFTOVER_AGE:
                    shutil.rmtree(folder)


class Compilers:
    """Processes that compile modules, one after the other each, in threads of this process that feed them."""

    def __init__(
        self, names: Sequence[str], later: Sequence[str], compiled: CompiledModules, lock: contextlib.ExitStack
    ) -> None:
        """Start to compile the modules ``names`` in their order, then those of ``later``, while loops may run already.

        The ``lock`` is held until all are done.
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
        """Returns the modules of ``names`` that are yet to be compiled. The others are compiled or have failed."""
        with self._state:
            return [name for name in names if name in self._awaited]

    def count(self, names: Sequence[str]) -> int:
        """Returns how many modules of ``names`` were compiled."""
        with self._state:
            return len(self._done.intersection(names))

    def _feed(self) -> None:
        """Let one process compile the next module until none is left. Start another process if it dies."""
        process = None
        try:
            while (name := self._next()) is not None:
                process = process or _start_compiler()
                if name in self._later and hasattr(os, "setpriority"):
                    with contextlib.suppress(OSError):  # it has just died
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
            log.warning("kernels cannot be compiled beforehand: %s", error)
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
            log.warning("%s was not compiled beforehand: %s", name, failure)
        with self._state:
            self._awaited.discard(name)
            if not failure:
                self._done.add(name)


def _start_compiler() -> subprocess.Popen[str]:
    """Start :mod:`vinesim.kernels.compiler_process` in a process group of its own, so that Ctrl-C reaches this process
    only.
    """
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
    """Returns the answer of a compiler for a module; None if the compiler has died."""
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
    """Compile modules on all cores, or load them if they are compiled.

    Warp's compiler releases the interpreter lock.
    """
    modules = [wp.get_module(importlib.import_module(_PREFIX + name).__name__) for name in names]
    with ProgressLine() as line, concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
        works = [pool.submit(wp.force_load, device, [module], max_workers=0) for module in modules]
        for number, work in enumerate(concurrent.futures.as_completed(works)):
            work.result()
            line.show(f"compiling kernels for {device}: {number + 1} of {len(names)} done")


def module_names(packages: Sequence[str] = (), without: Sequence[str] = _CUDA_ONLY) -> list[str]:
    """Returns all modules of some packages of :mod:`vinesim.kernels` that define kernels; of all packages by default.

    ``packages`` may name single modules, too.

    Long modules roughly come first, so that no core waits for the last one.
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
    """Returns the source of each module of the package, by its name relative to the package."""
    root = pathlib.Path(vinesim.kernels.__path__[0])
    return {
        ".".join(file.relative_to(root).with_suffix("").parts): file.read_bytes() for file in sorted(root.rglob("*.py"))
    }


if __name__ == "__main__":  # all, for tools/setup
    progress.show_on(sys.stderr)
    compile_kernels()
