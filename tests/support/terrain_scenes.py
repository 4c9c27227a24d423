"""Uneven ground for tests: planes, hills, and models that have nothing else."""

from __future__ import annotations

import numpy as np

from vinesim.scene.model import Model
from vinesim.scene.terrain import Terrain


def incline(along: float, across: float = 0.0, *, cell: float = 0.1, nodes: int = 121) -> Terrain:
    """A plane through the origin that rises by ``along`` and ``across`` [1] along x and y."""
    start = -0.5 * cell * (nodes - 1)
    return Terrain((start, start), cell, (along, across), np.zeros((nodes, nodes), np.float32))


def hills(seed: int = 3, *, roughness: float = 0.02, slope: tuple[float, float] = (0.1, -0.05)) -> Terrain:
    """12 m x 10 m of independent random heights on an inclined plane, 10 cm apart: as rough as it gets."""
    heights = np.random.default_rng(seed).normal(0.0, roughness, (101, 121)).astype(np.float32)
    return Terrain((-5.0, -4.0), 0.1, slope, heights)


def bare(terrain: Terrain | None, *, boxes: int = 0) -> Model:
    """A model with nothing but the ground, and boxes at the origin that the caller places."""
    model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, tie=0, box=boxes)
    model.box_size[:] = (0.4, 0.3, 0.2)
    model.box_mass[:] = 2.0
    model.terrain = terrain
    return model
