"""Plants on a GPU: are they where a CPU puts them, and how many bodies step a second? One JSON object a line.

    python benchmarks/gpu.py --reference cpu.npz        # on a machine whose Warp has CPU kernels
    python benchmarks/gpu.py --compare cpu.npz          # on one with an NVIDIA GPU
    python benchmarks/gpu.py --peer --trees 65536       # beside mujoco-warp, which must be installed

Trees are the canes of ``vinesim bench plants``: 16 bodies and a bunch. *resident*: joints and bodies stay on the
device for all ticks; *visible*: every tick the host may read bodies and add forces, as a client does.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State

TICKS = 100
PER_TREE = 17


def cane(side: float) -> TreeBuilder:
    """A horizontal cane with a bunch on its tip."""
    tree = TreeBuilder(frames.pose(np.array([0.0, side, 2.0])))
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0, 0.006), PER_TREE - 1)[-1]
    tree.add_body(
        last, offset=(1 / 16, 0, 0), rest=frames.from_x_axis(np.array([0.0, 0.0, -1.0])), organ=int(Organ.BUNCH),
        mass=0.5,
        com=(0.1, 0, 0), inertia=(5e-4, 5e-4, 5e-4), length=0.15, radius=(0.05, 0.05), damping=(0.002, 0.002, 0.002),
    )  # fmt: skip
    return tree


def forest(count: int) -> Model:
    """So many equal trees side by side."""
    one = assemble([cane(0.0)])
    counts = one.counts()
    model = Model.allocate(**{axis: n * count if axis in ("tree", "body") else n for axis, n in counts.items()})
    for name, dim in Model.array_fields().items():
        if dim.shape[0] in ("tree", "body"):
            value = getattr(one, name)
            getattr(model, name)[:] = np.tile(value, (count,) + (1,) * (value.ndim - 1))
    number = np.arange(count, dtype=np.int32)
    model.tree_first[:] = number * PER_TREE
    model.tree_pose[:, 1] = 0.5 * number
    model.body_tree[:] = np.repeat(number, PER_TREE)
    model.body_parent[:] += np.where(model.body_parent >= 0, np.repeat(number, PER_TREE) * PER_TREE, 0)
    return model


def stirred(model: Model, seed: int = 3) -> State:
    """Everything bent and moving."""
    rng = np.random.default_rng(seed)
    state = State.at_rest(model)
    state.joint_q[:] = frames.exp(rng.normal(size=(len(model.body_mass), 3)) * 0.05)
    state.joint_qd[:] = rng.normal(size=(len(model.body_mass), 3)) * 0.3
    return state


def plants_on(device: str, count: int) -> ArticulationSolver:
    model = forest(count)
    plants = ArticulationSolver(model, stirred(model), device=device)
    plants.wake(np.arange(count))
    return plants


def trajectory(device: str) -> dict[str, np.ndarray]:
    """256 trees, 200 ticks; half of them with a push on a body in the first 50."""
    plants = plants_on(device, 256)
    pushed = np.arange(0, 256, 2) * PER_TREE + 9
    wrench = np.tile([0.3, -0.2, 0.5, 0.01, 0.0, 0.02], (len(pushed), 1))
    for tick in range(200):
        plants.predict()
        response = plants.impulse_response(pushed[:4]) if tick == 20 else None
        if response is not None:
            kept = response
        plants.integrate(pushed if tick < 50 else None, wrench if tick < 50 else None)
    plants.forward_kinematics()
    state = plants.state
    return {"response": kept, "body_q": state.body_q.copy(), "joint_qd": state.joint_qd.copy()}


def seconds(work: Callable[[], None], rounds: int = 5) -> float:
    """Median of some rounds, the first one left out."""
    work()
    took = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return float(np.median(took))


def peer_milliseconds(count: int) -> float:
    """One step of so many worlds in mujoco-warp, each with the same cane, captured into a graph; no contacts."""
    import mujoco
    import mujoco_warp  # pyright: ignore[reportMissingImports]

    from vinesim.bench.mujoco_reference import compile_plants

    spec = compile_plants(assemble([cane(0.0)]))
    spec.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # it has no ``discrete``
    data = mujoco.MjData(spec)
    mujoco.mj_forward(spec, data)
    model, worlds = mujoco_warp.put_model(spec), mujoco_warp.put_data(spec, data, nworld=count)
    mujoco_warp.step(model, worlds)
    wp.synchronize()
    with wp.ScopedCapture() as capture:
        mujoco_warp.step(model, worlds)

    def steps() -> None:
        for _ in range(TICKS):
            wp.capture_launch(capture.graph)  # pyright: ignore[reportArgumentType]  (captured above)
        wp.synchronize()

    return 1e3 * seconds(steps) / TICKS


def say(about: dict, case: str, value: float, unit: str) -> None:
    sys.stdout.write(json.dumps({"bench": "gpu", "case": case, "value": value, "unit": unit} | about) + "\n")
    sys.stdout.flush()


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("--reference")
    ask.add_argument("--compare")
    ask.add_argument("--peer", action="store_true", help="also measure mujoco-warp")
    ask.add_argument("--device", default="cuda")
    ask.add_argument("--trees", type=int, nargs="*", default=[64, 1024, 4096, 16384, 65536, 131072])
    given = ask.parse_args()
    if given.reference:
        np.savez_compressed(given.reference, **trajectory("cpu"))
        return
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    name = driver = "none"
    if given.device != "cpu":
        answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
        name, driver = answer.splitlines()[0].split(", ")
    about = {"device": name, "driver": driver, "warp": wp.config.version}
    if given.compare:
        theirs, ours = np.load(given.compare), trajectory(given.device)
        apart = np.abs(theirs["body_q"][:, :3] - ours["body_q"][:, :3]).max()
        say(about, "256 trees, 200 ticks, pushed: largest distance from the CPU's bodies", 1e3 * float(apart), "mm")
        off = np.abs(theirs["response"] - ours["response"]).max() / np.abs(theirs["response"]).max()
        say(about, "response to unit impulses: largest difference from the CPU's, of the largest", float(off), "1")
    for count in given.trees:
        plants = plants_on(given.device, count)
        bodies = count * PER_TREE
        plants.upload()
        took = seconds(lambda plants=plants: plants.advance(TICKS)) / TICKS
        plants.download()
        assert np.isfinite(plants.state.body_q).all()
        say(about, f"{count} trees of {PER_TREE} bodies, resident", 1e3 * took, "ms/tick")
        say(about, f"{count} trees of {PER_TREE} bodies, resident", bodies / took / 1e9, "G body-steps/s")
        if given.peer:
            theirs = peer_milliseconds(count)
            also = {"peer": "mujoco-warp implicitfast", "peer_value": theirs, "ratio": theirs / (1e3 * took)}
            say(
                about | also, f"{count} trees of {PER_TREE} bodies, resident, beside mujoco-warp", 1e3 * took, "ms/tick"
            )
        if count <= 16384:

            def visible(plants: ArticulationSolver = plants) -> None:
                for _ in range(20):
                    plants.predict()
                    plants.integrate()

            say(about, f"{count} trees of {PER_TREE} bodies, visible", 1e3 * seconds(visible) / 20, "ms/tick")


if __name__ == "__main__":
    main()
