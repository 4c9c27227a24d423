"""Admittance control of a robot's hand, which moves in the direction of the force at its wrist; an example of force
feedback.

    controller = AdmittanceController(robot, "arm_left", "wrist_left_ft")
    ...
    controller(robot.sample(time, contacts))    # each step, before robot.control(time)

The controller uses only the robot's samples, so a ROS node can do the same with topics (CANOPIES D6.4, section 3.1;
Hogan 1985).
"""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.values import RobotSample

JACOBIAN_DAMPING = 0.05
"""[m/rad] Damping of the inverse Jacobian, which limits joint rates when the arm is stretched. GUESSED"""


class AdmittanceController:
    """Moves a robot's hand like a damped mass, with mass dv/dt + damping v = force at the wrist. The hand keeps its
    orientation."""

    def __init__(
        self,
        robot: Robot,
        group: str,
        sensor: str,
        *,
        mass: float = 6.0,
        damping: float = 60.0,
        force_deadband: float = 0.5,
    ) -> None:
        """``group``: joint group of the arm. ``sensor``: name of the wrist's force-torque sensor. ``mass`` [kg],
        ``damping`` [N s/m]: of the virtual mass. ``force_deadband`` [N]: smaller forces count as 0.

        The virtual mass must exceed the mass of the links beyond the sensor, because the sensor also measures their
        inertia. The force in the first sample, and in the first after :meth:`tare`, is assumed to be their weight.
        Raises :class:`CommandError` for an unknown sensor.
        """
        known = [mount.name for mount in robot.description.wrenches]
        if sensor not in known:
            raise CommandError(f"{robot.name} has no wrist sensor {sensor!r}; it has: {', '.join(known) or 'none'}")
        if not (mass > 0.0 and damping > 0.0):
            raise CommandError(f"mass {mass} and damping {damping} of an admittance must both be above 0")
        self.robot = robot
        self.sensor = sensor
        self.mass = mass
        self.damping = damping
        self.force_deadband = force_deadband
        self.velocity = np.zeros(3)
        """[3] m/s, commanded velocity of the hand, world axes."""
        self._joints = robot.description.joint_indices(group)
        self._weight: np.ndarray | None = None

    def tare(self) -> None:
        """Take the force in the next sample as the weight of the links beyond the sensor."""
        self._weight = None

    def __call__(self, sample: RobotSample) -> None:
        """Command the arm for one step. ``sample``: the robot's last sample."""
        wrench = next(wrench for wrench in sample.wrenches if wrench.name == self.sensor)
        pose = self.robot.frame_pose(wrench.frame)
        force = frames.rotate(pose[3:], wrench.force)
        if self._weight is None:
            self._weight = force
        force = force - self._weight
        if np.linalg.norm(force) < self.force_deadband:
            force = np.zeros(3)
        dt = self.robot.rigid.dt
        self.velocity = (self.velocity + dt / self.mass * force) / (1.0 + dt * self.damping / self.mass)
        J = self.robot.rigid.jacobian(self.robot.name, wrench.frame, pose[:3])[:, self._joints]
        wanted = np.concatenate([self.velocity, np.zeros(3)])
        rates = J.T @ np.linalg.solve(J @ J.T + JACOBIAN_DAMPING**2 * np.eye(6), wanted)
        self.robot.command_velocity(rates, self._joints)
