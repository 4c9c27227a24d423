"""Options that several commands share."""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

Seed = Annotated[int | None, typer.Option(help="Seed of the vineyard, instead of the scene's own.")]
Scene = Annotated[
    str, typer.Option(help="A scene file, or the name of a shipped scene: cordon, demo, harvest, slope, tendone, vsp.")
]
Device = Annotated[str, typer.Option(help="cpu, cuda or cuda:N (an NVIDIA GPU).")]
Camera = Annotated[str, typer.Option(help="A camera file, or d435, dslr, phone, pinhole, raspberry_pi.")]
Colour = Annotated[
    str, typer.Option(help="camera: colours, noise and clipping of the camera's file. exact: without them.")
]
ImageSize = Annotated[
    str | None, typer.Option(help="WxH [px] at the same horizontal field of view; by default the camera's own size.")
]
Sensors = Annotated[
    list[str] | None,
    typer.Option(
        help="KIND:FILE: a further sensor at the camera's place, such as multispectral:rededge_mx; may be repeated."
    ),
]
Seconds = Annotated[float | None, typer.Option(help="Stop after this time [s]; by default at Ctrl-C.")]
StatusFormat = Annotated[str, typer.Option(help="text: a line a second. json: a JSON object a second. none: nothing.")]


def _parse_factor(text: str) -> float | None:
    """Returns a real-time factor, or None for ``auto``."""
    if text == "auto":
        return None
    with contextlib.suppress(ValueError):
        if 0.01 <= (factor := float(text)) <= 1.0:
            return factor
    raise typer.BadParameter(f"{text!r}: give auto, or a number from 0.01 to 1")


RealTimeFactor = Annotated[
    float | None,
    typer.Option(
        parser=_parse_factor,
        metavar="auto|NUMBER",
        help="Ratio of simulated time to real time. auto (the default): as fast as every client can follow, at most 1, "
        "so that no step is skipped on a slow machine. In a world with a server, the server's value counts.",
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        help="Listen on a network without certificates: any program that reaches it may publish under any name."
    ),
]
World = Annotated[str, typer.Option(help="World on the server; actors in different worlds do not meet.")]
Pose = tuple[float, float, float]
"""Type of the option ``--pose``: X Y [m] and YAW [rad]."""
