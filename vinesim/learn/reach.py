"""Task *reach*: bring the fingers of an arm to a bunch without pressing on other plants."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import reach as kernels
from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn.arm import AXES
from vinesim.learn.arm_arrays import ArmArrays
from vinesim.learn.arm_env import DISTANCE, ArmEnv
from vinesim.learn.shoots import shoots
from vinesim.learn.variation import Variation
from vinesim.scene.model import Model

SHOOTS = 4
"""Number of shoots of a world; each has one bunch."""
NUMBERS = 2 * len(AXES) + 3 * SHOOTS + 1 + SHOOTS
"""Number of an observation's components."""
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
        super().__init__(plants, NUMBERS, num_envs, **options)

    def _beginnings(self) -> list[KernelLaunch]:
        given = [SHOOTS, self._seed, self._begins]
        return [KernelLaunch(draw_targets, given, [self._episode, self._target], threads=self.num_envs)]

    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        return [observe(self.arm_arrays, self._target, self._given_action, [observation, reward, success])]


def plants(rng: np.random.Generator, variation: Variation) -> Model:
    """Returns the shoots of a world."""
    return shoots(SHOOTS, rng, DISTANCE, variation)


def observe(arrays: ArmArrays, target: wp.array, action: wp.array, written: list[wp.array]) -> KernelLaunch:
    """Returns the launch that judges the state of all worlds.

    Args:
        arrays: the state.
        target: int32 [world], which tree's bunch is wanted.
        action: [world, joint] the last action.
        written: observation [world, :data:`NUMBERS`], reward and success [world].
    """
    numbers = kernels.ReachNumbers()
    numbers.reach = REACH
    numbers.success_reward = 10.0
    numbers.distance_cost = 1.0
    numbers.force_cost = 0.02
    numbers.action_cost = 0.01
    given = [numbers, arrays.arm, *arrays.bunches, arrays.worlds, target, action]
    given += [arrays.contacts, arrays.world_contacts]
    return KernelLaunch(kernels.observe, given, written, threads=arrays.worlds)
