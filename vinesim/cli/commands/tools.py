"""``vinesim bench``, ``vinesim doctor``, ``vinesim ros`` and ``vinesim certs``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer


def bench(
    names: Annotated[
        list[str], typer.Argument(help="Benchmarks to run one after the other, such as plants, camera, live.")
    ],
    json: Annotated[bool, typer.Option("--json", help="One JSON object a line, nothing else on stdout.")] = False,
    row: Annotated[
        list[str] | None,
        typer.Option(help="Row of live: demo, camera, lidar, tendone, start, generate, tick, cold; may be repeated."),
    ] = None,
) -> None:
    """Measure vinesim on this machine, compared with a peer in the same process on the same scene.

    Physics: plants, contact, tick (whole steps of a client). Sensors: camera, lidar. Time until a user can begin:
    start. Whole programs: live (demo, clients and commands as users start them, with budgets). ROS: ros (topics of
    every step in another process, one subscriber stopped; actions; resets). Fits: tune (recovery over 50 seeds,
    MuJoCo as the truth, compared with scipy, CMA-ES and Stein particles; needs scipy and cma).

    \b
    Examples:
      vinesim bench plants --json
      vinesim bench plants camera
      vinesim bench live --json
      vinesim bench live --row demo --row camera
      vinesim bench ros --json
    """
    from vinesim.cli.bench import run

    raise typer.Exit(run(names, json, row or ()))


def notebooks(
    names: Annotated[list[str] | None, typer.Argument(help="Notebooks to copy; by default all.")] = None,
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Folder to copy them into; without it, they are listed.")
    ] = None,
) -> None:
    """List the notebooks that ship with vinesim, or copy them into a folder for Jupyter.

    They contain their results. Jupyter is not part of vinesim; to run them, also install jupyterlab. Existing files
    are kept.

    \b
    Examples:
      vinesim notebooks
      vinesim notebooks --out my-notebooks
      vinesim notebooks tune_a_cane tune_a_swing --out my-notebooks
    """
    from vinesim.cli.notebooks import run

    raise typer.Exit(run(names or [], out))


def doctor(
    json: Annotated[bool, typer.Option("--json", help="All findings as one JSON object.")] = False,
) -> None:
    """Check this machine for the requirements of vinesim: one line each, ok, warning or error, with a remedy.

    Python, packages, processor, GPU, ROS 2, page, certificates, ports, shared memory, clock, caches. The exit code is 0
    if a client can run, and 1 if it lacks something.

    \b
    Examples:
      vinesim doctor
      vinesim doctor --json
    """
    from vinesim.cli.doctor.command import run

    raise typer.Exit(run(json))


def ros_build_interfaces(
    quiet: Annotated[bool, typer.Option(help="Print nothing if all is well, or if ROS is not installed.")] = False,
    wheel: Annotated[
        pathlib.Path | None, typer.Option(help="Write wheels into this folder; installs nothing.", show_default=False)
    ] = None,
) -> None:
    """Build the ROS message packages that have no official wheel, and make them importable. Needs g++.

    The packages are built once, cached, and installed by pip into this environment, for every node that runs in it.
    Official packages are not replaced.

    \b
    Examples:
      vinesim ros build-interfaces
      vinesim ros build-interfaces --wheel wheels
    """
    from vinesim.cli.ros import build

    raise typer.Exit(build(quiet, wheel))


def ros_record(
    path: Annotated[pathlib.Path, typer.Argument(help="The MCAP file to write; an existing one is kept.")],
    topic: Annotated[
        list[str] | None,
        typer.Option(help="A topic, or a regular expression for whole names; may be repeated. By default all."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after this time [s]; by default at Ctrl-C.")
    ] = None,
) -> None:
    """Record ROS topics into one MCAP file with their definitions, as rosbag2 does, without rosbag2.

    \b
    Examples:
      vinesim ros record run.mcap
      vinesim ros record run.mcap --topic /joint_states --topic '/head_front_camera/.*'
    """
    from vinesim.cli.ros import record

    raise typer.Exit(record(path, topic or [], seconds))


def ros_play(
    path: Annotated[pathlib.Path, typer.Argument(help="An MCAP file of ROS topics, of vinesim or rosbag2.")],
    rate: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed as a multiple of the recorded one.")] = 1.0,
) -> None:
    """Publish the topics of a recording again, /clock included.

    \b
    Examples:
      vinesim ros play run.mcap
      vinesim ros play run.mcap --rate 0.5
    """
    from vinesim.cli.ros import play

    raise typer.Exit(play(path, rate))


def certs_new(
    actor: Annotated[str, typer.Argument(help="The actor's name, or server.")],
    dir: Annotated[
        pathlib.Path, typer.Option(help="Folder of certificates, for --tls of a server; created at first use.")
    ] = pathlib.Path("certs"),
    authority: Annotated[
        pathlib.Path | None,
        typer.Option(help="Folder of the authority's key ca.key, created at first use; by default DIR-authority."),
    ] = None,
    role: Annotated[str, typer.Option(help="robot, human or spectator; spectators may only read.")] = "robot",
    host: Annotated[
        list[str] | None, typer.Option(help="Name or address by which clients reach the server; may be repeated.")
    ] = None,
) -> None:
    """Make the certificate and key of an actor; at first use also those of the authority and the server.

    An actor needs ca.pem, NAME.pem and NAME.key. The authority's key signs certificates; keep it on the machine
    that made it, away from servers and clients. A running server notices changes of its folder within seconds.

    \b
    Examples:
      vinesim certs new server --host 192.168.1.5
      vinesim certs new picker
      vinesim certs new visitor --role spectator --dir certs --authority /media/stick/authority
    """
    from vinesim.cli.certs import new

    raise typer.Exit(new(actor, dir, role, host or [], authority))
