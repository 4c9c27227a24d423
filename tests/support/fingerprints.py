"""Hashes of what vinesim computes, to show that a change of its code changes no bit: ``python
tests/support/fingerprints.py``

One line each for a push, a pick, a fall, a frame, a scan and messages. The hashes hold on one machine and with one set
of dependencies only (kernels are compiled for the processor), so none is kept: run it before a change and after it, and
compare.
"""

from __future__ import annotations

import hashlib
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))

from tests.laws import test_determinism
from tests.net import test_messages
from tests.robot.test_pick import picker, vineyard
from vinesim.client.tasks import start_poses
from vinesim.net.codec.objects import encode_objects
from vinesim.net.codec.robot import encode_robot
from vinesim.net.codec.trees import encode_trees
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickBunch
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene as load_scene
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.world import Physics


def _hash(*parts: bytes) -> str:
    return hashlib.blake2b(b"".join(parts), digest_size=16).hexdigest()


def push() -> str:
    """Three seconds of a robot that reaches for a bunch of the demo's vineyard and pushes it."""
    model = generate(load_scene("demo"))
    bunch, stand = start_poses.find_push_pose(model, np.zeros(2))
    physics = Physics(model)
    robot = Robot(physics.rigid, load_description("vinebot"), "anna", pose=stand)
    body = model.bunch_body[bunch]
    task = PushBunch(robot, "left", lambda: physics.state.body_q[body, :3])
    h = hashlib.blake2b(digest_size=16)
    for _ in range(300):
        task.control(physics.time)
        robot.control(physics.time)
        physics.step()
        test_determinism.digest(physics, h)
    return h.hexdigest()


def pick() -> str:
    """The picking task from start to end."""
    model, plan = vineyard(7)
    physics = Physics(model)
    task = PickBunch(physics, picker(physics, load_description("vinebot"), plan.base_pose), plan)
    h = hashlib.blake2b(digest_size=16)
    while not task.is_done:
        task.control(physics.time)
        task.robot.control(physics.time)
        physics.step()
        test_determinism.digest(physics, h)
    return h.hexdigest()


def fall() -> str:
    """Canes pushed, held, cut and picked by moving bars; then a vineyard with random joint rates."""
    return _hash(test_determinism.eventful_run()[0].encode(), test_determinism.vineyard_run().encode())


def frame() -> str:
    """A picture of the demo's vineyard with a robot, a human and a crate: colour, depth, labels, truth."""
    arguments = [
        "render",
        "demo",
        "--at",
        "0.4,1.2,1.3",
        "--look",
        "3,1,1.7",
        "--robot",
        "vinebot@1.8,0.9,3.1",
        "--person",
        "2.6,0.4",
        "--crate",
        "1.4,0.1,0.2",
        "--hour",
        "10",
        "--out",
    ]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "vinesim", *arguments, folder], check=True, stdout=subprocess.DEVNULL)
        return _hash(*(path.read_bytes() for path in sorted(pathlib.Path(folder).iterdir())))


def scan() -> str:
    """One revolution of each lidar in the demo's vineyard."""
    model = generate(load_scene("demo"))
    primitives = Primitives(model)
    primitives.update(rest_snapshot(model))
    pose = np.array([1.2, 0.9, 0.8, 0.0, 0.0, 0.0, 1.0])
    parts = []
    for name in ("vlp16", "os1_64"):
        done = Lidar(LidarSpec.load(name)).scan(primitives, pose)
        parts += [done.xyz.tobytes(), done.intensity.tobytes(), done.ring.tobytes(), done.labels.tobytes()]
    return _hash(*parts)


def message() -> str:
    """Messages of robots, branches and rigid objects."""
    rng = np.random.default_rng(11)
    robot = encode_robot(test_messages.robot(rng))
    trees = test_messages.cut(test_messages.trees(rng, [14, 3, 25]), [1, 0, 2], rng)
    objects = test_messages.objects(rng, 40)
    return _hash(
        robot if isinstance(robot, bytes) else b"".join(robot),
        *encode_trees(trees)[0],
        *encode_objects(objects, (0, 0))[0],
    )


if __name__ == "__main__":
    for one in (push, pick, fall, frame, scan, message):
        print(f"{one.__name__:8} {one()}", flush=True)
