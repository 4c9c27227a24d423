"""Where the hand of the arm is, and how its joints move it: by the damped pseudo-inverse of its Jacobian."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.learn.arm import AXES, JOINT_LIMIT, TOOL, TOOL_LINK
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RobotSpec

LEVER = 0.3
"""[m] Weight of turning: a turn counts as the way of a point at this distance."""
DAMPING = 0.01
"""[m^2] Damping of the pseudo-inverse."""
TURNS = 100
"""Largest number of steps of :meth:`ArmKinematics.solve`."""
TURN = 0.2
"""[rad] Largest motion of a joint in such a step."""
CLOSE = 0.005
"""[m] Error with which it ends; turning counts with :data:`LEVER`."""


class ArmKinematics:
    """The arm, without plants.

    Args:
        model: any plants; they do not matter.
        robot: the arm.
    """

    def __init__(self, model: Model, robot: RobotSpec) -> None:
        self._rigid = RigidWorld(model, parameters=PhysicsParameters(bunch_pool_size=0))
        self._rigid.add_robot(robot)
        self._q = self._rigid.robot("arm").q[: len(AXES)]

    def _pose(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the point between the fingers [3] m, and the axes [3, 3] of the hand."""
        self._rigid.mj_data.qpos[self._q] = q
        self._rigid.invalidate_kinematics()
        pose = self._rigid.link_pose("arm", TOOL_LINK)
        axes = frames.to_matrix(pose[3:])
        return pose[:3] + axes @ np.array(TOOL), axes

    def point(self, q: np.ndarray) -> np.ndarray:
        """Returns the point between the fingers [3] m at the positions ``q`` [7] rad of the joints."""
        return self._pose(q)[0]

    def ahead(self, q: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Returns the horizontal unit vector [3] from the arm's first joint to a ``point`` [3] m."""
        self._pose(q)
        way = (point - self._rigid.link_pose("arm", "link_0")[:3]) * [1.0, 1.0, 0.0]
        return way / np.linalg.norm(way)

    def step(self, q: np.ndarray, way: np.ndarray, ahead: np.ndarray | None = None) -> np.ndarray:
        """Returns how far to turn the joints [7] rad from ``q``, so that the point between the fingers moves along
        ``way`` [3] m. ``ahead`` [3]: horizontal direction into which the upright hand turns; None: it turns as it
        likes."""
        point, axes = self._pose(q)
        whole = self._rigid.jacobian("arm", TOOL_LINK, point)[:, : len(AXES)]
        J = whole[:3]
        if ahead is not None:
            J = np.concatenate([J, LEVER * whole[3:]])
            way = np.concatenate([way, LEVER * turn_upright(axes, ahead)])
        return J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(len(J)), way)

    def solve(self, q: np.ndarray, point: np.ndarray) -> np.ndarray | None:
        """Returns positions [7] rad of the joints for an upright hand at ``point`` [3] m that looks away from the arm's
        first joint, found from the positions ``q``; None if none are found."""
        ahead = self.ahead(q, point)
        for _ in range(TURNS):
            here, axes = self._pose(q)
            way = point - here
            if np.linalg.norm(way) + LEVER * np.linalg.norm(turn_upright(axes, ahead)) < CLOSE:
                return q
            q = np.clip(q + np.clip(self.step(q, way, ahead), -TURN, TURN), -JOINT_LIMIT, JOINT_LIMIT)
        return None


def turn_upright(axes: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Returns the rotation vector [3] rad from ``axes`` [3, 3] to axes with x along ``ahead`` [3] and z upwards."""
    up = np.array([0.0, 0.0, 1.0])
    wanted = np.stack([ahead, np.cross(up, ahead), up], 1)
    turn = wanted @ axes.T
    angle = np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))
    across = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return angle * across / max(float(np.linalg.norm(across)), 1e-9)
