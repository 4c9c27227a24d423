"""Pictures of all worlds of a batch: pictures a second on one device. One JSON object a line.

    python -m benchmarks.world_pictures                    # needs an NVIDIA GPU
    python -m benchmarks.world_pictures --worlds 8 --size 64 --device cpu --frames 3

Scene *shoots*: the arm and the four shoots of the task *reach*, seen by the cameras of that task. Scene *vine*: eight
shoots of a vine with leaves, posts and wires instead. A row has the time of a call of ``WorldCameras.render`` for all
worlds (``ms``), that of each of its launches (``ms_`` and its name), the number of pictures divided by the time of a
call (``pictures_s``), with depth and ids and, unless ``--no-colours``, RGB, the primitives of a world, and the device
memory that the pictures of a world take (``kb_a_world``). The arm moves once before the measurement.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time

import numpy as np
import warp as wp

from benchmarks.worlds import card, seconds_a_step
from vinesim.learn.arm import arm
from vinesim.learn.arm_env import CAMERAS, VARIANTS
from vinesim.learn.arm_task import BASE, HOME
from vinesim.learn.reach import Reach
from vinesim.learn.variation import Variation
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.sensors.camera.world_cameras import WorldCameras
from vinesim.sensors.export.images import look_at
from vinesim.worlds.plants import gathered, plants_of_worlds
from vinesim.worlds.worlds import Worlds

SCENES = ("shoots", "vine")
TREES = 8
"""Number of shoots of a world in the scene *vine*."""


def batch(scene: str, count: int, device: str) -> tuple[Worlds, np.ndarray]:
    """Returns ``count`` worlds, and the point [3] m that the fixed camera looks at."""
    if scene == "shoots":
        models = [Reach.plants(np.random.default_rng([0, k]), Variation()) for k in range(min(count, VARIANTS))]
        middle = np.array([1.0, 0.0, 0.75])
        base = BASE
    else:
        vineyard = generate(load_scene("demo"))
        away = np.linalg.norm(vineyard.tree_pose[:, :2] - vineyard.tree_pose[0, :2], axis=1)
        order = np.argsort(away, kind="stable")
        models = [gathered(vineyard, order[2 * k : 2 * k + TREES]) for k in range(min(count, 16))]
        middle = models[0].tree_pose[:, :3].mean(0).astype(float)
        base = (float(middle[0]), float(middle[1]) - 1.0, float(middle[2]) - 0.5)
    return Worlds(plants_of_worlds(models, count), count, robots=[arm(base, HOME)], device=device), middle


def measure(scene: str, count: int, cameras: int, size: int, device: str, frames: int, *, colours: bool) -> dict:
    """Returns a row."""
    began = time.perf_counter()
    worlds, middle = batch(scene, count, device)
    made = time.perf_counter()
    fixed, on_hand = CAMERAS
    views = [on_hand]
    for number in range(cameras - 1):
        eye = middle + np.array([-0.6 + 0.2 * number, -1.2, 0.4])
        views.append(dataclasses.replace(fixed, pose=look_at(eye, middle)))
    seen = WorldCameras(worlds, views[:cameras], (size, size), colours=colours)
    seen.render()
    wp.synchronize_device(device)
    started = time.perf_counter()
    worlds.bodies.targets.assign(worlds.bodies.targets.numpy() + np.float32(0.1))
    worlds.step(4)
    took = seconds_a_step(lambda n: [seen.render() for _ in range(n)], frames, device)
    row: dict[str, object] = {
        "case": "pictures",
        "scene": scene,
        "worlds": count,
        "cameras": cameras,
        "px": size,
        "colours": colours,
        "ms": round(1e3 * took, 3),
        "pictures_s": round(count * cameras / took),
        "primitives": seen.primitives,
        "kb_a_world": round(seen.memory() / 1e3),
        "worlds_start_s": round(made - began, 1),
        "start_s": round(started - made, 1),
    }
    for name, launch in seen.launches.items():
        one = seconds_a_step(
            lambda n, launch=launch: [launch.launch(1, wp.get_device(device)) for _ in range(n)], frames, device
        )
        row[f"ms_{name}"] = round(1e3 * one, 3)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description="pictures of all worlds of a batch a second")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024])
    parser.add_argument("--cameras", type=int, default=2, help="cameras of a world, one of them on the hand")
    parser.add_argument("--size", type=int, nargs="+", default=[128], help="width and height [px]")
    parser.add_argument("--frames", type=int, default=20, help="calls that are timed")
    parser.add_argument("--scenes", nargs="+", default=[*SCENES], choices=SCENES)
    parser.add_argument("--no-colours", action="store_true", help="depth and ids only")
    options = parser.parse_args()
    wp.config.quiet = True
    on = card(options.device)
    for scene in options.scenes:
        for count in options.worlds:
            for size in options.size:
                row = measure(
                    scene,
                    count,
                    options.cameras,
                    size,
                    options.device,
                    options.frames,
                    colours=not options.no_colours,
                )
                print(json.dumps(on | row), flush=True)


if __name__ == "__main__":
    main()
