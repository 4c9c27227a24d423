"""Admittance control: a pushed hand moves with the push (F18); without the sensor it stays (F17)."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.admittance_controller import AdmittanceController
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.builder import assemble


class PushedHand:
    """A robot whose left hand is pushed."""

    def __init__(self, *, uses_sensor: bool, **gains: float) -> None:
        self.rigid = RigidWorld(assemble([]))
        self.robot = Robot(self.rigid, load_description("vinebot"), "anna")
        self.time = 0.0
        self.controller = (
            AdmittanceController(self.robot, "arm_left", "wrist_left_ft", **gains) if uses_sensor else None
        )
        self._step()
        self.run(0.3)

    def _step(self) -> None:
        self.robot.control(self.time)
        self.rigid.predict()
        self.rigid.integrate()
        self.time += self.rigid.dt

    def run(self, seconds: float, force: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Positions of the hand [tick, 3] m under a steady force."""
        self.rigid.apply_wrench("anna", "gripper_left_base_link", np.array(force))
        positions = []
        for _ in range(round(seconds / self.rigid.dt)):
            if self.controller is not None:
                self.controller(self.robot.sample(self.time))
            self._step()
            positions.append(self.robot.frame_pose("wrist_left_ft_link")[:3])
        return np.array(positions)


@pytest.mark.parametrize("force", [(-6.0, 0.0, 0.0), (0.0, 6.0, 0.0), (0.0, 0.0, 6.0), (-4.0, 4.0, -4.0)])
def test_a_hand_moves_with_the_push_at_force_over_damping(force: tuple[float, float, float]) -> None:
    yard = PushedHand(uses_sensor=True, damping=60.0)
    attitude = yard.robot.frame_pose("wrist_left_ft_link")[3:]
    positions = yard.run(1.0, force)
    velocity = (positions[-1] - positions[-31]) / 0.3
    np.testing.assert_allclose(velocity, np.array(force) / 60.0, atol=0.05 * np.linalg.norm(force) / 60.0)
    turned = 2.0 * np.arccos(min(1.0, abs(attitude @ yard.robot.frame_pose("wrist_left_ft_link")[3:])))
    assert turned < 0.03


def test_it_accelerates_with_its_mass_and_rests_without_force() -> None:
    """The apparent mass is the commanded one and that of the real hand, whose inertia the sensor measures, too."""
    yard = PushedHand(uses_sensor=True, mass=6.0, damping=30.0)
    positions = yard.run(0.8, (0.0, 0.0, 6.0))
    speed = np.diff(positions[:, 2]) / yard.rigid.dt
    time_constant = yard.rigid.dt * (1 + np.argmax(speed > 0.632 * 0.2))
    assert 6.0 / 30.0 < time_constant < 1.1 * (6.0 + 2.2) / 30.0
    rest = yard.run(3.0)
    assert np.abs(rest[-1] - rest[-50]).max() < 1e-4
    assert rest[-1, 2] - positions[0, 2] > 0.1, "the hand went back"


def test_a_hand_without_the_sensor_stays() -> None:
    yard = PushedHand(uses_sensor=False)
    before = yard.run(0.1)[-1]
    pushed = yard.run(1.0, (0.0, 0.0, 6.0))
    assert np.abs(pushed[-1] - before).max() < 2e-3
    assert np.abs(yard.run(1.0)[-1] - before).max() < 1e-4


def test_weight_is_compensated_after_a_rotation_of_the_hand() -> None:
    yard = PushedHand(uses_sensor=True)
    controller = yard.controller
    yard.controller = None
    joints = yard.robot.joint_indices(["arm_left_5_joint", "arm_left_7_joint"])
    yard.robot.command_position(yard.robot.setpoint[joints] + 0.8, joints)
    yard.run(2.0)
    yard.controller = controller
    positions = yard.run(2.0)
    assert np.abs(positions[-1] - positions[0]).max() < 1e-3


def test_invalid_settings_are_refused() -> None:
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    with pytest.raises(CommandError, match=r"no wrist sensor 'elbow'.*wrist_left_ft"):
        AdmittanceController(robot, "arm_left", "elbow")
    with pytest.raises(CommandError, match="above 0"):
        AdmittanceController(robot, "arm_left", "wrist_left_ft", mass=0.0)
