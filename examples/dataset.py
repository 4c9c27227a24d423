"""Writes a small data set: pictures of vineyards with different seeds from random places, with a mask of the
bunches."""

import sys

import numpy as np

import vinesim

count = int(sys.argv[1]) if len(sys.argv) > 1 else 10
camera = vinesim.Camera("pinhole", size=(320, 240), quality="fast")
rng = np.random.default_rng(0)
bunches = 0
for seed in range(count):
    scene = vinesim.load_scene("demo", seed=seed)
    simulation = vinesim.Simulation(scene)
    eye = np.array([rng.uniform(0.5, 2.5), -1.0, rng.uniform(1.2, 1.5)])
    target = eye + np.array([0.0, 1.5, rng.uniform(0.0, 0.4)])
    frame = camera.render(simulation, vinesim.look_at(eye, target))
    mask = np.where(frame.organs == vinesim.Organ.BUNCH, frame.instances + 1, 0)  # 0: no bunch
    np.savez_compressed(f"picture_{seed:03d}.npz", rgb=frame.rgb, depth=frame.depth, bunch=mask)
    bunches += len(np.unique(mask)) - 1
print(f"{count} pictures with {bunches} bunches")
