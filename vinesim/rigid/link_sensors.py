"""Sensors in links of robots: the wrench on the parent and the acceleration, measured in every step for all at once."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from vinesim.rigid.robot_body import RobotBody


class LinkSensors:
    """What the sensors measured in the last step, in frames of the step's start; a row for each sensor."""

    def __init__(self) -> None:
        self._row: dict[tuple[str, str], int] = {}
        """Row of a sensor, by robot and link."""
        self._body = self._root = np.zeros(0, int)
        """[sensor] MuJoCo body of the link, and of the root of its robot."""
        self._wrench = np.zeros((0, 6))
        self._com = np.zeros((0, 3))
        """[sensor, 6] moment about the robot's centre of mass and force of the parent on the link [N m, N]; [sensor, 3]
        that centre [m]; world axes."""
        self._position = np.zeros((0, 3))
        self._rotation = np.zeros((0, 9))
        """[sensor, 3] m and [sensor, 9] row by row: pose of the link."""
        self._acceleration = np.zeros((0, 6))
        """[sensor, 6] rad/s^2, m/s^2: see :meth:`acceleration`."""

    def find_indices(self, m: mujoco.MjModel, robots: Mapping[str, RobotBody]) -> None:
        """Take over which links have sensors, in a world that was compiled anew; measurements are kept."""
        keys = [(name, link) for name, robot in robots.items() for link in robot.sensor_links]
        kept = np.array([self._row.get(key, -1) for key in keys], int)
        for name in ("_wrench", "_com", "_position", "_rotation", "_acceleration"):
            before: np.ndarray = getattr(self, name)
            after = np.zeros((len(keys), before.shape[1]))
            after[kept >= 0] = before[kept[kept >= 0]]
            setattr(self, name, after)
        self._rotation[kept < 0] = np.eye(3).ravel()
        self._row = {key: row for row, key in enumerate(keys)}
        self._body = np.array([robots[name].bodies[link] for name, link in keys], int)
        self._root = m.body_rootid[self._body]

    def measure(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Measure the step that ends, while MuJoCo's poses are still those of its start."""
        body = self._body
        if not len(body):
            return
        mujoco.mj_rnePostConstraint(m, d)
        self._wrench = d.cfrc_int[body]
        self._com = d.subtree_com[self._root]
        self._position = d.xpos[body]
        self._rotation = d.xmat[body]
        for row, link in enumerate(body.tolist()):
            mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_XBODY, link, self._acceleration[row], 1)

    def wrench(self, robot: str, link: str) -> np.ndarray:
        """Force [N] and moment about the link's origin [N m] of the link on its parent [6], in the link's axes."""
        row = self._find(robot, link)
        (x, y, z) = (self._com[row] - self._position[row]).tolist()
        (u, v, w) = self._wrench[row, 3:].tolist()
        moment = self._wrench[row, :3] + np.array([y * w - z * v, z * u - x * w, x * v - y * u])
        rotation = self._rotation[row].reshape(3, 3)
        return -np.concatenate([self._wrench[row, 3:] @ rotation, moment @ rotation])

    def acceleration(self, robot: str, link: str) -> np.ndarray:
        """[6] rad/s^2, m/s^2: angular and proper linear acceleration of the link's origin, link axes."""
        return self._acceleration[self._find(robot, link)].copy()

    def _find(self, robot: str, link: str) -> int:
        try:
            return self._row[robot, link]
        except KeyError:
            raise ValueError(f"link {link!r} of robot {robot!r} has no sensor; call add_link_sensor() first") from None
