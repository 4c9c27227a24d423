"""Plants on a GPU: are they where a CPU puts them, and how many bodies step a second? One JSON object a line.

    python benchmarks/gpu.py --reference cpu.npz        # on a machine whose Warp has CPU kernels
    python benchmarks/gpu.py --compare cpu.npz          # on one with an NVIDIA GPU
    python benchmarks/gpu.py --peer --trees 65536       # beside mujoco-warp, which must be installed
    python benchmarks/gpu.py --scenes                   # whole steps, robots included; Warp must have CPU kernels

Trees are the canes of ``vinesim bench plants``: 16 bodies and a bunch. *resident*: joints and bodies stay on the
device for all ticks; *visible*: every tick the host may read bodies and add forces, as a client does. *with contacts*:
every cane falls from a stirred state onto three bars and stays in touch with them; each is a world of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from vinesim.bench import scenes
from vinesim.bench.plants import plain_cane
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import assemble
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.world import Physics
from vinesim.worlds.batch_contacts import BatchContacts

TICKS = 100
PER_TREE = 17
BARS = ((0.3, 1.975), (0.6, 1.9), (0.85, 1.75))
"""Positions x, z [m] of the bars that the canes fall on."""
BAR_RADIUS = 0.012
SWEEPS = 20
"""Largest number of sweeps of the contact solver in a step: a GPU waits for the tree that needs most sweeps."""
SCENES = ((2, 10), (8, 64))
SCENE_STEPS = 120
"""Number of steps of a scene. Each entry of ``SCENES`` is a number of bars in two combs, and of canes between the
bars."""
PEERS = ("discrete", "implicitfast")
"""Integrators of mujoco-warp that are compared."""
CONTACT_CLOCK = 300
"""Number of ticks after which the canes lie on the bars."""


def bars() -> dict[str, np.ndarray]:
    """Returns the arrays of :class:`Model` for the level bars that lie across the canes, by name."""
    start = np.array([(x, -1.0, z) for x, z in BARS], np.float32)
    end = start * [1, -1, 1]
    return {
        "fixed_start": start,
        "fixed_end": end.astype(np.float32),
        "fixed_radius": np.full((len(BARS), 2), BAR_RADIUS, np.float32),
    }


def forest(count: int, spacing: float = 0.5, **fixed: np.ndarray) -> Model:
    """Returns a model of ``count`` equal trees side by side, ``spacing`` [m] apart.

    ``fixed``: arrays of fixed obstacles among the trees, by their names in :class:`Model`.
    """
    one = assemble([plain_cane(0.0)], **fixed)
    counts = one.counts()
    model = Model.allocate(**{axis: n * count if axis in ("tree", "body") else n for axis, n in counts.items()})
    for name, dim in Model.array_fields().items():
        if dim.shape[0] in ("tree", "body"):
            value = getattr(one, name)
            getattr(model, name)[:] = np.tile(value, (count,) + (1,) * (value.ndim - 1))
    for name, value in fixed.items():
        getattr(model, name)[:] = value
    number = np.arange(count, dtype=np.int32)
    model.tree_first[:] = number * PER_TREE
    model.tree_pose[:, 1] = spacing * number
    model.body_tree[:] = np.repeat(number, PER_TREE)
    model.body_parent[:] += np.where(model.body_parent >= 0, np.repeat(number, PER_TREE) * PER_TREE, 0)
    return model


def stirred(model: Model, seed: int = 3) -> State:
    """Returns a state in which all joints are bent and moving, at random."""
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


def canes_on_bars(device: str, count: int) -> tuple[ArticulationSolver, BatchContacts]:
    """Returns plants with ``count`` trees at one place, each a world of its own with a cane over the bars; and their
    contacts."""
    model = forest(count, 0.0, **bars())
    plants = ArticulationSolver(model, stirred(model), device=device)
    plants.wake(np.arange(count))
    plants.forward_kinematics()
    return plants, BatchContacts(plants, PhysicsParameters(solver_sweeps=SWEEPS))


def contact_trajectory(device: str) -> dict[str, np.ndarray]:
    """Let 256 canes fall on the bars; return body poses after 20 ticks, and contact forces [N] and counts of tick
    300."""
    plants, contacts = canes_on_bars(device, 256)
    plants.upload()
    plants.advance(20, contacts.solve)
    plants.download()
    plants.forward_kinematics()
    early = plants.state.body_q.copy()
    plants.upload()
    plants.advance(280, contacts.solve)
    plants.download()
    return {"contact_early_q": early, "contact_force": contacts.force, "contact_count": contacts.count}


def trajectory(device: str) -> dict[str, np.ndarray]:
    """Step 256 trees for 200 ticks, every second one pushed in the first 50; return final poses and rates, by name."""
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
    """Returns the median wall time [s] of ``rounds`` calls of ``work``, after a call that is not timed."""
    work()
    took = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return float(np.median(took))


def peer_scene(with_contacts: bool, integrator: str) -> Any:
    """Returns the cane as a MuJoCo model: alone, or with contacts between its capsules and the bars and the ground."""
    import mujoco

    from vinesim.bench.mujoco_reference import MujocoScene, compile_plants

    model = assemble([plain_cane(0.0)], **bars())
    if not with_contacts:
        world = compile_plants(model)
    else:
        world = MujocoScene(model, []).world
        is_plant = world.geom_bodyid > 0
        world.geom_contype[:] = is_plant
        world.geom_conaffinity[:] = ~is_plant
        world.body_contype[:] = 1
        world.body_conaffinity[:] = 0
        world.body_contype[0] = 0
        world.body_conaffinity[0] = 1
        world.opt.enableflags = 0
        world.opt.disableflags = 0
        world.opt.impratio = 1.0
        world.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    if integrator == "implicitfast":  # the integrator ``discrete`` adds damping of dt K by itself
        world.dof_damping[:] = np.repeat(model.joint_damping[:, 1], 3)
        world.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return world


def peer_milliseconds(count: int, integrator: str, start: State | None = None) -> tuple[float, float]:
    """Returns the time [ms] of one captured step of ``count`` worlds with one cane each in mujoco-warp, and the
    contacts a world.

    ``start``: state of canes that lie on bars, for a scene with contacts. None: the scene has no contacts.
    """
    import mujoco
    import mujoco_warp  # pyright: ignore[reportMissingImports]

    world = peer_scene(start is not None, integrator)
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    room = {} if start is None else {"nconmax": 12, "njmax": 48}
    model = mujoco_warp.put_model(world)
    worlds = mujoco_warp.put_data(world, data, nworld=count, **room)
    if start is not None:
        worlds.qpos.assign(frames.to_wxyz(start.joint_q).reshape(count, -1).astype(np.float32))
        rates = frames.rotate(frames.conjugate(start.joint_q), start.joint_qd)
        worlds.qvel.assign(rates.reshape(count, -1).astype(np.float32))
    mujoco_warp.step(model, worlds)
    wp.synchronize()
    with wp.ScopedCapture() as capture:
        mujoco_warp.step(model, worlds)

    def steps() -> None:
        for _ in range(TICKS):
            wp.capture_launch(capture.graph)  # captured above
        wp.synchronize()

    took = 1e3 * seconds(steps) / TICKS
    assert start is None or np.isfinite(worlds.qvel.numpy()).all()
    return took, float(worlds.nacon.numpy()[0]) / count


def say(about: dict, case: str, value: float, unit: str) -> None:
    sys.stdout.write(json.dumps({"bench": "gpu", "case": case, "value": value, "unit": unit} | about) + "\n")
    sys.stdout.flush()


def compare_contacts(about: dict, theirs: Any, ours: dict[str, np.ndarray]) -> None:
    """Print how far canes that fall on bars are from those on the CPU, and by how much the contact forces differ."""
    apart = np.abs(theirs["contact_early_q"] - ours["contact_early_q"])[:, :3].max()
    say(about, "256 canes fall on bars, 20 ticks: largest distance from the CPU's bodies", 1e3 * float(apart), "mm")
    weight = theirs["contact_force"].sum(0)
    off = (theirs["contact_force"] - ours["contact_force"]).sum(0)
    share = float(np.linalg.norm(off) / np.linalg.norm(weight))
    say(about, "the same after 300 ticks: force on all, difference from the CPU's, of it", share, "1")
    counts = int(theirs["contact_count"].sum()), int(ours["contact_count"].sum())
    say(about, f"the same: contacts, {counts[0]} on the CPU", counts[1], "contacts")


def scene_steps(device: str, bars: int, canes: int) -> tuple[np.ndarray, Physics, float]:
    """Step canes between the bars of two combs that close. Returns positions of bodies [step, body, 3] m, the physics,
    and the median wall time of a step [ms]."""
    physics = Physics(scenes.cane_row(canes), device=device)
    physics.add_robot(scenes.combs("combs", bars, canes))
    scenes.keep_awake(physics, np.arange(canes))
    position = []
    took = []
    for tick in range(SCENE_STEPS):
        physics.rigid.command("combs", np.full(2, 0.005 * min(1.0, tick / 100)))
        start = time.perf_counter()
        physics.step()
        took.append(time.perf_counter() - start)
        position.append(physics.state.body_q[:, :3].copy())
    return np.array(position), physics, 1e3 * float(np.median(took))


def compare_scenes(about: dict, device: str) -> None:
    """Compare whole steps with plants on the GPU with whole steps on the CPU. Contacts and robots are on the CPU in
    both."""
    for comb_bars, canes in SCENES:
        theirs, cpu, cpu_took = scene_steps("cpu", comb_bars, canes)
        ours, gpu, took = scene_steps(device, comb_bars, canes)
        case = f"{canes} canes between {comb_bars} bars, {gpu.contact_solver.count} contacts, plants on the GPU"
        say(about, f"{case}: largest distance from the CPU's bodies", 1e3 * float(np.abs(ours - theirs).max()), "mm")
        force = [float(np.abs(which.contact_solver.wrenches[:, :3]).sum()) for which in (cpu, gpu)]
        say(about, f"{case}: force, difference from the CPU's, of it", abs(force[1] / force[0] - 1.0), "1")
        say(about | {"peer": "the same on the CPU", "peer_value": cpu_took}, f"{case}: step", took, "ms")


def measure_contacts(about: dict, device: str, count: int, with_peer: bool) -> None:
    """Time steps of ``count`` canes that lie on bars; ``with_peer``: compare them with mujoco-warp."""
    plants, contacts = canes_on_bars(device, count)
    plants.upload()
    plants.advance(CONTACT_CLOCK, contacts.solve)
    took = 1e3 * seconds(lambda: plants.advance(TICKS, contacts.solve)) / TICKS
    plants.download()
    assert np.isfinite(plants.state.body_q).all()
    per_tree = float(contacts.count.mean())
    sweeps = contacts.sweeps
    case = f"{count} trees of {PER_TREE} bodies, resident, with contacts: {per_tree:.2f} a tree"
    also = {
        "sweeps_mean": float(sweeps.mean()),
        "share_at_most_sweeps": float((sweeps >= SWEEPS).mean()),
        "dropped": contacts.dropped,
    }
    say(about | also, case, took, "ms/tick")
    for integrator in PEERS[:1] if with_peer else ():  # the other integrator is unstable in contact
        theirs, their_contacts = peer_milliseconds(count, integrator, plants.state)
        beside = {
            "peer": f"mujoco-warp {integrator}",
            "peer_value": theirs,
            "ratio": theirs / took,
            "peer_contacts_a_tree": their_contacts,
        }
        say(about | also | beside, f"{case}, beside mujoco-warp", took, "ms/tick")


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("--reference")
    ask.add_argument("--compare")
    ask.add_argument("--peer", action="store_true", help="also measure mujoco-warp")
    ask.add_argument("--device", default="cuda")
    ask.add_argument("--trees", type=int, nargs="*", default=[64, 1024, 4096, 16384, 65536, 131072])
    ask.add_argument("--contacts", action="store_true", help="only with contacts")
    ask.add_argument("--scenes", action="store_true", help="only whole steps beside the CPU's")
    given = ask.parse_args()
    if given.reference:
        np.savez_compressed(given.reference, allow_pickle=False, **trajectory("cpu"), **contact_trajectory("cpu"))
        return
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    name = driver = "none"
    if given.device != "cpu":
        answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
        name, driver = answer.splitlines()[0].split(", ")
    about = {"device": name, "driver": driver, "warp": wp.config.version}
    if given.scenes:
        compare_scenes(about, given.device)
        return
    if given.compare:
        theirs = np.load(given.compare)
        ours = trajectory(given.device)
        apart = np.abs(theirs["body_q"][:, :3] - ours["body_q"][:, :3]).max()
        say(about, "256 trees, 200 ticks, pushed: largest distance from the CPU's bodies", 1e3 * float(apart), "mm")
        off = np.abs(theirs["response"] - ours["response"]).max() / np.abs(theirs["response"]).max()
        say(about, "response to unit impulses: largest difference from the CPU's, of the largest", float(off), "1")
        compare_contacts(about, theirs, contact_trajectory(given.device))
    for count in given.trees:
        measure_contacts(about, given.device, count, given.peer)
        if given.contacts:
            continue
        plants = plants_on(given.device, count)
        bodies = count * PER_TREE
        plants.upload()
        took = seconds(lambda plants=plants: plants.advance(TICKS)) / TICKS
        plants.download()
        assert np.isfinite(plants.state.body_q).all()
        say(about, f"{count} trees of {PER_TREE} bodies, resident", 1e3 * took, "ms/tick")
        say(about, f"{count} trees of {PER_TREE} bodies, resident", bodies / took / 1e9, "G body-steps/s")
        if given.peer:
            for integrator in PEERS:
                theirs, _ = peer_milliseconds(count, integrator)
                also = {"peer": f"mujoco-warp {integrator}", "peer_value": theirs, "ratio": theirs / (1e3 * took)}
                case = f"{count} trees of {PER_TREE} bodies, resident, beside mujoco-warp"
                say(about | also, case, 1e3 * took, "ms/tick")
        if count <= 16384:

            def visible(plants: ArticulationSolver = plants) -> None:
                for _ in range(20):
                    plants.predict()
                    plants.integrate()

            say(about, f"{count} trees of {PER_TREE} bodies, visible", 1e3 * seconds(visible) / 20, "ms/tick")


if __name__ == "__main__":
    main()
