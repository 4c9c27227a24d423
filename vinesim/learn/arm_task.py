"""A task with the arm, apart from where it runs: in a batch of worlds, or in the physics of a client."""

from __future__ import annotations

import abc
import math
from typing import ClassVar

import numpy as np
import warp as wp

from vinesim.interaction.blades import Blade
from vinesim.kernels.graph import KernelLaunch
from vinesim.learn.arm import AXES, arm
from vinesim.learn.arm_arrays import ArmArrays
from vinesim.learn.variation import Variation
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RobotSpec

DISTANCE = 1.2
"""[m] From the origin to the row of shoots."""
BASE = (-0.1, 0.0, 0.6)
"""[m] Place of the base of the arm."""
HOME = np.array([0.0, -2.3, 0.0, 1.9, 0.0, 1.6, 0.0, 0.0, 0.0])
"""First positions of the joints [rad] and fingers [m]."""


class ArmTask(abc.ABC):
    """What the actions of a task do, what is observed, and what success is. One tree of a world is wanted.

    Args:
        arrays: what the task reads and writes, of one world or several.
    """

    name: ClassVar[str]
    numbers: ClassVar[int]
    """Number of an observation's components."""
    actions: ClassVar[int] = len(AXES)
    """Number of an action's components."""
    max_steps: ClassVar[int] = 100
    """Number of actions after which an episode is truncated."""
    choices: ClassVar[int] = 1
    """Number of a world's trees from which the wanted one is drawn."""
    parameters: ClassVar[PhysicsParameters] = PhysicsParameters()
    """Numbers of the physics."""
    discount: ClassVar[float] = 0.98
    """Discount of an action for which the rewards are made. TUNED on the task reach."""

    failure: ClassVar[str] = "it can no longer be done"
    """What has happened when success is no longer possible."""

    learning_rate: ClassVar[float | None] = None
    """Learning rate of a training; None: it is adapted. With 64 worlds and 7.5 minutes on a core, Reach was done on
    98.8 % of unseen vines with an adapted rate, and on 94.8 % with 3e-4."""
    noise: ClassVar[float] = 1.0
    """Standard deviation of the actions that a training first explores."""
    calm: ClassVar[float] = math.inf
    """Number of iterations of a training after which the largest allowed deviation is 1/e of :attr:`noise`."""
    on_way: ClassVar[float] = 0.0
    """Share of the episodes of a training that begin on the way to :meth:`goals`."""

    def __init__(self, arrays: ArmArrays) -> None:
        self.arrays = arrays
        self.wanted = self._each(wp.int32)
        """[world] Number of the wanted tree, or of the tree whose bunch is wanted, in its world."""
        self.failed = self._each(wp.bool)
        """[world] Whether success is no longer possible, so that the episode ends."""

    @staticmethod
    @abc.abstractmethod
    def plants(rng: np.random.Generator, variation: Variation) -> Model:
        """Returns the plants of a world."""

    @staticmethod
    def robot() -> RobotSpec:
        """Returns the robot, whose first drives are the seven joints, and the last two the fingers."""
        return arm(BASE, HOME)

    @staticmethod
    def blade() -> Blade | None:
        """Returns the robot's blade, if it has one."""
        return None

    @staticmethod
    def wanted_body(model: Model, wanted: int) -> int:
        """Returns the body of a world's plants that the task is about. ``wanted``: number of the wanted tree."""
        return int(model.bunch_body[wanted])

    @classmethod
    def goals(cls, model: Model) -> np.ndarray:
        """Returns positions [choice, joint] rad of the seven joints near which the task can be done, for each tree of
        a world that may be wanted. A tree without any has the first positions."""
        return np.tile(HOME[: len(AXES)], (cls.choices, 1))

    def moves(self, action: wp.array, dt: float) -> list[KernelLaunch]:
        """Returns the launches that apply an action [world, k]. ``dt`` [s]: duration of a step."""
        return [self.arrays.move(action, dt)]

    def beginnings(self, begins: wp.array) -> list[KernelLaunch]:
        """Returns the launches that begin an episode in the worlds of ``begins`` [world]."""
        return []

    def counts(self) -> list[KernelLaunch]:
        """Returns the launches that follow once after each action, before :meth:`observe`."""
        return []

    @abc.abstractmethod
    def observe(self, action: wp.array, observation: wp.array, reward: wp.array, success: wp.array) -> KernelLaunch:
        """Returns the launch that writes the observation [world, k], the reward and the success [world] of the present
        states. ``action``: [world, k] the last one."""

    def _each(self, dtype: type) -> wp.array:
        """Returns an array of zeros with an element for each world."""
        return wp.zeros(self.arrays.worlds, dtype=dtype, device=self.arrays.device)
