"""``vinesim tune``: its options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Device

Model = Annotated[
    pathlib.Path,
    typer.Option(help="The plant: a TOML file with a table [specimen], alone or in a file of plant parameters."),
]


def tune(
    data: Annotated[
        pathlib.Path,
        typer.Argument(help="CSV: time [s], x [mm] ... of the tip, 'NAME x [mm]' of a marker, force [N] if measured."),
    ],
    model: Model,
    fit: Annotated[
        str, typer.Option(help="What is fitted, with commas: modulus, damping, mass (needs a force), rest (the shape).")
    ] = "modulus,damping",
    out: Annotated[
        pathlib.Path | None, typer.Option(help="Write plant parameters that scenes load, with the fitted numbers.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
    plot: Annotated[
        pathlib.Path | None, typer.Option(help="Draw track, residuals and posterior into this file (.png, .pdf, .svg).")
    ] = None,
    release: Annotated[float | None, typer.Option(help="When it was let go [s]; found unless given.")] = None,
    samples: Annotated[
        int, typer.Option(min=0, max=100_000, help="Draw so many candidates of the posterior, all simulated.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of these draws.")] = 0,
    device: Device = "cpu",
) -> None:
    """Fit a cane, or a bunch on its peduncle, to the track of a pull and release.

    Prints modulus, damping and what else is fitted with 90 % intervals, what the data do not decide, and what speaks
    against the fit; with such a fault the exit code is 5, and --out is not written. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim tune pull.csv --model cane.toml
      vinesim tune pull.csv --model cane.toml --fit modulus,damping,mass --out fitted.toml --plot fit.png
      vinesim tune swing.csv --model bunch.toml --release 0.4 --samples 2000 --json
    """
    from vinesim.cli.tune import run

    raise typer.Exit(run(data, model, fit, out, json, plot, release, samples, seed, device))
