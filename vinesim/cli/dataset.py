"""``vinesim dataset``: many random pictures with their ground truth, rendered by several processes, resumable."""

from __future__ import annotations

import collections
import contextlib
import importlib.util
import multiprocessing
import os
import pathlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vinesim.cli.render import parse_sensors, parse_size
from vinesim.client.composition.domain_randomizer import SceneRandomizer
from vinesim.core.errors import UsageError, WriteError
from vinesim.core.progress import ProgressLine
from vinesim.kernels.compilation import SENSOR_PACKAGES, compile_kernels
from vinesim.plants.device_buffers import find_device
from vinesim.sensors.export import annotations, dataset
from vinesim.sensors.export.dataset import DatasetPlan
from vinesim.sensors.export.files import remove_partial_files
from vinesim.sensors.export.mix import MixError, load_mix
from vinesim.sensors.spec_file import SensorError

CONNECT_TIMEOUT = 10.0
"""Time limit for connecting to a scheduler [s]."""
_RENDERING = threading.Lock()


class DaskMissing(RuntimeError):
    """The extra ``dask`` is not installed."""

    exit_code = 3


class WorkerDied(RuntimeError):
    """A worker was killed or crashed before all its images were written; the text says how to continue."""

    exit_code = 5


Worker = tuple[BaseProcess, Any]
"""A worker process, and the end of the pipe on which it reports."""


def run(
    *,
    images: int,
    out: pathlib.Path,
    seed: int,
    scene: str | None = None,
    mix: str | None = None,
    camera: str | None = None,
    size: str | None = None,
    workers: int | None = None,
    actors: float | None = None,
    device: str = "cpu",
    scheduler: str | None = None,
    sensor: Sequence[str] | None = None,
    segmentation: str = "polygons",
    yolo: str = "detect",
    negatives: float | None = None,
    semantic: bool = False,
    colour: str = "camera",
    sequence: int | None = None,
) -> int:
    """Render the missing images, then gather the annotations of all images. Returns the exit code."""
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    if scheduler is not None and workers is not None:
        raise UsageError(
            f"--workers is {workers}, but --scheduler has workers of its own; leave one of the options out"
        )
    for option, share in (("--actors", actors), ("--negatives", negatives)):
        if share is not None and not 0.0 <= share <= 1.0:
            raise UsageError(f"{option} is {share:g}: give a share of the images, 0 to 1")
    if sequence is not None and negatives is not None:
        raise UsageError(f"--negatives is {negatives:g}, but sequences follow bunches; leave one of the options out")
    for option, given, known in (
        ("--segmentation", segmentation, annotations.SEGMENTATIONS),
        ("--yolo", yolo, annotations.YOLO_TASKS),
    ):
        if given not in known:
            raise UsageError(f"{option} is {given!r}: give {', '.join(known[:-1])} or {known[-1]}")
    find_device(device)
    loaded = load_mix(mix or ("default" if scene is None else "around"), scene, camera)
    share = loaded.table.actors if actors is None else actors
    pixels = None if size is None else parse_size(size)
    without = loaded.table.negatives if negatives is None else negatives
    plan = DatasetPlan(
        loaded,
        seed,
        pixels,
        SceneRandomizer(share) if share > 0.0 or sequence is not None else None,
        device,
        parse_sensors(sensor or (), pixels),
        0.0 if sequence is not None else without,
        semantic,
        colour,
        sequence or 0,
    )
    running: list[Worker] = []
    try:
        dataset.prepare_folder(plan, out, images)
        compile_kernels(SENSOR_PACKAGES, device)
        wanted = dataset.missing_images(out, images)
        if scheduler is not None:
            with _progress(images, images - len(wanted)) as advance:
                _render_on_cluster(scheduler, plan, out, wanted, advance)
            return _finish(plan, out, images, len(wanted), segmentation, yolo)
        # With a GPU, the cores only generate vineyards, write files and compute the truth; all workers share the GPU.
        cores = os.cpu_count() or 2
        count = workers or max(cores // 2 if device == "cpu" else cores, 1)
        shares = _shares(wanted, count, plan.images_per_vineyard)
        running += [_start_worker(plan, out, share) for share in shares]
        with _progress(images, images - len(wanted)) as advance:
            _wait_for(running, lambda: advance(1))
    except KeyboardInterrupt:
        _stop_workers(running, out)
        done = images - len(dataset.missing_images(out, images))
        print(f"stopped with {done} of {images} images in {out}; run the same command to continue")
        return 130
    finally:
        _stop_workers(running, out)
    return _finish(plan, out, images, len(wanted), segmentation, yolo)


@contextlib.contextmanager
def _progress(images: int, done: int) -> Iterator[Callable[[int], None]]:
    """Context manager that shows how many of ``images`` are done: a bar on a terminal, otherwise a line every few
    seconds. Yields a function that is called with the number of new images."""
    if sys.stdout.isatty():
        with Progress(TextColumn("images"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as bar:
            task = bar.add_task("images", total=images, completed=done)
            yield lambda new: bar.advance(task, new)
        return
    with ProgressLine() as line:

        def show(new: int) -> None:
            nonlocal done
            done += new
            line.show(f"{done} of {images} images are there")

        yield show


def _finish(plan: DatasetPlan, out: pathlib.Path, images: int, new: int, segmentation: str, yolo: str) -> int:
    """Write the files that trainers read, and print a summary. Returns the exit code."""
    each = plan.images_per_vineyard
    splits = collections.Counter(dataset.split_of(image, each) for image in range(images))
    parts = ", ".join(f"{splits[split]} {split}" for split in dataset.SPLITS)
    print(f"{dataset.finish(out, images, segmentation, yolo)}: {images} images ({parts}), {new} of them new")
    missing = [split for split in dataset.SPLITS if not splits[split]]
    if missing:
        needs = " and ".join(f"--images {dataset.split_needs(split, each)} for {split}" for split in missing)
        print(f"data.yaml names no {' and no '.join(missing)}: splits are by vineyard; give at least {needs}")
    return 0


def _by_vineyard(wanted: list[int], each: int) -> list[list[int]]:
    """Returns the numbers of images, grouped by vineyard, of which each has ``each`` images."""
    vineyards: dict[int, list[int]] = {}
    for image in wanted:
        vineyards.setdefault(image // each, []).append(image)
    return list(vineyards.values())


def _shares(wanted: list[int], workers: int, each: int) -> list[list[int]]:
    """Returns the images of each worker, in whole vineyards of ``each`` images: a vineyard is generated once."""
    shares: list[list[int]] = [[] for _ in range(workers)]
    for group in _by_vineyard(wanted, each):
        min(shares, key=len).extend(group)
    return [share for share in shares if share]


def _render_on_cluster(
    scheduler: str, plan: DatasetPlan, out: pathlib.Path, wanted: list[int], advance: Callable[[int], None]
) -> None:
    """Render images on the workers of a Dask scheduler, one vineyard in each task. ``advance`` is called with the
    number of new images after each task.

    The images of a killed worker go to another worker. All machines must have the folder ``out`` at the same path.
    """
    if importlib.util.find_spec("distributed") is None:
        raise DaskMissing("Dask is not installed; run: pip install 'vinesim[dask]'")
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=CONNECT_TIMEOUT)
    except (OSError, ValueError) as bad:
        raise UsageError(
            f"--scheduler is {scheduler!r}: {str(bad).splitlines()[0]}; give the address that dask scheduler prints"
        ) from None
    with client:
        futures = [
            client.submit(_render_share, plan, out.absolute(), share, pure=False)
            for share in _by_vineyard(wanted, plan.images_per_vineyard)
        ]
        try:
            for future in distributed.as_completed(futures):
                advance(future.result())
        finally:
            client.cancel(futures)
    if missing := dataset.missing_images(out, wanted[-1] + 1 if wanted else 0):
        raise WriteError(
            f"{len(missing)} images that workers wrote are not in {out}; give a folder that all machines share"
        )


def _render_share(plan: DatasetPlan, out: pathlib.Path, share: list[int]) -> int:
    """Task of a cluster's worker: render images and return their number. A process renders one share at a time,
    whatever its number of threads."""
    with _RENDERING:
        return sum(1 for _ in dataset.render_images(plan, out, share))


def _start_worker(plan: DatasetPlan, out: pathlib.Path, share: list[int]) -> Worker:
    context = multiprocessing.get_context("spawn")
    parent_end, worker_end = context.Pipe(duplex=False)
    process = context.Process(target=_run_worker, args=(plan, out, share, worker_end), daemon=True)
    process.start()
    worker_end.close()
    return process, parent_end


def _run_worker(plan: DatasetPlan, out: pathlib.Path, share: list[int], pipe: Connection) -> None:
    """Main function of a worker process: render images and report each. It ends when the parent process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        for image in dataset.render_images(plan, out, share):
            pipe.send(image)
    except BrokenPipeError:
        return
    except (SensorError, MixError, WriteError) as bad:
        pipe.send(bad)


def _wait_for(workers: list[Worker], advance: Callable[[], None]) -> None:
    """Call ``advance`` after each image until all workers are done. Raises the exception that stopped a worker."""
    working = {pipe: process for process, pipe in workers}
    while working:
        for pipe in wait(list(working)):
            assert isinstance(pipe, Connection)
            try:
                message = pipe.recv()
            except EOFError:
                process = working.pop(pipe)
                process.join()
                if process.exitcode:
                    raise WorkerDied(
                        f"a worker {_how_it_ended(process.exitcode)}; finished images are kept; run the same "
                        "command to continue"
                    ) from None
                continue
            if isinstance(message, Exception):
                raise message
            advance()


def _how_it_ended(code: int) -> str:
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"


def _stop_workers(workers: list[Worker], out: pathlib.Path) -> None:
    """Stop workers that still run, and delete files that they leave half-written."""
    for process, _ in workers:
        process.terminate()
    for process, pipe in workers:
        process.join()
        pipe.close()
    if workers:
        remove_partial_files(out)
    workers.clear()
