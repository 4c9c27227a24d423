"""Environments of tasks for rsl_rl, which has a class of vector environments of its own."""

from __future__ import annotations

from typing import Any

import warp as wp

from vinesim.learn.task_env import TaskEnv
from vinesim.worlds.errors import MissingExtra

try:
    from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
    from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingExtra(f"this module needs rsl_rl: pip install rsl-rl-lib ({error})") from error


class RslEnv(VecEnv):
    """A task as a ``VecEnv`` of rsl_rl: ``OnPolicyRunner(RslEnv(ReachEnv(4096, device="cuda", arrays="torch")), ...)``.

    Observations are in the group ``policy``.

    ``env``: the task, with arrays of PyTorch. Raises :class:`ValueError` for others.
    """

    def __init__(self, env: TaskEnv) -> None:
        if env.arrays != "torch":
            raise ValueError(f"arrays {env.arrays!r}: rsl_rl takes torch")
        self.env = env
        self.cfg: dict[str, Any] = {}
        self.device = env.device
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.max_episode_length = env.max_episode_steps
        self._elapsed = wp.to_torch(env.elapsed)
        self._observations = self._grouped(env.reset()[0])

    @property
    def episode_length_buf(self) -> Any:
        """[world] Number of actions of the episodes. rsl_rl assigns it to begin at random times."""
        return self._elapsed

    @episode_length_buf.setter
    def episode_length_buf(self, value: Any) -> None:
        self._elapsed.copy_(value)

    def get_observations(self) -> Any:
        """Returns the present observations."""
        return self._observations

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        """Take one action in each world. Returns observations, rewards, which worlds ended, and other numbers."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self._observations = self._grouped(observation)
        log = {"/success": info["success"].float().mean(), "/fault": (info["fault"] != 0).float().mean()}
        return self._observations, reward, terminated | truncated, {"time_outs": truncated, "log": log}

    def _grouped(self, observation: Any) -> Any:
        return TensorDict({"policy": observation}, batch_size=[self.num_envs])
