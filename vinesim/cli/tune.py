"""``vinesim tune`` and ``vinesim experiment``."""

from __future__ import annotations

import importlib.util
import json
import pathlib
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vinesim.tune.experiment import Experiment


class ScipyMissing(RuntimeError):
    """The extra ``tune`` is not installed."""

    exit_code = 3


def require_scipy() -> None:
    """:class:`ScipyMissing` with the remedy unless scipy is installed."""
    if importlib.util.find_spec("scipy") is None:
        raise ScipyMissing("scipy is not installed; run: pip install 'vinesim[tune]'")


def run(
    data: pathlib.Path, model: pathlib.Path, fit: str, out: pathlib.Path | None, as_json: bool,
    plot: pathlib.Path | None, release: float | None, push: bool, samples: int, seed: int, device: str,
) -> int:  # fmt: skip
    """Fit and print; the exit code: 0, or 5 if something speaks against the fit."""
    require_scipy()
    from vinesim.tune import load_specimen, read_trajectory, tune

    parameters = [name.strip() for name in fit.split(",") if name.strip()]
    specimen, track = load_specimen(model), read_trajectory(data)
    found = tune(specimen, track, parameters, release=release, samples=samples, seed=seed, device=device, pushed=push)
    print(json.dumps(found.as_json()) if as_json else "\n".join(found.lines()))
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


def plan(experiment: Experiment, model: pathlib.Path, out: pathlib.Path | None, fit: str, as_json: bool) -> int:
    """Write the track of an experiment and print what a fit of it would know; the exit code."""
    require_scipy()
    from vinesim.tune import load_specimen, measure
    from vinesim.tune.experiment import expected_deviations

    specimen = load_specimen(model)
    track = measure(specimen, experiment)
    target = out or pathlib.Path(f"{experiment.kind}.csv")
    track.write(target)
    parameters = [name.strip() for name in fit.split(",") if name.strip()]
    expected = expected_deviations(specimen, track, parameters, pushed=experiment.kind == "push")
    if as_json:
        print(json.dumps({"track": str(target), "samples": len(track.time), "deviation": expected}))
        return 0
    print(f"track    {target}: {len(track.time)} samples")
    for name, deviation in expected.items():
        unit = f"{1.645 * deviation:.4f} rad" if name.startswith("bow") else f"{164.5 * deviation:.2f} %"
        print(f"{name:8s} would be known to +- {unit} (90 %)")
    return 0
