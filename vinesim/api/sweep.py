"""Maps a function over many seeds or parameters on all cores; tasks of killed processes are repeated.

def tip(seed):
    simulation = vinesim.Simulation(vinesim.CaneBuilder(tip_mass=0.01 * seed))
    simulation.step(200)
    return simulation.tip()

for seed, result in zip(range(8), sweep(tip, range(8))):
    print(seed, result)
"""

from __future__ import annotations

import concurrent.futures
import logging
import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from vinesim.core.errors import UsageError
from vinesim.core.numbers import is_whole

log = logging.getLogger(__name__)

MAX_LOSSES = 3
"""Number of deaths of workers with the same parameter after which the parameter is taken to be the cause."""

P = TypeVar("P")
R = TypeVar("R")


class WorkerLost(RuntimeError):
    """A worker died repeatedly with the same parameter; the message names the parameter."""

    exit_code = 5


def sweep(
    function: Callable[[P], R], parameters: Iterable[P], *, workers: int | None = None, executor: Any = None
) -> list[R]:
    """Call ``function`` with each parameter, in several processes. Returns the results in the order of the parameters.

    Args:
        function: function of one parameter. It must be defined in a module, because processes import it by name. An
            exception from it ends the sweep.
        parameters: seeds, or other values that can be pickled.
        workers: number of processes on this machine; one for each core unless given.
        executor: executor that runs the tasks instead of processes on this machine: an object with the method
            ``submit`` of :class:`concurrent.futures.Executor`, such as a cluster. Whether tasks of killed workers are
            repeated depends on the executor; Dask repeats them.

    Raises:
        WorkerLost: a worker died :data:`MAX_LOSSES` times with the same parameter.
    """
    tasks = list(parameters)
    if executor is not None:
        futures = [executor.submit(function, task) for task in tasks]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:  # if a task has raised an exception, later tasks need not begin
                future.cancel()
    if workers is not None and not (is_whole(workers) and workers >= 1):
        raise UsageError(f"workers is {workers}; give a whole number of 1 or more")
    number = workers or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    results: dict[int, R] = {}
    lost = [0] * len(tasks)
    while missing := [index for index in range(len(tasks)) if index not in results]:
        first = missing[0]
        # any of the running tasks may have killed its process, so after two losses the first one runs alone
        chosen = [first] if lost[first] >= MAX_LOSSES - 1 else missing
        if _all_done(function, tasks, chosen, number, results):
            continue
        if first not in results:
            lost[first] += 1
            if lost[first] >= MAX_LOSSES:
                raise WorkerLost(f"a process died {lost[first]} times with the parameter {tasks[first]!r}")
        log.warning("a process of the sweep died; %d of %d tasks are done", len(results), len(tasks))
    return [results[index] for index in range(len(tasks))]


def _all_done(
    function: Callable[[P], R], tasks: list[P], chosen: list[int], workers: int, results: dict[int, R]
) -> bool:
    """Run the ``chosen`` tasks in processes and add to ``results``. Returns False if a process died before the end."""
    # a fresh interpreter for each process, because Warp and Zenoh do not survive a fork
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(min(workers, len(chosen)), mp_context=context) as pool:
        futures = {pool.submit(function, tasks[index]): index for index in chosen}
        try:
            for future in concurrent.futures.as_completed(futures):
                results[futures[future]] = future.result()
        except BrokenProcessPool:
            for future, index in futures.items():
                if future.done() and future.exception() is None:
                    results[index] = future.result()
            return False
        finally:
            for future in futures:  # if a task has raised an exception, later tasks need not begin
                future.cancel()
    return True
