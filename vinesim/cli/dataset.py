"""``vinesim dataset``: many random pictures with their truth, by several processes; killed, it goes on where it was."""

from __future__ import annotations

import multiprocessing
import os
import pathlib
import signal
from multiprocessing.connection import Connection, wait

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vinesim.cli.render import parse_size
from vinesim.client.composition.randomizer import SceneRandomizer
from vinesim.errors import UsageError
from vinesim.scene.spec import load_scene
from vinesim.sensors.export import dataset
from vinesim.sensors.export.dataset import DatasetError, DatasetPlan
from vinesim.sensors.raster import renderers

Share = tuple[multiprocessing.process.BaseProcess, Connection]


def run(
    *,
    images: int,
    out: pathlib.Path,
    scene: str,
    seed: int,
    camera: str,
    size: str | None,
    workers: int | None,
    actors: float,
    renderer: str,
) -> int:
    """Draw what is not there yet, then gather the annotations of all images."""
    if seed < 0:
        raise UsageError(f"--seed is {seed}: give 0 or more")
    if not 0.0 <= actors <= 1.0:
        raise UsageError(f"--actors is {actors:g}: give a share of the images, 0 to 1")
    life = SceneRandomizer(actors) if actors > 0.0 else None
    plan = DatasetPlan(
        load_scene(scene),
        seed,
        camera,
        None if size is None else parse_size(size),
        life,
        renderers.check_renderer(renderer),
    )
    columns = TextColumn("images"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    crew: list[Share] = []
    try:
        dataset.prepare_folder(plan, out)
        wanted = dataset.missing_images(out, images)
        shares = _shares(wanted, workers or max((os.cpu_count() or 2) // 2, 1))
        crew += [_start(plan, out, share) for share in shares]
        with Progress(*columns) as progress:
            task = progress.add_task("images", total=images, completed=images - len(wanted))
            _follow(crew, lambda: progress.advance(task))
    except KeyboardInterrupt:
        _end(crew, out)
        done = images - len(dataset.missing_images(out, images))
        print(f"stopped with {done} of {images} images in {out}; the same command goes on")
        return 130
    finally:
        _end(crew, out)
    print(f"{dataset.finish(out, images)}: {images} images, {len(wanted)} of them new")
    return 0


def _shares(wanted: list[int], workers: int) -> list[list[int]]:
    """Whole vineyards for each worker, as even as it goes: growing one costs more than a picture of it."""
    vineyards: dict[int, list[int]] = {}
    for image in wanted:
        vineyards.setdefault(image // dataset.IMAGES_PER_VINEYARD, []).append(image)
    shares: list[list[int]] = [[] for _ in range(workers)]
    for group in vineyards.values():
        min(shares, key=len).extend(group)
    return [share for share in shares if share]


def _start(plan: DatasetPlan, out: pathlib.Path, share: list[int]) -> Share:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(plan, out, share, there), daemon=True)
    process.start()
    there.close()
    return process, here


def _work(plan: DatasetPlan, out: pathlib.Path, share: list[int], tell: Connection) -> None:
    """In a process of its own: draw, and say so; nobody listens any more: stop."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its crew
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        for image in dataset.render_images(plan, out, share):
            tell.send(image)
    except BrokenPipeError:
        return
    except DatasetError as bad:
        tell.send(str(bad))


def _follow(crew: list[Share], advance) -> None:
    """Until all are done; what stopped one is raised."""
    working = {tell: process for process, tell in crew}
    while working:
        for tell in wait(list(working)):
            assert isinstance(tell, Connection)
            try:
                said = tell.recv()
            except EOFError:
                process = working.pop(tell)
                process.join()
                if process.exitcode:
                    raise DatasetError(
                        f"a worker ended with code {process.exitcode}; what is done is kept, the same command goes on"
                    ) from None
                continue
            if isinstance(said, str):
                raise DatasetError(said)
            advance()


def _end(crew: list[Share], out: pathlib.Path) -> None:
    """Stop whoever still works, and take away what that leaves half-written."""
    for process, _ in crew:
        process.terminate()
    for process, tell in crew:
        process.join()
        tell.close()
    if crew:
        dataset.remove_partial_files(out)
    crew.clear()
