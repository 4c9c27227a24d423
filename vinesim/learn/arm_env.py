"""The tasks with the arm as environments: worlds, the differences between them, and episodes."""

from __future__ import annotations

import functools
import pathlib
from typing import Any, ClassVar

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn.episodes import begin_on_way, draw_targets
from vinesim.learn.arm import AXES, TOOL_LINK
from vinesim.learn.arm_arrays import arrays_of_worlds
from vinesim.learn.arm_task import HOME, ArmTask
from vinesim.learn.task_env import TaskEnv, check_options
from vinesim.learn.variation import Variation, as_variation
from vinesim.sensors.camera.world_cameras import WorldCamera
from vinesim.sensors.export.images import look_at
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

VARIANTS = 64
"""Default for the number of different groups of plants; further worlds repeat them."""
PICTURE_SIZE = 64
"""[px] Default for the width and height of observed pictures."""
CAMERAS = (
    WorldCamera(pose=look_at(np.array([-0.3, -0.35, 1.15]), np.array([0.95, 0.05, 0.75])), field_of_view=0.9),
    WorldCamera(
        pose=frames.pose(np.array([0.05, 0.0, 0.08]), frames.OPTICAL), field_of_view=1.2, actor="arm", link=TOOL_LINK
    ),
)
"""Cameras of observed pictures: one beside the base of the arm, and one on its hand, 8 cm above the fingers, which
looks along them. GUESSED."""
SPECTATOR = WorldCamera(pose=look_at(np.array([-0.4, -1.0, 1.25]), np.array([0.55, 0.0, 0.72])), field_of_view=0.8)
"""Camera of ``render``, which sees the arm and the shoots."""


class ArmEnv(TaskEnv):
    """A task of an arm of seven joints. Its action, from -1 to 1, sets the speeds of the targets of the joints, in
    units of 1 rad/s; further components are described by the task.

    Args:
        num_envs: number of worlds.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        arrays: ``"numpy"``, ``"torch"`` or ``"warp"``; see :class:`~vinesim.learn.task_env.TaskEnv`, which also
            describes ``info`` and errors.
        vines_seed: seed of the differences between worlds; the differences stay the same after a reset.
        vines: number of different groups of plants; further worlds repeat them.
        variation: ranges from which the numbers of each world are drawn: a
            :class:`~vinesim.learn.variation.Variation`, or the path of its TOML file.
        max_episode_steps: number of actions after which an episode is truncated; None: that of the task.
        on_way: share of the episodes that begin with the arm at a place, drawn evenly, of the way from its first
            positions to those near which the task can be done (:meth:`ArmTask.goals`), for trainings.
        render_mode: ``"rgb_array"`` or None; see :meth:`~vinesim.learn.task_env.TaskEnv.render`.
        observation: ``"state"`` or ``"pictures"``: the numbers, or a dictionary of the numbers (``state``) and of
            pictures of :data:`CAMERAS`; see :class:`~vinesim.learn.task_env.TaskEnv`.
        picture_size: width and height of these pictures [px].
        deterministic: whether equal seeds and actions give equal episodes to the bit on a GPU, too; see
            :class:`~vinesim.worlds.worlds.Worlds`.
    """

    task_class: ClassVar[type[ArmTask]]
    """The task."""
    world_options: ClassVar[dict[str, Any]] = {}
    """Further arguments of :class:`~vinesim.worlds.worlds.Worlds`."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        device: str = "cpu",
        arrays: str = "numpy",
        vines_seed: int = 0,
        vines: int = VARIANTS,
        variation: Variation | str | pathlib.Path = Variation(),
        max_episode_steps: int | None = None,
        on_way: float = 0.0,
        render_mode: str | None = None,
        observation: str = "state",
        picture_size: int = PICTURE_SIZE,
        deterministic: bool = False,
    ) -> None:
        task = self.task_class
        steps = task.max_steps if max_episode_steps is None else max_episode_steps
        check_options(
            {"num_envs": num_envs, "vines": vines, "max_episode_steps": steps},
            device=device,
            arrays=arrays,
            render_mode=render_mode,
            observation=observation,
            picture_size=picture_size,
        )
        ranges = as_variation(variation)
        variants = [
            task.plants(np.random.default_rng([vines_seed, number]), ranges) for number in range(min(num_envs, vines))
        ]
        self._on_way = on_way
        goals = [task.goals(model) for model in variants] if on_way > 0.0 else []
        self._goals = np.array([goals[world % len(variants)] for world in range(num_envs)] if goals else [])
        worlds = Worlds(
            plants_of_worlds(variants, num_envs),
            num_envs,
            robots=[task.robot()],
            parameters=task.parameters,
            device=device,
            blade=task.blade(),
            deterministic=deterministic,
            **self.world_options,
        )
        super().__init__(
            worlds,
            task.actions,
            task.numbers,
            device=device,
            arrays=arrays,
            variation=ranges,
            rng=np.random.default_rng([vines_seed, vines]),
            max_episode_steps=steps,
            render_mode=render_mode,
            observation=observation,
            cameras=CAMERAS,
            picture_size=picture_size,
            spectator=SPECTATOR,
        )

    @functools.cached_property
    def task(self) -> ArmTask:
        """The task in these worlds."""
        return self.task_class(arrays_of_worlds(self.worlds))

    @property
    def _failed(self) -> wp.array:
        return self.task.failed

    def _moves(self) -> list[KernelLaunch]:
        return self.task.moves(self._action, self.worlds.dt)

    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        return [self.task.observe(self._given_action, observation, reward, success)]

    def _beginnings(self) -> list[KernelLaunch]:
        given = [self.task_class.choices, self._seed, self._begins]
        draw = KernelLaunch(draw_targets, given, [self._episode, self.task.wanted], threads=self.num_envs)
        return [draw, *self._starts(), *self.task.beginnings(self._begins)]

    def _starts(self) -> list[KernelLaunch]:
        """Returns the launch that lets some episodes begin on the way to the goals, if any do."""
        if self._on_way == 0.0:
            return []
        arrays = self.task.arrays
        home = self.on_device(HOME[: len(AXES)], float)
        given = [self._on_way, home, self.on_device(self._goals, float), arrays.arm.q]
        given += [self._seed, self._begins, self._episode, self.task.wanted]
        return [KernelLaunch(begin_on_way, given, [arrays.arm.qpos, arrays.targets], threads=self.num_envs)]

    def _counts(self) -> list[KernelLaunch]:
        return self.task.counts()
