"""Files that the reader of a page brings along, under the names that the pages use."""

from __future__ import annotations

import pathlib
import re
import shutil
import subprocess
import sys
from collections.abc import Callable

import msgspec
import numpy as np

from tests.support.page_blocks import ROOT
from tests.support.recorded_pick import record_a_pick
from tests.support.tuning import hanging, scan
from vinesim.cli.certs import new
from vinesim.tune import Experiment, load_specimen, measure

CANE = ROOT / "examples/cane.toml"


def _track(path: pathlib.Path) -> None:
    measure(load_specimen(CANE), Experiment(duration=2.0)).write(path)


def _scan(path: pathlib.Path) -> None:
    np.savetxt(path, scan(hanging(load_specimen(CANE))), "%.5f")


def _filmed(path: pathlib.Path) -> None:
    """Pictures of a swing with two markers, as a ROS recording."""
    from tests.tune import test_track_command as filmed

    specimen = msgspec.structs.replace(load_specimen(CANE), segments=64, markers={"middle": 0.5})
    swing = measure(specimen, Experiment(duration=2.0, markers=("tip", "middle")), exact=True)
    pictures = [filmed.picture(places) for places in swing.position]
    filmed.write_bag(path, swing.time, pictures)


def _filmed_cane(path: pathlib.Path) -> None:
    """Pictures of a cane without markers, as a ROS recording."""
    from tests.tune import test_cane_track as filmed
    from tests.tune.test_track_command import write_bag

    time = np.arange(24) / 30.0
    pictures = [filmed.picture(t, 0.25 * np.cos(9.0 * t / time[-1])) for t in time]
    write_bag(path, time, [(one.rgb, one.depth) for one in pictures])


def _tour(path: pathlib.Path) -> None:
    """Pictures along a path."""
    command = ["vinesim", "render", "demo", "--path", str(ROOT / "examples/tour.csv"), "--size", "160x120"]
    subprocess.run([sys.executable, "-m", *command, "--out", str(path)], check=True, capture_output=True)


def _certificate(folder: pathlib.Path) -> None:
    """What an administrator hands to an actor of that name."""
    folder.mkdir()
    for name in ("ca.pem", f"{folder.name}.pem", f"{folder.name}.key"):
        shutil.copy(folder.parent / "certs" / name, folder)


MAKERS: dict[str, Callable[[pathlib.Path], object]] = {
    "pull.csv": _track,
    "filmed.csv": _track,
    "scan.xyz": _scan,
    "pull.mcap": _filmed,
    "cane.mcap": _filmed_cane,
    "tour": _tour,
    "vine.ply": lambda path: shutil.copy(ROOT / "examples/plants/vine.ply", path),
    "run.mcap": record_a_pick,
    "vine.mtg": lambda path: shutil.copy(ROOT / "examples/plants/vine.mtg", path),
    "my.urdf": lambda path: shutil.copy(ROOT / "data/robots/vinebot.urdf", path),
    "certs": lambda path: new("server", path, "robot", [], None),
    "picker": _certificate,
}
"""Functions that make such a file, by its name."""

WRITTEN = re.compile(r"(?:--out|--dir|(?<!ros )\brecord|ros record)[ =](\S+)")
"""A file that a command writes."""


def bring(text: str, folder: pathlib.Path) -> None:
    """Make the files of :data:`MAKERS` that a command, or a block of Python, reads from ``folder`` and that are not
    there yet."""
    written = set(WRITTEN.findall(text))
    for name in MAKERS:
        pattern = r"--tls picker/" if name == "picker" else rf"(?<![\w./-]){re.escape(name)}(?![\w.-])"
        if re.search(pattern, text) and name not in written and not (folder / name).exists():
            MAKERS[name](folder / name)
