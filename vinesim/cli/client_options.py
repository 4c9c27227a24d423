"""Options of ``vinesim client``, and the checks that need no scene.

Each option is declared once, with its help, its default and the roles that have it.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Collection
from typing import Annotated, get_type_hints

import typer

from vinesim.cli.commands.options import Pose, RealTimeFactor, Scene, Seconds, Seed, StatusFormat, World
from vinesim.core.errors import UsageError
from vinesim.ros.names import ros_namespace

ROLES = ("robot", "human", "spectator")

DEFAULT_WORLD = "vineyard"

CONTROLLERS = ("own", "none")
"""Whose controllers command a robot's joints: those of vinesim, or those of another controller manager."""
STATUS_FORMATS = ("text", "json", "none")


@dataclasses.dataclass(frozen=True)
class OnlyFor:
    """Annotation of an option of the command line: the roles that have the option. Without it, all roles have it."""

    roles: tuple[str, ...]


OF_ROBOT = OnlyFor(("robot",))
OF_HUMAN = OnlyFor(("human",))
OF_PEERS = OnlyFor(("robot", "human"))
OF_CAMERAS = OnlyFor(("robot", "spectator"))


@dataclasses.dataclass(frozen=True)
class ClientOptions:
    """Options of one client. Fields have the names of the command line's options and the order of the help."""

    role: Annotated[str, typer.Option(help="robot, human or spectator.")] = "robot"
    name: Annotated[
        str | None, typer.Option(help="The actor's unique name; by default ROLE-PID, or ROLE without a server.")
    ] = None
    connect: Annotated[
        str | None, typer.Option(help="Server, such as tcp/192.168.1.5:7377; by default none: the client is alone.")
    ] = None
    """None: the client is alone and has no network."""
    tls: Annotated[
        pathlib.Path | None,
        typer.Option(
            help="Folder with ca.pem, NAME.pem and NAME.key, for a server with certificates at tls/HOST:7377."
        ),
    ] = None
    scene: Scene = "demo"
    seed: Seed = None
    robot: Annotated[
        list[str] | None,
        OF_ROBOT,
        typer.Option(
            help="Robots: a URDF, xacro, SDF or MJCF file, a pipe, - for the standard input, or the name of a shipped "
            "robot: vinebot, logistic. Given several times, the robots are NAME_1, NAME_2, ..., each in a namespace of "
            "its own."
        ),
    ] = None
    """None: one robot of the kind vinebot."""
    srdf: Annotated[
        pathlib.Path | None,
        OF_ROBOT,
        typer.Option(help="Robots: the SRDF of MoveIt with joint groups; by default the one beside the robot file."),
    ] = None
    xacro_args: Annotated[
        list[str] | None,
        OF_ROBOT,
        typer.Option(metavar="NAME:=VALUE", help="Robots: arguments of a xacro file, separated by blanks."),
    ] = None
    base: Annotated[
        str,
        OF_ROBOT,
        typer.Option(
            help="Robots: how the base moves: planar (driven), free (the robot stands on its legs) or fixed (bolted "
            "down). auto: as the robot's files say."
        ),
    ] = "auto"
    spawn: Annotated[
        int | None,
        typer.Option(
            min=0, help="Index of one of the scene's start poses; by default the first one where nobody stands."
        ),
    ] = None
    pose: Annotated[
        Pose | None, typer.Option(help="Start at X Y [m] with YAW [rad] instead of a start pose of the scene.")
    ] = None
    approach: Annotated[
        float,
        OF_ROBOT,
        typer.Option(
            help="Robots: start this far behind the start pose and drive to it [m]; with a server, when another actor "
            "has joined."
        ),
    ] = 0.0
    namespace: Annotated[str, OF_ROBOT, typer.Option(help="Robots: prefix of all ROS topics.")] = ""
    params_file: Annotated[
        pathlib.Path | None,
        OF_ROBOT,
        typer.Option(help="Robots: a ROS 2 parameter file for the robot's nodes (YAML)."),
    ] = None
    ros: Annotated[bool, OF_ROBOT, typer.Option(help="Robots: run a ROS 2 node, if ROS 2 is installed.")] = True
    controllers: Annotated[
        str,
        OF_ROBOT,
        typer.Option(
            help="Robots: own, or none: the robot is hardware of your controller_manager, by the topics "
            "robot_joint_commands and robot_joint_states."
        ),
    ] = "own"
    push: Annotated[
        int | None,
        OF_ROBOT,
        typer.Option(hidden=True, help="Robots: reach for this bunch and push it repeatedly."),
    ] = None
    """The option is hidden, like all options with which a demo or a benchmark controls its clients."""
    job: Annotated[
        str | None, OF_ROBOT, typer.Option(help="Robots: do a task and stop: pick, exchange, meet or prune.")
    ] = None
    policy: Annotated[
        pathlib.Path | None,
        OF_ROBOT,
        typer.Option(
            help="Robots: a policy.npz of vinesim train, or reach, expose, pick or prune, which ship with vinesim. It "
            "does its task with the task's arm and shoots, drawn by --seed (1), and stops; exit code 1 if it fails. "
            "With --page it begins when a browser has opened the page, and stops when that is closed."
        ),
    ] = None
    bunches: Annotated[
        int,
        OF_ROBOT,
        typer.Option(
            min=0, help="Robots, --job pick: bunches to put into one crate; 0: until it is full or none is left."
        ),
    ] = 1
    order: Annotated[
        str,
        OF_ROBOT,
        typer.Option(help="Robots, --job pick: freest, the bunch with most room for the hand, or nearest."),
    ] = "freest"
    see: Annotated[
        bool,
        OF_ROBOT,
        typer.Option("--see", help="Robots, --job pick, prune: find plants by the robot's camera, not the simulation."),
    ] = False
    walk: Annotated[
        tuple[float, float] | None,
        OF_HUMAN,
        typer.Option(hidden=True, help="People: walk to this point, x y [m]."),
    ] = None
    reach: Annotated[
        int | None,
        OF_HUMAN,
        typer.Option(hidden=True, help="People: walk to this bunch, hold it, pull, let go, repeatedly."),
    ] = None
    into: Annotated[
        int | None,
        OF_HUMAN,
        typer.Option(hidden=True, help="People: pick the bunch of --reach, and lay it into this box."),
    ] = None
    height: Annotated[float, OF_HUMAN, typer.Option(min=1.0, max=2.5, help="People: height [m].")] = 1.75
    watch: Annotated[
        int | None,
        OF_ROBOT,
        typer.Option(hidden=True, help="Robots: record force and displacement of this bunch."),
    ] = None
    interest_radius: Annotated[
        float, typer.Option(min=0.1, max=5.0, help="Actors within this distance of an object receive its motion [m].")
    ] = 5.0
    jitter_buffer: Annotated[
        float,
        OF_PEERS,
        typer.Option(
            min=0.0, max=500.0, help="Show remote actors with this delay, which hides the network's jitter [ms]."
        ),
    ] = 0.0
    device: Annotated[
        str,
        typer.Option(
            help="Device of plants, cameras and lidars: cpu, cuda or cuda:N. For plants alone, a GPU is faster from "
            "200 awake trees on."
        ),
    ] = "cpu"
    seconds: Seconds = None
    out: Annotated[pathlib.Path | None, typer.Option(help="Folder for pictures, trace and report.json.")] = None
    status: StatusFormat = "text"
    sensor_hz: Annotated[
        float | None,
        OF_CAMERAS,
        typer.Option(min=0.1, help="Pictures and scans a second; by default each sensor's own rate."),
    ] = None
    sensors: Annotated[
        str | None,
        OF_ROBOT,
        typer.Option(
            help="Robots: pace of cameras and lidars. live: as fast as the machine can, but simulated time waits if a "
            "sensor is slower than --least-sensor-hz. paced: every frame at its rate in simulated time. lockstep: time "
            "waits for every frame, and two runs are equal to the bit. By default as in the robot's file, or live."
        ),
    ] = None
    """A value of :class:`vinesim.scene.values.SensorMode`; None: the mode that the robot's file gives."""
    least_sensor_hz: Annotated[
        float | None,
        OF_ROBOT,
        typer.Option(min=0.01, max=1000.0, help="Least rate of live sensors in simulated time [Hz]; by default 5."),
    ] = None
    """None: the rate that the robot's file gives."""
    tick_log: Annotated[
        pathlib.Path | None, typer.Option(hidden=True, help="Write the start and the duration of each tick (.npz).")
    ] = None
    page: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Show the vineyard in a browser, on this port. By default, people and spectators use a free port.",
        ),
    ] = None
    """0: any free port. None: a free port if the client is used through its page only, otherwise no page."""
    page_lan: Annotated[
        bool,
        typer.Option("--page-lan", help="Let other machines on the network open the page, by https with a token."),
    ] = False
    gestures: Annotated[
        pathlib.Path | None,
        OF_HUMAN,
        typer.Option("--gestures", help="People: TOML file of finger poses for the buttons."),
    ] = None
    outfit: Annotated[
        str | None,
        OF_HUMAN,
        typer.Option(help="People: colours of the clothes: orange, yellow, green, ...; by default chosen by name."),
    ] = None
    real_time_factor: RealTimeFactor = None
    """Real-time factor of a client without a server; None: as fast as the client can follow, at most 1."""
    world: World = DEFAULT_WORLD
    standby: Annotated[
        bool,
        OF_ROBOT,
        typer.Option(
            "--standby",
            help="Robots: keep a second sensor process ready, which takes over if the first fails; needs 0.11 GB.",
        ),
    ] = False

    @property
    def is_for_page(self) -> bool:
        """Whether the client is used through its page only: as a person without a script, or as a spectator that writes
        no pictures."""
        is_person = self.role == "human" and self.walk is None and self.reach is None
        return is_person or (self.role == "spectator" and self.out is None)


def check_role(role: str, given: Collection[str]) -> None:
    """Raise :class:`UsageError` unless the role exists and has all the options ``given`` on the command line."""
    if role not in ROLES:
        raise UsageError(f"role {role!r} is none of {', '.join(ROLES)}; give one of them")
    hints = get_type_hints(ClientOptions, include_extras=True)
    for option in sorted(given):
        limits = [one.roles for one in getattr(hints[option], "__metadata__", ()) if isinstance(one, OnlyFor)]
        roles = limits[0] if limits else ROLES
        if role not in roles:
            flag = "--no-ros" if option == "ros" else f"--{option.replace('_', '-')}"
            raise UsageError(f"{flag} is an option of --role {' or '.join(roles)}, not of {role}; leave it out")


def check_status(status: str) -> None:
    """Raise :class:`UsageError` unless ``status`` is a format of status lines."""
    if status not in STATUS_FORMATS:
        raise UsageError(f"--status {status!r}: give text, json or none")


def check_options(options: ClientOptions) -> None:
    """Check options before anything is built. Raises :class:`UsageError`, or DeviceError for a missing device."""
    from vinesim.scene.values import SensorMode

    check_status(options.status)
    ros_namespace(options.namespace)
    if options.sensors is not None and options.sensors not in tuple(SensorMode):
        raise UsageError(f"--sensors {options.sensors!r}: give {', '.join(SensorMode)}")
    if options.page_lan and options.page is None and not options.is_for_page:
        raise UsageError("--page-lan without a page: give --page PORT, too")
    if options.tls is not None and options.connect is None:
        raise UsageError(f"--tls {options.tls} without a server: give --connect tls/HOST:7377")
    if options.world != DEFAULT_WORLD and options.connect is None:
        raise UsageError(f"--world {options.world} without a server: give --connect tcp/HOST:7377")
    if options.world != DEFAULT_WORLD and options.tls is not None:
        raise UsageError(
            f"--world {options.world} --tls {options.tls}: a server with certificates has one world; leave --world out"
        )
    if options.real_time_factor is not None and options.connect is not None:
        raise UsageError(
            f"--real-time-factor {options.real_time_factor:g} with --connect: a world runs as fast as its server says; "
            "give it to vinesim server"
        )
    if options.controllers not in CONTROLLERS:
        raise UsageError(f"--controllers {options.controllers!r}: give {' or '.join(CONTROLLERS)}")
    if options.params_file is not None and not options.params_file.is_file():
        raise UsageError(f"--params-file {options.params_file}: there is no such file; give a ROS 2 parameter file")
    from vinesim.plants.device_buffers import find_device
    from vinesim.scene import appearance

    if options.outfit is not None and options.outfit not in appearance.outfit_names():
        known = ", ".join(appearance.outfit_names())
        raise UsageError(f"--outfit {options.outfit}: there is no such outfit; give one of {known}")
    find_device(options.device)
