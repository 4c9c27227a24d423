"""``vinesim tune`` and ``vinesim experiment``: their options."""

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
        typer.Argument(
            help="CSV: time [s], x [mm] ... of the tip, 'NAME x [mm]' of a marker, force [N] if measured, "
            "'base x [mm]' if it was shaken."
        ),
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
    cloud: Annotated[
        pathlib.Path | None,
        typer.Option(help="Points of the cane as it hangs at rest, base at the origin [m]: PLY, or lines of x y z."),
    ] = None,
    release: Annotated[float | None, typer.Option(help="When it was let go [s]; found unless given.")] = None,
    push: Annotated[bool, typer.Option("--push", help="The track is of a push: a steady force begins.")] = False,
    samples: Annotated[
        int, typer.Option(min=0, max=100_000, help="Draw so many candidates of the posterior, all simulated.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of these draws.")] = 0,
    device: Device = "cpu",
) -> None:
    """Fit a cane, or a bunch on its peduncle, to the track of a pull and release, a push, or a shaken base.

    Prints modulus, damping and what else is fitted with 90 % intervals, what the data do not decide, and what speaks
    against the fit; with such a fault the exit code is 5, and --out is not written. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim tune pull.csv --model cane.toml
      vinesim tune pull.csv --model cane.toml --fit modulus,damping,mass --out fitted.toml --plot fit.png
      vinesim tune swing.csv --model bunch.toml --release 0.4 --samples 2000 --json
    """
    from vinesim.cli.tune import run

    raise typer.Exit(run(data, model, fit, out, json, plot, release, push, samples, seed, device, cloud))


def track(
    recording: Annotated[
        pathlib.Path,
        typer.Argument(
            help="MCAP file of ROS topics, rosbag2 folder of such, or a data set as vinesim dataset writes."
        ),
    ],
    marker: Annotated[
        list[str],
        typer.Option(help="Colour R,G,B in a picture of the ball at the tip; NAME=R,G,B of another. May repeat."),
    ],
    radius: Annotated[float, typer.Option(help="Of the balls [m].")],
    out: Annotated[pathlib.Path, typer.Option(help="The CSV to write, for vinesim tune.")] = pathlib.Path("track.csv"),
    image: Annotated[
        str | None, typer.Option(help="Topic of the colours; the one with rgb or color in its name unless given.")
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="Topic of the aligned depth; the one with depth in its name unless given.")
    ] = None,
    pose: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        typer.Option(
            help="Of the optical frame in the world, X Y Z QX QY QZ QW; level and looking along y unless given."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Pictures a second, of a data set whose records have no time.")
    ] = None,
) -> None:
    """Track balls of one colour each through recorded RGB-D pictures, into a CSV for vinesim tune.

    No ROS is needed. Pictures in which a ball is hidden are gaps. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim track pull.mcap --marker 224,60,130 --radius 0.012 --out pull.csv
      vinesim track pull.mcap --marker 224,60,130 --marker middle=30,90,220 --radius 0.012
      vinesim track pull/ --image /camera/color/image_raw --depth /camera/aligned_depth_to_color/image_raw \\
        --marker 224,60,130 --radius 0.012
    """
    from vinesim.cli.tune import track

    raise typer.Exit(track(recording, marker, radius, out, image, depth, pose, rate))


def experiment(
    kind: Annotated[
        str,
        typer.Argument(
            help="pull-release: held aside, then let go. push: a steady force begins. shake: the base moves in a sweep."
        ),
    ],
    model: Model,
    out: Annotated[pathlib.Path | None, typer.Option(help="Write the track as CSV; KIND.csv unless given.")] = None,
    displacement: Annotated[
        float | None, typer.Option(help="Of the tip, by the pull or the push [m]; 0.1 unless given.")
    ] = None,
    angle: Annotated[
        float, typer.Option(help="Of force or shaking about the base's x axis, from its y axis [deg].")
    ] = 90.0,
    amplitude: Annotated[float | None, typer.Option(help="Of the base that is shaken [m]; 0.005 unless given.")] = None,
    from_frequency: Annotated[
        float | None, typer.Option("--from", help="Of the sweep, at its start [Hz]; 1 unless given.")
    ] = None,
    to_frequency: Annotated[
        float | None, typer.Option("--to", help="Of the sweep, at its end [Hz]; 8 unless given.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Of the track after the release, or of the sweep [s]; 3, or 10 of a sweep.")
    ] = None,
    hold: Annotated[float, typer.Option(help="Before it [s].")] = 0.2,
    rate: Annotated[float, typer.Option(help="Pictures a second.")] = 30.0,
    noise: Annotated[float, typer.Option(help="Standard deviation of a tracked position [m].")] = 0.002,
    force_noise: Annotated[
        float | None, typer.Option(help="A force gauge of this relative standard deviation, 0.01; none unless given.")
    ] = None,
    marker: Annotated[list[str] | None, typer.Option(help="tip, or one of specimen.markers; may repeat.")] = None,
    axes: Annotated[str, typer.Option(help="Axes of the world that are tracked.")] = "xyz",
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 0,
    fit: Annotated[str, typer.Option(help="What will be fitted; see vinesim tune.")] = "modulus,damping",
    json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Simulate what a laboratory would measure, with noise, and say what a fit of it would know.

    To plan a campaign: how long to film, how fast, with or without a force gauge. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim experiment pull-release --model examples/cane.toml
      vinesim experiment pull-release --model examples/cane.toml --rate 120 --duration 2 --axes z
      vinesim experiment pull-release --model examples/cane.toml --force-noise 0.01 --fit modulus,damping,mass
      vinesim experiment push --model examples/cane.toml --out push.csv
      vinesim experiment shake --model examples/cane.toml --amplitude 0.003 --from 2 --to 6 --rate 60
    """
    from vinesim.cli.tune import plan
    from vinesim.tune.experiment import Experiment

    what = Experiment(
        kind=kind,
        displacement=displacement,
        angle=angle,
        amplitude=amplitude,
        from_frequency=from_frequency,
        to_frequency=to_frequency,
        duration=duration,
        hold=hold,
        rate=rate,
        noise=noise,
        force_noise=force_noise,
        markers=tuple(marker or ["tip"]),
        axes=axes,
        seed=seed,
    )
    raise typer.Exit(plan(what, model, out, fit, json))
