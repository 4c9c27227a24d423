"""The command line: ``vinesim``.

This module knows the commands and their options and nothing else; a command imports its engine when it runs,
so that ``vinesim --help`` opens at once.

Exit codes: 0 done; 2 wrong use or bad input; 3 a part is missing on this machine; 4 the network or the server;
5 a job was not done; 130 stopped by Ctrl-C or SIGTERM where stopping is not the ordinary end.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pathlib
import signal
import sys
import traceback
from typing import Annotated

import typer

app = typer.Typer(
    add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False,
    help="Soft vines and grapes, where robots and people meet: simulated at 100 Hz by every client, no GPU needed.",
    epilog="Start with: vinesim demo",
)  # fmt: skip
scene_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Vineyards: what a scene file says.")
ros_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="ROS 2: set-up and state.")
app.add_typer(scene_app, name="scene")
app.add_typer(ros_app, name="ros")
certs_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Certificates for secured links.")
app.add_typer(certs_app, name="certs")

Seed = Annotated[int | None, typer.Option(help="Seed of the vineyard, instead of the scene's own.")]
Scene = Annotated[str, typer.Option(help="A scene file, or the name of one that ships: demo, harvest, tendone, vsp.")]
Renderer = Annotated[
    str, typer.Option(help="Who draws: warp, taichi (all cores) or taichi-gpu (Vulkan, Metal); needs vinesim[taichi].")
]
Robot = Annotated[str, typer.Option(help="A URDF file, or the name of one that ships: vinebot, logistic.")]


@app.command()
def demo(
    job: Annotated[
        str,
        typer.Option(help="push: on and on. pick: a bunch into a box. exchange: a full box for an empty one."),
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
    headless: Annotated[bool, typer.Option(help="No live table; one line a second.")] = False,
    out: Annotated[pathlib.Path, typer.Option(help="Folder for pictures, plot and summary.json.")] = pathlib.Path(
        "out"
    ),
) -> None:
    """A robot pushes a bunch, another client sees it move, ROS topics carry it; or a robot does a job.

    Starts a server, two robot clients (one for a job) and a plain rclpy listener, each a process of its own, on free
    ports. summary.json says what was measured; of a job whether it was done ("picked", "exchanged") and if not, why.

    \b
    Examples:
      vinesim demo
      vinesim demo --seconds 30 --seed 3 --out /tmp/run
      vinesim demo --scene my-block.toml --robot my-robot.urdf --headless
      vinesim demo --job pick --seed 5
      vinesim demo --job exchange
    """
    from vinesim.cli.demo import run, run_job

    if job != "push":
        raise typer.Exit(run_job(job, seconds=seconds, seed=seed, scene=scene, robot=robot, headless=headless, out=out))
    raise typer.Exit(
        run(
            seconds=seconds or 20.0, seed=seed, scene=scene or "demo", robot=robot or "vinebot", headless=headless,
            out=out,
        )
    )  # fmt: skip


@app.command()
def server(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            help="Where to listen, several times if need be; port 0 takes a free one. tcp/0.0.0.0:7447 for everything "
            "and udp/0.0.0.0:7447 for poses, unless given; with --tls tls/ and quic/."
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Link to the server at this endpoint and only carry: that one answers and keeps."),
    ] = None,
    keep: Annotated[
        pathlib.Path | None,
        typer.Option(help="Folder in which picked bunches, boxes and cuts are kept; in memory unless given."),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="Let in this scene only; unless given, the first actor decides.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of that scene, instead of its own.")] = None,
    max_clients: Annotated[
        int | None, typer.Option(min=1, help="So many actors at a time; no bound unless given.")
    ] = None,
    quota: Annotated[
        tuple[float, float],
        typer.Option(help="MESSAGES/s and BYTES/s that one actor may say for good (cuts, where things lie)."),
    ] = (200.0, 200_000.0),
    tls: Annotated[
        pathlib.Path | None, typer.Option(help="Folder of certificates (vinesim certs new): nobody else gets in.")
    ] = None,
    status: Annotated[str, typer.Option(help="text: a line a second. json: an object a second. none.")] = "none",
) -> None:
    """Carry messages between clients, and keep what stays true. The server simulates nothing.

    Facts are kept in memory unless --keep is given: a demonstration begins with an unpicked vineyard every time.

    \b
    Examples:
      vinesim server
      vinesim server --listen tcp/127.0.0.1:0 --status text
      vinesim server --scene vsp --max-clients 12 --keep harvest/
      vinesim server --tls certs/
      vinesim server --connect tcp/192.168.1.5:7447
    """
    options = dict(locals())
    from vinesim.cli.server import run

    raise typer.Exit(run(**options))


@app.command()
def client(
    role: Annotated[str, typer.Option(help="robot, human or spectator.")] = "robot",
    name: Annotated[str | None, typer.Option(help="The actor's name, one of a kind; robot-PID unless given.")] = None,
    connect: Annotated[str | None, typer.Option(help="Server, e.g. tcp/192.168.1.5:7447. Alone if not given.")] = None,
    tls: Annotated[
        pathlib.Path | None,
        typer.Option(help="Folder with ca.pem, NAME.pem and NAME.key; the server is then tls/HOST:7447."),
    ] = None,
    scene: Scene = "demo",
    seed: Seed = None,
    robot: Annotated[
        list[str] | None,
        typer.Option(help="As for demo; given several times, so many robots NAME_1, NAME_2, each under its namespace."),
    ] = None,
    spawn: Annotated[int, typer.Option(min=0, help="Which of the scene's start places.")] = 0,
    place: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Start at X Y [m] with YAW [rad] instead."),
    ] = None,
    back: Annotated[float, typer.Option(help="Start this far behind the place and drive to it [m].")] = 0.0,
    namespace: Annotated[str, typer.Option(help="Prefix of all ROS topics.")] = "",
    ros: Annotated[bool, typer.Option(help="Talk ROS 2, if it is installed.")] = True,
    push: Annotated[int | None, typer.Option(help="Reach for this bunch and push it, again and again.")] = None,
    job: Annotated[str | None, typer.Option(help="Do a job and stop: pick or exchange.")] = None,
    walk: Annotated[tuple[float, float] | None, typer.Option(help="A human: walk to this place, x y [m].")] = None,
    reach: Annotated[
        int | None, typer.Option(help="A human: walk to this bunch, hold it, pull at it, let go, again and again.")
    ] = None,
    height: Annotated[float, typer.Option(min=1.0, max=2.5, help="Of a human [m].")] = 1.75,
    watch: Annotated[int | None, typer.Option(help="Record force and displacement of this bunch.")] = None,
    near: Annotated[
        float, typer.Option(min=0.1, max=5.0, help="Others nearer than this to a thing hear of it [m].")
    ] = 5.0,
    jitter_buffer: Annotated[
        float,
        typer.Option(
            min=0.0, max=500.0, help="Show other actors so much later, and free of the network's jitter [ms]."
        ),
    ] = 0.0,
    device: Annotated[str, typer.Option(help="Where plants are simulated: cpu, cuda or cuda:N.")] = "cpu",
    threads: Annotated[
        int, typer.Option(min=1, help="Threads for the plants on the CPU; pays from 32 awake trees, on free cores.")
    ] = 1,
    seconds: Annotated[float | None, typer.Option(help="Stop after so long [s]; until Ctrl-C unless given.")] = None,
    out: Annotated[pathlib.Path | None, typer.Option(help="Folder for pictures, trace and report.json.")] = None,
    status: Annotated[str, typer.Option(help="text: a line a second. json: an object a second. none.")] = "text",
    sensor_hz: Annotated[
        float | None, typer.Option(min=0.1, help="Pictures and scans a second; each sensor's own rate unless given.")
    ] = None,
    renderer: Renderer = "warp",
) -> None:
    """Join the vineyard as one actor, with a simulation of its own.

    \b
    Examples:
      vinesim client --role robot
      vinesim client --role robot --connect tcp/127.0.0.1:7447 --name picker --spawn 1
      vinesim client --role robot --robot my-robot.urdf --scene vsp --namespace picker
      vinesim client --role robot --robot vinebot --robot my-robot.urdf --name farm
      vinesim client --role spectator --connect tcp/127.0.0.1:7447 --place 2 0 1.57 --out pictures
      vinesim client --role human --connect tcp/127.0.0.1:7447 --name eva --reach 12
    """
    options = dict(locals())
    if role == "human":
        from vinesim.cli.human_client import run as visit

        raise typer.Exit(visit(**options))
    if role == "spectator":
        from vinesim.cli.spectator_client import run as look

        raise typer.Exit(look(**options))
    from vinesim.cli.robot_client import run

    raise typer.Exit(run(**{name: value for name, value in options.items() if name not in ("walk", "reach", "height")}))


@app.command()
def record(
    file: Annotated[pathlib.Path, typer.Argument(help="The MCAP file to write; if there is one, FILE-2 and so on.")],
    connect: Annotated[str, typer.Option(help="Server.")] = "tcp/127.0.0.1:7447",
    world: Annotated[str, typer.Option(help="Which of the server's worlds.")] = "vineyard",
    tls: Annotated[
        pathlib.Path | None, typer.Option(help="Folder with ca.pem, NAME.pem and NAME.key, of a spectator; see --name.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name on its certificate; NAME-1 ... stand in an area.")] = None,
    scene: Annotated[
        str | None, typer.Option(help="Refuse to record any other scene. Whatever is there unless given.")
    ] = None,
    seed: Seed = None,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Stand in this area, X0 Y0 X1 Y1 [m]: what happens there is sent because of you."),
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="Of poses,trees,things,events,facts,forces; all unless given.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after so long [s]; until Ctrl-C unless given.")] = None,
) -> None:
    """Write down what is sent in a world, as MCAP. Unless an area is given, nothing more is sent because of it.

    \b
    Examples:
      vinesim record run.mcap
      vinesim record run.mcap --connect tcp/192.168.1.5:7447 --seconds 60
      vinesim record run.mcap --area -5 -5 5 5 --only poses,trees
    """
    options = dict(locals())
    from vinesim.cli.record import run

    raise typer.Exit(run(**options))


@app.command()
def replay(
    file: Annotated[pathlib.Path, typer.Argument(help="A file that vinesim record wrote, whole or cut off.")],
    connect: Annotated[str | None, typer.Option(help="Play it to this server.")] = None,
    listen: Annotated[str | None, typer.Option(help="Be a server, and play it once somebody is there.")] = None,
    world: Annotated[str, typer.Option(help="Which of the server's worlds.")] = "vineyard",
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Times as fast as it was.")] = 1.0,
    start: Annotated[float, typer.Option("--from", min=0.0, help="Seconds after its beginning to start at.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Seconds after its beginning to stop at.")] = None,
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Look at it: folder for a picture a second, without any server.")
    ] = None,
    place: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="With --out: look from X Y [m] along YAW [rad]; unless given, follow a robot."),
    ] = None,
    scene: Annotated[str | None, typer.Option(help="With --out: its scene file, if it is none that ships.")] = None,
    seed: Seed = None,
) -> None:
    """Let a recording happen again: for a server's clients, or as pictures.

    \b
    Examples:
      vinesim replay run.mcap --out pictures
      vinesim replay run.mcap --connect tcp/127.0.0.1:7447 --from 20 --to 40
      vinesim replay run.mcap --listen tcp/0.0.0.0:7447 --speed 0.5
    """
    options = dict(locals())
    from vinesim.cli.replay import run

    raise typer.Exit(run(**options))


@scene_app.command("show")
def scene_show(
    file: Annotated[str, typer.Argument(help="A scene file, or demo, harvest, tendone, vsp.")],
    seed: Seed = None,
    out: Annotated[pathlib.Path | None, typer.Option(help="Picture to write; NAME.png unless given.")] = None,
) -> None:
    """Print what a scene holds, and draw it.

    \b
    Examples:
      vinesim scene show demo
      vinesim scene show my-block.toml --seed 4 --out block.png
    """
    from vinesim.cli.scene import show

    raise typer.Exit(show(file, seed, out))


@app.command()
def render(
    scene: Annotated[str, typer.Argument(help="A scene file, or demo, harvest, tendone, vsp.")],
    at: Annotated[str, typer.Option(help="Where the camera stands, X,Y,Z [m].")],
    look: Annotated[str, typer.Option(help="The point it looks at, X,Y,Z [m].")],
    camera: Annotated[str, typer.Option(help="A camera file, or d435, pinhole.")] = "d435",
    size: Annotated[
        str | None, typer.Option(help="WxH [px] at the same horizontal field of view; the camera's own unless given.")
    ] = None,
    seed: Seed = None,
    hour: Annotated[
        float | None, typer.Option(min=0.0, max=24.0, help="Solar time [h], instead of the scene's own sun.")
    ] = None,
    out: Annotated[pathlib.Path, typer.Option(help="Folder for the picture and its truth.")] = pathlib.Path("render"),
    robot: Annotated[list[str] | None, typer.Option(help="NAME@X,Y[,YAW]: a robot there [m, rad]; may repeat.")] = None,
    person: Annotated[
        list[str] | None,
        typer.Option(help="X,Y[,YAW][,POSTURE]: somebody who stands, picks, reaches, points, waves, carries or walks."),
    ] = None,
    crate: Annotated[
        list[str] | None, typer.Option(help="X,Y[,YAW[,FILL]]: a crate, filled with bunches from 0 to 1.")
    ] = None,
    renderer: Renderer = "warp",
) -> None:
    """Draw one picture, and say all that is true of it: ids, masks, boxes, berries, cut points.

    Writes rgb.png, depth.png (16 bits, mm), labels.png (id = R + 256 G + 65536 B), overlay.png, camera.json and
    truth.json. Bunches in a crate were picked from the nearest vines.

    \b
    Examples:
      vinesim render demo --at 0.4,1.2,1.3 --look 3,1,1.7
      vinesim render vsp --camera pinhole --at 1,-1.2,1.1 --look 1,0,1 --size 1280x960 --seed 4 --out shot
      vinesim render harvest --at 0,0.15,1.35 --look 2.6,0.35,1 --robot vinebot@2.9,1,-2.5 --person 2.2,-0.28,2.3,pick --crate 1.8,0.75,0,0.4
    """  # a command line that can be copied
    from vinesim.cli.render import run

    things = {"robots": robot or (), "people": person or (), "crates": crate or ()}
    view = {"camera": camera, "at": at, "look": look, "size": size, "hour": hour}
    raise typer.Exit(run(scene, **view, seed=seed, out=out, renderer=renderer, **things))


@app.command()
def dataset(
    images: Annotated[int, typer.Option(min=1, max=999_999, help="How many.")],
    out: Annotated[pathlib.Path, typer.Option(help="Folder of the data set; one that was begun is gone on with.")],
    scene: Scene = "demo",
    seed: Annotated[int, typer.Option(help="The same seed gives the same images.")] = 0,
    camera: Annotated[str, typer.Option(help="A camera file, or d435, pinhole.")] = "d435",
    size: Annotated[
        str | None, typer.Option(help="WxH [px] at the same horizontal field of view; the camera's own unless given.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=256, help="Processes; half as many as cores unless given.")
    ] = None,
    renderer: Renderer = "warp",
    actors: Annotated[
        float, typer.Option(help="Share of the images with people, robots, crates and wind; 0 leaves the vines alone.")
    ] = 0.4,
) -> None:
    """Draw random pictures of random vineyards with their truth: COCO with masks, YOLO, depth, ids, poses.

    Seed of the vines, leaves, varieties, ripeness, hour and season of the sun, who is there and the viewpoint are drawn
    for you. Killed or stopped, the same command goes on; more images may be asked for later.

    \b
    Examples:
      vinesim dataset --images 1000 --out grapes
      vinesim dataset --images 200 --out vsp --scene vsp --seed 3 --camera pinhole --size 320x240 --workers 4
    """
    options = dict(locals())
    from vinesim.cli.dataset import run

    raise typer.Exit(run(**options))


@app.command()
def bench(
    names: Annotated[list[str], typer.Argument(help="plants, camera, sync; several are run one after the other.")],
    json: Annotated[bool, typer.Option("--json", help="One JSON object a line, nothing else on stdout.")] = False,
    plot: Annotated[
        pathlib.Path | None, typer.Option(help="Where sync (.png) or sensors (a folder) draw what they measured.")
    ] = None,
) -> None:
    """Measure, beside a peer that runs in the same process on the same scene.

    Of physics: plants, contact, tick, asleep. Of sensors: camera and lidar (speed), sensors (what they measure, beside
    the truth), eyes (the tick beside pictures). Of the network: sync (what delay does, in simulated time), link (real
    clients over emulated links; needs root), traffic (bytes a client hears), load (many clients), fuzz (broken
    messages).

    \b
    Examples:
      vinesim bench plants --json
      vinesim bench plants camera
      vinesim bench sync --json --plot docs/pictures/network-sync.png
      vinesim bench sensors --plot docs/pictures
    """
    from vinesim.cli.bench import run

    raise typer.Exit(run(names, json, plot))


@ros_app.command("build-interfaces")
def ros_build(
    quiet: Annotated[bool, typer.Option(help="Say nothing if all is well, or if ROS is not installed.")] = False,
) -> None:
    """Build the ROS message packages that have no wheel (once; cached). Needs g++.

    \b
    Examples:
      vinesim ros build-interfaces
    """
    from vinesim.cli.ros import build

    raise typer.Exit(build(quiet))


@certs_app.command("new")
def certs_new(
    actor: Annotated[str, typer.Argument(help="The actor's name, or server.")],
    dir: Annotated[pathlib.Path, typer.Option(help="Folder of the authority; made at first use.")] = pathlib.Path(
        "certs"
    ),
    role: Annotated[str, typer.Option(help="robot, human or spectator, who only reads.")] = "robot",
    host: Annotated[
        list[str] | None, typer.Option(help="For server: name or address by which clients reach it; repeatable.")
    ] = None,
) -> None:
    """Make the certificate and key of an actor; at first use the authority's and the server's as well.

    An actor needs ca.pem, NAME.pem and NAME.key; ca.key stays where it is made. The server reads its folder when it
    starts: an actor made later is let in after a restart, one whose .pem is removed is not.

    \b
    Examples:
      vinesim certs new server --host 192.168.1.5
      vinesim certs new picker
      vinesim certs new visitor --role spectator --dir certs
    """
    from vinesim.cli.certs import new

    raise typer.Exit(new(actor, dir, role, host or []))


@app.callback()
def options(
    verbose: Annotated[int, typer.Option("--verbose", "-v", count=True, help="Log more; twice for everything.")] = 0,
) -> None:
    """Log level for every command."""
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")


def main() -> None:
    """Entry point of the command line.

    Leaves without taking the interpreter down in order: all is closed by then, and Python 3.11 would end threads of
    foreign runtimes (Zenoh's are Rust) in a way that makes them abort the process.
    """
    # Small matrices gain nothing from BLAS threads, and those would take the other core from the eyes.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A shell lets what it starts in the background ignore Ctrl-C; whoever sends it means it, and so with SIGTERM.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    code = _run()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    logging.shutdown()
    os._exit(code)


def _run() -> int:
    """The exit code. An error of vinesim's own is one line in words; any other is a defect with a traceback."""
    try:
        app()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if not type(error).__module__.startswith("vinesim."):
            traceback.print_exc()
            return 1
        print(f"vinesim: {' '.join(str(error).split())}", file=sys.stderr)
        return getattr(error, "exit_code", 2)
    return 0
