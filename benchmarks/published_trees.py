"""Reproduces pull-and-release tests of scanned trees: the frequencies at which six trees swayed, and vinesim's.

    git clone https://github.com/TobyDJackson/WindAndTrees_FEM
    git clone https://github.com/TobyDJackson/WindAndTrees_NaturalFrequencies
    python benchmarks/published_trees.py WindAndTrees_FEM WindAndTrees_NaturalFrequencies

The trees stand in Wytham Woods: Jackson et al. 2019, Agricultural and Forest Meteorology 265:137, and J. R. Soc.
Interface 16:20190116. The data contain, for each tree, a model of cylinders from a laser scan
(``QSMs/cyl_data_TfN_*.mat``) and the strain of the trunk at 4 Hz after a rope was let go
(``PullAndRelease/TN_PK_season.txt``). Nothing is fitted: modulus and density are the values that the authors list for
ash; their values for other species give frequencies within 2.1 % of these.
"""

from __future__ import annotations

import argparse
import pathlib
import sys

import numpy as np

import vinesim
from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.physics_parameters import PhysicsParameters

WOOD = RodMaterial(modulus=9.5e9, density=801.0, damping=0.04)
"""Ash, NaturalFrequencies_FieldData.xlsx: 9500 MN/m^2, 801 kg/m^3. Damping GUESSED: a ratio of 0.025 at 0.2 Hz."""
TREES = (3, 12, 14, 16, 18, 20)
SAMPLE_RATE = 4.0
"""Sample rate of the strain gauges [Hz]."""
LEAST_FREQUENCY = 0.1
"""Lowest frequency that counts as sway [Hz]: slower motion is drift of the gauges, see :func:`main_frequency`."""
PULL = 500.0
"""Horizontal pull on the trunk at half the tree's height [N]."""
SWAY_DURATION = 60.0
"""Simulated time after the release [s]."""


def tree_of_cylinders(cylinders: np.ndarray, wood: RodMaterial) -> TreeBuilder:
    """Returns a tree with one body for each cylinder, in equilibrium in the shape of the cylinders.

    Args:
        cylinders: [k, 9 or more] m, radius, length, start (x, y, z), axis (x, y, z), number of the parent from 1 on
            (0: none); parents before children.
        wood: material of all cylinders.
    """
    radius = cylinders[:, 0]
    length = cylinders[:, 1]
    start = cylinders[:, 2:5]
    axis = cylinders[:, 5:8]
    turn = frames.from_x_axis(axis)
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    for k, parent in enumerate(cylinders[:, 8].astype(int) - 1):
        offset = np.zeros(3)
        rest = turn[k]
        if parent >= 0:
            back = frames.conjugate(turn[parent])
            offset = frames.rotate(back, start[k] - start[parent])
            rest = frames.multiply(back, turn[k])
        tree.add_rod(int(parent), length[k], (radius[k], radius[k]), wood, 1, offset=offset, rest=rest)
    tree.solve_rest_pose()
    return tree


def sway(cylinders: np.ndarray, wood: RodMaterial, *, pull: float = PULL) -> np.ndarray:
    """Simulate a pull of ``pull`` [N] at half the tree's height and its release. Returns the direction of the trunk's
    second piece at 100 Hz, x and y of its unit vector [step, 2]."""
    parent = cylinders[:, 8].astype(int) - 1
    height = cylinders[:, 4] - cylinders[0, 4]
    stem = [0]
    while (children := np.flatnonzero(parent == stem[-1])).size:
        stem.append(int(children[np.argmax(cylinders[children, 0])]))
    middle = stem[int(np.searchsorted(height[stem], 0.5 * height.max()))]
    few = PhysicsParameters(contact_capacity=1, max_contacts_per_tree=1)
    simulation = vinesim.Simulation(tree_of_cylinders(cylinders, wood), parameters=few, sleep=False)
    for step in range(600):
        simulation.apply_wrench(middle, (pull * min(1.0, step / 300), 0.0, 0.0))
        simulation.step()
    path = np.empty((round(SWAY_DURATION / simulation.dt), 7))
    for pose in path:
        simulation.step()
        pose[:] = simulation.body_pose(stem[1])
    return frames.rotate(path[:, 3:], np.array([1.0, 0.0, 0.0]))[:, :2]


def main_frequency(signal: np.ndarray, rate: float) -> float:
    """Returns the frequency [Hz] of the highest peak of the spectrum of ``signal`` [k] at ``rate`` [Hz], without
    drift."""
    window = round(10.0 * rate) // 2
    padded = np.pad(signal, window, "edge")
    drift = np.convolve(padded, np.full(2 * window + 1, 1.0 / (2 * window + 1)), "valid")
    count = 1 << 17
    spectrum = np.abs(np.fft.rfft((signal - drift) * np.hanning(len(signal)), count))
    frequency = np.fft.rfftfreq(count, 1.0 / rate)
    return float(frequency[np.argmax(np.where(frequency > LEAST_FREQUENCY, spectrum, 0.0))])


def measured(folder: pathlib.Path, number: int) -> tuple[str, list[float]]:
    """Returns the season and the measured frequencies [Hz] of all releases of a tree. Releases without leaves are
    preferred."""
    files = sorted(folder.glob(f"PullAndRelease/T{number}_P*_winter.txt"))
    season = "winter" if files else "summer"
    files = files or sorted(folder.glob(f"PullAndRelease/T{number}_P*_summer.txt"))
    strain = (np.loadtxt(file) for file in files)
    return season, [main_frequency(one[np.isfinite(one)], SAMPLE_RATE) for one in strain]


def main() -> None:
    """Print a table of all trees, and how well vinesim reproduces the order and the size of the frequencies."""
    import scipy.io  # scipy belongs to the developers' tools

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("fem", type=pathlib.Path, help="clone of WindAndTrees_FEM")
    parser.add_argument("frequencies", type=pathlib.Path, help="clone of WindAndTrees_NaturalFrequencies")
    given = parser.parse_args()
    pairs = []
    write = sys.stdout.write
    write("| tree | cylinders | season | measured [Hz] | vinesim [Hz] | ratio |\n|---|---|---|---|---|---|\n")
    for number in TREES:
        file = next(given.fem.glob(f"QSMs/cyl_data_Tf{number}_*.mat"))
        cylinders = scipy.io.loadmat(file)["CylData_updated"].astype(float)
        season, all_measured = measured(given.frequencies, number)
        computed = main_frequency(sway(cylinders, WOOD)[:, 0], 100.0)
        mean = float(np.mean(all_measured))
        pairs.append((mean, computed))
        span = f"{mean:.3f} ({min(all_measured):.3f} to {max(all_measured):.3f})"
        write(f"| T{number} | {len(cylinders)} | {season} | {span} | {computed:.3f} | {computed / mean:.2f} |\n")
        sys.stdout.flush()
    seen, found = np.array(pairs).T
    write(f"\nR^2 {np.corrcoef(seen, found)[0, 1] ** 2:.2f}, median ratio {np.median(found / seen):.2f}\n")


if __name__ == "__main__":
    main()
