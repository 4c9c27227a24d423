"""Controllers of the arm of the learning tasks that know its kinematics."""

import abc
import functools
from typing import Any

import numpy as np

from vinesim.learn.arm_kinematics import ArmKinematics
from vinesim.learn.arm_task import ArmTask
from vinesim.learn.pick import Pick
from vinesim.learn.prune import Prune
from vinesim.learn.reach import Reach
from vinesim.learn.variation import Variation

GAIN = 8.0
"""Action per rad that a joint is to turn."""
OPEN = 0.03
"""[m] Opening of the fingers with which the hand comes to a stalk."""
BELOW = 0.012
"""[m] How far below the middle of a stalk the hand grasps it, so that the cane above is not in the blade's mouth."""
CLOSED_ON_STALK = -0.04
"""[m] Opening of the fingers below which they have closed: a stalk of 4 mm leaves -0.044 m."""


@functools.cache
def kinematics(task: type[ArmTask]) -> ArmKinematics:
    """Returns the kinematics of a task's arm."""
    return ArmKinematics(task.plants(np.random.default_rng(0), Variation()), task.robot())


def towards(env: Any, ways: np.ndarray, gain: float = GAIN, ahead: np.ndarray | None = None) -> np.ndarray:
    """Returns the actions [world, 7] that move the point between the fingers along ``ways`` [world, 3] m. ``ahead``
    [world, 3]: horizontal directions into which the upright hand turns; None: it turns as it likes."""
    arm = kinematics(env.unwrapped.task_class)
    bodies = env.unwrapped.worlds.bodies
    positions = bodies.data.qpos.numpy()[:, bodies.rigid.robot("arm").q[:7]]
    turns = [None] * len(ways) if ahead is None else ahead
    steps = [arm.step(*each) for each in zip(positions, ways, turns, strict=True)]
    return np.clip(gain * np.array(steps), -1.0, 1.0).astype(np.float32)


class Controller(abc.ABC):
    """A stand-in for a policy of a task that computes actions from observations and the kinematics of the arm."""

    def __init__(self, task: type[ArmTask]) -> None:
        self.task = task.name
        self._numbers = (task.numbers, task.actions)
        self._arm = kinematics(task)

    def check_numbers(self, inputs: int, outputs: int) -> None:
        assert (inputs, outputs) == self._numbers

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        if observation.ndim == 2:
            return np.array([self(one) for one in observation])
        return np.clip(self._act(observation.astype(float)), -1.0, 1.0).astype(np.float32)

    @abc.abstractmethod
    def _act(self, observation: np.ndarray) -> np.ndarray:
        """Returns the action that follows from an observation."""


class Reaching(Controller):
    """Moves straight to the wanted bunch."""

    def __init__(self) -> None:
        super().__init__(Reach)

    def _act(self, observation: np.ndarray) -> np.ndarray:
        return GAIN * self._arm.step(observation[:7], observation[14:17])


class Picking(Controller):
    """Comes to 5 cm in front of the stalk, goes on until it is between the fingers, closes them, and commands the blade
    once they are closed."""

    def __init__(self) -> None:
        super().__init__(Pick)

    def _act(self, observation: np.ndarray) -> np.ndarray:
        q = observation[:7]
        opening = observation[14]
        to_stalk = observation[15:18]
        ahead = self._arm.ahead(q, self._arm.point(q) + to_stalk)
        aside = np.linalg.norm(to_stalk - (to_stalk @ ahead) * ahead)
        is_in_front = aside < 0.03 and to_stalk @ ahead < 0.09
        around = to_stalk + 0.01 * ahead - [0.0, 0.0, BELOW]
        is_around = np.linalg.norm(around) < 0.012
        is_closing = np.linalg.norm(to_stalk) < 0.035 and opening < 0.02
        action = np.zeros(9)
        if not is_around and not is_closing:
            action[:7] = GAIN * self._arm.step(q, around if is_in_front else to_stalk - 0.05 * ahead, ahead)
            action[7] = -0.5 if opening < OPEN else 0.0
        else:
            action[7] = 1.0
            action[8] = opening < CLOSED_ON_STALK
        return action


class Pruning(Controller):
    """Comes to 7 cm in front of the wanted internode, upright, goes on until the cane is between the bars, and cuts."""

    def __init__(self) -> None:
        super().__init__(Prune)

    def _act(self, observation: np.ndarray) -> np.ndarray:
        way = observation[14:17]
        ahead = np.array([1.0, 0.0, 0.0])
        left = way @ ahead
        is_in_front = np.linalg.norm(way - left * ahead) < 0.015 or left < 0.04
        action = np.zeros(8)
        action[:7] = GAIN * self._arm.step(observation[:7], way if is_in_front else way - 0.07 * ahead, ahead)
        action[7] = np.linalg.norm(way) < 0.008
        return action
