"""Vector environments with one world as environments, for libraries that want those."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np

from vinesim.learn.expose import ExposeEnv
from vinesim.learn.pick import PickEnv
from vinesim.learn.prune import PruneEnv
from vinesim.learn.reach import ReachEnv
from vinesim.learn.task_env import RENDER_MODES, TaskEnv, of_world


class OneWorld(gymnasium.Env[Any, np.ndarray]):
    """A task with one world. ``vector``: the task, with arrays of NumPy."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [*RENDER_MODES], "render_fps": 25}

    def __init__(self, vector: TaskEnv) -> None:
        self.vector = vector
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space
        self.render_mode = self.vector.render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see :class:`gymnasium.Env`."""
        super().reset(seed=seed)
        observation, _ = self.vector.reset(seed=seed, options=options)
        return of_world(observation, 0), {"success": False}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one action; see :class:`gymnasium.Env`."""
        observation, reward, terminated, truncated, info = self.vector.step(np.asarray(action)[None])
        seen = of_world(info.get("final_obs", observation), 0)
        return seen, float(reward[0]), bool(terminated[0]), bool(truncated[0]), {"success": bool(info["success"][0])}

    def render(self) -> np.ndarray | None:
        """Returns a picture [height, width, 3] uint8 of the present state; None without a render mode."""
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]


class ReachOne(OneWorld):
    """:class:`ReachEnv` with one world. ``options``: arguments of :class:`ReachEnv` except ``num_envs``, ``arrays``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(ReachEnv(1, **options))


class ExposeOne(OneWorld):
    """:class:`ExposeEnv` with one world. ``options``: arguments of :class:`ExposeEnv` except ``num_envs``,
    ``arrays``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(ExposeEnv(1, **options))


class PickOne(OneWorld):
    """:class:`PickEnv` with one world. ``options``: arguments of :class:`PickEnv` except ``num_envs``, ``arrays``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(PickEnv(1, **options))


class PruneOne(OneWorld):
    """:class:`PruneEnv` with one world. ``options``: arguments of :class:`PruneEnv` except ``num_envs``, ``arrays``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(PruneEnv(1, **options))
