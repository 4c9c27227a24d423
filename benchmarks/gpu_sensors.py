"""Cameras and lidars on a GPU: their agreement with a CPU, and their frames and rays a second. Prints JSON lines.

    python benchmarks/gpu_sensors.py [--device cuda] [--scene vsp]

First come all comparisons with the CPU of the same machine, then times. Times are medians of replayed CUDA graphs, in
which no launch waits for Python, and of whole frames that a program receives.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.raster import ray_cast
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import RigidVisual, Shape, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import MAX_DEPTH, pinhole

VIEWS = {
    "along a row": ((-0.6, 1.0, 1.45), (8.0, 1.35, 1.45)),
    "at bunches": ((1.15, 0.95, 1.45), (2.1, 0.1, 1.3)),
    "a leaf before the lens": ((1.1, 0.2, 1.5), (2.0, 0.4, 1.5)),
    "down on it all": ((4.0, -3.0, 6.0), (9.0, 4.0, 0.0)),
}
STAND = np.array([3.7, 1.25, 1.0, 0.0, 0.0, 0.0, 1.0])


def things() -> RigidVisual:
    """Returns one rigid solid of each kind, side by side."""
    shapes = [("box", 0.2, 0.1, 0.3), ("cylinder", 0.08, 0.2), ("capsule", 0.07, 0.2), ("ellipsoid", 0.1, 0.05, 0.2)]
    at = frames.pose(np.array([[0.3 * i, 0.0, 0.0] for i in range(len(shapes))]))
    return RigidVisual(
        "things", Organ.ROBOT, 0, tuple(Shape(k, tuple(s), q) for (k, *s), q in zip(shapes, at, strict=True))
    )


def world(model: Model, device: str) -> tuple[Primitives, Snapshot]:
    """Returns the primitives and a snapshot of the vineyard with some rigid solids in it."""
    primitives = Primitives(model, device=device)
    view = rest_snapshot(model, (things(),), np.array([[1.6, 0.6, 1.2, *frames.from_yaw(0.5)]]))
    primitives.update(view)
    return primitives, view


class Report:
    """Prints lines of JSON that each contain the name of the device."""

    def __init__(self, device: str) -> None:
        name = driver = "none"
        if device != "cpu":
            query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
            answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
            name, driver = answer.splitlines()[0].split(", ")
        self._about = {"device": name, "driver": driver, "warp": wp.config.version}

    def __call__(self, case: str, value: float, unit: str) -> None:
        sys.stdout.write(json.dumps({"bench": "gpu-sensors", "case": case, "value": value, "unit": unit} | self._about))
        sys.stdout.write("\n")
        sys.stdout.flush()


def compare(say: Report, model: Model, device: str) -> None:
    """Compare pictures and scans of ``device`` with those of the CPU of the same machine."""
    (ours, _) = world(model, device)
    (theirs, _) = world(model, "cpu")
    spec = CameraSpec.load("pinhole")
    info = spec.info("optical")
    for name, (eye, target) in VIEWS.items():
        pose = look_at(np.array(eye), np.array(target))
        seen = []
        for primitives, where in ((ours, device), (theirs, "cpu")):
            camera = Camera(spec, info, device=where)
            frame = camera.render(primitives, pose)
            seen.append((camera.rasterizer.primitive.numpy().reshape(frame.depth.shape), frame))
        (a, mine), (b, other) = seen
        same = (a == b) & (a >= 0)
        say(f"{name}: pixels that see the primitive that the CPU sees", float((a == b).mean()), "1")
        apart = np.abs(mine.depth[same] - other.depth[same]) / other.depth[same]
        say(f"{name}: depth of those, 99.9 % differ by less than", float(np.quantile(apart, 0.999)), "1")
        grey = np.abs(mine.rgb.astype(int) - other.rgb.astype(int)).max(-1)[a == b]
        say(f"{name}: picture of those, within 2 grey levels", float((grey <= 2).mean()), "1")
    scans = [
        Lidar(LidarSpec.load("vlp16"), device=where).scan(primitives, STAND)
        for primitives, where in ((ours, device), (theirs, "cpu"))
    ]
    a, b = (
        {
            (ring, offset): (label, xyz)
            for ring, offset, label, xyz in zip(s.ring, s.offset, s.labels, s.xyz, strict=True)
        }
        for s in scans
    )
    equal = [shot for shot in a.keys() & b.keys() if a[shot][0] == b[shot][0]]
    say("lidar: shots that return the label that the CPU's do", len(equal) / max(len(a), len(b)), "1")
    apart = [np.linalg.norm(a[shot][1] - b[shot][1]) for shot in equal]
    say("lidar: range of those, 99.9 % differ by less than", float(1e3 * np.quantile(apart, 0.999)), "mm")


def milliseconds(work: Callable[[], object], device: str, replays: int = 20, rounds: int = 7) -> float:
    """Returns the median time [ms] of ``work`` on a device, from a replayed CUDA graph. On a CPU ``work`` is called
    itself."""
    work()
    if device == "cpu":
        start = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - start)
    with wp.ScopedCapture(device=device) as capture:
        work()
    took = []
    for _ in range(rounds + 1):
        start, end = (wp.Event(device=device, enable_timing=True) for _ in range(2))
        wp.record_event(start)
        for _ in range(replays):
            wp.capture_launch(capture.graph)
        wp.record_event(end)
        took.append(wp.get_event_elapsed_time(start, end) / replays)
    return statistics.median(took[1:])


def rate(work: Callable[[int], object], device: str, count: int = 300) -> float:
    """Returns how many calls of ``work`` a second the host completes, together with their computation on the device."""
    for n in range(20):
        work(n)
    wp.synchronize_device(device)
    start = time.perf_counter()
    for n in range(count):
        work(n)
    wp.synchronize_device(device)
    return count / (time.perf_counter() - start)


def revolution(lasers: int, steps: int) -> np.ndarray:
    """Returns directions [ray, 3] of one revolution of a lidar, from 15 degrees below to 15 above level, laser by
    laser."""
    height, turn = np.meshgrid(np.radians(np.linspace(-15.0, 15.0, lasers)), np.arange(steps) * (2.0 * np.pi / steps))
    height = height.T.ravel()
    turn = turn.T.ravel()
    flat = np.cos(height)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(height)], 1).astype(np.float32)


def measure(say: Report, model: Model, device: str) -> None:
    primitives, view = world(model, device)
    about = f"640x480, {primitives.count} primitives"
    spec = CameraSpec.load("pinhole")
    info = spec.info("optical")
    for name, (eye, target) in VIEWS.items():
        pose = look_at(np.array(eye), np.array(target))
        lens = pinhole(info, pose)
        for quality in ("fast", "full"):
            camera = Camera(spec, info, quality=quality, device=device)
            camera.render_on_device(primitives, pose)
            spent = milliseconds(lambda c=camera, p=pose: c.render_on_device(primitives, p), device)
            say(f"{name}: {quality} frame, cached shadows, {about}", spent, "ms")
        spent = milliseconds(lambda c=camera, at=lens: c.rasterizer.draw(primitives, at), device)
        say(f"{name}: visibility alone, {about}", spent, "ms")
        for reach, one in (("near", camera._sunlight._near), ("far", camera._sunlight._far)):
            say(
                f"{name}: {reach} shadows drawn anew",
                milliseconds(lambda m=one: m._draw(primitives, m._whole()), device),
                "ms",
            )
    poses = [look_at(np.array([-0.6 + 1e-4 * n, 1.0, 1.45]), np.array([8.0, 1.35, 1.45])) for n in range(400)]
    for quality in ("fast", "full"):
        camera = Camera(spec, info, quality=quality, device=device)
        often = rate(lambda n, c=camera: c.render_on_device(primitives, poses[n]), device)
        say(f"{quality} frames left on the device, moving camera, {about}", often, "1/s")
        often = rate(lambda n, c=camera: c.render(primitives, poses[n]), device)
        say(f"{quality} frames handed to the host, moving camera, {about}", often, "1/s")
    lidar = Lidar(LidarSpec.load("vlp16"), device=device)
    say("lidar scans handed to the host", rate(lambda n: lidar.scan(primitives, STAND), device, 100), "1/s")
    tree = RayCaster(primitives)
    for lasers, steps in ((16, 1800), (64, 2048), (1024, 4096)):
        d = revolution(lasers, steps)
        start = wp.array(np.broadcast_to(STAND[:3].astype(np.float32), d.shape).copy(), dtype=wp.vec3, device=device)
        direction = wp.array(d, dtype=wp.vec3, device=device)
        found = [wp.empty(len(d), dtype=t, device=device) for t in (float, wp.int32)]

        def cast(start: wp.array = start, direction: wp.array = direction, found: list[wp.array] = found) -> None:
            inputs = [primitives.shapes, tree.hierarchies(), start, direction, MAX_DEPTH]
            wp.launch(ray_cast.cast_rays, len(start), inputs=inputs, outputs=found, device=device)

        say(f"{lasers} lasers, {len(d)} rays at once", len(d) / milliseconds(cast, device) / 1e6, "G rays/s")
    trees = np.unique(model.body_tree[model.bunch_body])[:20]
    awake = dataclasses.replace(view, moved_trees=trees)

    def follow(n: int) -> None:
        primitives.update(awake)
        lidar.scan(primitives, STAND)

    say(
        "20 trees moved, hierarchies refitted, one revolution handed to the host", 1e3 / rate(follow, device, 100), "ms"
    )


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("--device", default="cuda")
    ask.add_argument("--scene", default="vsp")
    given = ask.parse_args()
    say = Report(given.device)
    model = generate(load_scene(given.scene))
    compare(say, model, given.device)
    measure(say, model, given.device)


if __name__ == "__main__":
    main()
