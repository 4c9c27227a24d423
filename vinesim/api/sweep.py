"""The same function for many seeds or parameters, on all cores; what a killed process had is done again.

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

log = logging.getLogger(__name__)

MAX_LOSSES = 3
"""How often the worker of one parameter may die before the parameter is taken for what kills it."""

P = TypeVar("P")
R = TypeVar("R")


class WorkerLost(RuntimeError):
    """A worker died again and again with the same parameter; the text says which one."""

    exit_code = 5


def sweep(
    function: Callable[[P], R], parameters: Iterable[P], *, workers: int | None = None, executor: Any = None
) -> list[R]:
    """The results of ``function`` for all parameters, in their order.

    Args:
        function: of one parameter; a function of a module, since processes import it by its name. What it raises ends
            the sweep.
        parameters: seeds, or anything that can be pickled.
        workers: processes on this machine; one for each core unless given.
        executor: takes the tasks instead: anything with ``submit`` as :class:`concurrent.futures.Executor` has it, a
            cluster's for example. Whether it repeats what a killed worker had is its own matter; Dask's does.

    Raises:
        WorkerLost: a worker died :data:`MAX_LOSSES` times with the same parameter.
    """
    tasks = list(parameters)
    if executor is not None:
        futures = [executor.submit(function, task) for task in tasks]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:  # if one has raised, the others need not begin
                future.cancel()
    if workers is not None and workers < 1:
        raise UsageError(f"workers is {workers}; give 1 or more")
    number = workers or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    results: dict[int, R] = {}
    lost = [0] * len(tasks)
    while missing := [index for index in range(len(tasks)) if index not in results]:
        first = missing[0]
        # Of the tasks that were at work any may have killed its process: after two losses the first one goes alone.
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
    """Run the chosen tasks in processes until all are done, or a process dies: False. ``results`` has what is done."""
    # A fresh interpreter for each process: Warp and Zenoh do not survive a fork.
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
            for future in futures:  # if one has raised, the others need not begin
                future.cancel()
    return True
