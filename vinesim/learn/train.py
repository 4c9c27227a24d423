"""Training of a policy by PPO of rsl_rl, on a batch of worlds."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import io
import json
import math
import os
import pathlib
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.core.errors import UsageError, writing
from vinesim.core.version import __version__
from vinesim.learn.evaluate import UNSEEN, environment
from vinesim.learn.policy import Policy
from vinesim.learn.variation import Variation
from vinesim.sensors.export.files import write_files
from vinesim.worlds.errors import MissingExtra

HIDDEN = (256, 128, 64)
"""Widths of the hidden layers of the policy and of the value function."""
ACTIONS = 32
"""Number of actions in each world between two updates of the policy."""
SEEDS_APART = 1_000_003
"""Difference between the seeds of the vines of two processes."""
MINI_BATCHES = 4
"""Least number of mini-batches of an update of the policy."""
MINI_BATCH = 8192
"""Largest number of actions in a mini-batch. GUESSED: with four mini-batches of 32,768 actions, 4,096 worlds would
take few steps of the optimizer for the time that their actions take. The two were not compared with equal rewards."""
LEAST_NOISE = 0.15
"""Deviation of the explored actions above which it may be limited. GUESSED: it moves a hand by less than 0.1 m/s."""
VINES = 256
"""Largest number of different groups of plants in a training."""
LIBRARIES = ("torch", "rsl-rl-lib", "warp-lang", "mujoco-warp")
"""Packages whose versions are kept with a training."""
PPO: dict[str, Any] = {
    "class_name": "PPO",
    "lam": 0.95,
    "entropy_coef": 0.002,
    "num_learning_epochs": 5,
    "clip_param": 0.2,
    # returns are far larger than 0.2, by which a clipped loss lets the value of a state change in one iteration
    "use_clipped_value_loss": False,
    "value_loss_coef": 1.0,
    "max_grad_norm": 1.0,
}
"""Configuration of rsl_rl's PPO, without discount and learning rate, which a task has, and without the number of
mini-batches. TUNED on the task reach."""
ADAPTIVE = {"learning_rate": 1e-3, "schedule": "adaptive", "desired_kl": 0.01}
"""The learning rate that rsl_rl adapts to how much each update changes the policy. TUNED on the task reach."""


@dataclasses.dataclass(frozen=True)
class Rank:
    """This process among those that ``torchrun`` starts, which train one policy together, each on a GPU of its own."""

    number: int
    """From 0 on, on all machines."""
    count: int
    """Number of processes; 1 without ``torchrun``."""
    gpu: int
    """Number of the process's GPU on its machine."""

    @staticmethod
    def of_environment() -> Rank:
        """Returns what the variables ``RANK``, ``WORLD_SIZE`` and ``LOCAL_RANK`` say."""
        number, count, gpu = (int(os.environ.get(name, "0")) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
        return Rank(number, max(count, 1), gpu)


@dataclasses.dataclass(frozen=True)
class Progress:
    """State of a training after an iteration. Its fields are the columns of ``curve.csv``."""

    iteration: int
    seconds: float
    """[s] Since the first iteration began."""
    actions: int
    """Number of actions so far, in all worlds."""
    mean_reward: float
    """Mean reward of an action of this iteration."""
    success: float
    """Share of the episodes that ended in this iteration with success; NaN if none ended."""
    faults: int
    """Number of episodes that a fault ended in this iteration."""


def require_libraries() -> None:
    """Raise :class:`~vinesim.worlds.errors.MissingExtra`, with a remedy, unless PyTorch and rsl_rl can be imported."""
    try:
        importlib.import_module("vinesim.learn.rsl")
        importlib.import_module("rsl_rl.runners")
    except ImportError as error:
        missing = error.__cause__ or error
        raise MissingExtra(f"training needs PyTorch and rsl_rl: pip install 'vinesim[train]' ({missing})") from error


def _learning_rate(fixed: float | None) -> dict[str, Any]:
    return ADAPTIVE if fixed is None else {"learning_rate": fixed, "schedule": "fixed"}


class Training:
    """A training of a task. :meth:`iterations` trains; :meth:`policy` and :meth:`save` give what was learned so far.

    Processes of ``torchrun`` train one policy with different vines. rsl_rl averages their gradients.

    Args:
        task: name of the task, one of :data:`vinesim.learn.TASKS`.
        worlds: number of worlds of this process.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``; with several processes ``"cuda"``, of which each takes its GPU.
        seed: seed of vines, wanted bunches, weights and explored actions, below
            :data:`~vinesim.learn.evaluate.UNSEEN`.
        variation: ranges of the numbers in which worlds differ, or a TOML file with them.

    Raises :class:`~vinesim.worlds.errors.MissingExtra` without PyTorch or rsl_rl, and errors of
    :class:`~vinesim.learn.arm_env.ArmEnv`.
    """

    def __init__(
        self,
        task: str,
        worlds: int,
        *,
        device: str = "cpu",
        seed: int = 1,
        variation: Variation | str | pathlib.Path = Variation(),
    ) -> None:
        require_libraries()
        import torch  # pyright: ignore[reportMissingImports]
        from rsl_rl.runners import OnPolicyRunner  # pyright: ignore[reportMissingImports]

        from vinesim.learn.rsl import RslEnv

        self.task = task
        self.rank = rank = Rank.of_environment()
        """This process."""
        if rank.count > 1:
            if device != "cuda":
                raise UsageError(f"device {device!r} with {rank.count} processes: give 'cuda', each takes its own GPU")
            device = f"cuda:{rank.gpu}"
        self.curve: list[Progress] = []
        """Progress of the worlds of this process; actions are those of all."""
        self._origin = {"task": task, "seed": seed, "worlds": worlds, "vinesim": __version__}
        torch.manual_seed(seed + rank.number)
        if device == "cpu":
            # the networks are small, and threads that wait for each other slow down the worlds: on two busy cores a
            # training took 240 actions/s with them and 2,390 without
            torch.set_num_threads(1)
        make = environment(task)
        share = make.task_class.on_way
        env = make(
            worlds,
            device=device,
            arrays="torch",
            vines_seed=(seed + rank.number * SEEDS_APART) % UNSEEN,
            vines=VINES,
            variation=variation,
            on_way=share,
        )
        env.reset(seed=seed + rank.number)
        env.step(torch.zeros(env.num_envs, env.num_actions, device=device))  # the first step compiles the kernels
        self._env = RslEnv(env)
        self._noise = env.task_class.noise
        self._calm = env.task_class.calm
        self._device = str(env.worlds.bodies.device.name)
        network = {
            "class_name": "MLPModel",
            "hidden_dims": list(HIDDEN),
            "activation": "elu",
            "obs_normalization": True,
        }
        actions = {"class_name": "GaussianDistribution", "init_std": self._noise, "std_type": "log"}
        config = {
            "num_steps_per_env": ACTIONS,
            "save_interval": 1,  # nothing is saved without a folder for logs
            "check_for_nan": False,  # a check waits for the GPU; the environment gives finite numbers only
            "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
            "actor": network | {"distribution_cfg": actions},
            "critic": network,
            "algorithm": PPO
            | {
                "gamma": env.task_class.discount,
                "num_mini_batches": max(MINI_BATCHES, -(-worlds * ACTIONS // MINI_BATCH)),
            }
            | _learning_rate(env.task_class.learning_rate),
        }
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
            self._runner = OnPolicyRunner(self._env, config, log_dir=None, device=device)

    def iterations(self, count: int) -> Iterator[Progress]:
        """Train for ``count`` iterations. Yields the state after each one."""
        begin = time.monotonic()
        for i in range(count):
            self._limit_noise(self._noise * math.exp(-i / self._calm))
            with contextlib.redirect_stdout(io.StringIO()):  # several processes print that they synchronise
                self._runner.learn(1, init_at_random_ep_len=i == 0)
            total = self._env.take_totals()
            actions = self._env.num_envs * ACTIONS
            done = Progress(
                iteration=i + 1,
                seconds=time.monotonic() - begin,
                actions=actions * (i + 1) * self.rank.count,
                mean_reward=total.reward / actions,
                success=total.success / total.ended if total.ended else float("nan"),
                faults=total.fault,
            )
            self.curve.append(done)
            yield done

    def any_process(self, is_so: bool) -> bool:
        """Returns whether ``is_so`` in any process. All processes must call this; without ``torchrun`` there is one."""
        if self.rank.count == 1:
            return is_so
        import torch  # pyright: ignore[reportMissingImports]

        flag = torch.tensor(float(is_so), device=self._env.device)
        torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MAX)
        return bool(flag.item())

    def _limit_noise(self, largest: float) -> None:
        """Limit the deviation of the explored actions to ``largest``, but not below :data:`LEAST_NOISE`."""
        self._runner.alg.get_policy().distribution.log_std_param.data.clamp_(max=math.log(max(largest, LEAST_NOISE)))

    def policy(self) -> Policy:
        """Returns what was learned so far. It takes the mean of the actions that the training would explore."""
        actor = self._runner.alg.get_policy()
        state = {
            name: value.detach().cpu().numpy().astype(np.float32) for name, value in actor.mlp.state_dict().items()
        }
        layers = sorted({int(name.split(".")[0]) for name in state})
        normalizer = actor.obs_normalizer
        return Policy(
            self.task,
            normalizer.mean.cpu().numpy(),
            normalizer.std.cpu().numpy() + np.float32(normalizer.eps),
            tuple(state[f"{layer}.weight"] for layer in layers),
            tuple(state[f"{layer}.bias"] for layer in layers),
        )

    def save(self, folder: pathlib.Path, results: dict[str, Any] | None = None) -> None:
        """Write ``policy.npz``, ``curve.csv`` and ``summary.json`` into ``folder``, which exists.

        ``results``: further fields of the summary. Raises :class:`~vinesim.core.errors.WriteError`.
        """
        self.policy().save(folder / "policy.npz")
        lines = [",".join(field.name for field in dataclasses.fields(Progress))]
        for done in self.curve:
            row = (done.iteration, f"{done.seconds:.2f}", done.actions, f"{done.mean_reward:.5f}")
            share = "" if np.isnan(done.success) else f"{done.success:.4f}"
            lines.append(",".join(map(str, (*row, share, done.faults))))
        last = self.curve[-1] if self.curve else None
        summary = self._origin | {
            "processes": self.rank.count,
            "device": self._device,
            "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
            "iterations": 0 if last is None else last.iteration,
            "seconds": 0.0 if last is None else round(last.seconds, 1),
            "actions": 0 if last is None else last.actions,
        }
        files = {
            folder / "curve.csv": "\n".join(lines) + "\n",
            folder / "summary.json": json.dumps(summary | (results or {}), indent=2) + "\n",
        }
        with writing(folder):
            write_files({path: [text.encode()] for path, text in files.items()})
