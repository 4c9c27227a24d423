"""Task *reach*: bring the fingers of an arm to a bunch without pressing on other plants."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.learn import reach as kernels
from vinesim.learn.arm import AXES, JOINT_LIMIT, TOOL, TOOL_LINK, arm
from vinesim.learn.shoots import shoots
from vinesim.scene.model import Model
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

SHOOTS = 4
"""Number of shoots of a world; each has one bunch."""
DISTANCE = 1.2
"""[m] From the base of the arm to the row of shoots."""
BASE = (-0.1, 0.0, 0.6)
"""[m] Place of the base of the arm."""
STEPS = 4
"""Steps of 10 ms between two actions."""
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


class ReachEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Reach one bunch among four, in ``num_envs`` worlds with different shoots.

    Action [7], from -1 to 1: speeds of the targets of the seven joints, in units of 1 rad/s. An action lasts 40 ms.

    Observation [31] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the wanted bunch, and of the three others [m], in world axes; the sum of the forces on the
    other shoots [N]; and four numbers of which that of the wanted bunch is 1. Poses of bunches are those of 10 ms
    before.

    Reward of an action: 10 at success, minus the distance [m], minus 0.02 for each newton on other shoots, minus 0.01
    for each unit of squared action. An episode ends at success, and is truncated after 100 actions (4 s).

    ``info["success"]``: bool [world]. A world that ends begins again in the same step; its last observation is in
    ``info["final_obs"]``.

    Args:
        num_envs: number of worlds.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        vines_seed: seed of the shoots, which stay the same after a reset.
        max_episode_steps: number of actions after which an episode is truncated.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        device: str = "cpu",
        vines_seed: int = 0,
        max_episode_steps: int = MAX_EPISODE_STEPS,
        render_mode: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs {num_envs}: give at least 1")
        if render_mode is not None:
            raise ValueError(f"render_mode {render_mode!r}: this environment has none")
        self.num_envs = num_envs
        self.render_mode = None
        self.max_episode_steps = max_episode_steps
        variants = [_variant(vines_seed, i) for i in range(min(num_envs, VARIANTS))]
        self.worlds = Worlds(plants_of_worlds(variants, num_envs), num_envs, robots=[arm(BASE, HOME)], device=device)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(AXES),), np.float32)
        self._numbers = 2 * len(AXES) + 3 * SHOOTS + 1 + SHOOTS
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self._numbers,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._device = device
        self._elapsed = np.zeros(num_envs, np.int32)
        self._make_graphs()

    def _make_graphs(self) -> None:
        """Prepare the kernels of an action and of an observation."""
        worlds = self.worlds
        device = self._device
        bodies = worlds.bodies
        robot = bodies.rigid.robot("arm")
        joints = len(AXES)

        def on_device(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=device)

        def empty(dtype: Any, *shape: int) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self._target = empty(wp.int32, self.num_envs)
        self._action = empty(float, self.num_envs, joints)
        self._observation = empty(float, self.num_envs, self._numbers)
        self._reward = empty(float, self.num_envs)
        self._success = empty(wp.bool, self.num_envs)
        limit = np.full(joints, JOINT_LIMIT)
        q, v = (on_device(index[:joints], wp.int32) for index in (robot.q, robot.v))
        qpos, qvel = bodies.data.qpos, bodies.data.qvel
        numbers = kernels.ReachNumbers()
        numbers.reach, numbers.success_reward = REACH, 10.0
        numbers.distance_cost, numbers.force_cost, numbers.action_cost = 1.0, 0.02, 0.01
        plants = worlds.plants
        model = worlds.model
        bunch = on_device(plants.buffers.slots[model.bunch_body], wp.int32)
        self._move = KernelGraph(
            KernelLaunch(
                kernels.move_targets,
                [
                    SPEED * STEPS * worlds.dt,
                    on_device(-limit, float),
                    on_device(limit, float),
                    LEAD,
                    q,
                    self._action,
                    qpos,
                ],
                [bodies.targets],
                threads=self.num_envs,
                width=joints,
            ),
            device=device,
        )
        self._observe = KernelGraph(
            KernelLaunch(
                kernels.observe,
                [
                    numbers,
                    robot.bodies[TOOL_LINK],
                    wp.vec3(*TOOL),
                    bunch,
                    on_device(model.body_com[model.bunch_body], wp.vec3),
                    self.num_envs,
                    self._target,
                    plants.launches.resident_arrays["body_q"],
                    bodies.data.xpos,
                    bodies.data.xmat,
                    q,
                    v,
                    qpos,
                    qvel,
                    self._action,
                    *worlds.contacts.lists(),
                ],
                [self._observation, self._reward, self._success],
                threads=self.num_envs,
            ),
            device=device,
        )

    # ------------------------------------------------------------------ gymnasium

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in all worlds; see :class:`gymnasium.vector.VectorEnv`. ``seed``: chooses the bunches."""
        if isinstance(seed, list):
            raise ValueError("seed: give one number for all worlds")
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, np.bool_))
        return self._observed(), {"success": np.zeros(self.num_envs, np.bool_)}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one action in each world; see the class."""
        self._action.assign(np.asarray(actions, np.float32).reshape(self.num_envs, len(AXES)))
        self._move()
        self.worlds.step(STEPS)
        self._elapsed += 1
        observation = self._observed()
        reward = self._reward.numpy().astype(np.float64)
        success = self._success.numpy().copy()
        valid = np.isfinite(observation).all(1)
        terminated = success | ~valid
        truncated = (self._elapsed >= self.max_episode_steps) & ~terminated
        info: dict[str, Any] = {"success": success}
        ended = terminated | truncated
        if ended.any():
            info["final_obs"] = observation.copy()
            info["_final_obs"] = ended
            reward[~valid] = 0.0
            self._begin(ended)
            observation = np.where(ended[:, None], self._observed(), observation)
        return observation, reward, terminated, truncated, info

    def _begin(self, worlds: np.ndarray) -> None:
        """Begin an episode in some worlds: bool [world]."""
        target = self._target.numpy().copy()
        target[worlds] = self.np_random.integers(0, SHOOTS, int(worlds.sum()))
        self._target.assign(target)
        self._elapsed[worlds] = 0
        self.worlds.reset(worlds)

    def _observed(self) -> np.ndarray:
        """Returns the present observations [world, k]."""
        self.worlds.bodies.update_kinematics()
        self._observe()
        observation = self._observation.numpy().copy()
        observation[:, -SHOOTS:] = np.eye(SHOOTS, dtype=np.float32)[self._target.numpy()]
        return observation


def _variant(seed: int, number: int) -> Model:
    return shoots(SHOOTS, np.random.default_rng([seed, number]), DISTANCE)
