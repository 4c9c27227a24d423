"""``vinesim tune``."""

from __future__ import annotations

import importlib.util
import json
import pathlib
import sys


class ScipyMissing(RuntimeError):
    """The extra ``tune`` is not installed."""

    exit_code = 3


def require_scipy() -> None:
    """:class:`ScipyMissing` with the remedy unless scipy is installed."""
    if importlib.util.find_spec("scipy") is None:
        raise ScipyMissing("scipy is not installed; run: pip install 'vinesim[tune]'")


def run(
    data: pathlib.Path, model: pathlib.Path, fit: str, out: pathlib.Path | None, as_json: bool,
    plot: pathlib.Path | None, release: float | None, samples: int, seed: int, device: str,
) -> int:  # fmt: skip
    """Fit and print; the exit code: 0, or 5 if something speaks against the fit."""
    require_scipy()
    from vinesim.tune import load_specimen, read_trajectory, tune

    parameters = [name.strip() for name in fit.split(",") if name.strip()]
    specimen, track = load_specimen(model), read_trajectory(data)
    found = tune(specimen, track, parameters, release=release, samples=samples, seed=seed, device=device)
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
