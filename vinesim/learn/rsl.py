"""Environments of tasks for rsl_rl, which has a class of vector environments of its own."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import warp as wp

from vinesim.learn.task_env import TaskEnv
from vinesim.worlds.errors import MissingExtra

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # rsl_rl imports GitPython, which refuses a machine without git
try:
    import torch  # pyright: ignore[reportMissingImports]
    from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
    from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingExtra(f"this module needs rsl_rl: pip install 'vinesim[train]' ({error})") from error


class Totals(NamedTuple):
    """Sums over all worlds and some actions."""

    reward: float
    ended: int
    """Number of episodes that ended."""
    success: int
    """Number of episodes that ended with success."""
    fault: int
    """Number of episodes that ended with a fault."""


class RslEnv(VecEnv):
    """A task as a ``VecEnv`` of rsl_rl: ``OnPolicyRunner(RslEnv(ReachEnv(4096, device="cuda", arrays="torch")), ...)``.

    Observations are in the group ``policy``, pictures in groups with their names. The logged ``/success`` is the share
    of worlds whose last episode ended with success.

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
        self._succeeded = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._totals = torch.zeros(len(Totals._fields), dtype=torch.float64, device=env.device)

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
        ended = terminated | truncated
        success = info["success"]
        fault = info["fault"] != 0
        self._succeeded = torch.where(ended, success, self._succeeded)
        sums = [values.sum(dtype=torch.float64) for values in (reward, ended, success, fault)]
        self._totals += torch.stack(sums)
        log = {"/success": self._succeeded.float().mean(), "/fault": fault.float().mean()}
        return self._observations, reward, ended, {"time_outs": truncated, "log": log}

    def take_totals(self) -> Totals:
        """Returns the sums over all actions since the last call."""
        reward, *counts = self._totals.tolist()
        self._totals.zero_()
        return Totals(reward, *map(round, counts))

    def _grouped(self, observation: Any) -> Any:
        groups = {"policy": observation}
        if isinstance(observation, dict):
            groups = {"policy" if name == "state" else name: values for name, values in observation.items()}
        return TensorDict(groups, batch_size=[self.num_envs])
