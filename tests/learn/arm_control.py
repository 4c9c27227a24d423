"""A controller of the arm of the learning tasks that knows its kinematics."""

from typing import Any

import mujoco
import numpy as np

from vinesim.learn.arm import TOOL, TOOL_LINK


def towards(env: Any, ways: np.ndarray, gain: float = 8.0) -> np.ndarray:
    """Returns the actions [world, 7] that move the point between the fingers along ``ways`` [world, 3] m, by the damped
    pseudo-inverse of its Jacobian."""
    bodies = env.unwrapped.worlds.bodies
    robot = bodies.rigid.robot("arm")
    m = bodies.rigid.mj_model
    d = mujoco.MjData(m)
    body = robot.bodies[TOOL_LINK]
    actions = []
    for qpos, way in zip(bodies.data.qpos.numpy(), ways, strict=True):
        d.qpos[:] = qpos
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        point = d.xpos[body] + d.xmat[body].reshape(3, 3) @ np.array(TOOL)
        jacobian = np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, jacobian, None, point, body)
        J = jacobian[:, robot.v[:7]]
        actions.append(np.clip(gain * J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(3), way), -1.0, 1.0))
    return np.array(actions, np.float32)
