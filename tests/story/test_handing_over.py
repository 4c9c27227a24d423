"""A person by a script and a carrier: the person picks a bunch and lays it into the box that the carrier holds out."""

import math

import numpy as np
import pytest

from vinesim.avatar.local_human import LocalHuman
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.cli.human_client import pick_and_give
from vinesim.client.tasks.planning import plan_meeting
from vinesim.client.tasks.start_poses import bunch_centres, start_pose
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.meet_person import MeetPerson
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanSpec
from vinesim.world import Physics

pytestmark = pytest.mark.slow


def test_a_carrier_gets_the_bunch_of_a_person_and_no_other_leaves_its_vine():
    scene = load_scene("harvest")
    model = generate(scene)
    start = start_pose(scene, 0)
    plan = plan_meeting(model, start)
    physics = Physics(model, parameters=scene.physics)
    way = bunch_centres(model)[plan.bunch, :2] - plan.stand
    root = frames.pose(np.array([*plan.stand, 0.0]), frames.from_yaw(math.atan2(way[1], way[0])))
    source = ScriptedHuman(root)
    person = LocalHuman(physics, HumanSpec("visitor", 1, standing_pose(root)), source)
    source.do(pick_and_give(source, physics, plan.bunch, plan.box))
    robot = Robot(physics.rigid, load_description("logistic"), "carrier", pose=start)
    task = MeetPerson(physics, robot, plan)
    while not task.is_done:
        task.control(physics.time)
        robot.control(physics.time)
        person.control(physics.time)
        physics.step()
        person.update(physics.time)
    assert task.succeeded, task.reason
    assert np.flatnonzero(~physics.state.bunch_attached).tolist() == [plan.bunch]
