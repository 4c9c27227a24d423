"""Plots of a fit: track with uncertainty band, residuals, held-out release, posterior with prior."""

from __future__ import annotations

import math
import pathlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vinesim.core.errors import writing
from vinesim.tune.fit import Fit
from vinesim.tune.posterior import Z90

SIZE = (11.0, 4.6)
"""[inch] Width and height of :func:`draw_fit`."""
_LABELS = {name: f"ln {name} ratio" for name in ("modulus", "damping", "mass")}
_LABELS |= {"bow_y": "bow_y [rad]", "bow_z": "bow_z [rad]"}


def plot_fit(fit: Fit, path: str | pathlib.Path) -> None:
    """Draw track, residuals and posterior into a file."""
    figure = Figure(figsize=SIZE, layout="constrained")
    draw_fit(fit, figure)
    with writing(path):
        figure.savefig(path, dpi=130)


def draw_fit(fit: Fit, figure: Figure) -> None:
    """Draw track, residuals, and posterior with prior in one figure of about :data:`SIZE`."""
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.3, 1.0])[0]
    above, below = left.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    draw_track(fit, above)
    draw_residuals(fit, below)
    count = max(fit.posterior.physical, 1)
    draw_posterior(fit, right.subplots(count, count, squeeze=False))


def strongest_column(fit: Fit) -> int:
    """Returns the index of the tracked column with the largest swing."""
    return int(np.argmax(np.nanstd(fit.model, axis=0)))


def draw_track(fit: Fit, axes: Axes, column: int | None = None) -> None:
    """Draw one column of the track, the fitted candidate, and the 90 % band from parameters and noise."""
    column = strongest_column(fit) if column is None else column
    gross = fit.features.gross[:, column]
    used = np.isfinite(fit.model) & ~fit.features.gross
    spread = np.full(fit.model.shape, np.nan)
    spread[used] = np.einsum("oi,ij,oj->o", fit.jacobian, fit.posterior.covariance, fit.jacobian)
    data = fit.track.position[:, fit.track.tracked][:, column]
    time = fit.track.time
    model = fit.model[:, column]
    half = Z90 * np.sqrt(spread[:, column] + fit.column_noise[column] ** 2)
    half[gross] = np.interp(time[gross], time[used[:, column]], half[used[:, column]])
    axes.fill_between(time, 1e3 * (model - half), 1e3 * (model + half), color="C0", alpha=0.25, lw=0, label="90 %")
    axes.plot(time, 1e3 * model, color="C0", lw=1.0, label="fitted")
    axes.plot(time[~gross], 1e3 * data[~gross], ".", color="k", ms=3.0, label="track")
    if gross.any():  # at the edge of the axes if they are far away
        low, high = axes.get_ylim()
        axes.plot(time[gross], np.clip(1e3 * data[gross], low, high), "x", color="C3", ms=6.0, label="left out")
    axes.set_ylabel(f"{fit.track.column_names[column]} [mm]")
    axes.set_title(f"{fit.frequency:.2f} Hz, damping ratio {fit.damping_ratio:.3f}", fontsize="medium")
    axes.legend(fontsize="small", loc="upper right")


def draw_residuals(fit: Fit, axes: Axes) -> None:
    """Draw the residuals of every column and the noise, without the samples that are left out."""
    off = np.where(fit.features.gross, np.nan, 1e3 * (fit.track.position[:, fit.track.tracked] - fit.model))
    for column, noise, name in zip(off.T, fit.column_noise, fit.track.column_names, strict=True):
        (dots,) = axes.plot(fit.track.time, column, ".", ms=3.0, label=name)
        for sign in (-Z90, Z90):
            axes.axhline(1e3 * sign * noise, color=dots.get_color(), lw=0.6, ls="--")
    axes.set_ylabel("residual [mm]")
    axes.set_xlabel("time [s]")
    axes.legend(fontsize="x-small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=6, frameon=False)


def draw_posterior(fit: Fit, grid: np.ndarray) -> None:
    """Draw the posterior of each pair of the plant's numbers into the axes ``grid`` [k, k], with the prior where it
    fits."""
    posterior = fit.posterior
    count = fit.posterior.physical
    names = posterior.names[:count]
    labels = [_LABELS[name] for name in names]
    deviation = posterior.deviation
    for row in range(count):
        for column in range(count):
            axes: Axes = grid[row, column]
            axes.tick_params(labelsize="x-small")
            axes.locator_params(nbins=4)
            if column > row:
                axes.set_axis_off()
                continue
            x = posterior.mean[column] + np.linspace(-4.0, 4.0, 201) * deviation[column]
            if row == column:
                prior = fit.priors[names[row]]
                axes.plot(x, _normal(x, posterior.mean[row], deviation[row]), color="C0", label="posterior")
                axes.plot(x, _normal(x, prior.mean, prior.deviation), color="C1", label="prior")
                if fit.sample is not None:
                    axes.hist(fit.sample.draws[:, row], 40, density=True, color="0.8", label="draws")
                axes.set_yticks([])
            else:
                _draw_ellipses(axes, posterior.mean, posterior.covariance, column, row)
            if row == count - 1:
                axes.set_xlabel(labels[column], fontsize="small")
            if row == column == 0:
                axes.set_title("ratio = fitted / given in the model", fontsize="x-small", loc="left")
            if column == 0 and row:
                axes.set_ylabel(labels[row], fontsize="small")
    if count:
        first: Axes = grid[0, 0]
        last: Axes = grid[0, -1]  # empty if there are two numbers or more
        last.legend(*first.get_legend_handles_labels(), fontsize="x-small", loc="center" if count > 1 else "best")


def draw_held_out(fit: Fit, held_out: Fit, axes: Axes) -> None:
    """Draw another release of the same plant, and its prediction by the fit to the first release."""
    column = strongest_column(held_out)
    axes.plot(held_out.track.time, 1e3 * held_out.model[:, column], color="C0", lw=1.0, label="fitted elsewhere")
    data = held_out.track.position[:, held_out.track.tracked][:, column]
    axes.plot(held_out.track.time, 1e3 * data, ".", color="k", ms=3.0, label="held out")
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{fit.track.column_names[column]} [mm]")
    axes.legend(fontsize="small")


def _normal(x: np.ndarray, mean: float, deviation: float) -> np.ndarray:
    if not math.isfinite(deviation):
        return np.zeros_like(x)
    return np.exp(-0.5 * ((x - mean) / deviation) ** 2) / (deviation * math.sqrt(2.0 * math.pi))


def _draw_ellipses(axes: Axes, mean: np.ndarray, covariance: np.ndarray, i: int, j: int) -> None:
    """Draw the ellipses that contain 50 % and 90 % of the probability."""
    part = covariance[np.ix_([i, j], [i, j])]
    values, vectors = np.linalg.eigh(part)
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    for share, style in ((0.5, "-"), (0.9, "--")):
        radius = math.sqrt(-2.0 * math.log(1.0 - share))
        axes.plot(mean[i] + radius * circle[0], mean[j] + radius * circle[1], style, color="C0", lw=1.0)
