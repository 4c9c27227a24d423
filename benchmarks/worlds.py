"""Whole worlds on a GPU, beside mujoco_warp with the plants as its own bodies. One JSON object a line.

    python benchmarks/worlds.py                    # needs an NVIDIA GPU and mujoco_warp
    python benchmarks/worlds.py --worlds 16 --device cpu --no-peer

A world has an arm of seven joints with a gripper of two fingers, and four canes of 16 bodies with a bunch of 0.4 kg
each. *untouched*: nothing touches the canes. *touched*: a bar that stands still holds all four canes up. Both
simulators take steps of 10 ms. The canes begin level, fall and swing (``ms_falling``) until they hang still (``ms``),
because a cane that moves fast takes steps of several parts. ``world_steps_s``: number of worlds divided by the time
of a step (``ms``).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from typing import Any

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.learn.arm import AXES, arm
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

CANES = 4
SPACING = 0.2
HEIGHT = 1.2
BAR = (0.9, 1.12)
"""Position x, z [m] of the bar's axis, 8 cm below the canes and 0.3 m from where they begin."""
BAR_RADIUS = 0.012
BASE = (-0.6, 0.0, 0.5)
"""[m] Place of the base of the arm."""


def cane(number: int, bodies: int = 16) -> TreeBuilder:
    """Returns a limp level cane of 1 m with a bunch at its tip."""
    tree = TreeBuilder(frames.pose(np.array([0.6, SPACING * number - 0.3, HEIGHT])))
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(4e9, 800.0, 0.05, shear_modulus=2e9), bodies)[-1]
    spring = np.array([0.1, 0.5, 0.5])
    bunch = tree.add_body(
        last,
        offset=(1.0 / bodies, 0, 0),
        rest=frames.from_x_axis(np.array([0.0, 0.0, -1.0])),
        organ=int(Organ.BUNCH),
        mass=0.4,
        com=(0.07, 0, 0),
        length=0.18,
        radius=(0.04, 0.04),
        inertia=(3.2e-4, 7e-4, 7e-4),
        stiffness=spring,
        damping=0.02 * spring,
    )
    tree.bunches.append({"body": bunch, "length": 0.18, "radius": 0.04, "berries": 80, "pull": 500.0, "bend": 50.0})
    return tree


def plants(canes: int, *, touched: bool) -> Model:
    """Returns the plants of one world, above a bar if they are ``touched``."""
    fixed: dict[str, np.ndarray] = {}
    if touched:
        start = np.array([(BAR[0], -1.0, BAR[1])], np.float32)
        radius = np.full((1, 2), BAR_RADIUS, np.float32)
        fixed = {"fixed_start": start, "fixed_end": (start * [1, -1, 1]).astype(np.float32), "fixed_radius": radius}
    return assemble([cane(number) for number in range(canes)], **fixed)


def seconds_a_step(launch: Any, steps: int, device: str) -> float:
    """Returns the wall time [s] of one of ``steps`` steps, after as many that are not timed."""
    launch(steps)
    wp.synchronize_device(device)
    begin = time.perf_counter()
    launch(steps)
    wp.synchronize_device(device)
    return (time.perf_counter() - begin) / steps


def ours(
    count: int, device: str, steps: int, canes: int, *, touched: bool, settle: int, deterministic: bool = False
) -> dict[str, object]:
    """Returns the measurement of :class:`Worlds`: while the canes fall and swing, and again after ``settle`` steps."""
    began = time.perf_counter()
    model = plants_of_worlds([plants(canes, touched=touched)], count)
    worlds = Worlds(model, count, robots=[arm(BASE)], device=device, deterministic=deterministic)
    worlds.step(1)
    wp.synchronize_device(device)
    started = time.perf_counter() - began
    took = seconds_a_step(worlds.step, steps, device)
    took_falling = took
    if settle:
        worlds.step(settle)
        took = seconds_a_step(worlds.step, steps, device)
    contacts = worlds.contacts.count
    row: dict[str, object] = {
        "case": "vinesim",
        "touched": touched,
        "deterministic": deterministic,
        "worlds": count,
        "canes": canes,
        "ms": round(1e3 * took, 3),
        "world_steps_s": round(count / took),
        "ms_falling": round(1e3 * took_falling, 3),
        "contacts": int(contacts.sum()),
        "worlds_in_contact": int((contacts > 0).sum()),
        "dropped": int(worlds.dropped.sum()),
        "finite": bool(np.isfinite(worlds.plants.tree_rate).all()),
        "start_s": round(started, 1),
    }
    if wp.get_device(device).is_cuda:
        free = wp.get_device(device).free_memory
        row["free_gb"] = round(free / 1e9, 2)
        for name, part in (("rigid_ms", worlds.bodies.predict), ("rigid_2_ms", worlds.bodies.integrate)):
            row[name] = round(1e3 * seconds_a_step(lambda n, part=part: [part() for _ in range(n)], 50, device), 3)
        row["contacts_ms"] = round(
            1e3 * seconds_a_step(lambda n: [worlds.contacts.solve() for _ in range(n)], 50, device), 3
        )
    return row


def peer(count: int, device: str, steps: int, *, touched: bool) -> dict[str, object]:
    """Returns the measurement of mujoco_warp, of which plants, bar and arm are bodies of one model."""
    import mujoco
    import mujoco_warp as mjw

    m = mujoco.MjModel.from_xml_string(peer_scene(touched=touched))
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    room = {"nconmax": 64, "njmax": 256} if touched else {}
    with wp.ScopedDevice(device):
        model = mjw.put_model(m)
        data = mjw.put_data(m, d, nworld=count, **room)
        mjw.step(model, data)
        with wp.ScopedCapture() as capture:
            mjw.step(model, data)

    def launch(number: int) -> None:
        for _ in range(number):
            wp.capture_launch(capture.graph)

    took = seconds_a_step(launch, steps, device)
    return {
        "case": "mujoco_warp",
        "touched": touched,
        "worlds": count,
        "nv": int(m.nv),
        "ms": round(1e3 * took, 3),
        "world_steps_s": round(count / took),
        "contacts": int(data.nacon.numpy()[0]),
        "finite": bool(np.isfinite(data.qpos.numpy()).all()),
    }


def peer_scene(*, touched: bool) -> str:
    """Returns the MJCF of the same arm and canes."""
    body = '<body pos="-0.6 0 0.5"><geom type="cylinder" size=".06 .1" mass="5" contype="0" conaffinity="0"/>'
    for i, axis in enumerate(AXES):
        body += (
            f'<body pos="0.15 0 0"><joint name="j{i}" axis="{axis}" range="-2.5 2.5" damping="1" armature=".1"/>'
            '<geom type="capsule" fromto="0 0 0 .13 0 0" size=".04" mass="1.5"/>'
        )
    for side, y in (("l", 0.03), ("r", -0.03)):
        body += (
            f'<body pos="0.16 {y} 0"><joint name="{side}" type="slide" axis="0 1 0" range="-.03 .03" damping="5" '
            'armature=".01"/><geom type="box" size=".04 .006 .012" mass=".1"/></body>'
        )
    body += "</body>" * (len(AXES) + 1)
    for number in range(CANES):
        for i in range(16):
            at = f"0.6 {SPACING * number - 0.3} {HEIGHT}" if i == 0 else "0.0625 0 0"
            body += (
                f'<body pos="{at}"><joint type="ball" stiffness="12" damping="0.05"/>'
                '<geom type="capsule" fromto="0 0 0 0.0625 0 0" size=".004" mass="0.0025"/>'
            )
        body += (
            '<body pos="0.0625 0 0"><joint type="ball" stiffness="0.5" damping="0.002"/>'
            '<geom type="capsule" fromto="0 0 -.04 0 0 -.14" size=".04" mass=".4"/></body>'
        )
        body += "</body>" * 16
    bar = (
        f'<geom type="capsule" fromto="{BAR[0]} -1 {BAR[1]} {BAR[0]} 1 {BAR[1]}" size="{BAR_RADIUS}"/>'
        if touched
        else ""
    )
    servos = "".join(f'<position joint="j{i}" kp="300" kv="30"/>' for i in range(len(AXES)))
    servos += "".join(f'<position joint="{side}" kp="500" kv="20"/>' for side in "lr")
    return (
        '<mujoco><option timestep="0.01" integrator="discrete" iterations="20"/>'
        '<default><geom friction="0.8"/></default>'
        f'<worldbody><geom type="plane" size="5 5 .1"/>{bar}{body}</worldbody><actuator>{servos}</actuator></mujoco>'
    )


def card(device: str) -> dict[str, str]:
    """Returns the names of the device and of its driver."""
    if device == "cpu":
        return {"device": "cpu"}
    asked = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    driver = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.split("\n")[0]
    return {"device": wp.get_device(device).name, "driver": driver}


def main() -> None:
    parser = argparse.ArgumentParser(description="steps of whole worlds a second, beside mujoco_warp")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--settle", type=int, default=3000, help="steps after which the canes hang still")
    parser.add_argument("--single", type=int, default=0, help="also this many worlds of one cane")
    parser.add_argument("--no-peer", action="store_true")
    parser.add_argument("--deterministic", action="store_true", help="ours: equal worlds stay equal to the bit")
    options = parser.parse_args()
    wp.config.quiet = True
    on = card(options.device)
    for count in options.worlds:
        for touched in (False, True):
            row = ours(
                count,
                options.device,
                options.steps,
                CANES,
                touched=touched,
                settle=options.settle,
                deterministic=options.deterministic,
            )
            print(json.dumps(on | row), flush=True)
            if not options.no_peer:
                print(json.dumps(on | peer(count, options.device, options.steps, touched=touched)), flush=True)
    if options.single:
        print(json.dumps(on | ours(options.single, options.device, 20, 1, touched=True, settle=0)), flush=True)


if __name__ == "__main__":
    main()
