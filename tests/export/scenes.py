"""Small vineyards for tests of exports."""

from __future__ import annotations

import functools

import msgspec
import numpy as np

import vinesim
from vinesim.scene.model import Model


def bent_cane(tip_mass: float = 0.05, segments: int = 8) -> Model:
    """Returns a cane that is bent and twisted, in equilibrium."""
    bends = np.tile([0.32, -0.8, 1.28], (segments, 1)) / segments
    return vinesim.cane(damping_ratio=0.05, shape="equilibrium", bends=bends, segments=segments, tip_mass=tip_mass)


@functools.cache
def one_vine() -> Model:
    """Returns one vine of the scene demo with its bunches, wires and crates."""
    scene = vinesim.load_scene("demo")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=1)
    return vinesim.generate(msgspec.structs.replace(scene, layout=layout, spawns=()))


def bodies_of(model: Model, names: list[str]) -> np.ndarray:
    """Returns the index in the model of each exported body of a plant, by its name."""
    return np.array(
        [
            model.bunch_body[int(number)] if organ == "bunch" else int(number)
            for organ, number in (name.rsplit("_", 1) for name in names)
        ]
    )
