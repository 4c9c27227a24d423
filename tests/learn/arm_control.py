"""A controller of the arm of the learning tasks that knows its kinematics."""

from typing import Any

import mujoco
import numpy as np

from vinesim.learn.arm import TOOL, TOOL_LINK, arm
from vinesim.learn.arm_env import BASE, HOME
from vinesim.learn.reach import NUMBERS, plants
from vinesim.learn.variation import Variation
from vinesim.rigid.rigid_world import RigidWorld


def towards(env: Any, ways: np.ndarray, gain: float = 8.0) -> np.ndarray:
    """Returns the actions [world, 7] that move the point between the fingers along ``ways`` [world, 3] m, by the damped
    pseudo-inverse of its Jacobian."""
    bodies = env.unwrapped.worlds.bodies
    actions = [_action(bodies.rigid, qpos, way, gain) for qpos, way in zip(bodies.data.qpos.numpy(), ways, strict=True)]
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


def _action(rigid: Any, qpos: np.ndarray, way: np.ndarray, gain: float) -> np.ndarray:
    robot = rigid.robot("arm")
    m = rigid.mj_model
    d = mujoco.MjData(m)
    body = robot.bodies[TOOL_LINK]
    d.qpos[:] = qpos
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    point = d.xpos[body] + d.xmat[body].reshape(3, 3) @ np.array(TOOL)
    jacobian = np.zeros((3, m.nv))
    mujoco.mj_jac(m, d, jacobian, None, point, body)
    J = jacobian[:, robot.v[:7]]
    return np.clip(gain * J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(3), way), -1.0, 1.0)
