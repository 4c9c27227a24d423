"""``vinesim demo``: its options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Device, RealTimeFactor, Seed


def demo(
    job: Annotated[
        str,
        typer.Option(
            help="push: on and on. pick: a bunch into a box. exchange: a full box for an empty one. meet: a person "
            "picks into a box that a robot holds."
        ),
    ] = "push",
    seconds: Annotated[
        float | None, typer.Option(min=6.0, help="How long the robots push, 20; or how long a job may take, 120 [s].")
    ] = None,
    seed: Seed = None,
    scene: Annotated[
        str | None, typer.Option(help="A scene file, or the name of one that ships; demo, or harvest for the jobs.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="A URDF file, or the name of one that ships; vinebot, or logistic to exchange.")
    ] = None,
    device: Device = "cpu",
    real_time_factor: RealTimeFactor = None,
    headless: Annotated[bool, typer.Option(help="No live table; one line a second.")] = False,
    out: Annotated[pathlib.Path, typer.Option(help="Folder for pictures, plot and summary.json.")] = pathlib.Path(
        "out"
    ),
) -> None:
    """A robot pushes a bunch, another client sees it move, ROS topics carry it; or a robot does a job.

    Starts a server, two robot clients (one for a job) and a plain rclpy subscriber, each a process of its own, on free
    ports. The seconds of a push begin when server, clients, sensors and subscriber are all ready. summary.json holds
    the measurements; of a job whether it was done ("picked", "exchanged", "handed_over") and if not, why.
    To meet, a carrier brings a box to a person of another client, who picks a bunch and lays it in.

    \b
    Examples:
      vinesim demo
      vinesim demo --seconds 30 --seed 3 --out /tmp/run
      vinesim demo --scene my-block.toml --robot my-robot.urdf --headless
      vinesim demo --real-time-factor 0.5
      vinesim demo --job pick --seed 5
      vinesim demo --job exchange
      vinesim demo --job meet
    """
    if job == "push":
        from vinesim.cli.demo.push_demo import run_push

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

        code = run_job(
            job,
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
