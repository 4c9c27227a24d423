"""Median time of a step of plants without contacts, compared with MuJoCo on the same scene. Both run in one process, in
turns.

The scene: canes of 16 bodies (1 m, 8 mm, 5 GPa, 800 kg/m^3), each with a bunch of 0.5 kg on its tip.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from vinesim.bench.mujoco_reference import compile_plants
from vinesim.bench.scenes import interleaved_times
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import Measurement

CANE_COUNT = 64


def plain_cane(side: float) -> TreeBuilder:
    """Returns a horizontal cane at y = ``side`` [m] with a bunch hanging from its tip."""
    tree = TreeBuilder(frames.pose(np.array([0.0, side, 2.0])))
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0, 0.006), 16)[-1]
    tree.add_body(
        last,
        offset=(1 / 16, 0, 0),
        rest=frames.from_x_axis(np.array([0.0, 0.0, -1.0])),
        organ=int(Organ.BUNCH),
        mass=0.5,
        com=(0.1, 0, 0),
        inertia=(5e-4, 5e-4, 5e-4),
        length=0.15,
        radius=(0.05, 0.05),
        damping=(0.002, 0.002, 0.002),
    )
    return tree


def cane_scene(count: int) -> Model:
    """Returns a model of ``count`` canes, half a metre apart."""
    return assemble([plain_cane(0.5 * i) for i in range(count)])


def warmed_up_solver(model: Model, awake: int) -> ArticulationSolver:
    """Returns a solver whose first ``awake`` trees are awake and whose kernels are loaded."""
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(np.arange(awake))
    run_steps(plants, 5)
    return plants


def run_steps(plants: ArticulationSolver, count: int) -> None:
    """Run ``count`` whole steps without contacts."""
    for _ in range(count):
        plants.predict()
        plants.integrate()


def plant_measurements() -> Iterator[Measurement]:
    """Measure 64 awake canes without contacts, by processor time."""
    steps = 40
    model = cane_scene(CANE_COUNT)
    plants = warmed_up_solver(model, CANE_COUNT)
    mujoco_model = compile_plants(model)
    data = mujoco.MjData(mujoco_model)
    for _ in range(5):
        mujoco.mj_step(mujoco_model, data)

    def mujoco_steps() -> None:
        for _ in range(steps):
            mujoco.mj_step(mujoco_model, data)

    times = 1e3 / steps * interleaved_times(lambda: run_steps(plants, steps), mujoco_steps)
    name = f"MuJoCo {mujoco.mj_versionString()} discrete"
    ours, reference = times[1].tolist()
    case = f"{CANE_COUNT} canes awake, one thread, processor time"
    yield Measurement("plants", case, ours, "ms/tick", name, reference, reference / ours)
