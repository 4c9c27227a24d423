"""Options that several commands share."""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

Seed = Annotated[int | None, typer.Option(help="Seed of the vineyard, instead of the scene's own.")]
Scene = Annotated[str, typer.Option(help="A scene file, or the name of one that ships: demo, harvest, tendone, vsp.")]
Renderer = Annotated[
    str, typer.Option(help="Rasterizer: warp, taichi (all cores) or taichi-gpu (Vulkan, Metal); needs vinesim[taichi].")
]
Device = Annotated[str, typer.Option(help="cpu, cuda or cuda:N (an NVIDIA GPU).")]
Camera = Annotated[str, typer.Option(help="A camera file, or d435, pinhole.")]
ImageSize = Annotated[
    str | None, typer.Option(help="WxH [px] at the same horizontal field of view; the camera's own unless given.")
]
Sensors = Annotated[
    list[str] | None,
    typer.Option(
        help="KIND:FILE: looks from the camera's place as well, such as multispectral:rededge_mx; may repeat."
    ),
]
Seconds = Annotated[float | None, typer.Option(help="Stop after so long [s]; until Ctrl-C unless given.")]
StatusFormat = Annotated[str, typer.Option(help="text: a line a second. json: an object a second. none.")]


def _parse_factor(text: str) -> float | None:
    """A real-time factor, or None for ``auto``."""
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
        help="Simulated time passes so many times as fast as real time. auto, unless given: as fast as every client "
        "can follow, at most 1, so that no step is skipped on a slow machine. In a world with a server, the server's.",
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        help="Listen on a network without certificates: any program that reaches it may publish under any name."
    ),
]
World = Annotated[str, typer.Option(help="Which of the server's worlds; those in different ones do not meet.")]
Pose = tuple[float, float, float]
"""X Y [m] and YAW [rad]."""
