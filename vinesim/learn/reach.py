"""Task *reach*: bring the fingers of an arm to a bunch without pressing on other plants."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import reach as kernels
from vinesim.learn.arm import AXES
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_task import DISTANCE, ArmTask
from vinesim.learn.shoots import shoots
from vinesim.learn.variation import Variation
from vinesim.scene.model import Model

SHOOTS = 4
"""Number of shoots of a world; each has one bunch."""
REACH = 0.05
"""[m] Distance from the middle of a bunch at which it is reached: its surface is then between the fingers."""


class Reach(ArmTask):
    """The task of :class:`ReachEnv`."""

    name = "reach"
    numbers = 2 * len(AXES) + 3 * SHOOTS + 1 + SHOOTS
    choices = SHOOTS

    @staticmethod
    def plants(rng: np.random.Generator, variation: Variation) -> Model:
        """Returns four shoots."""
        return shoots(SHOOTS, rng, DISTANCE, variation)

    def observe(self, action: wp.array, observation: wp.array, reward: wp.array, success: wp.array) -> KernelLaunch:
        """See :meth:`ArmTask.observe`."""
        numbers = kernels.ReachNumbers()
        numbers.reach = REACH
        numbers.success_reward = 10.0
        numbers.distance_cost = 1.0
        numbers.force_cost = 0.02
        numbers.action_cost = 0.01
        arrays = self.arrays
        given = [numbers, arrays.arm, *arrays.bunches, arrays.worlds, self.wanted, action]
        given += [arrays.contacts, arrays.world_contacts]
        return KernelLaunch(kernels.observe, given, [observation, reward, success], threads=arrays.worlds)


class ReachEnv(ArmEnv):
    """Reach one bunch among four, in ``num_envs`` worlds with different shoots.

    Observation [31] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the wanted bunch, and of the three others [m], in world axes; the sum of the forces on the
    other shoots [N]; and four numbers of which that of the wanted bunch is 1. Poses of bunches are those of 10 ms
    before.

    Reward of an action: 10 at success, minus the distance [m], minus 0.02 for each newton on other shoots, minus 0.01
    for each unit of squared action. An episode ends at success, and is truncated after 100 actions (4 s).

    :class:`~vinesim.learn.arm_env.ArmEnv` describes arguments and actions.
    """

    task_class = Reach
