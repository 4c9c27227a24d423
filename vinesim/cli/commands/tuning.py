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
        str,
        typer.Option(
            help="Quantities to fit, separated by commas: modulus, damping, mass (needs a force), rest (the shape)."
        ),
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
    release: Annotated[
        float | None, typer.Option(help="Time of the release [s]; by default found in the track.")
    ] = None,
    push: Annotated[bool, typer.Option("--push", help="The track is of a push: a steady force begins.")] = False,
    samples: Annotated[
        int,
        typer.Option(min=0, max=100_000, help="Number of candidates to draw from the posterior; all are simulated."),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of these draws.")] = 0,
    device: Device = "cpu",
    truth: Annotated[
        pathlib.Path | None,
        typer.Option(help="The true plant of a simulated experiment (its --hidden); printed beside the estimates."),
    ] = None,
) -> None:
    """Fit a cane, or a bunch on its peduncle, to the track of a pull and release, a push, or a shaken base.

    Prints modulus, damping and the other fitted quantities with 90 % intervals, directions that the data do not
    determine, and faults of the fit. With a fault the exit code is 5, and --out is not written. Places that cannot be
    written are refused before the fit, with exit code 2. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim tune pull.csv --model cane.toml
      vinesim tune pull.csv --model cane.toml --fit modulus,damping,mass --out fitted.toml --plot fit.png
      vinesim tune swing.csv --model bunch.toml --release 0.4 --samples 2000 --json
    """
    from vinesim.cli.tune import run

    raise typer.Exit(run(data, model, fit, out, json, plot, release, push, samples, seed, device, cloud, truth))


def track(
    recording: Annotated[
        pathlib.Path,
        typer.Argument(help="MCAP or SQLite file of ROS topics, rosbag2 folder, or data set of vinesim dataset."),
    ],
    marker: Annotated[
        list[str] | None,
        typer.Option(
            help="Colour R,G,B of the ball at the tip in a picture; NAME=R,G,B for another ball. May be repeated."
        ),
    ] = None,
    radius: Annotated[float | None, typer.Option(help="Radius of the balls [m].")] = None,
    cane: Annotated[
        pathlib.Path | None,
        typer.Option(help="Without balls: the file of this cane, a table [specimen]; the cane itself is followed."),
    ] = None,
    bunch: Annotated[
        pathlib.Path | None,
        typer.Option(help="Without balls: the file of this bunch, a table [specimen]; the bunch itself is followed."),
    ] = None,
    base: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="With --cane or --bunch: X Y Z of its clamp in the world [m]."),
    ] = None,
    percent: Annotated[
        int, typer.Option(min=20, max=97, help="With --cane: place of the tracked point, of the cane's length [%].")
    ] = 80,
    out: Annotated[pathlib.Path, typer.Option(help="The CSV to write, for vinesim tune.")] = pathlib.Path("track.csv"),
    image: Annotated[
        str | None,
        typer.Option(help="Topic of the colour pictures; by default the topic with rgb or color in its name."),
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="Topic of the aligned depth; by default the topic with depth in its name.")
    ] = None,
    pose: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        typer.Option(
            help="Pose of the optical frame in the world, X Y Z QX QY QZ QW; by default level, looking along y."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Pictures a second, for a data set whose records have no time.")
    ] = None,
) -> None:
    """Track coloured balls, a bare cane or a bunch through recorded RGB-D pictures, into a CSV for vinesim tune.

    No ROS is needed. Pictures in which the ball or that part of the cane is hidden are gaps. Needs scipy (extra: tune).

    \b
    Examples:
      vinesim track pull.mcap --marker 224,60,130 --radius 0.012 --out pull.csv
      vinesim track pull.mcap --marker 224,60,130 --marker middle=30,90,220 --radius 0.012
      vinesim track pull.mcap --cane cane.toml --base -0.5 0.9 0
      vinesim track swing.mcap --bunch bunch.toml --base 0 0.5 0.1
      vinesim track pull/ --image /camera/color/image_raw --depth /camera/aligned_depth_to_color/image_raw \\
        --marker 224,60,130 --radius 0.012
    """
    from vinesim.cli.tune import track

    raise typer.Exit(track(recording, marker or [], radius, out, image, depth, pose, rate, cane, base, percent, bunch))


def experiment(
    kind: Annotated[
        str,
        typer.Argument(
            help="pull-release: held aside, then let go. push: a steady force begins. shake: the base moves in a sweep."
        ),
    ],
    model: Model,
    out: Annotated[pathlib.Path | None, typer.Option(help="CSV file for the track; by default KIND.csv.")] = None,
    displacement: Annotated[
        float | None, typer.Option(help="Displacement of the tip by the pull or the push [m]; by default 0.1.")
    ] = None,
    angle: Annotated[
        float, typer.Option(help="Direction of force or shaking: angle about the base's x axis, from its y axis [deg].")
    ] = 90.0,
    amplitude: Annotated[float | None, typer.Option(help="Amplitude of a shaken base [m]; by default 0.005.")] = None,
    from_frequency: Annotated[
        float | None, typer.Option("--from", help="Frequency at the start of the sweep [Hz]; by default 1.")
    ] = None,
    to_frequency: Annotated[
        float | None, typer.Option("--to", help="Frequency at the end of the sweep [Hz]; by default 8.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(help="Duration of the track after the release [s], by default 3; or of the sweep, by default 10."),
    ] = None,
    hold: Annotated[float, typer.Option(help="Duration of the track before the release or the sweep [s].")] = 0.2,
    rate: Annotated[float, typer.Option(help="Pictures a second.")] = 30.0,
    noise: Annotated[float, typer.Option(help="Standard deviation of a tracked position [m].")] = 0.002,
    force_noise: Annotated[
        float | None,
        typer.Option(
            help="Relative standard deviation of a force gauge, such as 0.01; by default no force is measured."
        ),
    ] = None,
    marker: Annotated[list[str] | None, typer.Option(help="tip, or one of specimen.markers; may be repeated.")] = None,
    axes: Annotated[str, typer.Option(help="Axes of the world that are tracked.")] = "xyz",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    fit: Annotated[str, typer.Option(help="Quantities to fit; see vinesim tune.")] = "modulus,damping",
    hidden: Annotated[
        pathlib.Path | None,
        typer.Option(
            help="Draw the true modulus and damping from the seed, half to twice the model's, and write them here."
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Simulate a measurement in a laboratory, with noise, and print how well a fit to it would do.

    For the planning of experiments: how long to film, how fast, with or without a force gauge. Needs scipy (extra:
    tune).

    \b
    Examples:
      vinesim experiment pull-release --model examples/cane.toml
      vinesim experiment pull-release --model examples/cane.toml --rate 120 --duration 2 --axes z
      vinesim experiment pull-release --model examples/cane.toml --force-noise 0.01 --fit modulus,damping,mass
      vinesim experiment pull-release --model examples/cane.toml --seed 7 --hidden truth.toml
      vinesim experiment push --model examples/cane.toml --out push.csv
      vinesim experiment shake --model examples/cane.toml --amplitude 0.003 --from 2 --to 6 --rate 60
    """
    from vinesim.cli.tune import plan, require_scipy

    require_scipy()
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
    raise typer.Exit(plan(what, model, out, fit, json, hidden))
