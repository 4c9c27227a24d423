"""Launches that several threads of a CPU share, chunk by chunk, without Python between them.

To wake a thread takes 30 to 60 us, as long as half of the trees of a step take. So a thread that has nothing to do polls
memory for the next launch, for :data:`POLL_TIME`, before it sleeps, and the thread that launches begins at once: each thread
that is free takes the next chunk, and one that wakes late finds fewer left. Results do not depend on which thread took
which chunk, since chunks share no data that they write. The threads never hold the interpreter's lock.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import threading
import time
from collections.abc import Callable, Sequence

import warp as wp

from vinesim.kernels.launch import BoundLaunch, bind_launch, bound, usable_cores

POLL_TIME = 300_000
"""[ns] How long an idle thread polls: longer than the pauses between a step's launches, much shorter than a step."""

_IDLE = 0
_ASLEEP = 3
_ENDED = 4
"""States of a thread that Python uses. The native code defines all states."""
_FIRST_THREAD = 16
_LINE = 8
"""Places in the memory of a pool, by numbers of eight bytes: the states of the threads, each in a cache line of its own
with the address of its semaphore. Before them, in lines of their own, are the next chunk and the address of the job."""
ONCE = ctypes.c_int32(1)
"""Number of threads of a kernel that runs as one thread in all, for :meth:`LaunchPool.sequence`."""
_FIRST_ENTRY = 3
"""Index of the first entry in a job; see ``_COMMON``."""
_ALL = 1 << 40
"""Number of entries in a chunk of a launch that is not shared."""
_SEMAPHORE_SIZE = 128
"""[bytes] Size of a semaphore: more than any C library's ``sem_t``."""
_C_FUNCTIONS = ("sem_wait", "clock_gettime", "sem_post", "sched_yield")
"""Functions of the C library that native code calls by their addresses."""

_COMMON = """
    typedef void (*Kernel)(void*, void*);
    typedef signed (*Semaphore)(void*);
    typedef long (*GetTime)(long, long*);
    typedef void (*Yield)();
    // a thread that is ASSIGNED to a job is WORKING as soon as it takes the first chunk, and IDLE again if none is left by
    // then; one that is ASLEEP waits at its semaphore, which is posted when it leaves that state
    enum { IDLE, ASSIGNED, WORKING, ASLEEP, ENDED };
    long long* const pool = (long long*)(size_t)address;
    const auto state_of = [&](int i) { return pool + 16 + 8 * i; };
    const auto change = [&](int i, long long from, long long to) {
        return __atomic_compare_exchange_n(state_of(i), &from, to, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE);
    };
    const auto pause = [] {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        asm volatile("yield");
#endif
    };
    // job: chunks, entries of a chunk, entries, first entry, launches, numbers of a launch; of each launch: kernel, address
    // of the list, bytes of an entry; for each thread addresses of bounds, their shape and size, arguments, list in them
    const auto run_part = [&](const long long* job, int thread, long long first, long long count) {
        for (long long i = 0; i < job[4]; ++i) {
            const long long* const launch = job + 6 + i * job[5];
            const long long* const mine = launch + 3 + 5 * thread;
            *(unsigned*)mine[1] = (unsigned)count;
            *(size_t*)mine[2] = (size_t)count;
            *(long long*)mine[4] = launch[1] + (job[3] + first) * launch[2];
            ((Kernel)launch[0])((void*)mine[0], (void*)mine[3]);
        }
    };
    const auto run_chunk = [&](const long long* job, int thread) {
        const long long chunk = __atomic_fetch_add(pool, 1, __ATOMIC_RELAXED);
        if (chunk >= job[0]) return false;
        const long long first = chunk * job[1], left = job[2] - first;
        run_part(job, thread, first, left < job[1] ? left : job[1]);
        return true;
    };
"""


@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
"""
    + _COMMON
    + """
    const auto lead = [&](const long long* job) {
        __atomic_store_n(pool, 0, __ATOMIC_RELAXED);
        __atomic_store_n(pool + 8, (long long)(size_t)job, __ATOMIC_RELEASE);
        const long long wanted = threads < job[0] ? threads : job[0];
        for (int i = 1; i < wanted; ++i) {  // to wake one takes as long as eight chunks
            if (!change(i, IDLE, ASSIGNED) && job[0] >= 8 && change(i, ASLEEP, ASSIGNED)) ((Semaphore)(size_t)post)((void*)state_of(i)[1]);
        }
        while (run_chunk(job, 0)) {}
        for (int i = 1; i < threads; ++i) {
            change(i, ASSIGNED, IDLE);  // one that has not begun, perhaps for want of a core, is not waited for
            for (int polls = 0; __atomic_load_n(state_of(i), __ATOMIC_ACQUIRE) == WORKING; ++polls) {
                pause();
                if (polls > 1000 && yield_) ((Yield)(size_t)yield_)();
            }
        }
    };
    const long long* const listed = (const long long*)(size_t)jobs;
    for (int i = 0; i < count; ++i) {
        long long* const job = (long long*)(size_t)listed[2 * i];
        const long long entries = *(const int*)(size_t)listed[2 * i + 1];
        if (threads > 1 && entries >= 2 * job[1]) {
            job[0] = (entries + job[1] - 1) / job[1];
            job[2] = entries;
            lead(job);
        } else if (entries > 0) {
            run_part(job, 0, 0, entries);
        }
    }
#endif
"""
)
def lead(address: wp.uint64, jobs: wp.uint64, count: int, threads: int, post: wp.uint64, yield_: wp.uint64):
    """Do jobs one after the other. A job of two chunks or more is shared with the other threads.

    jobs: for each job its address, and the address of its number of entries, which is read when the job begins.
    """
    ...


@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
"""
    + _COMMON
    + """
    const auto now = [&] {
        long time[2];
        ((GetTime)(size_t)get_time)(clock, time);
        return 1000000000LL * time[0] + time[1];
    };
    long long since = now();
    for (int polls = 1;; ++polls) {
        const long long state = __atomic_load_n(state_of(thread), __ATOMIC_RELAXED);
        if (state == ENDED) break;
        if (state == ASSIGNED && change(thread, ASSIGNED, WORKING)) {
            const long long* const work = (const long long*)__atomic_load_n(pool + 8, __ATOMIC_ACQUIRE);
            while (run_chunk(work, thread)) {}
            __atomic_store_n(state_of(thread), IDLE, __ATOMIC_RELEASE);
            since = now();
        } else if (polls % 64 == 0 && now() - since > poll_time && change(thread, IDLE, ASLEEP)) {
            while (((Semaphore)(size_t)wait)((void*)state_of(thread)[1])) {}  // interrupted by a signal
            since = now();
        }
        pause();
    }
#endif
"""
)
def follow(address: wp.uint64, thread: int, poll_time: int, clock: int, wait: wp.uint64, get_time: wp.uint64):
    """Work on every job, and sleep when there has been none for ``poll_time`` [ns]."""
    ...


@wp.kernel(enable_backward=False)
def lead_threads(
    # model
    threads: int,
    post: wp.uint64,
    yield_address: wp.uint64,
    # in
    address: wp.uint64,
    jobs: wp.uint64,
    count: int,
):
    """One thread in all: the thread that launches."""
    lead(address, jobs, count, threads, post, yield_address)


@wp.kernel(enable_backward=False)
def follow_thread(
    # model
    thread: int,
    poll_time: int,
    clock: int,
    wait: wp.uint64,
    get_time: wp.uint64,
    # in
    address: wp.uint64,
):
    """One thread in all: each of the other threads."""
    follow(address, thread, poll_time, clock, wait, get_time)


class LaunchPool:
    """Threads that share the launches of kernels with the caller.

    The module's docstring describes how they wait and share.
    """

    def __init__(self, size: int) -> None:
        """``size``: number of threads that work at once, including the caller of a launch, which works alone on one
        core.
        """
        self._cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(usable_cores()))
        size = size if len(self._cores) > 1 else 1
        self._semaphores = [ctypes.create_string_buffer(_SEMAPHORE_SIZE) for _ in range(size)]
        try:
            library = ctypes.CDLL(None)
            calls = [ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0 for name in _C_FUNCTIONS]
            self._post = library.sem_post
            can_sleep = not any(library.sem_init(semaphore, 0, 0) for semaphore in self._semaphores)
        except (OSError, AttributeError, TypeError):
            calls = [0] * len(_C_FUNCTIONS)
            can_sleep = False
        self.size = size if can_sleep else 1  # without POSIX semaphores the caller works alone
        self._calls = [wp.uint64(call) for call in calls]
        self._memory = (ctypes.c_int64 * (_FIRST_THREAD + _LINE * (size + 1)))()
        base = -ctypes.addressof(self._memory) % 64 // 8
        self._address = wp.uint64(ctypes.addressof(self._memory) + 8 * base)
        self._states = [base + _FIRST_THREAD + _LINE * i for i in range(size)]
        self._threads: list[threading.Thread] = []
        self._current_core = getattr(library, "sched_getcpu", lambda: -1) if can_sleep else lambda: -1
        self._core = -1
        """Core on which the caller ran when it last woke the others."""
        for i in range(1, self.size):
            self._memory[self._states[i] + 1] = ctypes.addressof(self._semaphores[i])
            given = [i, POLL_TIME, time.CLOCK_MONOTONIC, *self._calls[:2], self._address]
            arguments = (bind_launch(follow_thread, given, []), self._memory, self._semaphores)
            self._threads.append(threading.Thread(target=_follow, args=arguments, name=f"launch pool {i}", daemon=True))
            self._threads[-1].start()

    def share(self, launches: Sequence[BoundLaunch], chunk: int) -> BoundLaunch:
        """Returns a launch that the threads share in chunks of ``chunk`` entries of its list.

        All ``launches`` have the same list and are bound with :attr:`size` partitions; a chunk goes through one launch
        after the other. The caller alone makes launches of fewer than two chunks, and launches that native code cannot
        make.
        """
        if self.size == 1 and len(launches) == 1:
            return launches[0]
        job = _job(launches, chunk)
        if job is None:

            def launch_here(threads: int, first: int = 0, partition: int = 0) -> None:
                for launch in launches:
                    launch(threads, first)

            return bound(launch_here)
        entries = ctypes.c_int32()
        run = self._bind([(job, entries)])

        def launch(threads: int, first: int = 0, partition: int = 0) -> None:
            entries.value = threads
            job[_FIRST_ENTRY] = first
            run(1)
            job[_FIRST_ENTRY] = 0

        launch.keeps = launches  # type: ignore[attr-defined]
        return bound(launch, job=job)

    def sequence(self, launches: Sequence[tuple[BoundLaunch, ctypes.c_int32]]) -> Callable[[], None]:
        """Returns a function that makes ``launches`` one after the other, in one call of native code.

        Each launch comes with the memory of its number of threads. The number is read when the launch begins, so
        earlier kernels may write it. Launches made by :meth:`share` are shared.
        """
        jobs = [(_job([launch], _ALL) if launch.job is None else launch.job, count) for launch, count in launches]
        native = [(job, count) for job, count in jobs if job is not None]
        if len(native) < len(jobs):  # on CUDA, or with another Warp

            def launch_each() -> None:
                for launch, count in launches:
                    launch(count.value)

            return launch_each
        run = self._bind(native)

        def launch() -> None:
            run(1)

        launch.keeps = launches  # type: ignore[attr-defined]
        return launch

    def _bind(self, jobs: Sequence[tuple[ctypes.Array, ctypes.c_int32]]) -> BoundLaunch:
        """Returns one launch for jobs, each with the memory of its number of entries."""
        addresses = [(ctypes.addressof(job), ctypes.addressof(count)) for job, count in jobs]
        listed = (ctypes.c_int64 * (2 * len(jobs)))(*itertools.chain.from_iterable(addresses))
        given = [self.size, *self._calls[2:], self._address, wp.uint64(ctypes.addressof(listed)), len(jobs)]
        run = bind_launch(lead_threads, given, [])
        run.keeps = (run.keeps, jobs, listed)  # type: ignore[attr-defined]
        return run

    def wake(self) -> None:
        """Wake the sleeping threads for a launch that comes soon, on other cores than the caller's.

        Where a virtual machine does not tell that its cores share a cache, Linux wakes a thread on the core on which it
        ran last, even if the caller runs there now and other cores are free. The caller would then
        wait for that thread for as long as it polls.
        """
        if self.size > 1 and (core := self._current_core()) != self._core:
            self._core = core
            if others := self._cores - {core}:
                for number in filter(None, (thread.native_id for thread in self._threads)):
                    with contextlib.suppress(OSError):
                        os.sched_setaffinity(number, others)
        for i in range(1, self.size):
            if self._memory[self._states[i]] == _ASLEEP:  # which only this thread changes
                self._memory[self._states[i]] = _IDLE
                self._post(self._semaphores[i])

    @property
    def sleeping(self) -> int:
        """Number of threads that sleep now."""
        return sum(self._memory[state] == _ASLEEP for state in self._states[1 : self.size])

    def close(self) -> None:
        """End the threads."""
        for i in range(1, self.size):
            self._memory[self._states[i]] = _ENDED
            self._post(self._semaphores[i])
        self.size = 1

    def __del__(self) -> None:
        with contextlib.suppress(AttributeError):  # of one that could not be made
            self.close()


def _job(launches: Sequence[BoundLaunch], chunk: int) -> ctypes.Array | None:
    """What native code reads of launches over one list in chunks of so many entries; None if it cannot make them."""
    packed = [launch.packed for launch in launches]
    numbers = [[*one.head, *(number for part in one.parts for number in part)] for one in packed if one]
    if len(numbers) < len(launches):
        return None
    head = [0, chunk, 0, 0, len(numbers), len(numbers[0])]
    return (ctypes.c_int64 * (len(head) + sum(map(len, numbers))))(*head, *itertools.chain.from_iterable(numbers))


def _follow(run: BoundLaunch, *_memory: object) -> None:
    """The life of a thread, which keeps its memory."""
    run(1)
