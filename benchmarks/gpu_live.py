"""A whole client, a camera and the making of a data set on a GPU, in JSON lines; needs neither ROS nor a network.

    python benchmarks/gpu_live.py [--device cuda] [--seconds 20] [--images 320] [--only client]

The client is set up as ``vinesim client --device cuda`` sets it up: its loop runs here at 100 Hz, its sensors in a
process of their own. That process renders four D435 (640x480, colour and depth, 30 Hz) and an OS1-64 (64x1024, 10 Hz),
which are always wanted. Then one camera is measured whose frames are handed to the host as fast as they come, and at
last ``vinesim dataset`` with its ground truth. If one part fails, a line reports the failure, and the other parts run.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import multiprocessing
import os
import pathlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgspec
import numpy as np
import warp as wp

from vinesim.cli.client_session import SWITCH_INTERVAL, run_loop
from vinesim.client.client import Client
from vinesim.client.processes import sensor_process, sensor_worker
from vinesim.client.rate_loop import RateLoop
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.start_poses import find_reachable_bunch, spawn_pose, start_pose
from vinesim.kernels.compilation import compile_kernels
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraMount, CameraOutput
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

CAMERAS = 4
WARM_UP = 3.0
"""Real time before the count of frames begins [s]."""
RGBD = CameraOutput.RGB | CameraOutput.DEPTH


def render_all(config: Any, channel: Any, pipe: Any) -> None:
    """Entry point of the sensor process. Unlike the client's own, it renders every sensor without any subscriber."""
    worker: Any = sensor_worker.SensorWorker
    worker._demand = lambda self, mount: lambda: RGBD if mount.kind == CameraMount.kind else CameraOutput.DEPTH
    sensor_worker.run_sensor_worker(config, channel, pipe)


class Report:
    """Prints lines of JSON that each contain the name of the device."""

    def __init__(self, device: str) -> None:
        name = driver = "none"
        if device != "cpu":
            query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
            answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
            name, driver = answer.splitlines()[0].split(", ")
        self._about = {"device": name, "driver": driver, "warp": wp.config.version, "cores": os.cpu_count()}

    def __call__(self, case: str, value: float, unit: str) -> None:
        self.line({"case": case, "value": value, "unit": unit})

    def line(self, values: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps({"bench": "gpu-live"} | values | self._about) + "\n")
        sys.stdout.flush()


@contextlib.contextmanager
def running_client(device: str, plants: str) -> Iterator[tuple[Client, sensor_process.SensorProcess]]:
    """Yields a client whose robot pushes a bunch again and again, and its sensor process.

    ``device`` computes the sensors, ``plants`` is the device of the plants.
    """
    scene = load_scene("demo")
    model = generate(scene)
    robot = load_description("vinebot")
    cameras = tuple(msgspec.structs.replace(robot.sensors_of("camera")[0], name=f"camera_{i}") for i in range(CAMERAS))
    lidars = (msgspec.structs.replace(robot.sensors_of("lidar")[0], type="os1_64"),)
    robot = dataclasses.replace(robot, sensors=(*cameras, *lidars))
    sensor_process.run_sensor_worker = render_all
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(MemoryHub().bus("robot"))
        sensors = stack.enter_context(
            sensor_process.SensorProcess("robot", scene, model, robot, ros=False, device=device)
        )
        executor = stack.enter_context(ThreadPoolExecutor(1, "spawner"))
        client = Client(
            scene, model, robot, bus, name="robot", pose=start_pose(scene, 0), executor=executor, device=plants
        )
        stack.callback(client.leave)
        sensors.attach(client)
        bunch = find_reachable_bunch(model, spawn_pose(scene, 0))
        rest = client.physics.state.body_q[model.bunch_body[bunch]].copy()
        client.trace = trace = Trace(model, bunch, rest, 1 << 15)
        push = PushBunch(client.robot, client.side_of(trace.centre()), trace.centre)
        client.pre_step += [push.control, LookAt(client.robot, trace.centre)]
        yield client, sensors


def measure_client(report: Report, device: str, plants: str, seconds: float) -> None:
    """Print the rates of all sensors and of the client's ticks over ``seconds`` [s] of real time."""
    with running_client(device, plants) as (client, sensors):
        loop = RateLoop(client.physics.dt)
        marks = []
        stop = threading.Event()

        def watch() -> None:
            """Note the counts of frames from time to time, in a thread of its own: the client's loop must not wait for
            it."""
            while not stop.wait(0.25):
                marks.append((time.perf_counter(), sensors.report()))

        watcher = threading.Thread(target=watch)
        watcher.start()
        sys.setswitchinterval(SWITCH_INTERVAL)
        run_loop(stop, client.tick, loop, WARM_UP + seconds, loop.dt)
        stop.set()
        watcher.join()
    log = loop.log()
    ticks = log.between(log.begins[0] + WARM_UP, np.inf)
    text = f"client, {CAMERAS} cameras and a lidar on {device}, plants on {plants}"
    for key, unit in (("tick_hz", "Hz"), ("tick_p50_ms", "ms"), ("tick_p99_ms", "ms"), ("overruns", "1")):
        report(f"{text}: {key}", ticks[key], unit)
    (begin, before) = next(m for m in marks if m[0] > log.begins[0] + WARM_UP)
    (end, after) = marks[-1]
    for what in ("frames", "frames_dropped"):
        for name, count in after[what].items():
            report(f"{text}: {what} of {name}", (count - before[what].get(name, 0)) / (end - begin), "Hz")
    report.line({"case": f"{text}: sensors computed on", "value": after["sensor_device"], "unit": ""})


def measure_camera(report: Report, device: str, seconds: float) -> None:
    """Print how many frames a second one moving camera renders and hands to the host."""
    model = generate(load_scene("demo"))
    primitives = Primitives(model, device=device)
    primitives.update(rest_snapshot(model))
    for kind in ("pinhole", "d435"):
        spec = CameraSpec.load(kind)
        for quality in ("fast", "full"):
            camera = Camera(spec, spec.info("optical"), quality=quality, device=device)
            count = 0
            begin = 0.0
            end = now = np.inf
            for number in range(1_000_000):
                eye = np.array([-0.6 + 1e-4 * (number % 1000), 1.0, 1.45])
                camera.render(primitives, look_at(eye, np.array([8.0, 1.35, 1.45])), outputs=RGBD)
                now = time.perf_counter()
                if number == 3:
                    begin = now
                    end = now + seconds
                count += number > 3
                if now > end:
                    break
            report(f"{kind} {quality}, colour and depth handed to the host, moving", count / (now - begin), "1/s")


def measure_dataset(report: Report, device: str, images: int) -> None:
    """Print how many images a second ``vinesim dataset`` writes with their ground truth: over the whole run, and
    between the first and the last tenth of the images."""
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder) / "set"
        command = [sys.executable, "-m", "vinesim", "dataset", "--images", str(images), "--out", str(out)]
        start = time.time()
        subprocess.run([*command, "--device", device], check=True, stdout=subprocess.DEVNULL)
        took = time.time() - start
        done = np.sort([file.stat().st_mtime for file in (out / "records").iterdir()])
    low = images // 10
    high = images - images // 10 - 1
    report(f"dataset of {images} images of 640x480, starts and annotations included", images / took, "1/s")
    if high > low and done[high] > done[low]:
        report("dataset, from its first to its last tenth", (high - low) / (done[high] - done[low]), "1/s")
    report("dataset: from start to first image", done[0] - start, "s")


def main() -> None:
    ask = argparse.ArgumentParser()
    ask.add_argument("--device", default="cuda")
    ask.add_argument("--seconds", type=float, default=20.0, help="of the client; a third of it for each camera")
    ask.add_argument("--images", type=int, default=320)
    ask.add_argument("--only", choices=("client", "camera", "dataset"))
    given = ask.parse_args()
    report = Report(given.device)
    device = given.device
    start = time.perf_counter()
    compile_kernels(device=device)
    report("kernels compiled or loaded", time.perf_counter() - start, "s")
    parts: list[tuple[str, Callable[[], None]]] = [
        ("client", lambda: measure_client(report, device, device, given.seconds)),
        ("camera", lambda: measure_camera(report, device, given.seconds / 6.0)),
        ("dataset", lambda: measure_dataset(report, device, given.images)),
    ]
    if device != "cpu":
        parts.insert(1, ("client", lambda: measure_client(report, device, "cpu", given.seconds)))
    for name, measure in parts:
        if given.only in (None, name):
            try:
                measure()
            except Exception as fault:  # the measurements of the other parts are wanted nevertheless
                report.line({"case": name, "error": f"{type(fault).__name__}: {fault}"})


if __name__ == "__main__":
    multiprocessing.freeze_support()
    main()
