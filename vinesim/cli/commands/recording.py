"""``vinesim record`` and ``vinesim replay``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Insecure, Pose, Seconds, Seed, World


def record(
    file: Annotated[pathlib.Path, typer.Argument(help="The MCAP file to write; if there is one, FILE-2 and so on.")],
    connect: Annotated[str, typer.Option(help="Server.")] = "tcp/127.0.0.1:7447",
    world: World = "vineyard",
    tls: Annotated[
        pathlib.Path | None, typer.Option(help="Folder with ca.pem, NAME.pem and NAME.key, of a spectator; see --name.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name on its certificate; observers are NAME-1 and so on.")] = None,
    scene: Annotated[str | None, typer.Option(help="Refuse to record any other scene; any scene unless given.")] = None,
    seed: Seed = None,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Subscribe to all of this area, X0 Y0 X1 Y1 [m], also to what no actor is near."),
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="Of poses,trees,things,events,facts,forces; all unless given.")
    ] = None,
    seconds: Seconds = None,
) -> None:
    """Record the messages of a world as MCAP. Unless an area is given, nothing more is sent because of it.

    \b
    Examples:
      vinesim record run.mcap
      vinesim record run.mcap --connect tcp/192.168.1.5:7447 --seconds 60
      vinesim record run.mcap --area -5 -5 5 5 --only poses,trees
    """
    options = dict(locals())
    from vinesim.cli.record import run

    raise typer.Exit(run(**options))


def replay(
    file: Annotated[pathlib.Path, typer.Argument(help="A file that vinesim record wrote, whole or cut off.")],
    connect: Annotated[str | None, typer.Option(help="Publish it to this server.")] = None,
    listen: Annotated[str | None, typer.Option(help="Be a server, and start when the first client is there.")] = None,
    insecure: Insecure = False,
    world: World = "vineyard",
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Times as fast as it was.")] = 1.0,
    start: Annotated[float, typer.Option("--from", min=0.0, help="Seconds after its beginning to start at.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Seconds after its beginning to stop at.")] = None,
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Render it: folder for a picture a second, without any server.")
    ] = None,
    page: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Show it in a browser, with a timeline: port on this machine, 0: any."),
    ] = None,
    ros: Annotated[bool, typer.Option("--ros", help="Publish it as ROS 2 topics, without any server.")] = False,
    pose: Annotated[
        Pose | None,
        typer.Option(help="With --out and --page: look from X Y [m] along YAW [rad]; unless given, follow a robot."),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="With --out, --page and --ros: its scene file, if it is none that ships.")
    ] = None,
    seed: Seed = None,
) -> None:
    """Play a recording again: to a server's clients, in a browser, as pictures, or as ROS topics.

    \b
    Examples:
      vinesim replay run.mcap --page 8080
      vinesim replay run.mcap --out pictures
      vinesim replay run.mcap --ros
      vinesim replay run.mcap --connect tcp/127.0.0.1:7447 --from 20 --to 40
      vinesim replay run.mcap --listen tcp/127.0.0.1:7447 --speed 0.5
    """
    options = dict(locals())
    from vinesim.cli.replay import run

    raise typer.Exit(run(**options))
