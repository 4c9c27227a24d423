"""Plot of a contact: force on one bunch and its displacement on several clients."""

from __future__ import annotations

import pathlib

import numpy as np

from vinesim.client.recording.bunch_trace import Rows


def touch(path: pathlib.Path, traces: dict[str, Rows], title: str) -> None:
    """Draw force [N] above and displacement [mm] below against the host's clock; one line a client. Writes a PNG.

    Shaded is the time from when a client received the bunch from its owner until it did so for the last time.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (force, shift) = pyplot.subplots(2, 1, sharex=True, figsize=(9.0, 5.6), layout="constrained")
    start = min(rows.clock[0] for rows in traces.values() if len(rows.clock))
    for (name, rows), style in zip(traces.items(), ("-", "--", ":"), strict=False):
        t = rows.clock - start
        force.plot(t, np.linalg.norm(rows.force, axis=1), style, label=name, linewidth=1.1)
        shift.plot(t, 1e3 * np.linalg.norm(rows.displacement, axis=1), style, label=name, linewidth=1.4)
        followed = t[rows.is_remote]
        if len(followed):
            near = f"{name} is near: it is sent the bunch"
            for axes in (force, shift):
                axes.axvspan(followed[0], followed[-1], color="0.94", zorder=0, label=near)
    force.set_ylabel("contact force [N]")
    shift.set_ylabel("bunch moved from rest [mm]")
    shift.set_xlabel("time [s]")
    figure.suptitle(title, fontsize=10)
    force.legend(
        frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(force.get_legend_handles_labels()[0])
    )
    for axes in (force, shift):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
