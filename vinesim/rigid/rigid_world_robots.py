"""Commands to robots and measurements of them, by name; part of
:class:`vinesim.rigid.rigid_world.RigidWorld`."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from vinesim.rigid.mujoco_world import WorldCore
from vinesim.rigid.urdf import RobotError
from vinesim.scene.values.signals import Color


def _check_finite(name: str, what: str, given: object, size: int) -> None:
    """:class:`RobotError` unless a command consists of ``size`` finite numbers."""
    values = np.asarray(given, float)
    if values.shape != (size,):
        raise RobotError(f"robot {name!r}: {what} has the shape {values.shape}; give {size} numbers")
    if not math.isfinite(values.dot(values)) and not np.isfinite(values).all():  # the first is the cheapest
        raise RobotError(f"robot {name!r}: {what} is {values.tolist()}; give finite numbers")


class RobotAccess(WorldCore):
    """Robots of a rigid world. Every method raises ``ValueError`` if no robot or link has the name given, and
    :class:`RobotError` for commands that are not finite or of another shape."""

    def place_robot(self, name: str, pose: np.ndarray, position: np.ndarray) -> None:
        """Put a robot at base ``pose`` [7] and joint ``position`` [joint], at rest, with its targets there."""
        self._check_joints(name, position=position)
        _check_finite(name, "pose", pose, 7)
        self.robot(name).place(self.mj_model, self.mj_data, np.asarray(pose, float), position)
        self._kinematics_current = False

    def _check_joints(self, name: str, **commands: object) -> None:
        """:class:`RobotError` unless each command that is given has one finite number for each drive."""
        count = len(self.robot(name).spec.drives)
        for what, given in commands.items():
            if given is not None:
                _check_finite(name, f"joint {what}", given, count)

    # ------------------------------------------------------------------ commands

    def command(self, name: str, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Set the targets of the servos: ``position`` [joint] and ``velocity`` [joint] (zero unless given)."""
        self._check_joints(name, position=position, velocity=velocity)
        self.robot(name).command(position, velocity)

    def set_gains(
        self,
        name: str,
        stiffness: np.ndarray,
        damping: np.ndarray,
        effort: np.ndarray,
        *,
        limit: np.ndarray | None = None,
        exact: np.ndarray | None = None,
    ) -> None:
        """Set the gains of the servos and a feedforward ``effort`` (all [joint]); they last until the next call.

        Args:
            name: of the robot.
            stiffness: N m/rad or N/m; with zero gains a joint is driven by ``effort`` alone.
            damping: N m s/rad or N s/m.
            effort: N m or N, added within ``limit``.
            limit: N m or N, of the servos; that of the drive unless a lower one is given.
            exact: bool, joints that swing with just this damping; the others are damped as if it were larger by dt
            times
                stiffness, as stiff servos should be.
        """
        self._check_joints(name, stiffness=stiffness, damping=damping, effort=effort)
        self.robot(name).set_gains(self.mj_model, self.mj_data, (stiffness, damping, effort), limit, exact)

    def command_base(self, name: str, velocity: tuple[float, float, float]) -> None:
        """Drive the base with (vx, vy, wz) [m/s, m/s, rad/s] in its own axes; zero holds it in place."""
        robot = self.robot(name)
        _check_finite(name, "base velocity", velocity, 3)
        robot.base_velocity[:] = velocity
        robot.base_slip = self.parameters.base_slip

    def follow_remote(
        self, name: str, base_q: np.ndarray, base_qd: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """Pull the copy of a remote robot to its received state; it stays dynamic, so that a vine still holds it back.

        ``base_q`` [7], ``base_qd`` [6] world axes, ``position`` and ``velocity`` [joint].
        """
        self._check_joints(name, position=position, velocity=velocity)
        _check_finite(name, "base pose", base_q, 7)
        _check_finite(name, "base velocity", base_qd, 6)
        self.robot(name).follow_remote(
            self.mj_data, np.asarray(base_q, float), np.asarray(base_qd, float), position, velocity
        )

    def apply_wrench(self, name: str, link: str, force: np.ndarray, moment: np.ndarray = np.zeros(3)) -> None:
        """Apply a force [3] N and a moment [3] N m at a link's centre of mass, world axes, until the next call."""
        wrench = self.mj_data.xfrc_applied[self._link_body(name, link)]
        _check_finite(name, "force", force, 3)
        _check_finite(name, "moment", moment, 3)
        wrench[:3], wrench[3:] = force, moment

    def set_remote_wrenches(self, name: str, wrenches: dict[str, np.ndarray]) -> None:
        """Apply the wrenches [6] by link with which remote people push a robot, until the next call.

        Force [N] and moment about the link's centre of mass [N m], world axes. :meth:`joint_measurements` counts them
        as contacts. Raises :class:`RobotError` if a link does not exist or a wrench is not finite.
        """
        robot = self.robot(name)
        for link, wrench in wrenches.items():
            _check_finite(name, f"wrench on {link!r}", wrench, 6)
        if wrenches or robot.remote_wrenches:
            robot.set_remote_wrenches(self.mj_data, wrenches)

    def set_indicator_color(self, name: str, color: Color | None) -> None:
        """Set the colour of a robot's indicator lights, black for unlit; None: as its URDF has them."""
        robot = self.robot(name)
        robot.indicator_color = color
        self._show_lamps(robot)

    # ------------------------------------------------------------------ joints and base

    def joint_measurements(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity, effort and contact effort of the drives, each [joint] in the order of ``spec.drives``.

        The effort is that of the drive in the last step: servo and its share of gravity compensation. The contact
        effort is J^T f of the contacts with plants and with rigid bodies; at rest the two cancel.
        """
        robot = self.robot(name)
        d = self.mj_data
        return d.qpos[robot.q], d.qvel[robot.v], robot.transmitted_effort(d), self.contact_force[robot.v]

    def joint_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity [joint] of the drives alone, as in :meth:`joint_measurements`."""
        robot = self.robot(name)
        return self.mj_data.qpos[robot.q], self.mj_data.qvel[robot.v]

    def gravity_effort(self, name: str) -> np.ndarray:
        """[joint] N m or N: the part of the drives' effort that carries the robot's own weight."""
        return self.mj_data.qfrc_gravcomp[self.robot(name).v]

    def joint_inertia(self, name: str) -> np.ndarray:
        """[joint] kg m^2 or kg: inertia that each drive sees while the others stand, armature included, in this
        pose."""
        return self.mj_data.M[self.robot(name).inertia_index]

    def base_state(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Pose [7] and velocity [6] (world axes) of the base link."""
        robot = self.robot(name)
        d = self.mj_data
        x, y, yaw = d.qpos[robot.base_q].tolist()
        vx, vy, wz = d.qvel[robot.base_v].tolist()
        half = 0.5 * yaw
        pose = np.array([x, y, robot.base_height, 0.0, 0.0, math.sin(half), math.cos(half)])
        return pose, np.array([vx, vy, 0.0, 0.0, 0.0, wz])

    # ------------------------------------------------------------------ links

    def link_centre(self, name: str, link: str) -> np.ndarray:
        """Centre of mass [3] m of a link at the last step's start; ``ValueError`` if there is none of this name."""
        return self.mj_data.xipos[self._link_body(name, link)].copy()

    def jacobian(self, name: str, link: str, point: np.ndarray) -> np.ndarray:
        """[6, joint]: velocity of the world ``point`` [3] of a link, then its angular velocity, per joint velocity."""
        robot = self.robot(name)
        body = self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((6, self.mj_model.nv))
        mujoco.mj_jac(self.mj_model, self.mj_data, jacobian[:3], jacobian[3:], np.asarray(point, float), body)
        return jacobian[:, robot.v]

    def add_link_sensor(self, name: str, link: str) -> None:
        """From the next step on, measure :meth:`link_wrench` and :meth:`link_acceleration` at a link."""
        self._link_body(name, link)
        if link not in self.robot(name).sensor_links:
            self.robot(name).sensor_links.append(link)
            self._link_sensors.find_indices(self.mj_model, self._robots)

    def link_wrench(self, name: str, link: str) -> np.ndarray:
        """[6] N, N m about the link's origin: wrench of the link, and all beyond it, on its parent.

        In the link's axes, mean of the last step. Weight, inertia, pushes and contacts with rigid bodies are included;
        contacts with plants are not: they are in ``Physics.contacts``.
        """
        return self._link_sensors.wrench(name, link)

    def link_acceleration(self, name: str, link: str) -> np.ndarray:
        """[6] rad/s^2, m/s^2: angular and proper acceleration of a link's origin in its axes; at rest 9.81 upwards."""
        return self._link_sensors.acceleration(name, link)

    def link_angular_velocity(self, name: str, link: str) -> np.ndarray:
        """[3] rad/s of a link, in its axes."""
        body = self._link_body(name, link)
        self.update_kinematics()
        jacobian = np.zeros((3, self.mj_model.nv))
        mujoco.mj_jacBody(self.mj_model, self.mj_data, None, jacobian, body)
        return jacobian @ self.mj_data.qvel @ self.mj_data.xmat[body].reshape(3, 3)
