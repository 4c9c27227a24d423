"""``vinesim client``: its options, and which of them belong to which role."""

from __future__ import annotations

import gc
import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Pose, RealTimeFactor, Renderer, Scene, Seconds, Seed, StatusFormat, World

Role = Annotated[str, typer.Option(help="robot, human or spectator.")]
Name = Annotated[str | None, typer.Option(help="The actor's unique name; ROLE-PID unless given, alone ROLE.")]
Server = Annotated[str | None, typer.Option(help="Server, e.g. tcp/192.168.1.5:7447. Alone if not given.")]
Certificates = Annotated[
    pathlib.Path | None,
    typer.Option(help="Folder with ca.pem, NAME.pem and NAME.key; the server is then tls/HOST:7447."),
]
Robots = Annotated[
    list[str] | None,
    typer.Option(
        help="Of a robot: a URDF file, or the name of one that ships: vinebot, logistic. Given several times, so many "
        "robots NAME_1, NAME_2, each under its namespace."
    ),
]
Spawn = Annotated[int, typer.Option(min=0, help="Index of one of the scene's start poses.")]
StartPose = Annotated[Pose | None, typer.Option(help="Start at X Y [m] with YAW [rad] instead.")]
Approach = Annotated[
    float,
    typer.Option(
        help="Of a robot: start this far behind the start pose and drive to it [m]; on a server once others are there."
    ),
]
Namespace = Annotated[str, typer.Option(help="Of a robot: prefix of all ROS topics.")]
Ros = Annotated[bool, typer.Option(help="Of a robot: run a ROS 2 node, if ROS 2 is installed.")]
ParamsFile = Annotated[
    pathlib.Path | None, typer.Option(help="Of a robot: a ROS 2 parameter file for its nodes (YAML).")
]
Job = Annotated[str | None, typer.Option(help="Of a robot: do a job and stop: pick, exchange or meet.")]
Height = Annotated[float, typer.Option(min=1.0, max=2.5, help="Of a human [m].")]
InterestRadius = Annotated[
    float, typer.Option(min=0.1, max=5.0, help="Actors nearer than this to an object receive its motion [m].")
]
JitterBuffer = Annotated[
    float,
    typer.Option(min=0.0, max=500.0, help="Show other actors this much later, without the network's jitter [ms]."),
]
Device = Annotated[
    str,
    typer.Option(
        help="Where plants are simulated, cameras and lidars compute: cpu, cuda or cuda:N. For plants alone a GPU pays "
        "from 200 awake trees, beside four threads from 1,000."
    ),
]
Threads = Annotated[
    int,
    typer.Option(
        min=1, help="Threads for the contacts of plants on the CPU; pays from 100 awake trees, on free cores."
    ),
]
Out = Annotated[pathlib.Path | None, typer.Option(help="Folder for pictures, trace and report.json.")]
SensorRate = Annotated[
    float | None, typer.Option(min=0.1, help="Pictures and scans a second; each sensor's own rate unless given.")
]
Sensors = Annotated[
    str | None,
    typer.Option(
        help="Of a robot: live: cameras and lidars give what they can, but time waits below --least-sensor-hz. paced: "
        "every frame at its rate in simulated time. lockstep: time waits for every frame, and two runs are equal to "
        "the bit. As the robot's file says unless given, else live."
    ),
]
LeastSensorRate = Annotated[
    float | None,
    typer.Option(min=0.01, max=1000.0, help="Of live sensors: least rate in simulated time [Hz]; 5 unless given."),
]
Page = Annotated[
    int | None,
    typer.Option(
        min=0, max=65535, help="Show the vineyard in a browser, on this port; people and spectators: on a free one."
    ),
]
PageLan = Annotated[
    bool, typer.Option("--page-lan", help="Let other machines of the network open the page, by https with a token.")
]
OwnGestures = Annotated[
    pathlib.Path | None, typer.Option("--gestures", help="Of a human: TOML file of finger poses for the buttons.")
]
Outfit = Annotated[
    str | None,
    typer.Option(help="Of a human: what it wears: orange, yellow, green, ...; follows from its name unless given."),
]
Standby = Annotated[
    bool,
    typer.Option(
        "--standby",
        help="Of a robot: keep a process ready that takes the place of the one that renders its sensors if that fails; "
        "0.11 GB.",
    ),
]
# what the clients of a demo and of a benchmark are told to do
Push = Annotated[int | None, typer.Option(hidden=True, help="Of a robot: reach for this bunch and push it repeatedly.")]
Watch = Annotated[
    int | None, typer.Option(hidden=True, help="Of a robot: record force and displacement of this bunch.")
]
TickLog = Annotated[
    pathlib.Path | None, typer.Option(hidden=True, help="Write when each tick began and its work (.npz).")
]
Walk = Annotated[tuple[float, float] | None, typer.Option(hidden=True, help="Of a human: walk to this point, x y [m].")]
Reach = Annotated[
    int | None, typer.Option(hidden=True, help="Of a human: walk to this bunch, hold it, pull, let go, repeatedly.")
]

Into = Annotated[
    int | None, typer.Option(hidden=True, help="Of a human: pick the bunch of --reach, and lay it into this box.")
]


def client(
    ctx: typer.Context,
    role: Role = "robot",
    name: Name = None,
    connect: Server = None,
    tls: Certificates = None,
    scene: Scene = "demo",
    seed: Seed = None,
    robot: Robots = None,
    spawn: Spawn = 0,
    pose: StartPose = None,
    approach: Approach = 0.0,
    namespace: Namespace = "",
    params_file: ParamsFile = None,
    ros: Ros = True,
    push: Push = None,
    job: Job = None,
    walk: Walk = None,
    reach: Reach = None,
    into: Into = None,
    height: Height = 1.75,
    watch: Watch = None,
    interest_radius: InterestRadius = 5.0,
    jitter_buffer: JitterBuffer = 0.0,
    device: Device = "cpu",
    threads: Threads = 1,
    seconds: Seconds = None,
    out: Out = None,
    status: StatusFormat = "text",
    sensor_hz: SensorRate = None,
    sensors: Sensors = None,
    least_sensor_hz: LeastSensorRate = None,
    renderer: Renderer = "warp",
    tick_log: TickLog = None,
    page: Page = None,
    page_lan: PageLan = False,
    gestures: OwnGestures = None,
    outfit: Outfit = None,
    real_time_factor: RealTimeFactor = None,
    world: World = "vineyard",
    standby: Standby = False,
) -> None:
    """Join the vineyard as one actor, with a simulation of its own.

    \b
    Examples:
      vinesim client --role robot
      vinesim client --role robot --connect tcp/127.0.0.1:7447 --name picker --spawn 1
      vinesim client --role robot --robot my-robot.urdf --scene vsp --namespace picker
      vinesim client --role robot --robot vinebot --robot my-robot.urdf --name farm
      vinesim client --role spectator --connect tcp/127.0.0.1:7447 --pose 2 0 1.57 --out pictures
      vinesim client --role spectator --connect tcp/127.0.0.1:7447
      vinesim client --role human --connect tcp/127.0.0.1:7447 --name eva --outfit green
    """
    gc.disable()  # a sixth of the time of the start; the loop enables it
    values = {option: value for option, value in locals().items() if option != "ctx"}
    from vinesim.cli.client_options import ClientOptions, check_role

    check_role(role, {option for option in values if _is_given(ctx, option)})
    options = ClientOptions(**values)
    if role == "robot":
        from vinesim.client.processes.spawned_process import sensor_modules, start_early

        start_early("sensor process", sensor_modules(ros))
        from vinesim.cli.robot_client import run
    elif role == "human":
        from vinesim.cli.human_client import run
    else:
        from vinesim.cli.spectator_client import run
    raise typer.Exit(run(options))


def _is_given(ctx: typer.Context, option: str) -> bool:
    """Whether an option stands on the command line, rather than having its default."""
    source = ctx.get_parameter_source(option)
    return source is not None and source.name == "COMMANDLINE"
