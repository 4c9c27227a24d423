"""A ball driven through shoots, as a hand that reaches into a hedge: forces, breaks, rates and energy. Prints one JSON
object a line.

    python benchmarks/hedge_push.py [--places 20] [--scenes vsp demo] [--plot docs/pictures/hedge_push.png]

A ball with a radius of 3 cm starts 8 cm beside a shoot, or further back where it touches nothing, and is driven across
the shoot to 22 cm behind it, at 0.05 and at 0.5 m/s, once through wood and ties that give (``gives``) and once through
such that never give. Then the ball is taken away, and the shoots swing for a second. ``moment_share`` is the largest
moment in a joint of a cane as a share of the moment that cracks it, ``work`` what the ball did on plants and wires,
``energy_above_work`` the largest amount by which plants and wires gained more (kinetic, elastic, weight, and what wood
and ties have taken up). A ball that starts within a shoot or a wire would add the energy of that overlap.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys

import numpy as np

from vinesim import Simulation
from vinesim.api.energy import energy
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene

RADIUS = 0.03
BEFORE = 0.08
BEHIND = 0.22
CLEAR = 0.005
SPEEDS = (0.05, 0.5)


def places(model: Model, count: int, seed: int = 1) -> list[int]:
    """Returns ``count`` segments of shoots, chosen at random among those of main axes and side shoots."""
    rng = np.random.default_rng(seed)
    canes = np.flatnonzero((model.body_organ == int(Organ.CANE)) & (model.body_parent >= 0))
    return rng.choice(canes, count, replace=False).tolist()


def free_start(simulation: Simulation, middle: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Returns the point [3] m nearest to ``BEFORE`` ahead of ``middle`` at which the ball touches neither plants nor
    wires; ``across``: the direction of the push."""
    model = simulation.model
    wires = np.flatnonzero(model.fixed_radius[:, 0] > 0.0)
    first = model.fixed_start[wires].astype(float)
    way = model.fixed_end[wires].astype(float) - first
    for back in np.arange(BEFORE, 0.6, 0.01):
        start = middle - back * across
        share = np.clip(((start - first) * way).sum(1) / np.maximum((way * way).sum(1), 1e-12), 0.0, 1.0)
        gap = np.linalg.norm(start - first - share[:, None] * way, axis=1) - model.fixed_radius[wires].max(1)
        near = simulation.physics.contact_solver.nearest_body(start[None], RADIUS + CLEAR)
        if near is None and gap.min(initial=np.inf) > RADIUS + CLEAR:
            return start
    raise RuntimeError(f"no free place within 0.6 m of {middle.round(3).tolist()}; choose another shoot")


def push(model: Model, body: int, speed: float, *, dt: float = 0.01, sleep: bool = True) -> dict[str, object]:
    """Drive a ball across the middle of segment ``body`` and return what it felt and did."""
    simulation = Simulation(model, dt=dt, sleep=sleep)
    pose = simulation.body_pose(body)
    along = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
    middle = pose[:3] + 0.5 * float(model.body_length[body]) * along
    across = np.cross(along, [0.0, 0.0, 1.0])
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 0.1 else np.array([0.0, 1.0, 0.0])
    start = free_start(simulation, middle, across)
    travel = float((middle - start) @ across) + BEHIND
    steps = round(travel / speed / dt)
    ball = simulation.add_pusher(shape="sphere", size=(RADIUS,), position=start, mass=1.0, force=2000.0)
    ball.follow(start + travel * across, speed=speed)
    plants = simulation.physics.plants
    wood = simulation.physics.detachment_monitor.wood
    near = np.flatnonzero(np.linalg.norm(model.tree_pose[:, :3] - pose[:3], axis=1) < 2.5)

    def plants_energy() -> float:
        simulation.physics.update_kinematics()
        simulation.physics.elastic_supports.update()  # the wires as the shoots are now, not at the start of the step
        stored = simulation.physics.wires.energy
        return stored + energy(plants, simulation.parameters.gravity, near).total

    total = plants_energy()
    work = peak = share = kick = excess = 0.0
    broken = cracked = untied = 0
    for step in range(steps + round(1.0 / dt)):
        if step == steps:
            simulation.remove_pusher(ball.name)
        last = ball.position if ball.name in simulation.pushers else None
        simulation.step()
        if ball.name in simulation.pushers:
            force = ball.force
            peak = max(peak, float(np.linalg.norm(force)))
            work -= float(ball.contact_force @ (ball.position - last))
            share = max(share, float(wood.used_strength().max(initial=0.0)))
        else:
            kick = max(kick, float(plants.tree_rate[simulation.awake].max(initial=0.0)))
        if step % 5 == 0:
            excess = max(excess, plants_energy() - total + wood.work.sum() + wood.tie_work - work)
        broken += len(simulation.detachments)
        cracked += sum(one.kind == "crack" for one in simulation.breakages)
        untied += sum(one.kind == "untie" for one in simulation.breakages)
    return {
        "force": peak,
        "moment_share": share,
        "rate_after": kick,
        "work": work,
        "energy_above_work": excess,
        "broken": broken,
        "cracked": cracked,
        "untied": untied,
        "faults": simulation.faults,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--scenes", nargs="+", default=["vsp", "demo"])
    parser.add_argument("--plot", type=pathlib.Path)
    args = parser.parse_args()
    rows = []
    for scene in args.scenes:
        gives = generate(load_scene(scene))
        stiff = gives.copy()
        stiff.body_strength[:] = stiff.tie_slip[:] = stiff.tie_strength[:] = 0.0
        for body in places(gives, args.places):
            for speed in SPEEDS:
                for model in (stiff, gives):
                    row = {"bench": "hedge_push", "scene": scene, "body": body, "speed": speed}
                    row |= {"gives": model is gives} | push(model, body, speed)
                    rows.append(row)
                    sys.stdout.write(json.dumps(row) + "\n")
                    sys.stdout.flush()
    if args.plot:
        plot(rows, args.plot)


def plot(rows: list[dict], path: pathlib.Path) -> None:
    """Draw the peak forces with wood that gives over those with wood that never gives."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.5))
    for scene, marker in zip(dict.fromkeys(row["scene"] for row in rows), "os^v", strict=False):
        for speed, colour in zip(SPEEDS, ("tab:blue", "tab:red"), strict=True):
            pair = [[r["force"] for r in rows if (r["scene"], r["speed"], r["gives"]) == (scene, speed, give)]
                    for give in (False, True)]  # fmt: skip
            axes.loglog(*np.maximum(pair, 0.1), marker, color=colour, label=f"{scene}, {speed} m/s", mfc="none")
    ends = np.array([0.1, 1000.0])
    axes.loglog(ends, ends, "k:", lw=0.8)
    axes.set(xlabel="peak force, wood never gives [N]", ylabel="peak force, wood gives [N]")
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
