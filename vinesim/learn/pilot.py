"""A policy that controls the arm of a client's physics."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelGraph
from vinesim.learn.arm import AXES
from vinesim.learn.arm_arrays import ClientArm
from vinesim.learn.policy import Policy
from vinesim.learn.reach import NUMBERS, observe
from vinesim.learn.task_env import STEPS
from vinesim.world import Physics


class ReachPilot:
    """Lets a policy reach for a bunch, with the observation and the servo targets of
    :class:`~vinesim.learn.reach.ReachEnv`, by its kernels. Call :meth:`control` before each step of the physics, or
    :meth:`look` and :meth:`act` before each action.

    Args:
        physics: a world with the task's four shoots.
        policy: a policy for the task.
        wanted: number of the tree whose bunch is wanted.
        robot: name of the arm.
    """

    def __init__(self, physics: Physics, policy: Policy, wanted: int, robot: str = "arm") -> None:
        policy.check_numbers(NUMBERS, len(AXES))
        self._physics = physics
        self._policy = policy
        self._robot = robot
        self._client = ClientArm(physics, robot)
        joints = len(AXES)
        observation, action = (wp.zeros((1, size), dtype=float, device="cpu") for size in (NUMBERS, joints))
        reward = wp.zeros(1, dtype=float, device="cpu")
        success = wp.zeros(1, dtype=wp.bool, device="cpu")
        target = wp.array([wanted], dtype=wp.int32, device="cpu")
        arrays = self._client.arrays
        self._observe = KernelGraph(observe(arrays, target, action, [observation, reward, success]), device="cpu")
        self._move = KernelGraph(arrays.move(action, physics.dt), device="cpu")
        self.observation = observation.numpy()[0]
        """[:data:`~vinesim.learn.reach.NUMBERS`] The last observation."""
        self.action = action.numpy()[0]
        """[joint] The last action."""
        self.targets = arrays.targets.numpy()[0]
        """[joint] rad, targets of the servos; those of the fingers [m] do not change."""
        self._success = success.numpy()
        self._steps = 0
        self.look()

    @property
    def has_reached(self) -> bool:
        """Whether the bunch was reached when :meth:`look` was called last."""
        return bool(self._success[0])

    def control(self, time: float) -> None:
        """Look and act, if the last action has had its steps. ``time``: unused."""
        if self._steps % STEPS == 0:
            self.look()
            self.act()
        self._steps += 1

    def look(self) -> None:
        """Observe the state after the last step."""
        self._client.read()
        self._observe()

    def act(self) -> None:
        """Give the servos the targets that follow from the last observation."""
        self.action[:] = self._policy(self.observation)
        self._move()
        self._physics.rigid.command(self._robot, self.targets.astype(np.float64))
