"""TIAGo Pro from its published, unedited description: holds, drives, grips, reaches and pushes a bunch."""

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.builder import assemble
from vinesim.world import Physics

pytestmark = pytest.mark.slow

BUNCH = np.array([0.65, 0.25, 1.25])
"""Centre of a hanging bunch, ahead of the robot's left shoulder [m]."""


@pytest.fixture(scope="module")
def tiago() -> RobotDescription:
    try:
        return load_description("tiago_pro")
    except DescriptionError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


class Vineyard:
    """One vine with a bunch in front of the robot, and a clock."""

    def __init__(self, description: RobotDescription) -> None:
        at_origin = assemble([cane((0.0, 0.0, 0.0), bunch=0.5)])
        pose = at_origin.forward_kinematics(at_origin.joint_settled)[at_origin.bunch_body[0]]
        middle = pose[:3] + frames.rotate(pose[3:].astype(float), np.array([0.085, 0.0, 0.0]))
        self.physics = Physics(assemble([cane(BUNCH - middle, bunch=0.5)]), detachment=False)
        self.robot = Robot(self.physics.rigid, description, "tiago")

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.physics.dt)):
            self.robot.control(self.physics.time)
            self.physics.step()


def test_it_holds_its_pose_with_the_link_masses_of_its_urdf(tiago):
    world = Vineyard(tiago)
    world.run(2.0)
    position, velocity, effort, _ = world.physics.rigid.joint_measurements("tiago")
    assert np.abs(position - tiago.home).max() < 1e-3
    assert np.abs(velocity).max() < 1e-3
    torso = tiago.joints.index("torso_lift_joint")
    assert effort[torso] > 100.0, "the lift carries arms and head"
    assert world.physics.rigid.faults == 0


def test_it_drives_a_circle_and_stops_without_commands(tiago):
    world = Vineyard(tiago)
    rigid = world.physics.rigid
    rigid.place_robot("tiago", frames.pose([10.0, 0.0, 0.0]), tiago.home)
    for _ in range(300):
        world.robot.command_base(0.4, 0.4, world.physics.time)
        world.run(world.physics.dt)
    pose, velocity = rigid.base_state("tiago")
    assert np.hypot(*velocity[:2]) == pytest.approx(0.4, rel=0.02)
    assert np.linalg.norm(pose[:2] - [10.0, 1.0]) == pytest.approx(1.0, abs=0.1)
    world.run(1.5)
    assert np.abs(rigid.base_state("tiago")[1]).max() < 1e-2


def test_fingers_and_their_mimic_joints_close(tiago):
    world = Vineyard(tiago)
    finger = tiago.joint_indices("gripper_left")
    drive = tiago.drives[finger[0]]
    for fraction in (0.2, 0.8):
        goal = drive.lower + fraction * (drive.upper - drive.lower)
        world.robot.command_position(np.full(len(finger), goal), finger)
        world.run(1.5)
        np.testing.assert_allclose(world.physics.rigid.joint_measurements("tiago")[0][finger], goal, atol=5e-3)


def test_it_reaches_and_pushes_a_bunch(tiago):
    world = Vineyard(tiago)
    task = PushBunch(world.robot, "left", lambda: BUNCH, repeat=False, hold_time=0.5)
    pushed = 0.0
    effort = 0.0
    while task.push_count == 0 and world.physics.time < 40.0:
        task.control(world.physics.time)
        world.run(world.physics.dt)
        contacts = [c for c in world.physics.contacts if c.actor == "tiago"]
        pushed = max(pushed, float(np.linalg.norm(sum((c.force for c in contacts), np.zeros(3)))))
        effort = max(effort, float(np.abs(world.physics.rigid.joint_measurements("tiago")[3]).max()))
    assert (task.push_count, task.missed_count) == (1, 0)
    assert 0.5 < pushed < 60.0
    assert effort > 0.1, "the joints carry the reaction of the bunch"
    assert world.physics.rigid.faults == 0
