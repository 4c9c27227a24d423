"""A hand pushed slowly through a closed canopy, with leaves that touch and with leaves that are only seen. Prints one
JSON object a line.

    python benchmarks/leaf_push.py [--places 20] [--scenes vsp demo]

A ball with a radius of 4 cm, about a fist, is driven 0.4 m level across the row at 0.1 m/s, through a leaf chosen at
random. Leaves are passed over where the ball meets wood or fruit on its way while leaves are only seen. ``force`` is
the largest force on the ball (``wood``: also from wood), ``leaf_force`` the largest sum of the forces of leaves,
``leaves`` the number of leaves that it touched, ``most_at_once`` how many at once, ``expected`` the stiffness of the
petioles times the overlap at the tick of the largest force, ``work`` what the ball did on the plants,
``energy_above_work`` the largest amount by which the plants gained more, and ``step`` the median time of a step. A
ball that begins within reach of leaves begins with their springs bent: their energy is then part of
``energy_above_work``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Literal

import numpy as np

from vinesim import Simulation
from vinesim.api.energy import energy
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import load_scene

RADIUS = 0.04
TRAVEL = 0.4
SPEED = 0.1


def push(model: Model, leaf: int, kind: Literal["ghost", "touch"]) -> dict[str, object]:
    """Drive a ball through the middle of a ``leaf`` and return what it felt and did."""
    simulation = Simulation(model, parameters=PhysicsParameters(leaves=kind))
    solver = simulation.physics.contact_solver
    blade = frames.compose(simulation.body_pose(int(model.leaf_body[leaf])), model.leaf_pose[leaf].astype(float))
    across = np.array([0.0, 1.0, 0.0])
    start = blade[:3] - 0.5 * TRAVEL * across
    ball = simulation.add_pusher(size=(RADIUS,), position=start, mass=1.0, force=2000.0)
    ball.follow(start + TRAVEL * across, speed=SPEED)
    near = np.flatnonzero(np.linalg.norm(model.tree_pose[:, :3] - blade[:3], axis=1) < 2.5)

    def plants_energy() -> float:
        simulation.physics.update_kinematics()
        return energy(simulation.physics.plants, simulation.parameters.gravity, near).total

    total = plants_energy()
    peak = leaf_peak = expected = work = excess = 0.0
    touched: set[int] = set()
    most = wood = 0
    times = []
    for step in range(round(TRAVEL / SPEED / 0.01)):
        last = ball.position
        begin = time.perf_counter()
        simulation.step()
        times.append(time.perf_counter() - begin)
        work -= float(ball.force @ (ball.position - last))
        peak = max(peak, float(np.linalg.norm(ball.force)))
        contacts = solver.impulses.contacts
        count = solver.count
        capsule = contacts.feature[:count] // 2
        presses = solver.impulses.rows.impulse[0 : 3 * count : 3] > 0.0
        of_ball = contacts.other[:count] >= 0
        is_leaf = capsule >= solver.capsules.tree_start[-1]
        here = presses & of_ball & is_leaf
        wood += int((presses & of_ball & ~is_leaf).any())
        touched |= set(capsule[here].tolist())
        most = max(most, int(here.sum()))
        force = float(np.linalg.norm(contacts.force[:count][here].sum(0)))
        if force > leaf_peak:
            leaf_peak = force
            springs = solver.capsules.stiffness[capsule[here]] * -contacts.gap[:count][here]
            expected = float(np.linalg.norm(springs @ contacts.axes[:count][here, 0]))
        if step % 10 == 0:
            excess = max(excess, plants_energy() - total - work)
    return {
        "force": peak,
        "leaf_force": leaf_peak,
        "expected": expected,
        "leaves": len(touched),
        "most_at_once": most,
        "wood": wood > 0,
        "work": work,
        "energy_above_work": excess,
        "step": float(np.median(times)),
        "faults": simulation.faults,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--scenes", nargs="+", default=["vsp", "demo"])
    args = parser.parse_args()
    for scene in args.scenes:
        model = generate(load_scene(scene))
        found = 0
        for leaf in np.random.default_rng(1).permutation(len(model.leaf_body)).tolist():
            ghost = push(model, leaf, "ghost")
            if ghost["wood"]:
                continue
            for kind, seen in {"ghost": ghost, "touch": push(model, leaf, "touch")}.items():
                row = {"bench": "leaf_push", "scene": scene, "leaf": leaf, "leaves_are": kind}
                sys.stdout.write(json.dumps(row | seen) + "\n")
                sys.stdout.flush()
            found += 1
            if found == args.places:
                break


if __name__ == "__main__":
    main()
