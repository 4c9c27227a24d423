"""Simulates one revolution of the lidar on a robot that stands in a vineyard."""

import numpy as np

import vinesim

simulation = vinesim.Simulation("demo")
robot = simulation.add_robot("vinebot", pose=(1.5, -1.2, 1.57))
scan = vinesim.Lidar("vlp16").scan(simulation, robot=robot)
ranges = np.linalg.norm(scan.xyz, axis=1)
leaves = np.count_nonzero(scan.organs == vinesim.Organ.LEAF)
print(f"{len(ranges)} points from {ranges.min():.2f} to {ranges.max():.1f} m, {leaves} of them on leaves")
