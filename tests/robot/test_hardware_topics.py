"""Joints as hardware of another controller manager: positions, velocities and efforts, NaN, timeouts, the TOML file."""

from __future__ import annotations

import pathlib
import shutil

import numpy as np
import pytest

from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.controller_manager import ControllerManager
from vinesim.robot.description.controllers import only_hardware
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.builder import assemble
from vinesim.scene.values import ControllerKind, HardwareTopics

HEAD = ("head_1_joint", "head_2_joint")
NONE = np.full(2, np.nan)


class Hardware:
    """A vinebot that is hardware, and the index of its head's joints."""

    def __init__(self) -> None:
        self.rigid = RigidWorld(assemble([]))
        self.robot = Robot(self.rigid, only_hardware(load_description("vinebot")), "anna")
        self.manager = ControllerManager(self.robot)
        self.head = self.robot.joint_indices(HEAD)
        self.time = 0.0

    def command(self, position=NONE, velocity=NONE, effort=NONE) -> None:
        self.manager.command_hardware("hardware", HEAD, *map(np.asarray, (position, velocity, effort)), self.time)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.rigid.dt)):
            self.manager(self.time)
            self.robot.control(self.time)
            self.rigid.predict()
            self.rigid.integrate()
            self.time += self.rigid.dt

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities of the head's joints."""
        position, velocity, *_ = self.rigid.joint_measurements("anna")
        return position[self.head], velocity[self.head]


def test_without_controllers_a_robot_keeps_its_cutters_only() -> None:
    own = load_description("vinebot")
    specs = only_hardware(own).controllers
    hardware = [spec for spec in specs if spec.kind is ControllerKind.TOPIC_BASED]
    assert [(spec.joints, spec.hardware) for spec in hardware] == [(tuple(own.joints), HardwareTopics())]
    assert {spec.name for spec in specs} == {"hardware", "cutter_left_controller", "cutter_right_controller"}
    assert (HardwareTopics().commands, HardwareTopics().states) == ("robot_joint_commands", "robot_joint_states")


def test_positions_are_held_and_nan_leaves_a_joint_as_it_is() -> None:
    robot = Hardware()
    robot.command(position=[0.3, np.nan])
    robot.run(3.0)  # six times the timeout
    assert robot.state()[0] == pytest.approx([0.3, 0.0], abs=2e-3)
    robot.command(position=[np.nan, -0.2])
    robot.run(2.0)
    assert robot.state()[0] == pytest.approx([0.3, -0.2], abs=2e-3)


def test_a_velocity_ends_after_the_timeout() -> None:
    robot = Hardware()
    robot.command(velocity=[0.4, np.nan])
    robot.run(0.45)
    assert robot.state()[1] == pytest.approx([0.4, 0.0], abs=0.02)
    robot.run(0.6)
    stopped = robot.state()[0]
    assert stopped[0] == pytest.approx(0.4 * 0.5, abs=0.04)
    robot.run(1.0)
    assert robot.state()[0] == pytest.approx(stopped, abs=2e-3)


def test_an_effort_accelerates_by_newtons_law_and_ends_after_the_timeout() -> None:
    robot = Hardware()
    inertia = robot.rigid.joint_inertia("anna")[robot.head]
    robot.command(effort=[1.0, np.nan])
    robot.run(0.05)
    assert robot.state()[1][0] == pytest.approx(0.05 / inertia[0], rel=0.2)
    robot.run(1.5)
    stopped = robot.state()[0]
    robot.run(1.0)
    assert robot.state()[0] == pytest.approx(stopped, abs=5e-3)


def test_a_position_comes_before_a_velocity_and_this_before_an_effort() -> None:
    robot = Hardware()
    robot.command(position=[0.2, np.nan], velocity=[-0.5, 0.3], effort=[9.0, -9.0])
    robot.run(0.4)
    assert robot.state()[0][0] > 0.05
    assert robot.state()[1][1] == pytest.approx(0.3, abs=0.03)


def test_a_foreign_joint_is_refused() -> None:
    robot = Hardware()
    with pytest.raises(CommandError, match="hardware of anna does not move no_such_joint"):
        robot.manager.command_hardware("hardware", ["no_such_joint"], NONE[:1], NONE[:1], NONE[:1], 0.0)


def with_controller(folder: pathlib.Path, *lines: str) -> pathlib.Path:
    """A vinebot whose TOML file has one controller more, and only this one."""
    own = load_description("vinebot").file
    copy = folder / own.name
    shutil.copy(own, copy)
    text = own.with_suffix(".toml").read_text()
    copy.with_suffix(".toml").write_text("\n".join([text, "[controllers.arms]", *lines, ""]))
    return copy


def test_names_and_timeout_come_from_the_robots_file(tmp_path) -> None:
    keys = ('kind = "topic_based"', 'joints = ["head_1_joint"]', 'commands = "to_arm"', "timeout = 2.0")
    description = load_description(with_controller(tmp_path, *keys))
    (spec,) = only_hardware(description).controllers
    assert (spec.joints, spec.hardware) == (HEAD[:1], HardwareTopics("to_arm", "robot_joint_states", 2.0))


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (('kind = "topic_based"', 'joints = ["head_1_joint"]', "timeout = 0.0"), "'arms' has the timeout 0.0"),
        (('kind = "forward_effort"', 'joints = ["head_1_joint"]', 'states = "s"'), "'forward_effort' has states"),
    ],
)
def test_wrong_keys_are_refused(tmp_path, lines, reason) -> None:
    with pytest.raises(DescriptionError, match=reason):
        load_description(with_controller(tmp_path, *lines))
