"""Two runs are bitwise equal: plants, contacts, grasp, cut, fall, sleep and waking, a stopped tree."""

from __future__ import annotations

import hashlib
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from tests.support.waiting import deadline
from vinesim.bench import scenes as scenes
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.world import Physics

pytestmark = pytest.mark.slow

HERE = pathlib.Path(__file__)


def digest(physics: Physics, h: hashlib._Hash) -> None:
    """Hash all state that the next step depends on, and detachments."""
    state = physics.state
    for name in state.array_fields():
        h.update(np.ascontiguousarray(getattr(state, name)).tobytes())
    h.update(physics.rigid.mj_data.qpos.tobytes() + physics.rigid.mj_data.qvel.tobytes())
    for contact in physics.contacts:
        h.update(repr((contact.actor, contact.link, contact.body)).encode())
        h.update(contact.force.tobytes() + contact.position.tobytes())
    h.update(physics.plants.awake.tobytes() + repr([(p.body, p.cause) for p in physics.detachments]).encode())


def eventful_run() -> tuple[str, dict[str, int]]:
    """Hash of 300 steps, and the number of events of each kind."""
    events = dict.fromkeys(("contacts", "detachments", "woken", "rested", "stopped"), 0)
    h = hashlib.blake2b(digest_size=16)
    physics = Physics(scenes.cane_row(5))
    robots = [scenes.bar("bar", 0, 2), scenes.gripper("hand", scenes.bunch_center(2))]
    for robot in robots:
        physics.add_robot(robot)
    physics.sleep_monitor.patience = 20
    for tick in range(300):
        ramp = min(1.0, tick / 60)
        physics.rigid.command("bar", np.array([0.06 * ramp if tick < 150 else 0.0]))
        physics.rigid.command("hand", ramp * np.array([0.05, 0.05, 0.05]) * (tick < 220))
        if tick == 120:
            physics.pick(2)  # while the gripper holds it
        if tick == 140:
            physics.cut(3 * 19 + 8)  # half a cane falls
        if tick == 160:
            physics.plants.wake(4)
            physics.plants.body_load[4 * 19 + 12, 1] = np.nan
        before = physics.plants.awake
        physics.step()
        events["contacts"] += len(physics.contacts)
        events["detachments"] += len(physics.detachments)
        events["woken"] += len(np.setdiff1d(physics.plants.awake, before))
        events["rested"] += len(np.setdiff1d(before, physics.plants.awake))
        events["stopped"] = int(physics.fault_guard.count.sum())
        digest(physics, h)
    return h.hexdigest(), events


def vineyard_run() -> str:
    """Hash of half a second of the demo vineyard with random joint rates."""
    model = generate(load_scene("demo"))
    h = hashlib.blake2b(model.digest().encode(), digest_size=16)
    physics = Physics(model)
    physics.plants.wake(np.arange(0, len(model.tree_first), 3))
    physics.state.joint_qd[:] = np.random.default_rng(5).normal(size=physics.state.joint_qd.shape)
    for _ in range(50):
        physics.step()
        digest(physics, h)
    return h.hexdigest()


def test_two_runs_in_one_process() -> None:
    first, events = eventful_run()
    assert min(events.values()) > 0, events  # every kind of event occurred
    assert eventful_run() == (first, events)
    assert vineyard_run() == vineyard_run()


def test_two_runs_in_two_processes() -> None:
    """With other hash seeds and addresses."""
    path = os.pathsep.join([str(HERE.parents[2]), os.environ.get("PYTHONPATH", "")])
    other = subprocess.run(
        [sys.executable, str(HERE)],
        capture_output=True,
        text=True,
        check=True,
        timeout=deadline(120.0),
        env=os.environ | {"PYTHONHASHSEED": "1", "PYTHONPATH": path},
    )
    assert other.stdout.splitlines()[-1] == f"{eventful_run()[0]} {vineyard_run()}"


if __name__ == "__main__":
    print(eventful_run()[0], vineyard_run())
