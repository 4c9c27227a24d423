"""``vinesim bench start``: the time that a user waits for the first step and the first picture, with warm caches.

Each case runs in fresh processes, three times after a run that fills the caches; the median of the wall time counts.
Compiling all kernels on a machine without cached kernels takes half a minute and is not measured here.
"""

from __future__ import annotations

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from vinesim.scene.values import Measurement

RUNS = 3
SCENES = ("demo", "tendone")
BUDGETS = {
    "demo: generate": 0.3,
    "tendone: generate": 2.0,
    "vinesim render demo": 2.0,
    "each further viewpoint of --path": 0.25,
    "vinesim client: start, first picture, one step, end": 3.0,
}
"""Budget of each case [s]."""
VIEWPOINTS = 9

_PARTS = """
import json, sys, time
start, parts = time.perf_counter(), {}

def lap(part):
    global start
    now = time.perf_counter()
    parts[part] = now - start
    start = now

import vinesim.sensors.scheduler
lap("import of the sensors")
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
scene = load_scene(sys.argv[1])
start = time.perf_counter()
model = generate(scene)
lap("generate")
from vinesim.sensors.primitives.scene_primitives import Primitives
primitives = Primitives(model)
lap("primitives")
import numpy as np
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
spec = CameraSpec.load("d435")
camera = Camera(spec, spec.info("optical"), "camera", scene.sun.direction, quality="fast")
camera.render(primitives, look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.7])), 0.0)
lap("first frame, kernels loaded")
print(json.dumps(parts))
"""


def start_measurements() -> Iterator[Measurement]:
    """Measure all cases, each compared with its budget if it has one."""
    for scene in SCENES:
        runs = [json.loads(_run("-c", _PARTS, scene)[1]) for _ in range(RUNS + 1)][1:]
        for part in runs[0]:
            yield _row(f"{scene}: {part}", statistics.median(run[part] for run in runs))
    with tempfile.TemporaryDirectory() as folder:
        yield from _render_rows(pathlib.Path(folder))
    client = ("client", "--role", "robot", "--scene", "demo", "--seconds", "0.01", "--no-ros", "--status", "none")
    yield _row("vinesim client: start, first picture, one step, end", _median_wall(*client))


def _render_rows(folder: pathlib.Path) -> Iterator[Measurement]:
    path = folder / "path.csv"
    rows = [f"{0.4 + 0.1 * i:.1f},1.2,1.3,3,1,1.7" for i in range(VIEWPOINTS)]
    walls = []
    for count in (1, VIEWPOINTS):
        path.write_text("x,y,z,look_x,look_y,look_z\n" + "\n".join(rows[:count]))
        walls.append(_median_wall("render", "demo", "--path", str(path), "--out", str(folder / "out")))
    yield _row("vinesim render demo", walls[0])
    yield _row("each further viewpoint of --path", (walls[1] - walls[0]) / (VIEWPOINTS - 1))


def _median_wall(*command: str) -> float:
    """Returns the median wall time [s] of a command of vinesim."""
    return statistics.median([_run("-m", "vinesim", *command)[0] for _ in range(RUNS + 1)][1:])


def _run(*arguments: str) -> tuple[float, str]:
    """Run a Python process that may cache its compiled modules, as a user's does. Returns its wall time [s] and its
    output."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    output = subprocess.run(
        [sys.executable, *arguments], env=environment, check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    return time.perf_counter() - start, output


def _row(case: str, seconds: float) -> Measurement:
    budget = BUDGETS.get(case)
    if budget is None:
        return Measurement("start", case, seconds, "s")
    return Measurement("start", case, seconds, "s", "budget", budget, budget / max(seconds, 1e-9))
