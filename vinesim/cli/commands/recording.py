"""``vinesim record`` and ``vinesim replay``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Insecure, Pose, Seconds, Seed, World


def record(
    file: Annotated[
        pathlib.Path, typer.Argument(help="The MCAP file to write; an existing file is kept, and FILE-2 is written.")
    ],
    connect: Annotated[str, typer.Option(help="Server.")] = "tcp/127.0.0.1:7377",
    world: World = "vineyard",
    tls: Annotated[
        pathlib.Path | None, typer.Option(help="Folder with ca.pem, NAME.pem and NAME.key of a spectator; see --name.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name on the certificate; the recorder's observers are NAME-1 and so on.")
    ] = None,
    scene: Annotated[str | None, typer.Option(help="Record this scene only; by default any scene.")] = None,
    seed: Seed = None,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="Subscribe to everything in this area, X0 Y0 X1 Y1 [m], also to objects without an actor nearby."
        ),
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="Kinds to record, from poses,trees,things,events,facts,forces; by default all.")
    ] = None,
    seconds: Seconds = None,
) -> None:
    """Record the messages of a world as MCAP. Without --area, recording causes no additional messages.

    \b
    Examples:
      vinesim record run.mcap
      vinesim record run.mcap --connect tcp/192.168.1.5:7377 --seconds 60
      vinesim record run.mcap --area -5 -5 5 5 --only poses,trees
    """
    options = dict(locals())
    from vinesim.cli.record import run

    raise typer.Exit(run(**options))


def replay(
    file: Annotated[pathlib.Path, typer.Argument(help="A file that vinesim record wrote, complete or truncated.")],
    connect: Annotated[str | None, typer.Option(help="Play to the clients of this server.")] = None,
    listen: Annotated[
        str | None, typer.Option(help="Act as a server, and start when the first client has joined.")
    ] = None,
    insecure: Insecure = False,
    world: World = "vineyard",
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed as a multiple of real time.")] = 1.0,
    start: Annotated[float, typer.Option("--from", min=0.0, help="Start at this time of the recording [s].")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Stop at this time of the recording [s].")] = None,
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Render one picture a second into this folder, without a server.")
    ] = None,
    page: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Show the recording in a browser, with a timeline, on this port; 0: any free port."
        ),
    ] = None,
    ros: Annotated[
        bool, typer.Option("--ros", help="Publish the recording as ROS 2 topics, without a server.")
    ] = False,
    pose: Annotated[
        Pose | None,
        typer.Option(help="With --out and --page: look from X Y [m] along YAW [rad]; by default follow a robot."),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            help="With --out, --page and --ros: scene file of the recording, if its scene is not a shipped one."
        ),
    ] = None,
    seed: Seed = None,
) -> None:
    """Play a recording again: to a server's clients, in a browser, as pictures, or as ROS topics.

    \b
    Examples:
      vinesim replay run.mcap --page 8080
      vinesim replay run.mcap --out pictures
      vinesim replay run.mcap --ros
      vinesim replay run.mcap --connect tcp/127.0.0.1:7377 --from 20 --to 40
      vinesim replay run.mcap --listen tcp/127.0.0.1:7377 --speed 0.5
    """
    options = dict(locals())
    from vinesim.cli.replay import run

    raise typer.Exit(run(**options))
