"""Evaluation of a policy on vines that no training has seen."""

from __future__ import annotations

import dataclasses
import importlib
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from gymnasium.utils.seeding import np_random

from vinesim.core.errors import UsageError
from vinesim.kernels.learn.episodes import draw_targets
from vinesim.learn import TASKS
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_task import ArmTask
from vinesim.learn.pilot import Pilot
from vinesim.learn.policy import Policy, PolicyError
from vinesim.learn.variation import Variation, as_variation
from vinesim.scene.model import Model
from vinesim.world import Physics

DEFAULT_SEED = 1
"""Seed of an evaluation unless another one is given."""
UNSEEN = 2**31
"""Smallest seed of vines for evaluations. Trainings use smaller seeds."""


Report = Callable[[str], object]
"""Function that is called with a line of text about the progress. An exception that it raises ends the evaluation."""


def _no_report(_: str) -> None:
    """Report nothing."""


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
    seed: int = DEFAULT_SEED,
    device: str = "cpu",
    variation: Variation | str | pathlib.Path = Variation(),
    report: Report = _no_report,
) -> Evaluation:
    """Returns how a policy does in one episode in each of ``worlds``, all with different vines.

    ``seed``: seed of vines and of wanted bunches. ``report``: see :data:`Report`. Raises
    :class:`~vinesim.learn.policy.PolicyError` for a policy of an unknown task or with other numbers than its task has.
    """
    task = task_of(policy)
    policy.check_numbers(task.numbers, task.actions)
    env = environment(policy.task)(
        worlds, device=device, vines_seed=UNSEEN + seed, vines=worlds, variation=variation
    )  # fmt: skip
    observation, _ = env.reset(seed=seed)
    going = np.ones(worlds, bool)
    success = np.zeros(worlds, bool)
    faults = actions = 0
    for k in range(env.max_episode_steps):
        report(f"action {k + 1} of {env.max_episode_steps}, {int(success.sum())} of {worlds} {TASKS[policy.task]}")
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
    policy: Policy,
    worlds: int = 100,
    *,
    seed: int = DEFAULT_SEED,
    variation: Variation | str | pathlib.Path = Variation(),
    report: Report = _no_report,
) -> Evaluation:
    """Returns how a policy does with the physics of a client, one world after the other.

    Vines and wanted bunches are those of the first ``worlds`` worlds of :func:`evaluate` with the same ``seed``. Here
    plants touch each other, break and sleep. A fault is a robot or a tree that was stopped. ``report``: see
    :data:`Report`. Raises
    :class:`~vinesim.learn.policy.PolicyError` as :func:`evaluate` does, and :class:`ValueError` for a variation of
    friction or delay, which only batches have.
    """
    ranges = as_variation(variation)
    task = task_of(policy)
    if ranges.friction != (1.0, 1.0) or ranges.delay != (0, 0):
        raise UsageError("full physics with a variation of friction or delay: only batches have it; leave both out")
    policy.check_numbers(task.numbers, task.actions)
    if worlds < 1:
        raise UsageError(f"worlds {worlds}: give at least 1")
    successes = faults = actions = 0
    for number, wanted in enumerate(wanted_bunches(task, worlds, seed)):
        report(f"world {number + 1} of {worlds}, {successes} {TASKS[policy.task]}")
        physics = task_physics(task, unseen_plants(task, number, seed, ranges))
        pilot = Pilot(physics, policy, task, int(wanted))
        for targets in pilot.targets():
            physics.rigid.command("arm", targets)
            physics.step()
            if physics.faults["robots_stopped"] or physics.faults["trees_stopped"]:
                faults += 1
                break
        else:
            successes += pilot.succeeded
            actions += pilot.actions if pilot.succeeded else 0
    return Evaluation(policy.task, worlds, successes, faults, actions / max(successes, 1))


def task_of(policy: Policy) -> type[ArmTask]:
    """Returns the task of a policy. Raises :class:`~vinesim.learn.policy.PolicyError` for an unknown one."""
    if policy.task not in TASKS:
        raise PolicyError(f"the policy is for task {policy.task!r}, which is none of {', '.join(TASKS)}")
    return environment(policy.task).task_class


def task_physics(task: type[ArmTask], plants: Model, **options: Any) -> Physics:
    """Returns a client's physics with the robot of a task. ``options``: arguments of
    :class:`~vinesim.world.Physics`."""
    options.setdefault("parameters", task.parameters)
    physics = Physics(plants, **options)
    physics.add_robot(task.robot())
    blade = task.blade()
    if blade is not None:
        physics.add_blade(blade.actor, blade.link, blade.pose, blade.half, force=blade.limit, speed=blade.speed)
    return physics


def unseen_plants(task: type[ArmTask], number: int, seed: int, variation: Variation = Variation()) -> Model:
    """Returns the plants of world ``number`` of :func:`evaluate`."""
    return task.plants(np.random.default_rng([UNSEEN + seed, number]), variation)


def wanted_bunches(task: type[ArmTask], worlds: int, seed: int) -> np.ndarray:
    """Returns the numbers [world] of the trees whose bunches a batch of the task wants in its first episodes after
    ``reset(seed=seed)``."""
    rng, _ = np_random(seed)
    begins = wp.full(worlds, True, dtype=wp.bool, device="cpu")
    drawn = wp.array([rng.integers(2**31)], dtype=wp.int32, device="cpu")
    episode, wanted = (wp.zeros(worlds, dtype=wp.int32, device="cpu") for _ in range(2))
    wp.launch(draw_targets, worlds, [task.choices, drawn, begins], [episode, wanted], device="cpu")
    return wanted.numpy()
