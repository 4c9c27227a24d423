"""One robot on bare ground with a clock, and the expected reading of its left wrist sensor."""

from __future__ import annotations

import dataclasses
from xml.etree import ElementTree

import numpy as np

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import assemble
from vinesim.scene.terrain import Terrain


class Yard:
    """One robot on bare ground, and a clock."""

    def __init__(
        self, description: RobotDescription, pose: np.ndarray | None = None, terrain: Terrain | None = None
    ) -> None:
        self.rigid = RigidWorld(dataclasses.replace(assemble([]), terrain=terrain))
        self.robot = Robot(self.rigid, description, "anna", pose=pose)
        self.time = 0.0

    def run(self, seconds: float) -> np.ndarray:
        """Positions, velocities, efforts and set-points of every tick [tick, 4, joint]."""
        rows = []
        for _ in range(round(seconds / self.rigid.dt)):
            self.robot.control(self.time)
            self.rigid.predict()
            self.rigid.integrate()
            self.time += self.rigid.dt
            position, velocity, effort, _ = self.rigid.joint_measurements("anna")
            rows.append((position, velocity, effort, self.robot.setpoint.copy()))
        return np.array(rows)


def hand_of(description: RobotDescription, position: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Mass [kg] beyond the left wrist sensor, and its centre [3] m in the base, from the URDF; at home by default."""
    poses = description.link_poses(description.home if position is None else position)
    mass = 0.0
    moment = np.zeros(3)
    for link in ElementTree.fromstring(description.urdf).iterfind("link"):
        name = link.get("name")
        if (name.startswith("gripper_left") or name == "wrist_left_ft_link") and link.find("inertial") is not None:
            own = float(link.find("inertial/mass").get("value"))
            at = np.array(link.find("inertial/origin").get("xyz").split(), float)
            mass = mass + own
            moment = moment + own * (poses[name][:3] + frames.rotate(poses[name][3:], at))
    return mass, moment / mass


def centre_of_hand(yard: Yard) -> np.ndarray:
    """[3] in the base."""
    return hand_of(yard.robot.description, yard.rigid.joint_measurements("anna")[0])[1]


def wrench_of(yard: Yard) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque [3] of the left wrist, world axes."""
    wrench = next(w for w in yard.robot.sample(yard.time).wrenches if w.name == "wrist_left_ft")
    turn = yard.robot.frame_pose(wrench.frame)[3:]
    return frames.rotate(turn, wrench.force), frames.rotate(turn, wrench.torque)
