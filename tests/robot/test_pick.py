"""The picking job: a bunch of a seeded vineyard ends in a box, and weighs there what it weighed on its vine."""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np
import pytest

from tests.support.contact_forces import pressed_on_ground
from vinesim.client.tasks import planning, start_poses
from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.pick import PickBunch, PickPlan, stalk_length
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene as load_scene
from vinesim.scene.spec import with_seed
from vinesim.world import Physics

pytestmark = pytest.mark.slow

GRAVITY = 9.81


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@functools.cache
def vineyard(seed: int) -> tuple[Model, PickPlan]:
    plan = with_seed(load_scene("harvest"), seed)
    model = generate(plan)
    return model, next(planning.plan_picks(model, start_poses.spawn_pose(plan, 0)[:2]))


def disable_sleep(physics: Physics) -> None:
    """Disable sleep, so that MuJoCo computes the forces of resting bodies, too."""
    physics.rigid.mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def picker(physics: Physics, description: RobotDescription, pose: np.ndarray) -> Robot:
    robot = Robot(physics.rigid, description, "anna", pose=pose)
    robot.fit_cutters(physics)
    return robot


def run(pick: PickBunch) -> PickBunch:
    while not pick.is_done:
        pick.control(pick.physics.time)
        pick.robot.control(pick.physics.time)
        pick.physics.step()
    return pick


@pytest.mark.parametrize(("name", "seed"), [("demo", 3), ("harvest", 7)])
def test_the_bars_of_the_cutter_pass_above_the_shoulders_of_every_bunch(name: str, seed: int):
    """Shoulders: fruit 20 mm or more beside the stalk, as high as its collision shapes; a bar is 6 mm thick."""
    model = generate(with_seed(load_scene(name), seed))
    capsules = plant_capsules(model)
    pose = model.forward_kinematics(model.joint_settled).astype(float)
    fruit = np.flatnonzero((capsules.bunch >= 0) & (model.body_organ[capsules.body] == int(Organ.BUNCH)))
    of = capsules.bunch[fruit]
    radius = capsules.radius[fruit].astype(float)
    points = [frames.pose(at[fruit].astype(float)) for at in (capsules.start, capsules.end)]
    ends = [frames.compose(pose[capsules.body[fruit]], point)[:, :3] for point in points]
    upper = frames.inverse(pose[model.bunch_body[of]])
    depth = np.minimum(*(frames.compose(upper, frames.pose(end))[:, 0] for end in ends))
    beside = 0.020
    height = np.where(radius > beside, np.sqrt(np.maximum(radius**2 - beside**2, 0.0)) - depth, -np.inf)
    sizes = zip(model.bunch_radius.tolist(), model.bunch_length.tolist(), strict=True)
    stalk = np.array([stalk_length(*size) for size in sizes])
    assert len(np.unique(of)) == len(stalk) > 50
    assert (stalk[of] - height).min() > 0.003
    assert stalk.max() < 0.025  # the shortest peduncle is 50 mm long


@pytest.mark.long
def test_a_picked_bunch_ends_in_the_box_with_its_weight(vinebot: RobotDescription):
    model, task = vineyard(7)
    physics = Physics(model)
    robot = picker(physics, vinebot, task.base_pose)
    disable_sleep(physics)
    body = model.bunch_body[task.bunch]
    physics.plants.wake(int(model.body_tree[body]))
    for _ in range(30):
        robot.control(physics.time)
        physics.step()
    on_vine = float(physics.plants.joint_wrench(np.array([body]))[0, 2])
    empty = pressed_on_ground(physics, task.box)
    assert empty == pytest.approx(float(model.box_mass[task.box]) * GRAVITY, rel=1e-3)

    pick = run(PickBunch(physics, robot, task))
    assert pick.picked, pick.reason
    assert not physics.state.bunch_attached[task.bunch]
    assert physics.state.bunch_attached.sum() == len(model.bunch_body) - 1, "another bunch was detached"
    for _ in range(150):
        robot.control(physics.time)
        physics.step()
    assert pick.in_box
    in_box = np.mean([_next(physics, robot, task.box) for _ in range(50)]) - empty
    assert on_vine > 3.0
    assert in_box == pytest.approx(on_vine, rel=0.01)
    # cut by the blade, not pulled off; the hand is empty now
    assert np.abs(physics.rigid.bunch_pose(task.bunch)[:3] - pick.arm.tip_position).max() > 0.2


def _next(physics: Physics, robot: Robot, box: int) -> float:
    robot.control(physics.time)
    physics.step()
    return pressed_on_ground(physics, box)


def test_a_bunch_out_of_reach_is_refused_with_the_reason(vinebot: RobotDescription):
    model, task = vineyard(7)
    distant = frames.compose(task.base_pose, frames.pose([-0.8, 0.0, 0.0]))
    physics = Physics(model)
    pick = run(PickBunch(physics, picker(physics, vinebot, distant), task))
    assert not pick.picked
    assert pick.reason.startswith("reach: the hand is 0.")
    assert "out of reach" in pick.reason
    assert physics.state.bunch_attached.all()


def test_a_failed_cut_is_reported_with_the_reason(vinebot: RobotDescription, monkeypatch: pytest.MonkeyPatch):
    model, task = vineyard(7)
    physics = Physics(model)
    robot = picker(physics, vinebot, task.base_pose)
    monkeypatch.setattr(robot, "command_cutter", lambda group, force: None)
    pick = run(PickBunch(physics, robot, task))
    assert not pick.picked
    assert pick.reason.startswith("cut: the blades missed the stalk")
    assert physics.state.bunch_attached.all()


def test_a_missing_bunch_is_reported_with_the_reason(vinebot: RobotDescription):
    """The fingers close in empty space, as the bunch has fallen before."""
    model, task = vineyard(7)
    physics = Physics(model)
    pick = PickBunch(physics, picker(physics, vinebot, task.base_pose), task)
    while pick.phase != "advance":
        pick.control(physics.time)
        pick.robot.control(physics.time)
        physics.step()
    physics.pick(task.bunch)
    assert "slipped out of the fingers" in run(pick).reason


def test_a_robot_without_a_cutter_is_refused(vinebot: RobotDescription):
    model, task = vineyard(7)
    physics = Physics(model)
    robot = picker(
        physics,
        dataclasses.replace(vinebot, grippers=tuple(g for g in vinebot.grippers if g not in vinebot.cutters)),
        task.base_pose,
    )
    with pytest.raises(CommandError, match="no gripper with a cutter on its"):
        PickBunch(physics, robot, task)


@pytest.mark.long
def test_two_picks_are_bitwise_equal(vinebot: RobotDescription):
    ends = []
    for _ in range(2):
        model, task = vineyard(7)
        physics = Physics(model)
        pick = PickBunch(physics, picker(physics, vinebot, task.base_pose), task)
        while pick.phase != "tuck":
            pick.control(physics.time)
            pick.robot.control(physics.time)
            physics.step()
        ends.append(physics.rigid.mj_data.qpos.tobytes() + physics.state.joint_q.tobytes())
    assert ends[0] == ends[1]
