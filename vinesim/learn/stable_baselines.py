"""Environments of tasks for Stable-Baselines3, which does not take Gymnasium's vector environments."""

from __future__ import annotations

from typing import Any

import numpy as np

from vinesim.learn.task_env import TaskEnv, of_world
from vinesim.worlds.errors import MissingExtra

try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    message = f"this module needs Stable-Baselines3: pip install stable-baselines3 ({error})"
    raise MissingExtra(message) from error


class StableBaselinesEnv(VecEnv):
    """A task as a ``VecEnv`` of Stable-Baselines3: ``PPO("MlpPolicy", StableBaselinesEnv(ReachEnv(8)))``.

    ``env``: the task, with arrays of NumPy. Raises :class:`ValueError` for others.
    """

    def __init__(self, env: TaskEnv) -> None:
        if env.arrays != "numpy":
            raise ValueError(f"arrays {env.arrays!r}: Stable-Baselines3 takes numpy")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(env.action_space.shape or (), np.float32)

    def reset(self) -> Any:
        """Begin an episode in all worlds. Returns the observations [world, k], or a dictionary with pictures, too."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions [world, k] for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Take the actions. Returns observations, rewards, which worlds ended, and a dictionary for each world."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [
            {"is_success": bool(success), "fault": int(fault), "TimeLimit.truncated": bool(late)}
            for success, fault, late in zip(info["success"], info["fault"], truncated, strict=True)
        ]
        for world in np.flatnonzero(ended):
            infos[world]["terminal_observation"] = of_world(info["final_obs"], world)
        return observation, reward, ended, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of the environment, once for each of the worlds."""
        return [getattr(self.env, attr_name)] * len(self._worlds(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment, which all worlds share."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment once. Returns its result for each of the worlds."""
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)] * len(self._worlds(indices))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns False for each of the worlds."""
        return [False] * len(self._worlds(indices))

    def _worlds(self, indices: Any) -> list[int]:
        return list(self._get_indices(indices))
