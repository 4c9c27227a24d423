"""Task *expose*: push a shoot aside that hides a bunch, and hold it there."""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import expose as kernels
from vinesim.learn.arm import AXES
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_task import DISTANCE, ArmTask
from vinesim.learn.shoots import shoots
from vinesim.learn.variation import Variation
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.worlds.plants import joined

EYE = (-0.1, 0.0, 0.85)
"""[m] Point from which the bunch is looked at, above the base of the arm."""
FRONT = (0.7, 0.8)
"""Range of where the hiding bunch hangs, as a share of the way from the eye to the wanted bunch. GUESSED."""
AWAY = DISTANCE + 0.1
"""[m] From the origin to where the shoots grow: the arm at rest touches none of them."""
SHARE = 0.85
"""Visible share of a bunch from which it is exposed: eight of nine points."""
SPEED = 0.1
"""[m/s] Speed below which the hiding bunch is held, not swinging. GUESSED."""


class Expose(ArmTask):
    """The task of :class:`ExposeEnv`. The wanted bunch is that of the first shoot."""

    name = "expose"
    numbers = 2 * len(AXES) + 3 * 2 + 2

    @staticmethod
    def plants(rng: np.random.Generator, variation: Variation) -> Model:
        """Returns a shoot with the wanted bunch, and one whose bunch hangs between it and the eye."""
        wanted, hiding = (shoots(1, rng, AWAY, variation) for _ in range(2))
        back, front = _middle(wanted), _middle(hiding)
        hiding.tree_pose[0, :3] += np.array(EYE) + rng.uniform(*FRONT) * (back - np.array(EYE)) - front
        return joined([wanted, hiding])

    def observe(self, action: wp.array, observation: wp.array, reward: wp.array, success: wp.array) -> KernelLaunch:
        """See :meth:`ArmTask.observe`."""
        numbers = kernels.ExposeNumbers()
        numbers.eye = wp.vec3(*EYE)
        numbers.share = SHARE
        numbers.speed = SPEED
        numbers.success_reward = 10.0
        numbers.force_cost = 0.02
        numbers.action_cost = 0.01
        arrays = self.arrays
        given = [numbers, arrays.arm, *arrays.bunches, arrays.body_qd, arrays.bunch_size, arrays.worlds]
        given += [arrays.capsules, action, arrays.contacts, arrays.world_contacts]
        return KernelLaunch(kernels.observe, given, [observation, reward, success], threads=arrays.worlds)


class ExposeEnv(ArmEnv):
    """Make a bunch visible that the bunch of another shoot hides, in ``num_envs`` worlds with different shoots.

    Nine points of the bunch are looked at from a fixed point above the base of the arm. The other shoot can hide them;
    the arm and leaves cannot.

    Observation [22] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the wanted bunch, and of the hiding bunch [m], in world axes; the visible share, 0 to 1;
    and the sum of the forces on the wanted bunch's shoot [N]. Poses of bunches are those of 10 ms before.

    Reward of an action: 10 at success, plus the visible share minus 1, minus 0.02 for each newton on the wanted bunch's
    shoot, minus 0.01 for each unit of squared action. Success: eight of nine points are visible, and the hiding bunch
    moves by less than 0.1 m/s. An episode ends at success, and is truncated after 100 actions (4 s).

    :class:`~vinesim.learn.arm_env.ArmEnv` describes arguments and actions.
    """

    task_class = Expose


def _middle(model: Model) -> np.ndarray:
    """Returns the middle [3] m of the first bunch of a model at rest."""
    pose = model.forward_kinematics(State.at_rest(model).joint_q)[model.bunch_body[0]]
    return pose[:3] + frames.rotate(pose[3:], model.body_com[model.bunch_body[0]].astype(float))
