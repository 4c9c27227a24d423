"""Memory, threads and open files of processes and their children, as Linux counts them in /proc."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

RESOURCE_TRACKER = "resource tracker"
"""Name of the process with which Python's multiprocessing frees shared memory."""
_PROC = pathlib.Path("/proc")


class ProcUnavailable(RuntimeError):
    """The measurement needs /proc of Linux; the text explains this."""

    exit_code = 3


@dataclasses.dataclass(frozen=True, slots=True)
class ProcessSample:
    """One process at one time."""

    memory: float
    """Proportional set size [MB]: resident memory, where pages that n processes share count 1/n."""
    own: float
    """Part of the memory that is not a copy of a file [MB]: heap, arrays and shared memory. Unlike the proportional set
    size, this part does not grow when another process that has loaded the same libraries ends."""
    threads: int
    handles: int
    """Number of open file descriptors."""


@dataclasses.dataclass(frozen=True, slots=True)
class ProcessHistory:
    """Successive samples of one process."""

    times: list[float]
    """Times of the samples [s], of a monotonic clock."""
    samples: list[ProcessSample]

    def since(self, time: float) -> ProcessHistory:
        """Returns the samples from ``time`` [s] on."""
        first = int(np.searchsorted(self.times, time))
        return ProcessHistory(self.times[first:], self.samples[first:])

    def growth(self) -> float:
        """Slope of the own memory by least squares [MB/h]; 0 with fewer than two samples."""
        if len(self.times) < 2:
            return 0.0
        hours = (np.array(self.times) - self.times[0]) / 3600.0
        return float(np.polyfit(hours, [sample.own for sample in self.samples], 1)[0])

    def change(self, what: str) -> int:
        """Returns by how much the largest number of ``threads`` or ``handles`` in the second half of the samples
        exceeds the largest in the first half."""
        middle = len(self.samples) // 2
        halves = self.samples[: max(middle, 1)], self.samples[middle:]
        first, second = (max(getattr(sample, what) for sample in half) for half in halves)
        return second - first


def check_proc() -> None:
    """Raise :class:`ProcUnavailable` unless this system has the files that :func:`sample_process` reads."""
    if not (_PROC / "self" / "smaps_rollup").exists():
        raise ProcUnavailable("memory of processes is read from /proc/PID/smaps_rollup, which only Linux has")


def sample_process(pid: int) -> ProcessSample:
    """Returns a sample of a process. Raises OSError if the process has ended."""
    place = _PROC / str(pid)
    kilobytes: dict[str, int] = {}
    for line in (place / "smaps_rollup").read_text().splitlines()[1:]:
        name, value, *_ = line.split()
        kilobytes[name.rstrip(":")] = int(value)
    status = (place / "status").read_text()
    return ProcessSample(
        memory=kilobytes["Pss"] / 1024.0,
        own=(kilobytes["Pss_Anon"] + kilobytes["Pss_Shmem"]) / 1024.0,
        threads=int(status.partition("Threads:")[2].split(maxsplit=1)[0]),
        handles=len(os.listdir(place / "fd")),
    )


def process_tree(pid: int) -> Iterator[tuple[int, str]]:
    """Yields id and name of each descendant of a process; names are those of ``ps -o comm``."""
    children: list[int] = []
    with contextlib.suppress(OSError):
        for thread in os.listdir(_PROC / str(pid) / "task"):
            with contextlib.suppress(OSError):
                children += map(int, (_PROC / str(pid) / "task" / thread / "children").read_text().split())
    for child in sorted(children):
        with contextlib.suppress(OSError):
            yield child, _name(child)
            yield from process_tree(child)


def _name(pid: int) -> str:
    if b"resource_tracker" in (_PROC / str(pid) / "cmdline").read_bytes():
        return RESOURCE_TRACKER
    return (_PROC / str(pid) / "comm").read_text().strip()


class ProcessSampler:
    """Histories of named processes and of their descendants."""

    def __init__(self, roots: Sequence[tuple[str, int]]) -> None:
        """Kind and id of each process that has no parent among them."""
        self._roots = list(roots)
        self.histories: dict[tuple[str, int], ProcessHistory] = {}
        """History of each process, by kind and id; the kind of a descendant is its name."""
        self._sampled_at = 0.0

    def add(self, kind: str, pid: int) -> None:
        """Sample another process and its descendants from now on."""
        self._roots.append((kind, pid))

    def memory(self) -> float:
        """Memory of all processes that ran at the last sample [MB]."""
        return sum(one.samples[-1].memory for one in self.histories.values() if one.times[-1] == self._sampled_at)

    def sample(self, time: float) -> None:
        """Add a sample of each process that runs at ``time`` [s]."""
        self._sampled_at = time
        for kind, root in self._roots:
            for name, pid in ((kind, root), *((name, pid) for pid, name in process_tree(root))):
                with contextlib.suppress(OSError):  # the process may have ended meanwhile
                    found = sample_process(pid)
                    history = self.histories.setdefault((name, pid), ProcessHistory([], []))
                    history.times.append(time)
                    history.samples.append(found)
