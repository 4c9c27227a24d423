"""Task *pick*: grasp a bunch by its stalk, cut it off above the fingers, and hold it.

An action is rewarded by the progress that it makes: the potential of the state after it minus that before it. Waiting
makes no progress, wherever the hand is, and costs time. The potential is not discounted: with discounted potentials,
which change no policy's advantage over another one (Ng, Harada, Russell 1999, "Policy invariance under reward
transformations"), a training learned nothing of the way to the stalk, since a policy that only waits earns the less the
nearer it waits.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import warp as wp

from vinesim.interaction.blades import Blade
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import pick as kernels
from vinesim.learn.arm import AXES, CLOSED, FINGER, FINGER_WAY, GAP, harvest_arm, harvest_blade
from vinesim.learn.arm_arrays import ArmArrays
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_kinematics import ArmKinematics
from vinesim.learn.arm_task import BASE, DISTANCE, HOME, ArmTask
from vinesim.learn.shoots import shoots
from vinesim.learn.task_env import STEPS
from vinesim.learn.variation import Variation
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import RobotSpec

SHOOTS = 2
"""Number of shoots of a world; each has one bunch."""
SLOTS = 32
"""Contacts that the plants of a world can have at once: fingers around a stalk have up to 16, the bunch more."""
FINGER_SPEED = 0.15
"""[m/s] Speed of the targets of the fingers. GUESSED."""
DEAD = 0.2
"""Command of the fingers up to which they stay. GUESSED: the noise of a training lets a bunch fall less often."""
TRIGGER = 5
"""Number of actions, 0.2 s, for which the blade must be commanded until it closes. GUESSED, as a guard against cuts by
accident: an action of noise about 0 closes the blade once in 62 actions, not in every second one."""
REACH = 0.05
"""[m] Distance of the stalk from the point between the fingers up to which the bunch is in the hand. GUESSED: the
fingers are 8 cm long."""
LOST = 0.2
"""[m] Distance of the stalk from which on a bunch that came off is lost. GUESSED."""
SPEED = 0.1
"""[m/s] Speed below which the bunch is held, not falling or swinging. GUESSED."""
HELD = 5
"""Number of actions, 0.2 s, for which the bunch must be held."""
TIME_COST = 0.02
"""Cost of an action. GUESSED: an episode that never ends then costs 0.02 / (1 - 0.99) = 2, as much as a lost
bunch without the potential that it loses."""
IN_FRONT = 0.02
"""[m] Distance of the tips of the fingers from a stalk in front of them. GUESSED: nothing touches the hand there."""
ACTION_COST = 0.001
"""Cost of an action per squared action. GUESSED: with 0.01, as in the other tasks, the noise of the nine actions of a
training costs as much as time does."""
PLACE = (-0.02, 0.0, 0.01)
"""[m] Place of the stalk in the hand that has the highest potential, from the point between the tips of the fingers.
GUESSED: a quarter of a finger, so that a stalk does not slip out at the tips; and 1 cm below the middle of the stalk,
so that the cane above is not in the blade's mouth (a controller picks 45 of 48 bunches so, and 32 without)."""
DISTANCE_WORTH = 10.0
"""[1/m] Potential per distance of the stalk from :data:`PLACE`. GUESSED: the way from the first pose, some 0.4 m, is
worth 4, less than success."""
TILT_WORTH = 2.0
"""Potential per 1 - the cosine of the angle between the stalk and the hand's vertical axis. GUESSED: the way from the
first pose, in which the hand points down, is worth 2."""
GRASP_WORTH = 3.0
"""Potential of closed fingers with the stalk between them. GUESSED: more than the tilt, less than success."""
CUT_WORTH = 2.0
"""Further potential of this grasp, times how far the bunch is cut off. GUESSED: a command of the blade that begins in a
grasp is rewarded at once, and one that is broken off loses this reward again."""


class Pick(ArmTask):
    """The task of :class:`PickEnv`."""

    name = "pick"
    numbers = 2 * len(AXES) + 14 + 3 * (SHOOTS - 1) + 1 + SHOOTS
    actions = len(AXES) + 2
    max_steps = 150
    choices = SHOOTS
    failure = "the wanted bunch is lost, or another one came off"
    learning_rate = 3e-4
    """That of Stable-Baselines3. With 64 worlds an adapted rate fell to its least value of 1e-5 within two iterations:
    the gradients of small batches differ so much."""
    noise = 0.6
    calm = 150
    """GUESSED: noise of 0.5 shakes a bunch in the hand by more than :data:`SPEED`, so that no success is ever seen."""
    on_way = 0.5
    """GUESSED."""
    discount = 0.99
    """GUESSED: 0.98 forgets in 2 s, and an episode of Pick takes up to 6 s."""

    def __init__(self, arrays: ArmArrays) -> None:
        super().__init__(arrays)
        self._held = self._each(wp.int32)
        self._commanded = self._each(wp.int32)
        self._potential = self._each(float)

    @staticmethod
    def plants(rng: np.random.Generator, variation: Variation) -> Model:
        """Returns two shoots."""
        return shoots(SHOOTS, rng, DISTANCE, variation)

    @staticmethod
    def robot() -> RobotSpec:
        """Returns the arm with fingers that hold a bunch by its stalk."""
        return harvest_arm(BASE, HOME)

    @staticmethod
    def blade() -> Blade | None:
        """Returns the blade above the fingers."""
        return harvest_blade()

    @classmethod
    def goals(cls, model: Model) -> np.ndarray:
        """Returns positions in which the upright hand is in front of the stalks; see :meth:`ArmTask.goals`."""
        home = HOME[: len(AXES)]
        arm = ArmKinematics(model, cls.robot())
        poses = model.forward_kinematics(State.at_rest(model).joint_q)
        stalks = poses[model.body_parent[model.bunch_body], :3]
        found = [arm.solve(home, stalk - IN_FRONT * arm.ahead(home, stalk)) for stalk in stalks]
        return np.array([home if q is None else q for q in found])

    def moves(self, action: wp.array, dt: float) -> list[KernelLaunch]:
        """See :meth:`ArmTask.moves`."""
        arrays = self.arrays
        given = [CLOSED, -FINGER_WAY, FINGER_SPEED * STEPS * dt, DEAD, len(AXES), TRIGGER, action]
        written = [arrays.targets, self._commanded, arrays.closing]
        return [*super().moves(action, dt), KernelLaunch(kernels.move_hand, given, written, threads=arrays.worlds)]

    def beginnings(self, begins: wp.array) -> list[KernelLaunch]:
        """See :meth:`ArmTask.beginnings`."""
        counted = [self._held, self._commanded]
        return [KernelLaunch(kernels.forget_counts, [begins], counted, threads=self.arrays.worlds)]

    def counts(self) -> list[KernelLaunch]:
        """See :meth:`ArmTask.counts`."""
        arrays = self.arrays
        given = [self._numbers(), arrays.worlds, arrays.arm, arrays.places, self.wanted]
        return [KernelLaunch(kernels.count_held, given, [self._held, self.failed], threads=arrays.worlds)]

    def observe(self, action: wp.array, observation: wp.array, reward: wp.array, success: wp.array) -> KernelLaunch:
        """See :meth:`ArmTask.observe`."""
        arrays = self.arrays
        given = [self._numbers(), arrays.worlds, arrays.fingers, arrays.arm, arrays.places, self.wanted]
        given += [self._held, self._commanded, action, arrays.contacts, arrays.world_contacts]
        written = [self._potential, observation, reward, success]
        return KernelLaunch(kernels.observe, given, written, threads=arrays.worlds)

    def _numbers(self) -> kernels.PickNumbers:
        numbers = kernels.PickNumbers()
        numbers.reach = REACH
        numbers.lost = LOST
        numbers.speed = SPEED
        numbers.actions = HELD
        numbers.trigger = TRIGGER
        numbers.success_reward = 10.0
        numbers.time_cost = TIME_COST
        numbers.force_cost = 0.02
        numbers.action_cost = ACTION_COST
        numbers.place = wp.vec3(*PLACE)
        numbers.distance_worth = DISTANCE_WORTH
        numbers.tilt_worth = TILT_WORTH
        numbers.grasp_worth = GRASP_WORTH
        numbers.cut_worth = CUT_WORTH
        numbers.finger = wp.vec3(*FINGER)
        numbers.gap = GAP
        numbers.open_gap = GAP + 2.0 * FINGER_WAY
        return numbers


class PickEnv(ArmEnv):
    """Pick one bunch of two, in ``num_envs`` worlds with different shoots.

    Action [9], from -1 to 1: the speeds of the targets of the seven joints, in units of 1 rad/s; whether the fingers
    close (above 0.2), open (below -0.2) or stay, at 0.15 m/s; and the blade, which closes at the end of an action if
    this component has been above 0 for five actions in a row. The hand grasps the stalk of a bunch between its fingers,
    and the blade cuts above them. The bunch then hangs from the fingers.

    Observation [34] float32: positions [rad] of the seven joints; their rates [rad/s]; how much farther apart the
    fingers are than in the middle of their way [m]; from the point between the fingers to the middle of the wanted
    bunch's stalk (the upper end of its last segment), and to the bunch's middle [m], in world axes; for how many
    actions the blade has been commanded, as a share of five; from the same point to the middle of the stalk [m], and
    the stalk's direction, in the axes of the hand; from the point to the middle of the other bunch [m], in world axes;
    the sum of the forces on the other shoot [N]; and two numbers of which that of the wanted bunch is 1. No number
    tells whether the bunch is off: such a number never changes until a policy first cuts, and a policy that had learned
    to hold a stalk still then let it go.

    Reward of an action: 10 at success, minus 0.02, minus 0.02 for each newton on the other shoot, minus 0.001 for each
    unit of squared action, plus the potential of the state after it, minus that of the state before it. The potential
    is -10 for each metre from the stalk to a place 2 cm behind the tips of the fingers and 1 cm above their middle,
    minus 2 for each unit of 1 - the cosine of the angle between the stalk and the hand's vertical axis, plus 3 times
    how far the fingers have closed (1: they touch) with the stalk between them, plus 2 times this number times how far
    the bunch is cut off (1: it is off; while it hangs, the share of the command of the blade).

    Success: the bunch has been held for 0.2 s: it is off the vine, its stalk is less than 5 cm from the point between
    the fingers, and its middle moves by less than 0.1 m/s. An episode ends at success. It fails, and ends with a reward
    lower by 2, if the wanted bunch is lost (off the vine, its stalk farther than 20 cm from that point) or the other
    one comes off. It is truncated after 150 actions (6 s).

    :class:`~vinesim.learn.arm_env.ArmEnv` describes arguments.
    """

    task_class = Pick
    world_options: ClassVar[dict[str, Any]] = {"bunches": SHOOTS, "slots": SLOTS}
