"""Simulates one revolution of a lidar on a mast, at the height of the bunches."""

import numpy as np

import vinesim

simulation = vinesim.Simulation("demo")
scan = vinesim.Lidar("os1_64").scan(simulation, (1.5, -0.6, 1.5, 0.0, 0.0, 0.0, 1.0))
ranges = np.linalg.norm(scan.xyz, axis=1)
leaves, bunches = (np.count_nonzero(scan.organs == organ) for organ in (vinesim.Organ.LEAF, vinesim.Organ.BUNCH))
print(f"{len(ranges)} points from {ranges.min():.2f} to {ranges.max():.1f} m, ", end="")
print(f"{leaves} of them on leaves, {bunches} on bunches")
