"""A controller of the arm of the learning tasks that knows its kinematics."""

from typing import Any

import mujoco
import numpy as np

from vinesim.learn.arm import TOOL, TOOL_LINK, arm
from vinesim.learn.arm_env import BASE, HOME
from vinesim.learn.reach import NUMBERS, plants
from vinesim.learn.variation import Variation
from vinesim.rigid.rigid_world import RigidWorld

LEVER = 0.3
"""[m] Weight of turning: a turn counts as the way of a point at this distance."""


def turn_upright(axes: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Returns the rotation vector [3] rad from ``axes`` [3, 3] to axes with x along ``ahead`` [3] and z upwards."""
    up = np.array([0.0, 0.0, 1.0])
    wanted = np.stack([ahead, np.cross(up, ahead), up], 1)
    turn = wanted @ axes.T
    angle = np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))
    across = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return angle * across / max(float(np.linalg.norm(across)), 1e-9)


def towards(env: Any, ways: np.ndarray, gain: float = 8.0, ahead: np.ndarray | None = None) -> np.ndarray:
    """Returns the actions [world, 7] that move the point between the fingers along ``ways`` [world, 3] m, by the damped
    pseudo-inverse of its Jacobian. ``ahead`` [world, 3]: horizontal directions into which the upright hand turns; None:
    it turns as it likes."""
    bodies = env.unwrapped.worlds.bodies
    turns = [None] * len(ways) if ahead is None else ahead
    actions = [
        _action(bodies.rigid, qpos, way, gain, turn)
        for qpos, way, turn in zip(bodies.data.qpos.numpy(), ways, turns, strict=True)
    ]
    return np.array(actions, np.float32)


class Reaching:
    """A stand-in for a policy of the task reach that moves straight to the wanted bunch."""

    task = "reach"

    def __init__(self) -> None:
        self._rigid = RigidWorld(plants(np.random.default_rng(0), Variation()))
        self._rigid.add_robot(arm(BASE, HOME))

    def check_numbers(self, inputs: int, outputs: int) -> None:
        assert (inputs, outputs) == (NUMBERS, 7)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        if observation.ndim == 2:
            return np.array([self(one) for one in observation])
        qpos = self._rigid.mj_data.qpos.copy()
        qpos[self._rigid.robot("arm").q[:7]] = observation[:7]
        return _action(self._rigid, qpos, observation[14:17], 8.0).astype(np.float32)


def _action(rigid: Any, qpos: np.ndarray, way: np.ndarray, gain: float, ahead: np.ndarray | None = None) -> np.ndarray:
    robot = rigid.robot("arm")
    m = rigid.mj_model
    d = mujoco.MjData(m)
    body = robot.bodies[TOOL_LINK]
    d.qpos[:] = qpos
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    axes = d.xmat[body].reshape(3, 3)
    jacobian = np.zeros((6, m.nv))
    mujoco.mj_jac(m, d, jacobian[:3], jacobian[3:], d.xpos[body] + axes @ np.array(TOOL), body)
    J = jacobian[:3, robot.v[:7]]
    if ahead is not None:
        J = np.concatenate([J, LEVER * jacobian[3:, robot.v[:7]]])
        way = np.concatenate([way, LEVER * turn_upright(axes, ahead)])
    return np.clip(gain * J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(len(J)), way), -1.0, 1.0)
