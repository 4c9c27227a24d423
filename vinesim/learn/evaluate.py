"""Evaluation of a policy on vines that no training has seen."""

from __future__ import annotations

import dataclasses
import importlib
import pathlib

import numpy as np

from vinesim.learn import TASKS
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.policy import Policy, PolicyError
from vinesim.learn.variation import Variation

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


def environment(task: str) -> type[ArmEnv]:
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
    check_numbers(policy, env)
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


def check_numbers(policy: Policy, env: ArmEnv) -> None:
    """Raise :class:`~vinesim.learn.policy.PolicyError` unless a policy has as many inputs and outputs as a task."""
    numbers = env.single_observation_space.shape or ()
    if (policy.inputs,) != numbers or policy.outputs != env.num_actions:
        raise PolicyError(
            f"the policy maps {policy.inputs} numbers to {policy.outputs}, task {policy.task} has {numbers[0]} and "
            f"{env.num_actions}; train it again"
        )
