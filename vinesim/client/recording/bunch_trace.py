"""Records force on one bunch and its displacement in every step on one client, as evidence of a contact."""

from __future__ import annotations

import dataclasses
import pathlib
import time

import numpy as np

from vinesim.scene.model import Model


class Trace:
    """Force on one bunch and its displacement. Rows are written into preallocated arrays."""

    def __init__(self, model: Model, bunch: int, rest_q: np.ndarray, capacity: int) -> None:
        """``rest_q`` [7]: pose of the bunch's body before the contact; ``capacity``: rows."""
        self.bunch = bunch
        self.body = int(model.bunch_body[bunch])
        clusters = int(model.bunch_cluster[bunch]) + np.arange(model.bunch_clusters[bunch])
        self.bodies = frozenset([self.body, *clusters.tolist()])
        """Indices of the bodies of the bunch and of its berry clusters, which hands may touch."""
        self._com = np.array([0.5 * float(model.bunch_length[bunch]), 0.0, 0.0])
        self._rest = self._centre(rest_q)
        # filled instead of np.zeros, so that all memory pages exist from the start and a run's memory does not grow
        self._clock = np.full(capacity, 0.0)
        self._time = np.full(capacity, 0.0)
        self._force = np.full((capacity, 3), 0.0)
        self._position = np.full((capacity, 3), 0.0)
        self._is_remote = np.full(capacity, False)
        self.length = 0

    def _centre(self, pose: np.ndarray) -> np.ndarray:
        x, y, z, w = pose[3:]
        # only the body's x axis, which is cheaper than a general rotation
        axis = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
        return pose[:3] + axis * self._com[0]

    def add(self, sim_time: float, pose: np.ndarray, force: np.ndarray, is_remote: bool = False) -> None:
        """Add a row: pose [7] after a tick, and force [3] N on the bunch during the tick.

        ``is_remote``: another client owned the bunch, and its states were applied.
        """
        if self.length == len(self._clock):
            return
        row = self.length
        self._clock[row] = time.monotonic()
        self._time[row] = sim_time
        self._position[row] = self._centre(pose)
        self._force[row] = force
        self._is_remote[row] = is_remote
        self.length += 1

    def centre(self) -> np.ndarray:
        """Position [3] m of the bunch's centre in the newest row, or at rest without rows."""
        return self._position[self.length - 1].copy() if self.length else self._rest.copy()

    @property
    def displacement(self) -> float:
        """Distance of the bunch from its position at rest, in the newest row [m]."""
        return float(np.linalg.norm(self._position[self.length - 1] - self._rest)) if self.length else 0.0

    def rows(self) -> Rows:
        """Returns all rows so far."""
        n = self.length
        return Rows(
            self._clock[:n], self._time[:n], self._position[:n] - self._rest, self._force[:n], self._is_remote[:n]
        )


@dataclasses.dataclass(frozen=True)
class Rows:
    """A trace as arrays with one row for each step."""

    clock: np.ndarray
    """Time of each row on the host's monotonic clock, which processes of one host share [tick] s."""
    time: np.ndarray
    """Simulation time of the client in each row [tick] s."""
    displacement: np.ndarray
    """Displacement of the bunch's centre from rest [tick, 3] m."""
    force: np.ndarray
    """Force on the bunch [tick, 3] N."""
    is_remote: np.ndarray
    """Whether another client owned the bunch and that client's states were applied [tick] bool."""

    def save(self, path: pathlib.Path) -> None:
        """Write the rows as an .npz file."""
        np.savez_compressed(path, **dataclasses.asdict(self))

    @classmethod
    def load(cls, path: pathlib.Path) -> Rows:
        """Read a file written by :meth:`save`."""
        with np.load(path) as data:
            return cls(**{field.name: data[field.name] for field in dataclasses.fields(cls)})


MOVED = 1e-6
"""Distance of a bunch's centre from its position before a touch from which on the bunch counts as moved [m]."""


def touch_to_motion(rows: Rows) -> int | None:
    """Returns the number of ticks from the first tick with a force to the first tick with motion; 0 if they are the
    same tick.

    None if the bunch was not touched, or never moved (D6.4 section 2.1 asks for a direct response; F03).
    """
    touched = np.flatnonzero(np.linalg.norm(rows.force, axis=1) > 0.0)
    if not len(touched):
        return None
    first = int(touched[0])
    before = rows.displacement[max(first - 1, 0)]
    moved = np.flatnonzero(np.linalg.norm(rows.displacement[first:] - before, axis=1) > MOVED)
    return int(moved[0]) if len(moved) else None


def remote_error(local: Rows, remote: Rows, threshold: float = 0.002) -> dict[str, float] | None:
    """Returns the distance of the remote copy of a bunch from the owner's bunch at equal times of the host's clock
    [mm].

    The distance is evaluated at times at which the owner's bunch was displaced by more than ``threshold`` [m] and the
    other client received its states. It includes the effect of the network's delay. None if there are no such times.
    """
    if len(remote.clock) < 2:
        return None
    after = np.clip(np.searchsorted(remote.clock, local.clock), 1, len(remote.clock) - 1)
    common = (local.clock >= remote.clock[0]) & (local.clock <= remote.clock[-1])
    common &= remote.is_remote[after] & remote.is_remote[after - 1]
    common &= np.linalg.norm(local.displacement, axis=1) > threshold
    if not common.any():
        return None
    at = local.clock[common]
    seen = np.stack([np.interp(at, remote.clock, remote.displacement[:, k]) for k in range(3)], -1)
    error = 1e3 * np.linalg.norm(seen - local.displacement[common], axis=1)
    return {
        "p50": float(np.percentile(error, 50)),
        "p95": float(np.percentile(error, 95)),
        "max": float(error.max()),
        "seconds": float(common.sum() * np.median(np.diff(local.clock))),
        "peak_displacement": 1e3 * float(np.linalg.norm(local.displacement[common], axis=1).max()),
    }


# Plot of a contact: force on one bunch and its displacement on several clients.


def touch(path: pathlib.Path, traces: dict[str, Rows], title: str) -> None:
    """Plot force [N] and displacement [mm] of a bunch against the host's clock into a PNG file, with one line for each
    client.

    Shading shows the time from the first to the last state that a client received from the owner of the bunch.
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
            near = f"{name} is near and receives the bunch's states"
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
