"""``vinesim demo``: its options."""

from __future__ import annotations

import contextlib
import pathlib
import sys
from collections.abc import Iterator
from typing import Annotated

import typer

from vinesim.cli.commands.options import Device, RealTimeFactor, Seed


def demo(
    job: Annotated[
        str,
        typer.Option(
            help="push: push a bunch again and again. pick: put a bunch into a box. exchange: a full box for an "
            "empty one. meet: a person picks into a box that a robot holds. prune: cut the canes of a dormant vine."
        ),
    ] = "push",
    seconds: Annotated[
        float | None,
        typer.Option(
            min=6.0,
            help="Time that the robots push [s], by default 20; or time limit of a task, by default 120, and more for "
            "more than one bunch.",
        ),
    ] = None,
    bunches: Annotated[
        int,
        typer.Option(min=0, help="pick: number of bunches for one crate; 0: until it is full or none is left."),
    ] = 1,
    order: Annotated[
        str, typer.Option(help="pick: freest, the bunch with most room for the hand first, or nearest.")
    ] = "freest",
    see: Annotated[
        bool,
        typer.Option(
            "--see", help="pick, prune: find bunches, canes by the robot's own camera, not by the simulation."
        ),
    ] = False,
    seed: Seed = None,
    scene: Annotated[
        str | None,
        typer.Option(
            help="A scene file, or a shipped scene by name; by default demo, for tasks harvest, to prune winter_spur."
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(help="A robot file, or the name of a shipped robot; by default vinebot, or logistic to exchange."),
    ] = None,
    device: Device = "cpu",
    real_time_factor: RealTimeFactor = None,
    headless: Annotated[bool, typer.Option(help="No live table; one line a second.")] = False,
    out: Annotated[pathlib.Path, typer.Option(help="Folder for pictures, plot and summary.json.")] = pathlib.Path(
        "out"
    ),
) -> None:
    """Let a robot push a bunch, show its motion on another client and in ROS topics; or let a robot do a task.

    Starts a server, two robot clients (one for a task) and a plain rclpy subscriber, each in its own process, on free
    ports. The seconds of a push begin when server, clients, sensors and subscriber are all ready. summary.json holds
    the measurements; for a task also whether it was done ("picked", "exchanged", "handed_over", "pruned"), if not, why.
    In the task meet, a carrier brings a box to a person of another client, who picks a bunch and lays it into the box.

    \b
    Examples:
      vinesim demo
      vinesim demo --seconds 30 --seed 3 --out run
      vinesim demo --scene my-block.toml --robot my-robot.urdf --headless
      vinesim demo --real-time-factor 0.5
      vinesim demo --job pick --seed 5
      vinesim demo --job pick --bunches 0 --order nearest
      vinesim demo --job pick --see
      vinesim demo --job exchange
      vinesim demo --job meet
      vinesim demo --job prune
      vinesim demo --job prune --see
    """
    with _without_summary():
        if job == "push":
            from vinesim.cli.demo.push_demo import run_push
            from vinesim.client.tasks.registry import validate_sight

            validate_sight(job, see)
            code = run_push(
                seconds=seconds or 20.0,
                seed=seed,
                scene=scene or "demo",
                robot=robot or "vinebot",
                device=device,
                real_time_factor=real_time_factor,
                headless=headless,
                out=out,
            )
        else:
            from vinesim.cli.demo.task_demo import run_job
            from vinesim.client.tasks.harvesting import HarvestOptions

            code = run_job(
                job,
                harvest=HarvestOptions.named(bunches, order),
                see=see,
                seconds=seconds,
                seed=seed,
                scene=scene,
                robot=robot,
                device=device,
                real_time_factor=real_time_factor,
                headless=headless,
                out=out,
            )
        raise typer.Exit(code)


@contextlib.contextmanager
def _without_summary() -> Iterator[None]:
    """Tell why there is no summary if Ctrl-C comes while programs still start, and the demo has nothing to sum up."""
    try:
        yield
    except KeyboardInterrupt:
        print("vinesim: stopped before there was a result, so summary.json was not written", file=sys.stderr)
        raise
