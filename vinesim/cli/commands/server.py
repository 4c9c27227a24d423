"""``vinesim server``: its options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Insecure, RealTimeFactor, StatusFormat


def server(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            help="Where to listen, several times if need be; port 0 takes a free one. tcp/127.0.0.1:7377 for "
            "everything and udp/127.0.0.1:7377 for poses, this machine alone, unless given; with --tls tls/ and quic/ "
            "on all interfaces."
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            help="Work as a router only, for the server at this endpoint, which admits actors and keeps the state."
        ),
    ] = None,
    state_dir: Annotated[
        pathlib.Path | None,
        typer.Option(
            help="Folder in which picked bunches, boxes and cuts are stored; by default they are in memory only."
        ),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="Admit this scene only; by default the scene of the first actor.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of that scene, instead of its own.")] = None,
    max_clients: Annotated[
        int | None, typer.Option(min=1, help="Largest number of actors at a time; by default unlimited.")
    ] = None,
    max_clients_per_address: Annotated[
        int, typer.Option(min=1, help="Largest number of actors of one address; this machine itself has no such limit.")
    ] = 256,
    max_sessions: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Largest number of network sessions; a client on another machine has two. By default 100 and two for "
            "each of --max-clients, or 4096.",
        ),
    ] = None,
    quota: Annotated[
        tuple[float, float],
        typer.Option(help="MESSAGES/s and BYTES/s of retained records (cuts, resting objects) for each actor."),
    ] = (200.0, 200_000.0),
    spectators_speak_to: Annotated[
        str, typer.Option(help="Who hears spectators: nobody, people (and no robots) or all.")
    ] = "people",
    tls: Annotated[
        pathlib.Path | None,
        typer.Option(help="Folder of certificates (vinesim certs new); actors without one are refused."),
    ] = None,
    insecure: Insecure = False,
    real_time_factor: RealTimeFactor = None,
    status: StatusFormat = "none",
) -> None:
    """Route messages between clients, and keep the retained state. The server simulates nothing.

    Without --state-dir the state is in memory only: each start begins with an unpicked vineyard.

    \b
    Examples:
      vinesim server
      vinesim server --listen tcp/127.0.0.1:0 --status text
      vinesim server --scene vsp --max-clients 12 --state-dir harvest/
      vinesim server --real-time-factor 0.2
      vinesim server --tls certs/
      vinesim server --insecure
      vinesim server --connect tcp/192.168.1.5:7377
    """
    options = dict(locals())
    from vinesim.cli.server import run

    raise typer.Exit(run(**options))
