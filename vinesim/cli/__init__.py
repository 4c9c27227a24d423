"""The command line ``vinesim``.

``commands`` contains the options of all commands and nothing else. A command imports its implementation when it runs,
so that ``vinesim --help`` is fast.

Exit codes: 0 done; 1 ``doctor`` has found an error, or a defect of vinesim; 2 wrong use or bad input; 3 a part is
missing on this machine; 4 an error of the network or the server; 5 a task was not done, or its files could not be
written; 130 stopped by Ctrl-C or SIGTERM where stopping is not the normal end.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import traceback
from typing import Annotated

import typer

from vinesim.cli.commands.client import client
from vinesim.cli.commands.demo import demo
from vinesim.cli.commands.images import dataset, export, render, scene_import_plant, scene_show
from vinesim.cli.commands.learning import train
from vinesim.cli.commands.perception import fuse, view
from vinesim.cli.commands.recording import record, replay
from vinesim.cli.commands.server import server
from vinesim.cli.commands.tools import (
    bench,
    certs_new,
    doctor,
    examples,
    ros_build_interfaces,
    ros_call,
    ros_echo,
    ros_hz,
    ros_play,
    ros_pub,
    ros_record,
    ros_topics,
)
from vinesim.cli.commands.tuning import experiment, track, tune
from vinesim.core import allocator, progress

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Soft vines and grapes with robots and people: simulated at 100 Hz by every client, no GPU needed.",
    epilog="Start with: vinesim demo",
)
scene_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Vineyards: contents of a scene file.")
ros_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="ROS 2: topics, services, message packages.")
certs_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Certificates for secured links.")
app.add_typer(scene_app, name="scene")
app.add_typer(ros_app, name="ros")
app.add_typer(certs_app, name="certs")
for command in (
    demo,
    server,
    client,
    record,
    replay,
    render,
    dataset,
    export,
    fuse,
    view,
    track,
    tune,
    experiment,
    train,
    bench,
    doctor,
):
    app.command()(command)
app.command()(examples)
scene_app.command("show")(scene_show)
scene_app.command("import-plant")(scene_import_plant)
ros_app.command("build-interfaces")(ros_build_interfaces)
ros_app.command("record")(ros_record)
ros_app.command("play")(ros_play)
ros_app.command("topics")(ros_topics)
ros_app.command("hz")(ros_hz)
ros_app.command("echo")(ros_echo)
ros_app.command("pub")(ros_pub)
ros_app.command("call")(ros_call)
certs_app.command("new")(certs_new)


@app.callback()
def configure_logging(
    verbose: Annotated[int, typer.Option("--verbose", "-v", count=True, help="Log more; -vv logs everything.")] = 0,
) -> None:
    """Set the log level for every command."""
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    progress.show_on(sys.stderr)


def main() -> None:
    """Run the command line, and end the process with its exit code.

    The process ends without the interpreter's own shutdown: everything is closed by then, and Python 3.11 would stop
    threads of foreign runtimes (Zenoh's are Rust) in a way that makes them abort the process.
    """
    # BLAS threads do not speed up small matrices, and would take processor time from the sensors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # MuJoCo draws nothing in vinesim, and its search for a window system takes 0.1 s.
    os.environ.setdefault("MUJOCO_GL", "disable")
    allocator.keep_large_blocks_apart()
    allocator.trim_regularly()
    # A shell lets processes in the background ignore SIGINT. Whoever sends SIGINT or SIGTERM means to end the process.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    code = _run()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    logging.shutdown()
    os._exit(code)


def _run() -> int:
    """Run the command and return its exit code. Errors of vinesim's own are printed in one line; any other exception is
    a defect and is printed with a traceback."""
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
