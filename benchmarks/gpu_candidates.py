"""Candidates of a fit on a GPU: the time for which 10,000 released canes are simulated for three seconds. Prints one
JSON object a line.

    python benchmarks/gpu_candidates.py --reference cpu.npy    # on a machine whose Warp has CPU kernels
    python benchmarks/gpu_candidates.py --compare cpu.npy      # on one with an NVIDIA GPU

The specimen is the cane of ``vinesim bench tune``. Stiffness, damping and pull are drawn at random; markers are read 30
times a second. The first run includes making the trees and loading the kernels.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time

import numpy as np
import warp as wp

from vinesim.bench.tuning_cases import bench_cane
from vinesim.tune.candidates import Candidates

SECONDS = 3.0
RATE = 30.0
DT = 0.01
CHECKED = 64


def drawn(count: int) -> np.ndarray:
    """Returns trial numbers [count, 7] of candidates around one cane that is pulled sideways."""
    rng = np.random.default_rng(1)
    candidates = np.zeros((count, 7))
    candidates[:, :2] = rng.uniform(-1.0, 1.0, (count, 2))
    candidates[:, 5] = rng.uniform(0.5, 1.5, count)
    return candidates


def say(row: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("--device", default="cuda")
    ask.add_argument("--count", type=int, default=10_000)
    ask.add_argument("--reference", help="only write what a CPU computes of the first candidates to this file")
    ask.add_argument("--compare", help="compare with such a file")
    given = ask.parse_args()
    specimen = bench_cane(5e9, 0.002)
    ticks = np.unique(np.round(np.arange(0.0, SECONDS, 1.0 / RATE) / DT).astype(int))
    candidates = drawn(given.count)
    if given.reference:
        np.save(given.reference, Candidates(specimen, dt=DT).run(candidates[:CHECKED], ticks).position)
        return
    about = {"bench": "gpu_candidates", "device": "cpu", "warp": wp.config.version}
    if given.device != "cpu":
        query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
        about["device"], about["driver"] = answer.splitlines()[0].split(", ")
    runner = Candidates(specimen, dt=DT, device=given.device)
    for run in ("first", "second", "third"):
        begin = time.perf_counter()
        motion = runner.run(candidates, ticks)
        case = f"{given.count} candidates of {SECONDS:g} s, {runner.size} bodies each, {len(ticks)} samples: {run} run"
        say(about | {"case": case, "value": time.perf_counter() - begin, "unit": "s"})
    if given.compare:
        apart = np.abs(motion.position[:CHECKED] - np.load(given.compare)).max()
        case = f"largest distance of markers of {CHECKED} from the CPU's"
        say(about | {"case": case, "value": 1e3 * float(apart), "unit": "mm"})


if __name__ == "__main__":
    main()
