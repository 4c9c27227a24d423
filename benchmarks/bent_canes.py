"""Fits of canes that are bent by 1 to 1.5 rad: once with their shape from a point cloud, once as if they were straight.
Prints one JSON object a line.

    python benchmarks/bent_canes.py

The specimens are the canes of ``vinesim bench tune`` with an even bow. The tracks last 2 s at 30 pictures a second,
with 2 mm of noise; the clouds have 4,000 points on the bark, with 1 mm of noise; start values are up to five times off.
"""

from __future__ import annotations

import json
import math
import sys

import msgspec
import numpy as np

from vinesim.bench.tuning_cases import bench_cane
from vinesim.scene.plant_parameters import Specimen
from vinesim.tune import Experiment, measure, tune, with_cloud
from vinesim.tune.candidates import COLUMNS, Candidates

BOWS = ((1.1, -0.8), (-0.9, 0.5), (0.3, 1.5))
ANGLES = (0.0, 45.0, 90.0)
"""Directions [deg] in which the canes are pulled before their release."""


def scan(cane: Specimen, rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Returns ``count`` points [n, 3] m on the bark of a cane that hangs at rest, as a scanner would measure them."""
    marked = msgspec.structs.replace(cane, markers={f"p{i}": 0.01 * i for i in range(1, 101)})
    row = np.zeros((1, len(COLUMNS)))
    row[0, 3:5] = cane.bow
    axis = np.concatenate([np.zeros((1, 3)), Candidates(marked, tuple(marked.markers), dt=0.01).shape(row)[0]])
    at = rng.uniform(0.0, 100.0, count)
    side = rng.normal(size=(count, 3))
    side *= 0.004 / np.linalg.norm(side, axis=1, keepdims=True)
    line = np.stack([np.interp(at, np.arange(101), axis[:, i]) for i in range(3)], -1)
    return line + side + rng.normal(0.0, 1e-3, (count, 3))


def main() -> None:
    for seed, (bow, angle) in enumerate((bow, angle) for bow in BOWS for angle in ANGLES):
        rng = np.random.default_rng(seed)
        modulus = 1e9 * math.exp(rng.uniform(math.log(2.0), math.log(9.0)))
        damping = rng.uniform(0.001, 0.008)
        truth = msgspec.structs.replace(bench_cane(modulus, damping, 64), bow=bow)
        off = np.exp(rng.uniform(-math.log(5.0), math.log(5.0), 2))
        guess = bench_cane(modulus * off[0], damping * off[1])
        track = measure(truth, Experiment(duration=2.0, angle=angle, seed=seed))
        shaped = tune(with_cloud(guess, scan(truth, rng)), track)
        straight = tune(guess, track)
        row: dict[str, object] = {"bench": "bent_canes", "bow_rad": bow, "pull_deg": angle}
        for name, fit in (("cloud", shaped), ("straight", straight)):
            row[f"{name}_ok"] = fit.ok
            row[f"{name}_modulus_error"] = fit.estimate("modulus").value / modulus - 1.0
            row[f"{name}_damping_error"] = fit.estimate("damping").value / damping - 1.0
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
