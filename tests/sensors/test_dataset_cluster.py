"""Data sets by the workers of a Dask scheduler: the same files, though a worker is killed; misuse is one line."""

from __future__ import annotations

import os
import pathlib
import signal
import threading

import pytest

from tests.sensors.test_dataset import SCENE
from tests.support.waiting import wait
from vinesim.cli.dataset import run
from vinesim.core.errors import UsageError
from vinesim.sensors.export import dataset

IMAGES = 11  # of three vineyards


def options(folder: pathlib.Path, out: str, **more: object) -> dict:
    scene = folder / "vine.toml"
    scene.write_text(SCENE)
    given = {
        "images": IMAGES,
        "out": folder / out,
        "scene": str(scene),
        "seed": 5,
        "camera": "pinhole",
        "size": "80x60",
        "workers": None,
        "actors": 0.0,
        "device": "cpu",
    }
    return given | more


def files(folder: pathlib.Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.long
def test_dask_workers_make_the_same_files_though_one_is_killed(tmp_path, capsys) -> None:
    """Of two workers on the loopback one that is at work is killed after the first image."""
    distributed = pytest.importorskip("distributed", reason="Dask is an extra (dask)")
    assert run(**options(tmp_path, "local", workers=1)) == 0
    out = tmp_path / "cluster"
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        local_directory=str(tmp_path / "dask"),
    )
    with cluster, distributed.Client(cluster) as watcher:
        process: dict[str, int] = watcher.run(os.getpid)
        killed: list[int] = []

        def kill_one() -> None:
            wait(lambda: list((out / "records").glob("*.json")), "the first image")
            busy = [address for address, tasks in watcher.processing().items() if tasks]
            killed.append(process[(busy or list(process))[0]])
            os.kill(killed[0], signal.SIGKILL)

        killer = threading.Thread(target=kill_one)
        killer.start()
        assert run(**options(tmp_path, "cluster", scheduler=cluster.scheduler_address)) == 0
        killer.join()
    assert killed
    assert f"{IMAGES} images" in capsys.readouterr().out
    assert files(out) == files(tmp_path / "local")
    assert not dataset.missing_images(out, IMAGES)


def test_misuse_of_a_scheduler_is_one_line(tmp_path) -> None:
    with pytest.raises(UsageError, match="--scheduler has workers of its own; leave one of the options out"):
        run(**options(tmp_path, "set", workers=2, scheduler="tcp://127.0.0.1:8786"))
    pytest.importorskip("distributed", reason="Dask is an extra (dask)")
    with pytest.raises(UsageError, match=r"--scheduler is 'nowhere'.*give the address that dask scheduler prints"):
        run(**options(tmp_path, "set", scheduler="nowhere"))
