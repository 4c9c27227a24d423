"""Evaluation of a policy on vines that no training has seen."""

from __future__ import annotations

import dataclasses
import importlib
import pathlib
from collections.abc import Callable

import numpy as np
import warp as wp
from gymnasium.utils.seeding import np_random

from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn import TASKS
from vinesim.learn.arm import AXES, arm
from vinesim.learn.arm_env import BASE, HOME, MAX_EPISODE_STEPS, ArmEnv
from vinesim.learn.pilot import ReachPilot
from vinesim.learn.policy import Policy, PolicyError
from vinesim.learn.reach import NUMBERS, SHOOTS, plants
from vinesim.learn.task_env import STEPS
from vinesim.learn.variation import Variation, as_variation
from vinesim.scene.model import Model
from vinesim.world import Physics

UNSEEN = 2**31
"""Seed of vines from which on they are for evaluations. Those of trainings have smaller seeds."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """How one episode in each of several worlds ended."""

    task: str
    worlds: int
    successes: int
    faults: int
    """Number of episodes that a fault ended; they count as failures."""
    actions: float
    """Mean number of actions of the episodes with success; 0 if there were none."""

    def fields(self) -> dict[str, float]:
        """Returns the numbers, and the share of episodes with success, for a file."""
        numbers = {key: value for key, value in dataclasses.asdict(self).items() if key != "task"}
        return numbers | {"share": self.successes / self.worlds}

    def line(self) -> str:
        """Returns the result as one line of text."""
        return f"{TASKS[self.task]} {self.successes} of {self.worlds} ({100.0 * self.successes / self.worlds:.1f} %)"


def environment(task: str) -> Callable[..., ArmEnv]:
    """Returns the class of a task of :data:`vinesim.learn.TASKS`. Raises :class:`ValueError` for another name."""
    if task not in TASKS:
        raise ValueError(f"task {task!r}: give one of {', '.join(TASKS)}")
    return getattr(importlib.import_module(f"vinesim.learn.{task}"), f"{task.capitalize()}Env")


def evaluate(
    policy: Policy,
    worlds: int = 500,
    *,
    seed: int = 1,
    device: str = "cpu",
    variation: Variation | str | pathlib.Path = Variation(),
) -> Evaluation:
    """Returns how a policy does in one episode in each of ``worlds``, all with different vines.

    ``seed``: seed of vines and of wanted bunches. Raises :class:`~vinesim.learn.policy.PolicyError` for a policy of an
    unknown task or with other numbers than its task has.
    """
    if policy.task not in TASKS:
        raise PolicyError(f"the policy is for task {policy.task!r}, which is none of {', '.join(TASKS)}")
    env = environment(policy.task)(
        worlds, device=device, vines_seed=UNSEEN + seed, vines=worlds, variation=variation
    )  # fmt: skip
    policy.check_numbers(env.num_observations, env.num_actions)
    observation, _ = env.reset(seed=seed)
    going = np.ones(worlds, bool)
    success = np.zeros(worlds, bool)
    faults = actions = 0
    for k in range(env.max_episode_steps):
        observation, _, terminated, truncated, info = env.step(policy(observation))
        new = going & info["success"]
        success |= new
        actions += int(new.sum()) * (k + 1)
        faults += int((going & (info["fault"] != 0)).sum())
        going &= ~(terminated | truncated)
        if not going.any():
            break
    env.close()
    successes = int(success.sum())
    return Evaluation(policy.task, worlds, successes, faults, actions / max(successes, 1))


def evaluate_with_full_physics(
    policy: Policy, worlds: int = 100, *, seed: int = 1, variation: Variation | str | pathlib.Path = Variation()
) -> Evaluation:
    """Returns how a policy for *reach* does with the physics of a client, one world after the other.

    Vines and wanted bunches are those of the first ``worlds`` worlds of :func:`evaluate` with the same ``seed``. Here
    plants touch each other, break and sleep. A fault is a robot or a tree that was stopped. Raises
    :class:`~vinesim.learn.policy.PolicyError` as :func:`evaluate` does, and :class:`ValueError` for another task, and
    for a variation of friction or delay, which only batches have.
    """
    ranges = as_variation(variation)
    if policy.task != "reach":
        raise ValueError(f"full physics with task {policy.task}: there is only reach")
    if ranges.friction != (1.0, 1.0) or ranges.delay != (0, 0):
        raise ValueError("full physics with a variation of friction or delay: only batches have it; leave both out")
    policy.check_numbers(NUMBERS, len(AXES))
    successes = faults = actions = 0
    for number, wanted in enumerate(wanted_bunches(worlds, seed)):
        physics = Physics(unseen_plants(number, seed, ranges))
        physics.add_robot(arm(BASE, HOME))
        pilot = ReachPilot(physics, policy, int(wanted))
        for k in range(MAX_EPISODE_STEPS):
            physics.rigid.command("arm", pilot.act())
            for _ in range(STEPS):
                physics.step()
            pilot.look()
            if physics.faults["robots_stopped"] or physics.faults["trees_stopped"]:
                faults += 1
                break
            if pilot.has_reached:
                successes += 1
                actions += k + 1
                break
    return Evaluation(policy.task, worlds, successes, faults, actions / max(successes, 1))


def unseen_plants(number: int, seed: int, variation: Variation = Variation()) -> Model:
    """Returns the shoots of world ``number`` of :func:`evaluate`, for the task reach."""
    return plants(np.random.default_rng([UNSEEN + seed, number]), variation)


def wanted_bunches(worlds: int, seed: int) -> np.ndarray:
    """Returns the numbers [world] of the bunches that a batch of :class:`~vinesim.learn.reach.ReachEnv` wants in its
    first episodes after ``reset(seed=seed)``."""
    rng, _ = np_random(seed)
    begins = wp.full(worlds, True, dtype=wp.bool, device="cpu")
    drawn = wp.array([rng.integers(2**31)], dtype=wp.int32, device="cpu")
    episode, wanted = (wp.zeros(worlds, dtype=wp.int32, device="cpu") for _ in range(2))
    wp.launch(draw_targets, worlds, [SHOOTS, drawn, begins], [episode, wanted], device="cpu")
    return wanted.numpy()
