"""``vinesim train``: its options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Device
from vinesim.core.errors import UsageError


def train(
    task: Annotated[str, typer.Argument(help="reach, expose, pick or prune.")],
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Folder for policy.npz, curve.csv and summary.json of a training.")
    ] = None,
    evaluate: Annotated[
        pathlib.Path | None,
        typer.Option(
            help="Do not train: evaluate this policy.npz on vines never seen; or reach, expose, pick or prune, which "
            "ship with vinesim."
        ),
    ] = None,
    worlds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of worlds; by default 4096 for a training, 500 for --evaluate, 100 with --full-physics.",
        ),
    ] = None,
    device: Device = "cpu",
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of vines, tasks and weights.")] = 1,
    iterations: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of updates of the policy, by default 300; each follows 32 actions in each world."
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="End the training after this time, even before --iterations [min].")
    ] = None,
    variation: Annotated[
        pathlib.Path | None, typer.Option(help="TOML file: ranges in which worlds differ (docs/worlds.md).")
    ] = None,
    full_physics: Annotated[
        bool,
        typer.Option(
            "--full-physics",
            help="With --evaluate: one world after the other with the physics of a client, without batch.",
        ),
    ] = False,
) -> None:
    """Train a policy for a task by PPO on many worlds at once, then evaluate it on vines never seen.

    A training needs PyTorch and rsl_rl (extra: train); an NVIDIA GPU lets it have thousands of worlds. Its files are
    brought up to date every 10 s; Ctrl-C ends it and keeps what was learned. An evaluation takes one episode in each of
    500 worlds with different vines, and needs no PyTorch (extra: learn).

    \b
    Examples:
      vinesim train reach --out run --device cuda
      vinesim train reach --out run --device cuda --worlds 8192 --minutes 5 --variation ranges.toml
      vinesim train reach --evaluate run/policy.npz --worlds 500
      vinesim train reach --evaluate run/policy.npz --full-physics
      vinesim train pick --evaluate pick
    """
    from vinesim.cli.train import TRAINING_ITERATIONS, run_evaluation, run_training

    if evaluate is not None:
        for option, value in (("--iterations", iterations), ("--minutes", minutes)):
            if value is not None:
                raise UsageError(f"{option} {value} with --evaluate {evaluate}: nothing is trained; omit {option}")
        raise typer.Exit(
            run_evaluation(
                task, evaluate, out, worlds, device=device, seed=seed, variation=variation, full=full_physics
            )
        )
    raise typer.Exit(
        run_training(
            task,
            out,
            worlds,
            device=device,
            seed=seed,
            iterations=iterations or TRAINING_ITERATIONS,
            minutes=minutes,
            variation=variation,
            full=full_physics,
        )
    )
