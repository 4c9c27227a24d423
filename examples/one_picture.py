"""Renders one picture of a vineyard: colour, measured depth, and the label of every pixel."""

import sys

import numpy as np

import vinesim

width, height = (int(sys.argv[1]), int(sys.argv[2])) if len(sys.argv) > 2 else (640, 480)
simulation = vinesim.Simulation("demo")
camera = vinesim.Camera("d435", size=(width, height))
frame = camera.render(simulation, vinesim.look_at((1.5, -1.2, 1.4), (1.5, 0.5, 1.6)))
np.savez_compressed("picture.npz", rgb=frame.rgb, depth=frame.depth, labels=frame.labels)
bunches = np.unique(frame.instances[frame.organs == vinesim.Organ.BUNCH])
measured = np.isfinite(frame.depth).mean()
print(f"picture.npz: {width} x {height}, {len(bunches)} bunches in sight, {100 * measured:.0f} % of the depth measured")
