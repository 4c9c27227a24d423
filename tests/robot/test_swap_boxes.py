"""The exchange task: a full box is carried away with its bunches, and an empty one takes its place."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from vinesim.client.tasks import planning, start_poses
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.swap_boxes import LIFT_HEIGHT, SwapBoxes, SwapPlan
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene as load_scene
from vinesim.world import Physics

pytestmark = pytest.mark.slow


@functools.cache
def yard() -> tuple[Model, SwapPlan]:
    plan = load_scene("harvest")
    model = generate(plan)
    return model, planning.plan_swap(model, start_poses.spawn_pose(plan, 1))


def start_task(count: int = 6) -> SwapBoxes:
    model, swap = yard()
    physics = Physics(model, detachment=False)
    robot = Robot(physics.rigid, load_description("logistic"), "carrier", pose=swap.start)
    planning.fill_box(physics, swap.full_box, count)
    return SwapBoxes(physics, robot, swap)


def tick(task: SwapBoxes) -> None:
    task.control(task.physics.time)
    task.robot.control(task.physics.time)
    task.physics.step()


@pytest.mark.long
def test_a_full_box_is_exchanged_for_an_empty_one():
    task = start_task()
    model, swap = yard()
    place = task.box_pose(swap.full_box).copy()
    load_kg = sum(float(model.body_mass[model.bunch_body[bunch]]) for bunch in task.physics.rigid.free_bunches)
    lift = task.robot.description.joint_indices("lift_front")[0]
    carried = []
    while not task.is_done:
        tick(task)
        if task.phase == "turn":
            carried.append(task.robot.rigid.joint_measurements("carrier")[2][lift])
    assert task.succeeded, task.reason
    report = task.report()
    assert report["exchanged"]
    assert report["bunches"] == 6
    assert np.linalg.norm(task.box_pose(swap.empty_box)[:2] - place[:2]) < 0.05
    assert task.box_pose(swap.empty_box)[2] == pytest.approx(0.0, abs=2e-3), "on the ground"
    assert task.box_pose(swap.full_box)[2] == pytest.approx(LIFT_HEIGHT, abs=0.01), "on the carrier"
    # the lift carries its own parts, the box, and every bunch in it
    parts = 6.0 + 2 * 1.5
    expected = 9.81 * (parts + float(model.box_mass[swap.full_box]) + load_kg)
    assert np.median(carried) == pytest.approx(expected, rel=0.01)


def test_a_missing_box_is_reported_with_the_reason():
    task = start_task(count=0)
    joint = task.physics.rigid.mj_data.joint("box/1")
    while task.phase != "take the empty box":
        tick(task)
    joint.qpos[2] = 5.0  # the box is removed
    joint.qvel[:] = 0.0
    for _ in range(20):
        joint.qpos[2] = 5.0
        joint.qvel[2] = 0.0
        tick(task)
    while not task.is_done:
        joint.qpos[2] = 5.0
        joint.qvel[2] = 0.0
        tick(task)
    assert not task.succeeded
    assert task.reason.startswith("take the empty box: the rear paddles feel 0 N")


def test_a_robot_without_clamps_is_refused():
    model, swap = yard()
    physics = Physics(model)
    robot = Robot(physics.rigid, load_description("vinebot"), "anna", pose=swap.start)
    with pytest.raises(CommandError, match="no group 'lift_front'"):
        SwapBoxes(physics, robot, swap)


def test_an_unknown_box_is_refused():
    model, swap = yard()
    with pytest.raises(start_poses.PlacementError, match="no box 7: this scene has 2"):
        planning.plan_swap(model, swap.start, full=7)
