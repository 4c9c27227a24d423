"""Task *reach*: bring the fingers of an arm to a bunch without pressing on other plants."""

from __future__ import annotations

from typing import Any

import warp as wp

from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import reach as kernels
from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn.arm import AXES
from vinesim.learn.arm_env import DISTANCE, ArmEnv
from vinesim.learn.shoots import shoots

SHOOTS = 4
"""Number of shoots of a world; each has one bunch."""
REACH = 0.05
"""[m] Distance from the middle of a bunch at which it is reached: its surface is then between the fingers."""


class ReachEnv(ArmEnv):
    """Reach one bunch among four, in ``num_envs`` worlds with different shoots.

    Observation [31] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the wanted bunch, and of the three others [m], in world axes; the sum of the forces on the
    other shoots [N]; and four numbers of which that of the wanted bunch is 1. Poses of bunches are those of 10 ms
    before.

    Reward of an action: 10 at success, minus the distance [m], minus 0.02 for each newton on other shoots, minus 0.01
    for each unit of squared action. An episode ends at success, and is truncated after 100 actions (4 s).

    ``options``: arguments of :class:`~vinesim.learn.arm_env.ArmEnv`, which also describes actions.
    """

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        self._target = wp.zeros(max(num_envs, 1), dtype=wp.int32, device=options.get("device", "cpu"))
        numbers = 2 * len(AXES) + 3 * SHOOTS + 1 + SHOOTS
        super().__init__(lambda rng, variation: shoots(SHOOTS, rng, DISTANCE, variation), numbers, num_envs, **options)

    def _beginnings(self) -> list[KernelLaunch]:
        given = [SHOOTS, self._seed, self._begins]
        return [KernelLaunch(draw_targets, given, [self._episode, self._target], threads=self.num_envs)]

    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        numbers = kernels.ReachNumbers()
        numbers.reach, numbers.success_reward = REACH, 10.0
        numbers.distance_cost, numbers.force_cost, numbers.action_cost = 1.0, 0.02, 0.01
        given = [
            numbers,
            self._arm_state(),
            *self._bunches(),
            self.num_envs,
            self._target,
            self._given_action,
            *self.worlds.contacts.lists(),
        ]
        return [KernelLaunch(kernels.observe, given, [observation, reward, success], threads=self.num_envs)]
