"""What the tasks with an arm in front of shoots share: worlds, actions, and what differs between worlds."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.kernels.graph import KernelLaunch
from vinesim.learn.arm import AXES, TOOL_LINK, arm
from vinesim.learn.arm_arrays import ArmArrays, arrays_of_worlds
from vinesim.learn.task_env import TaskEnv, check_options
from vinesim.learn.variation import Variation, as_variation
from vinesim.scene.model import Model
from vinesim.scene.values import RobotSpec
from vinesim.sensors.camera.world_cameras import WorldCamera
from vinesim.sensors.export.images import look_at
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

DISTANCE = 1.2
"""[m] From the origin to the row of shoots."""
BASE = (-0.1, 0.0, 0.6)
"""[m] Place of the base of the arm."""
HOME = np.array([0.0, -2.3, 0.0, 1.9, 0.0, 1.6, 0.0, 0.0, 0.0])
"""First positions of the joints [rad] and fingers [m]."""
MAX_EPISODE_STEPS = 100
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
Plants = Callable[[np.random.Generator, Variation], Model]


class ArmEnv(TaskEnv):
    """A task of an arm of seven joints. Its action [7], from -1 to 1, sets the speeds of the targets of the joints, in
    units of 1 rad/s.

    Args:
        plants: returns the plants of a world.
        numbers: number of an observation's components.
        num_envs: number of worlds.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        arrays: ``"numpy"``, ``"torch"`` or ``"warp"``; see :class:`~vinesim.learn.task_env.TaskEnv`, which also
            describes ``info`` and errors.
        vines_seed: seed of the differences between worlds; the differences stay the same after a reset.
        vines: number of different groups of plants; further worlds repeat them.
        variation: ranges of these numbers, or a TOML file with them.
        max_episode_steps: number of actions after which an episode is truncated.
        robot: the robot, whose first drives are the seven joints; None: :func:`~vinesim.learn.arm.arm`.
        actions: number of an action's components, if the task has more.
        render_mode: ``"rgb_array"`` or None; see :meth:`~vinesim.learn.task_env.TaskEnv.render`.
        observation: ``"state"`` or ``"pictures"``: the numbers, or a dictionary of the numbers (``state``) and of
            pictures of :data:`CAMERAS`; see :class:`~vinesim.learn.task_env.TaskEnv`.
        picture_size: width and height of these pictures [px].
        options: further arguments of :class:`~vinesim.worlds.worlds.Worlds`.
    """

    def __init__(
        self,
        plants: Plants,
        numbers: int,
        num_envs: int = 1,
        *,
        device: str = "cpu",
        arrays: str = "numpy",
        vines_seed: int = 0,
        vines: int = VARIANTS,
        variation: Variation | str | pathlib.Path = Variation(),
        max_episode_steps: int = MAX_EPISODE_STEPS,
        render_mode: str | None = None,
        observation: str = "state",
        picture_size: int = PICTURE_SIZE,
        robot: RobotSpec | None = None,
        actions: int = len(AXES),
        **options: Any,
    ) -> None:
        check_options(num_envs, arrays, render_mode, observation, picture_size)
        ranges = as_variation(variation)
        variants = [
            plants(np.random.default_rng([vines_seed, number]), ranges) for number in range(min(num_envs, vines))
        ]
        super().__init__(
            Worlds(
                plants_of_worlds(variants, num_envs),
                num_envs,
                robots=[arm(BASE, HOME) if robot is None else robot],
                device=device,
                **options,
            ),
            actions,
            numbers,
            device=device,
            arrays=arrays,
            variation=ranges,
            rng=np.random.default_rng([vines_seed, vines]),
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            observation=observation,
            cameras=CAMERAS,
            picture_size=picture_size,
            spectator=SPECTATOR,
        )

    @functools.cached_property
    def arm_arrays(self) -> ArmArrays:
        """What kernels read and write."""
        return arrays_of_worlds(self.worlds)

    def _moves(self) -> list[KernelLaunch]:
        return [self.arm_arrays.move(self._action, self.worlds.dt)]
