"""Task *reach*: bring the fingers of an arm to a bunch without pressing on other plants."""

from __future__ import annotations

import pathlib

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import reach as kernels
from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn.arm import AXES, JOINT_LIMIT, TOOL, TOOL_LINK, arm
from vinesim.learn.shoots import shoots
from vinesim.learn.task_env import STEPS, TaskEnv, check_options
from vinesim.learn.variation import Variation, as_variation
from vinesim.scene.model import Model
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

SHOOTS = 4
"""Number of shoots of a world; each has one bunch."""
DISTANCE = 1.2
"""[m] From the base of the arm to the row of shoots."""
BASE = (-0.1, 0.0, 0.6)
"""[m] Place of the base of the arm."""
MAX_EPISODE_STEPS = 100
SPEED = 1.0
"""[rad/s] Speed of a joint's target at action 1."""
LEAD = 0.3
"""[rad] Largest distance of a joint's target from the joint."""
VARIANTS = 64
"""Number of different groups of shoots; further worlds repeat them."""
REACH = 0.05
"""[m] Distance from the middle of a bunch at which it is reached: its surface is then between the fingers."""
HOME = np.array([0.0, -2.3, 0.0, 1.9, 0.0, 1.6, 0.0, 0.0, 0.0])


class ReachEnv(TaskEnv):
    """Reach one bunch among four, in ``num_envs`` worlds with different shoots.

    Action [7], from -1 to 1: speeds of the targets of the seven joints, in units of 1 rad/s. An action lasts 40 ms.

    Observation [31] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the wanted bunch, and of the three others [m], in world axes; the sum of the forces on the
    other shoots [N]; and four numbers of which that of the wanted bunch is 1. Poses of bunches are those of 10 ms
    before.

    Reward of an action: 10 at success, minus the distance [m], minus 0.02 for each newton on other shoots, minus 0.01
    for each unit of squared action. An episode ends at success, and is truncated after 100 actions (4 s).

    Args:
        num_envs: number of worlds.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        arrays: ``"numpy"``, ``"torch"`` or ``"warp"``; see :class:`~vinesim.learn.task_env.TaskEnv`, which also
            describes ``info`` and errors.
        vines_seed: seed of what differs between worlds, which stays the same after a reset.
        variation: ranges of these numbers, or a TOML file with them.
        max_episode_steps: number of actions after which an episode is truncated.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        device: str = "cpu",
        arrays: str = "numpy",
        vines_seed: int = 0,
        variation: Variation | str | pathlib.Path = Variation(),
        max_episode_steps: int = MAX_EPISODE_STEPS,
        render_mode: str | None = None,
    ) -> None:
        check_options(num_envs, arrays, render_mode)
        variation = as_variation(variation)
        variants = [_variant(vines_seed, i, variation) for i in range(min(num_envs, VARIANTS))]
        worlds = Worlds(plants_of_worlds(variants, num_envs), num_envs, robots=[arm(BASE, HOME)], device=device)
        self._target = wp.zeros(num_envs, dtype=wp.int32, device=device)
        super().__init__(
            worlds,
            len(AXES),
            2 * len(AXES) + 3 * SHOOTS + 1 + SHOOTS,
            device=device,
            arrays=arrays,
            variation=variation,
            rng=np.random.default_rng([vines_seed, VARIANTS]),
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
        )

    def _moves(self) -> list[KernelLaunch]:
        bodies = self.worlds.bodies
        joints = len(AXES)
        limit = np.full(joints, JOINT_LIMIT)
        q = self.on_device(bodies.rigid.robot("arm").q[:joints], wp.int32)
        limits = [self.on_device(-limit, float), self.on_device(limit, float)]
        given = [SPEED * STEPS * self.worlds.dt, *limits, LEAD, q, self._action, bodies.data.qpos]
        return [KernelLaunch(kernels.move_targets, given, [bodies.targets], threads=self.num_envs, width=joints)]

    def _beginnings(self) -> list[KernelLaunch]:
        given = [SHOOTS, self._seed, self._begins]
        return [KernelLaunch(draw_targets, given, [self._episode, self._target], threads=self.num_envs)]

    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        worlds = self.worlds
        model = worlds.model
        data = worlds.bodies.data
        robot = worlds.bodies.rigid.robot("arm")
        joints = len(AXES)
        numbers = kernels.ReachNumbers()
        numbers.reach, numbers.success_reward = REACH, 10.0
        numbers.distance_cost, numbers.force_cost, numbers.action_cost = 1.0, 0.02, 0.01
        given = [
            numbers,
            robot.bodies[TOOL_LINK],
            wp.vec3(*TOOL),
            self.on_device(worlds.plants.buffers.slots[model.bunch_body], wp.int32),
            self.on_device(model.body_com[model.bunch_body], wp.vec3),
            self.num_envs,
            self._target,
            worlds.plants.launches.resident_arrays["body_q"],
            data.xpos,
            data.xmat,
            self.on_device(robot.q[:joints], wp.int32),
            self.on_device(robot.v[:joints], wp.int32),
            data.qpos,
            data.qvel,
            self._given_action,
            *worlds.contacts.lists(),
        ]
        return [KernelLaunch(kernels.observe, given, [observation, reward, success], threads=self.num_envs)]


def _variant(seed: int, number: int, variation: Variation) -> Model:
    return shoots(SHOOTS, np.random.default_rng([seed, number]), DISTANCE, variation)
