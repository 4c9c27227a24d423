"""A robot ties, unties and takes leaves off at the mouth of its cutter; commands from ROS that it cannot follow are
refused with one line."""

from __future__ import annotations

import numpy as np

from vinesim import Simulation
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.core import frames
from vinesim.ros.commands.types import PlantWork
from vinesim.scene.cane import CaneBuilder, assemble
from vinesim.scene.surroundings import Wire


def test_a_robot_ties_the_cane_at_its_mouth_and_opens_the_tie_again(caplog):
    far = Simulation(CaneBuilder(pose=(0.0, 0.0, 30.0, 0.0, 0.0, 0.0, 1.0)))
    robot = far.add_robot("vinebot")
    (blade, *_) = (one for blades in robot._cutters.values() for one in blades)
    mouth = frames.compose(far.physics.rigid.link_pose(robot.name, blade.link), blade.pose)[:3]
    handle = RosCommandHandler(robot, lambda: [PlantWork("tie"), PlantWork("shake")])
    handle(0.0)
    assert handle.rejected_count == 2
    assert "no cane within 100 mm of the tool; the nearest is" in caplog.text
    assert "no work on plants 'shake'; give one of tie, untie, take_leaves" in caplog.text
    along = frames.pose(mouth + np.array([-0.2, 0.0, 0.06]))
    wire = Wire(tuple(mouth + np.array([0.0, 0.5, 0.09])), tuple(mouth + np.array([0.0, -0.5, 0.09])))
    cane = CaneBuilder(length=0.5, radius=0.003, segments=10, damping_ratio=0.3, pose=along)
    near = Simulation(assemble([cane], wires=[wire]))
    robot = near.add_robot("vinebot")
    assert "to the nearest wire" in robot.work_on_plant("tie")
    near.step(100)
    (tie,) = near.physics.handwork.ties.values()
    assert tie.actor == robot.name
    assert not tie.is_pulling
    assert robot.work_on_plant("untie").startswith("opens the tie of body ")
    assert tie.is_open
