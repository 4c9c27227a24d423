"""``vinesim client``; its options are :class:`vinesim.cli.client_options.ClientOptions`."""

from __future__ import annotations

import dataclasses
import gc
import inspect
from typing import Any, get_type_hints

import typer

from vinesim.cli.client_options import ClientOptions, check_role


def client(ctx: typer.Context, **values: Any) -> None:
    """Join the vineyard as one actor, with a simulation of its own.

    \b
    Examples:
      vinesim client --role robot
      vinesim client --role robot --connect tcp/127.0.0.1:7377 --name picker --spawn 1
      vinesim client --role robot --robot my-robot.urdf --scene vsp --namespace picker
      vinesim client --role robot --robot vinebot --robot my-robot.urdf --name farm
      vinesim client --role spectator --connect tcp/127.0.0.1:7377 --pose 2 0 1.57 --out pictures
      vinesim client --role spectator --connect tcp/127.0.0.1:7377
      vinesim client --role human --connect tcp/127.0.0.1:7377 --name eva --outfit green
    """
    gc.disable()  # the collector takes a sixth of the start time; the loop enables it again
    options = ClientOptions(**values)
    check_role(options.role, {option for option in values if _is_given(ctx, option)})
    if options.role == "robot":
        from vinesim.client.processes.worker_process import sensor_modules, start_early

        start_early("sensor process", sensor_modules(options.ros))
        from vinesim.cli.robot_client import run
    elif options.role == "human":
        from vinesim.cli.human_client import run
    else:
        from vinesim.cli.spectator_client import run
    raise typer.Exit(run(options))


def _signature() -> inspect.Signature:
    """Returns the signature that typer reads options from: the context, and a parameter for each field of
    :class:`ClientOptions`."""
    hints = get_type_hints(ClientOptions, include_extras=True)
    context = inspect.Parameter("ctx", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
    options = [
        inspect.Parameter(one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default, annotation=hints[one.name])
        for one in dataclasses.fields(ClientOptions)
    ]
    return inspect.Signature([context, *options])


client.__signature__ = _signature()  # pyright: ignore[reportFunctionMemberAccess] inspect.signature() looks for it


def _is_given(ctx: typer.Context, option: str) -> bool:
    """Returns whether an option was given on the command line, rather than having its default."""
    source = ctx.get_parameter_source(option)
    return source is not None and source.name == "COMMANDLINE"
