"""Tracks of markers from a camera or a tracker: reads, checks and writes CSV with units in the header."""

from __future__ import annotations

import csv
import dataclasses
import io
import logging
import math
import pathlib
import re

import numpy as np

from vinesim.core.errors import writing
from vinesim.core.text_files import CUT, NumberReader, Row, TextError, read_table
from vinesim.tune.specimen import TIP

log = logging.getLogger(__name__)

MIN_SAMPLES = 8
"""Smallest number of samples of a track."""
MAX_MISSING = 0.6
"""[1] Largest fraction of a column that may be missing."""
_SCALE = {"s": 1.0, "ms": 1e-3, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "N": 1.0}
_UNITS = {"time": ("s", "ms"), "force": ("N",), "position": ("m", "cm", "mm"), "base": ("m", "cm", "mm")}
_MISSING = ("", "nan", "na", "n/a")
"""Cells of gaps, in lower case."""
BASE = "base"
"""Name of the columns for the motion of the base; no marker may have this name."""
_HEADER = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]")


class TrajectoryError(ValueError):
    """Raised for a track that cannot be used. The message is one line with file, line, column, value and correction."""


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions of markers while a plant was pulled, released and swinging, or shaken at its base.

    Raises :class:`TrajectoryError` if shapes or numbers contradict each other.
    """

    time: np.ndarray
    """Times of the samples [sample] s, increasing; intervals may differ."""
    position: np.ndarray
    """Positions of the markers [sample, marker, 3] m, world axes (z up); NaN where a marker was not visible. An axis
    that was not tracked is all NaN."""
    markers: tuple[str, ...] = (TIP,)
    """Names of the markers; see :attr:`~vinesim.scene.plant_parameters.Specimen.markers`."""
    force: np.ndarray | None = None
    """Pull measured by a gauge at the tip [sample] N; NaN without a reading. None without a gauge."""
    source: str = "data"
    """Name of the source of the track, such as its file, for messages."""
    base: np.ndarray | None = None
    """Displacement of the base from its position at the first sample [sample, 3] m; the base does not rotate. None:
    the base did not move."""

    def __post_init__(self) -> None:
        count = len(self.time)
        trouble = None
        if self.position.shape != (count, len(self.markers), 3):
            trouble = f"position has the shape {self.position.shape}; give [{count}, {len(self.markers)}, 3]"
        elif self.force is not None and self.force.shape != (count,):
            trouble = f"force has the shape {self.force.shape}; give [{count}]"
        elif self.base is not None and self.base.shape != (count, 3):
            trouble = f"base has the shape {self.base.shape}; give [{count}, 3]"
        elif count < MIN_SAMPLES:
            trouble = f"{count} samples; give {MIN_SAMPLES} or more"
        elif not np.isfinite(self.time).all() or (np.diff(self.time) <= 0.0).any():
            trouble = "time does not increase; sort the samples and remove repeated ones"
        elif self.base is not None and not np.isfinite(self.base).all():
            trouble = "the motion of the base has gaps; give it at every sample"
        elif self.base is not None and self.force is not None:
            trouble = "the track has both a pull at the tip and a motion of the base; remove the columns of one"
        elif not self.tracked.any():
            trouble = "no axis of a marker was tracked; give a column such as 'x [mm]'"
        if trouble:
            raise TrajectoryError(f"{self.source}: {trouble}")

    @property
    def tracked(self) -> np.ndarray:
        """Whether each axis of each marker was tracked [marker, 3] bool."""
        return np.any(np.isfinite(self.position), axis=0)

    @property
    def column_names(self) -> list[str]:
        """Names of the tracked columns: marker and axis."""
        return [f"{self.markers[marker]} {'xyz'[axis]}" for marker, axis in np.argwhere(self.tracked)]

    @property
    def rate(self) -> float:
        """Sample rate from the median interval [1/s]."""
        return float(1.0 / np.median(np.diff(self.time)))

    def between(self, start: float, end: float) -> Trajectory:
        """Returns the samples from time ``start`` to ``end`` [s]."""
        here = (self.time >= start) & (self.time <= end)
        force = None if self.force is None else self.force[here]
        base = None if self.base is None else self.base[here]
        return dataclasses.replace(self, time=self.time[here], position=self.position[here], force=force, base=base)

    def write(self, path: str | pathlib.Path) -> None:
        """Write a CSV file for :func:`read_trajectory`, with positions in mm."""
        with writing(path):
            pathlib.Path(path).write_text(self.as_csv(), encoding="utf-8", newline="")

    def as_csv(self) -> str:
        """Returns the text of the file that :meth:`write` writes."""
        columns = [("time [s]", self.time)]
        for marker, axis in np.argwhere(self.tracked):
            name = "xyz"[axis] if self.markers[marker] == TIP else f"{self.markers[marker]} {'xyz'[axis]}"
            columns.append((f"{name} [mm]", 1e3 * self.position[:, marker, axis]))
        if self.force is not None:
            columns.append(("force [N]", self.force))
        if self.base is not None:
            columns += [(f"base {'xyz'[axis]} [mm]", 1e3 * self.base[:, axis]) for axis in _moved_axes(self.base)]
        text = io.StringIO(newline="")
        out = csv.writer(text, lineterminator="\n")
        out.writerow([name for name, _ in columns])
        for row in zip(*(values.tolist() for _, values in columns), strict=True):
            clock, *values = row  # microseconds are exact enough for times since 1970
            out.writerow([f"{round(clock, 6):.16g}", *("" if math.isnan(x) else f"{x:.6g}" for x in values)])
        return text.getvalue()


def _moved_axes(base: np.ndarray) -> list[int]:
    """Returns the axes along which a base [sample, 3] moved; the first axis if it stood still."""
    return np.flatnonzero(np.any(base != 0.0, axis=0)).tolist() or [0]


@dataclasses.dataclass(frozen=True, slots=True)
class _Column:
    kind: str
    scale: float
    marker: str = ""
    axis: int = 0


def read_trajectory(path: str | pathlib.Path) -> Trajectory:
    """Read a track from a CSV file.

    The first line names columns with units: ``time [s]``, ``x [mm]`` for the tip, ``NAME x [mm]`` for a marker, ``base
    x [mm]`` for the displacement of the base, ``force [N]``. Axes are x, y and z of the world, z up. Units are s or ms,
    and m, cm or mm, in brackets [] or (). Empty cells and ``nan`` are gaps, which are not allowed in time and base.
    Lines that begin with ``#`` are skipped. Columns may stand in any order, and be separated by commas, semicolons or
    tabs; between semicolons or tabs, decimals may have commas. If the last line has no line end, a warning is logged.

    Raises :class:`TrajectoryError` with line, column, value and correction if a line is invalid.
    """
    path = pathlib.Path(path)
    try:
        content = read_table(path)
    except FileNotFoundError:
        raise TrajectoryError(f"{path}: no such file; give the CSV file of a track") from None
    except OSError as bad:
        raise TrajectoryError(f"{path}: cannot be read: {bad.strerror}; give a CSV file") from None
    except TextError as bad:
        raise TrajectoryError(bad.at(path)) from None
    if content is None:
        raise TrajectoryError(f"{path}: is empty; give a header such as 'time [s],x [mm],z [mm]' and samples")
    columns = _read_header(path, *content.head)
    if not content.rows:
        raise TrajectoryError(f"{path}: no samples follow the header; give {MIN_SAMPLES} or more lines of numbers")
    numbers = NumberReader()
    table = np.array([_read_row(path, row, columns, content.head.cells, numbers) for row in content.rows])
    table = table.reshape(-1, len(columns))
    clock = next(i for i, column in enumerate(columns) if column.kind == "time")
    for row in range(1, len(table)):
        if not table[row, clock] > table[row - 1, clock]:
            raise TrajectoryError(
                f"{path}:{content.rows[row].line}: column {content.head.cells[clock]!r} does not increase: "
                f"{table[row, clock]:g} s after {table[row - 1, clock]:g} s; sort the lines and remove repeated ones"
            )
    if content.is_cut:
        log.warning("%s: %s", path, CUT)
    return _assemble(path, columns, table, clock)


def _assemble(path: pathlib.Path, columns: list[_Column], table: np.ndarray, clock: int) -> Trajectory:
    markers = tuple(dict.fromkeys(column.marker for column in columns if column.kind == "position"))
    position = np.full((len(table), len(markers), 3), np.nan)
    force = None
    base = np.zeros((len(table), 3)) if any(column.kind == "base" for column in columns) else None
    for i, column in enumerate(columns):
        if column.kind == "force":
            force = table[:, i]
        elif column.kind == "base" and base is not None:
            base[:, column.axis] = table[:, i]
        elif column.kind == "position":
            missing = float(np.mean(np.isnan(table[:, i])))
            if missing > MAX_MISSING:
                raise TrajectoryError(
                    f"{path}: column {column.marker} {'xyz'[column.axis]} is empty in {missing:.0%} of the lines; "
                    f"remove the column, or track it in more than {1.0 - MAX_MISSING:.0%}"
                )
            position[:, markers.index(column.marker), column.axis] = table[:, i]
    return Trajectory(table[:, clock], position, markers, force, path.name, base)


def _read_header(path: pathlib.Path, line: int, names: list[str]) -> list[_Column]:
    columns = [_read_name(f"{path}:{line}: column {i} {name!r}", name) for i, name in enumerate(names, 1)]
    seen: dict[tuple[str, str, int], int] = {}
    for i, column in enumerate(columns):
        key = (column.kind, column.marker, column.axis)
        if key in seen:
            raise TrajectoryError(f"{path}:{line}: columns {seen[key] + 1} and {i + 1} are the same; remove one")
        seen[key] = i
    kinds = [column.kind for column in columns]
    for kind, example in (("time", "time [s]"), ("position", "x [mm]")):
        if kind not in kinds:
            raise TrajectoryError(f"{path}:{line}: no column of {kind}; add one, e.g. '{example}'")
    return columns


def _read_name(place: str, text: str) -> _Column:
    found = _HEADER.fullmatch(text.strip())
    if not found and text.strip().lower() in ("frame", "frames", "picture"):
        raise TrajectoryError(f"{place} numbers pictures; divide it by the pictures a second and name it 'time [s]'")
    if not found:
        raise TrajectoryError(f"{place} has no unit; name it with its unit, e.g. 'time [s]', 'x [mm]', 'force [N]'")
    name = found["name"].strip()
    unit = found["unit"].strip()
    words = name.replace(".", " ").replace("_", " ").split()
    if name.lower() in ("time", "t"):
        kind = "time"
        marker = ""
        axis = 0
    elif name.lower() in ("force", "f"):
        kind = "force"
        marker = ""
        axis = 0
    elif len(words) == 2 and words[0].lower() == BASE and words[1].lower() in ("x", "y", "z"):
        kind = "base"
        marker = ""
        axis = "xyz".index(words[1].lower())
    elif words and words[-1].lower() in ("x", "y", "z"):
        kind = "position"
        marker = " ".join(words[:-1]) or TIP
        axis = "xyz".index(words[-1].lower())
    else:
        raise TrajectoryError(
            f"{place} is not known; name it time, x, y, z, 'MARKER x', 'base x' or force, with its unit"
        )
    if kind == "position" and unit.lower() in ("px", "pixel", "pixels"):
        raise TrajectoryError(
            f"{place}: a position in pixels; multiply it by the mm of a pixel in the plane of the swing (a ruler held "
            "there, over its pixels), let z point up, and name it [mm]"
        )
    if unit not in _UNITS[kind]:
        hint = "; a balance that shows 1 kg is pulled by 9.81 N" if unit in ("kg", "g") and kind == "force" else ""
        raise TrajectoryError(f"{place}: unit {unit!r} of a {kind}; give {' or '.join(_UNITS[kind])}{hint}")
    return _Column(kind, _SCALE[unit], marker, axis)


def _read_row(
    path: pathlib.Path, row: Row, columns: list[_Column], names: list[str], numbers: NumberReader
) -> list[float]:
    values = []
    for text, column, name in zip(row.cells, columns, names, strict=True):
        is_whole = column.kind in ("time", "base")
        if not is_whole and text.lower() in _MISSING:
            values.append(math.nan)
            continue
        try:
            values.append(numbers.read(text) * column.scale)
        except TextError as bad:
            remedy = "" if is_whole else ", or leave the cell empty where there is none"
            raise TrajectoryError(f"{path}:{row.line}: column {name!r} is {bad}{remedy}") from None
    return values
