"""``vinesim bench``, ``vinesim doctor``, ``vinesim examples``, ``vinesim ros`` and ``vinesim certs``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer


def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Benchmarks to run one after the other: plants, contact, tick, start, camera, lidar, live, ros, tune."
        ),
    ] = None,
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

    raise typer.Exit(run(names or [], json, row or ()))


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


def examples(
    out: Annotated[
        pathlib.Path, typer.Option(help="Folder into which they are copied; created if it is missing.")
    ] = pathlib.Path(),
    force: Annotated[bool, typer.Option("--force", help="Replace files that differ from those of vinesim.")] = False,
) -> None:
    """Copy what ships with vinesim into the folders examples, notebooks, ros and data.

    Pages of the documentation name files of these folders. In a checkout they are already there. Files of yours are
    not replaced.

    \b
    Examples:
      vinesim examples
      vinesim examples --out vineyard
    """
    from vinesim.cli.examples import copy

    raise typer.Exit(copy(out, force))


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
    path: Annotated[pathlib.Path, typer.Argument(help="MCAP or SQLite file of ROS topics, or a rosbag2 folder.")],
    rate: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed as a multiple of the recorded one.")] = 1.0,
) -> None:
    """Publish the topics of a recording again, /clock included.

    \b
    Examples:
      vinesim ros play run.mcap
      vinesim ros play mybag/ --rate 0.5
    """
    from vinesim.cli.ros import play

    raise typer.Exit(play(path, rate))


Namespace = Annotated[str, typer.Option(help="Namespace of relative names, such as joint_states.")]


def ros_topics(
    types: Annotated[
        bool, typer.Option("--types", help="Also print types and numbers of publishers and subscribers.")
    ] = False,
    namespace: Namespace = "",
) -> None:
    """List the topics of the domain ROS_DOMAIN_ID, as ros2 topic list does. With --namespace only those in it.

    \b
    Examples:
      vinesim ros topics
      vinesim ros topics --types
    """
    from vinesim.cli.ros import topics

    raise typer.Exit(topics(namespace, types))


def ros_hz(
    topic: Annotated[str, typer.Argument(help="Name of the topic.")],
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Stop this time after the first message [s]; by default at Ctrl-C.")
    ] = None,
    namespace: Namespace = "",
) -> None:
    """Print the rate of a topic's messages, as ros2 topic hz does, by the time at which they arrive.

    \b
    Examples:
      vinesim ros hz /joint_states
      vinesim ros hz /lidar/points --seconds 5
    """
    from vinesim.cli.ros import hz

    raise typer.Exit(hz(topic, namespace, seconds))


def ros_echo(
    topic: Annotated[str, typer.Argument(help="Name of the topic.")],
    once: Annotated[bool, typer.Option("--once", help="Stop after the first message.")] = False,
    field: Annotated[
        str | None, typer.Option(help="Print only this field, such as pose.pose.position or position[2].")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Print long lists and texts completely.")] = False,
    namespace: Namespace = "",
) -> None:
    """Print the messages of a topic as YAML, as ros2 topic echo does. The QoS is that of the publishers.

    \b
    Examples:
      vinesim ros echo /joint_states --once
      vinesim ros echo /mobile_base_controller/odom --field pose.pose.position
    """
    from vinesim.cli.ros import echo

    raise typer.Exit(echo(topic, namespace, field, once, full))


def ros_pub(
    topic: Annotated[str, typer.Argument(help="Name of the topic.")],
    message: Annotated[str, typer.Argument(help="Fields of the message as JSON or YAML.")],
    type: Annotated[
        str | None, typer.Option(help="Type of the message; by default that of the topic's subscribers.")
    ] = None,
    rate: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Messages per second.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Publish one message.")] = False,
    namespace: Namespace = "",
) -> None:
    """Publish a message on a topic until Ctrl-C, as ros2 topic pub does.

    \b
    Examples:
      vinesim ros pub /indicator_lights/command '{"data": "warning"}' --once
      vinesim ros pub /mobile_base_controller/cmd_vel '{"twist": {"linear": {"x": 0.2}}}' --rate 10
    """
    from vinesim.cli.ros import publish

    raise typer.Exit(publish(topic, message, namespace, type, rate, once))


def ros_call(
    service: Annotated[str, typer.Argument(help="Name of the service.")],
    request: Annotated[str, typer.Argument(help="Fields of the request as JSON or YAML.")] = "{}",
    timeout: Annotated[float, typer.Option(min=0.0, help="Longest time until the response [s].")] = 30.0,
    namespace: Namespace = "",
) -> None:
    """Call a service and print its response as YAML, as ros2 service call does.

    \b
    Examples:
      vinesim ros call /get_simulation_state
      vinesim ros call /get_entity_state '{"entity": "robot"}'
    """
    from vinesim.cli.ros import call

    raise typer.Exit(call(service, request, namespace, timeout))


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
