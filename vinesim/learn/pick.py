"""Task *pick*: grasp a bunch by its stalk, cut it off above the fingers, and hold it."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import pick as kernels
from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn.arm import AXES, CLOSED, FINGER_WAY, harvest_arm, harvest_blade
from vinesim.learn.arm_env import BASE, DISTANCE, HOME, ArmEnv
from vinesim.learn.shoots import shoots
from vinesim.learn.task_env import STEPS

SHOOTS = 2
"""Number of shoots of a world; each has one bunch."""
SLOTS = 32
"""Contacts that the plants of a world can have at once: fingers around a stalk have up to 16, the bunch more."""
MAX_EPISODE_STEPS = 150
FINGER_SPEED = 0.15
"""[m/s] Speed of the targets of the fingers. GUESSED."""
REACH = 0.05
"""[m] Distance of the stalk from the point between the fingers up to which the bunch is in the hand. GUESSED: the
fingers are 8 cm long."""
LOST = 0.2
"""[m] Distance of the stalk from which on a bunch that came off is lost. GUESSED."""
SPEED = 0.1
"""[m/s] Speed below which the bunch is held, not falling or swinging. GUESSED."""
HELD = 5
"""Number of actions, 0.2 s, for which the bunch must be held."""


class PickEnv(ArmEnv):
    """Pick one bunch of two, in ``num_envs`` worlds with different shoots.

    Action [9], from -1 to 1: the speeds of the targets of the seven joints, in units of 1 rad/s; where the fingers
    go, from open (-1) to closed (1), at 0.15 m/s; and the blade, which closes at the end of the action if this
    component is above 0. The hand grasps the stalk of a bunch between its fingers, and the blade cuts above them. The
    bunch then hangs from the fingers.

    Observation [28] float32: positions [rad] of the seven joints; their rates [rad/s]; how much farther apart the
    fingers are than in the middle of their way [m]; from the point between the fingers to the middle of the wanted
    bunch's stalk (the upper end of its last segment), and to the bunch's middle [m], in world axes; 1 while the bunch
    hangs, else 0; from the same point to the middle of the other bunch [m]; the sum of the forces on the other shoot
    [N]; and two numbers of which that of the wanted bunch is 1.

    Reward of an action: 2 for the action with which the wanted bunch comes off, 10 at success, minus the distance of
    its stalk from the point between the fingers [m], minus 0.02 for each newton on the other shoot, minus 0.01 for each
    unit of squared action. Success: the bunch has been held for 0.2 s: it is off the vine, its stalk is less than 5 cm
    from the point between the fingers, and its middle moves by less than 0.1 m/s. An episode ends at success. It ends
    with a reward lower by 2 if the wanted bunch is lost (off the vine, its stalk farther than 20 cm from that point)
    or the other one comes off. It is truncated after 150 actions (6 s).

    ``options``: arguments of :class:`~vinesim.learn.arm_env.ArmEnv`.
    """

    def __init__(self, num_envs: int = 1, *, max_episode_steps: int = MAX_EPISODE_STEPS, **options: Any) -> None:
        device = options.get("device", "cpu")
        self._target, self._held, self._since = (
            wp.zeros(max(num_envs, 1), dtype=wp.int32, device=device) for _ in range(3)
        )
        super().__init__(
            lambda rng, variation: shoots(SHOOTS, rng, DISTANCE, variation),
            2 * len(AXES) + 8 + 3 * (SHOOTS - 1) + 1 + SHOOTS,
            num_envs,
            robot=harvest_arm(BASE, HOME),
            actions=len(AXES) + 2,
            blade=harvest_blade(),
            bunches=SHOOTS,
            slots=SLOTS,
            max_episode_steps=max_episode_steps,
            **options,
        )

    def _moves(self) -> list[KernelLaunch]:
        pool = self.worlds.pool
        assert pool is not None, "the arm has a blade"
        given = [CLOSED, -FINGER_WAY, FINGER_SPEED * STEPS * self.worlds.dt, len(AXES), self._action]
        written = [self.worlds.bodies.targets, pool.closing]
        return [*super()._moves(), KernelLaunch(kernels.move_hand, given, written, threads=self.num_envs)]

    def _beginnings(self) -> list[KernelLaunch]:
        drawn = [self._episode, self._target]
        counted = [self._held, self._since]
        return [
            KernelLaunch(draw_targets, [SHOOTS, self._seed, self._begins], drawn, threads=self.num_envs),
            KernelLaunch(kernels.forget_held, [self._begins], counted, threads=self.num_envs),
        ]

    def _judgements(self, results: Any) -> list[KernelLaunch]:
        given = [self._numbers(), self.num_envs, self.arm_arrays.arm, self._places(), self._target]
        count = KernelLaunch(kernels.count_held, given, [self._held, self._since, self._failed], threads=self.num_envs)
        return [count, *super()._judgements(results)]

    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        fingers = self.worlds.bodies.rigid.robot("arm").q[len(AXES) :]
        given = [
            self._numbers(),
            self.num_envs,
            self.on_device(fingers, wp.int32),
            self.arm_arrays.arm,
            self._places(),
            self._target,
            self._held,
            self._since,
            self._given_action,
            self.arm_arrays.contacts,
            self.arm_arrays.world_contacts,
        ]
        return [KernelLaunch(kernels.observe, given, [observation, reward, success], threads=self.num_envs)]

    def _numbers(self) -> kernels.PickNumbers:
        numbers = kernels.PickNumbers()
        numbers.reach = REACH
        numbers.lost = LOST
        numbers.speed = SPEED
        numbers.actions = HELD
        numbers.cut_reward = 2.0
        numbers.success_reward = 10.0
        numbers.distance_cost = 1.0
        numbers.force_cost = 0.02
        numbers.action_cost = 0.01
        return numbers

    def _places(self) -> kernels.BunchPlaces:
        worlds = self.worlds
        pool = worlds.pool
        assert pool is not None, "the arm has a blade"
        model = worlds.model
        segment = model.body_parent[model.bunch_body]
        places = kernels.BunchPlaces()
        places.body, places.com, places.body_q = self.arm_arrays.bunches
        places.segment = self.on_device(worlds.plants.buffers.slots[segment], wp.int32)
        places.length = self.on_device(model.body_length[segment].astype(np.float32), float)
        places.slots = pool.bunch
        places.free_body = pool.table.body
        places.free_v = pool.table.v
        data = worlds.bodies.data
        places.xpos = data.xpos
        places.xmat = data.xmat
        places.qvel = data.qvel
        return places
