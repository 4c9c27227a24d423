"""``vinesim tune``, ``vinesim track`` and ``vinesim experiment``."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import pathlib
import sys
from typing import TYPE_CHECKING

from vinesim.core.errors import UsageError, require_place, writing

if TYPE_CHECKING:
    from vinesim.tune.experiment import Experiment


LEAST_CHROMA = 0.2
"""Smallest accepted chroma of a marker's colour [1]: largest minus smallest of red, green and blue, divided by the
largest."""


class ScipyMissing(RuntimeError):
    """The extra ``tune`` is not installed."""

    exit_code = 3


def require_scipy() -> None:
    """Raise :class:`ScipyMissing`, with a remedy, unless scipy is installed."""
    if importlib.util.find_spec("scipy") is None:
        raise ScipyMissing("scipy is not installed; run: pip install 'vinesim[tune]'")


def run(
    data: pathlib.Path,
    model: pathlib.Path,
    fit: str,
    out: pathlib.Path | None,
    as_json: bool,
    plot: pathlib.Path | None,
    release: float | None,
    push: bool,
    samples: int,
    seed: int,
    device: str,
    cloud: pathlib.Path | None = None,
    truth: pathlib.Path | None = None,
) -> int:
    """Fit and print the result. Returns the exit code: 0, or 5 if the fit has a fault."""
    require_scipy()
    from vinesim.tune import load_specimen, read_trajectory, tune, with_cloud

    if out is not None:
        require_place("--out", out)
    if plot is not None:
        require_place("--plot", plot)
        _require_picture("--plot", plot)
    parameters = [name.strip() for name in fit.split(",") if name.strip()]
    specimen = load_specimen(model)
    hidden = None if truth is None else load_specimen(truth)
    if hidden is not None and hidden.organ != specimen.organ:
        raise UsageError(
            f"--truth {truth} is a {hidden.organ}, --model {model} a {specimen.organ}; give the same plant"
        )
    track = read_trajectory(data)
    if cloud is not None:
        specimen = with_cloud(specimen, cloud)
    found = tune(specimen, track, parameters, release=release, samples=samples, seed=seed, device=device, pushed=push)
    compared = [] if hidden is None else found.compare(hidden)
    if as_json:
        more = {} if hidden is None else {"truth": [dataclasses.asdict(one) for one in compared]}
        print(json.dumps(found.as_json() | more))
    else:
        print("\n".join([*found.lines(), *(one.line() for one in compared)]))
    if plot is not None:
        from vinesim.tune.plots import plot_fit

        plot_fit(found, plot)
    if not found.ok:
        if as_json:
            print(f"vinesim: the fit failed: {'; '.join(found.faults)}", file=sys.stderr)
        return 5
    if out is not None:
        found.write_plant(out)
    return 0


def _require_picture(option: str, path: pathlib.Path) -> None:
    """Raise :class:`UsageError` unless matplotlib writes files with the suffix of ``path``."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in known:  # matplotlib adds .png where there is none
        raise UsageError(f"{option} is {path}; give a file with the suffix .png, .pdf or .svg")


def track(
    recording: pathlib.Path,
    markers: list[str],
    radius: float | None,
    out: pathlib.Path,
    image: str | None,
    depth: str | None,
    pose: tuple[float, ...] | None,
    rate: float | None,
    cane: pathlib.Path | None = None,
    base: tuple[float, float, float] | None = None,
    percent: int = 80,
) -> int:
    """Write the track of markers, or of a bare cane, in recorded pictures, and print how often each was found. Returns
    the exit code."""
    require_scipy()
    import numpy as np

    from vinesim.sensors.recorded_pictures import read_pictures
    from vinesim.tune import load_specimen, track_cane, track_marker

    if cane is None and (not markers or radius is None or base is not None):
        raise UsageError("give --marker and --radius of coloured balls, or --cane and --base of a cane without balls")
    if cane is not None and (markers or radius is not None or base is None):
        raise UsageError(f"--cane {cane} is followed without balls; give --base X Y Z, and no --marker or --radius")
    if radius is not None and not radius > 0.0:
        raise UsageError(f"--radius is {radius:g}; give the ball's radius in metres, above 0")
    if rate is not None and not rate > 0.0:
        raise UsageError(f"--rate is {rate:g}; give pictures a second, above 0")
    where = None
    if pose is not None:
        where = np.array(pose)
        size = float(np.linalg.norm(where[3:]))
        if not abs(size - 1.0) < 0.01:
            raise UsageError(f"--pose ends with a quaternion of length {size:.3g}; give x y z and qx qy qz qw")
        where[3:] /= size
    colours = dict(_read_marker(text) for text in markers)
    pictures = read_pictures(recording, image=image, depth=depth, pose=where, rate=rate)
    if cane is not None and base is not None:
        specimen = load_specimen(cane)
        found = track_cane(pictures, specimen, base=np.array(base), percent=percent, source=recording.name)
    else:
        found = track_marker(pictures, colours, radius=radius or 0.0, source=recording.name)
    found = dataclasses.replace(found, time=found.time - found.time[0])
    found.write(out)
    print(f"track    {out}: {len(found.time)} pictures in {found.time[-1]:.2f} s")
    for name, places in zip(found.markers, found.position.swapaxes(0, 1), strict=True):
        seen = np.isfinite(places).all(1)
        low = 1e3 * np.nanmin(places, 0)
        high = 1e3 * np.nanmax(places, 0)
        spans = ", ".join(f"{axis} {b - a:.0f} mm" for axis, a, b in zip("xyz", low, high, strict=True))
        print(f"{name:8s} found in {seen.sum()}, the others are gaps; moved over {spans}")
    return 0


def _read_marker(text: str) -> tuple[str, tuple[int, int, int]]:
    """Returns name and colour of ``R,G,B`` (the marker at the tip) or ``NAME=R,G,B``."""
    name, _, colour = text.rpartition("=")
    parts = colour.split(",")
    if len(parts) != 3 or not all(part.strip().isdigit() and int(part) < 256 for part in parts):
        raise UsageError(f"--marker is {text!r}; give its colour in a picture as R,G,B of 0 to 255, e.g. 224,60,130")
    red, green, blue = (int(part) for part in parts)
    if max(red, green, blue) - min(red, green, blue) < LEAST_CHROMA * max(red, green, blue):
        raise UsageError(f"--marker is {text!r}, nearly grey; use a marker with a colour that nothing else has")
    return name.strip() or "tip", (red, green, blue)


def plan(
    experiment: Experiment,
    model: pathlib.Path,
    out: pathlib.Path | None,
    fit: str,
    as_json: bool,
    hidden: pathlib.Path | None = None,
) -> int:
    """Write the track of an experiment and print how exact a fit to it would be. Returns the exit code.

    ``hidden``: file for the truth, a specimen that is drawn from the seed; None: the truth is the model.
    """
    require_scipy()
    from vinesim.sensors.export.files import write_files
    from vinesim.tune import hidden_specimen, load_specimen, measure
    from vinesim.tune.experiment import expected_deviations
    from vinesim.tune.fit import specimen_toml

    experiment.check()
    target = out or pathlib.Path(f"{experiment.kind}.csv")
    places = {"--model": model, "--out": target} | ({} if hidden is None else {"--hidden": hidden})
    for option, path in list(places.items())[1:]:
        require_place(option, path)
        if path.exists() and not path.is_file():
            raise UsageError(f"{option} {path} is a device or a pipe, which cannot be replaced; give a file")
        for other, used in places.items():
            if other != option and used.resolve() == path.resolve():
                raise UsageError(f"{option} and {other} are the same file {path}; give different ones")
    specimen = load_specimen(model)
    if hidden is not None:
        specimen = hidden_specimen(specimen, experiment.seed)
    track = measure(specimen, experiment)
    parameters = [name.strip() for name in fit.split(",") if name.strip()]
    expected = expected_deviations(specimen, track, parameters, pushed=experiment.kind == "push")
    files = {target: [track.as_csv().encode()]}
    if hidden is not None:
        files[hidden] = [specimen_toml(specimen).encode()]
    replaced = {path: "; an earlier file was replaced" if path.exists() else "" for path in files}
    with writing(" and ".join(map(str, files))):
        write_files(files)
    if as_json:
        print(json.dumps({"track": str(target), "samples": len(track.time), "deviation": expected}))
        return 0
    print(f"track    {target}: {len(track.time)} samples{replaced[target]}")
    if hidden is not None:
        print(f"truth    {hidden}: drawn from seed {experiment.seed}; for --truth of vinesim tune{replaced[hidden]}")
    for name, deviation in expected.items():
        unit = f"{1.645 * deviation:.4f} rad" if name.startswith("bow") else f"{164.5 * deviation:.2f} %"
        print(f"{name:8s} would be known to +- {unit} (90 %)")
    return 0
