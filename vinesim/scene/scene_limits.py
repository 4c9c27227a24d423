"""Limits of the numbers of a scene. They are far above what vineyards have; a number beyond them costs memory or time
without end, or is none in single precision, in which the simulation computes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

MAX_VINES = 10_000
"""Largest number of vines of a scene; a hectare has about 4,000."""
MAX_BUNCHES = 100_000
"""Largest number of bunches of a scene: the number of vines times the largest number on a vine."""
MAX_SEED = (1 << 63) - 1
"""Largest seed, as in the messages between clients."""
MAX_COORDINATE = 10_000.0
"""[m] Largest distance from the origin along an axis, at which single precision has steps of 1 mm."""
MAX_NUMBER = 1e12
"""Largest magnitude of a number without a limit of its own."""

LIMITS: dict[str, tuple[float, float, str]] = {
    "seed": (0, MAX_SEED, ""),
    "palette.seed": (0, MAX_SEED, ""),
    "layout.rows": (1, MAX_VINES, ""),
    "layout.vines": (1, MAX_VINES, ""),
    "layout.row_spacing": (0.2, 100.0, "m"),
    "layout.vine_spacing": (0.2, 100.0, "m"),
    "layout.height": (0.2, 10.0, "m"),
    "terrain.direction": (-1e3, 1e3, "rad"),
    "terrain.corner[]": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "fruit.bunches[]": (0, 1000, ""),
    "boxes[].x": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "boxes[].y": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "boxes[].yaw": (-1e3, 1e3, "rad"),
    "boxes[].size[]": (0.01, 10.0, "m"),
    "boxes[].mass": (0.001, 10_000.0, "kg"),
    "sun.azimuth": (-1e3, 1e3, "rad"),
    "wind.mean[]": (-60.0, 60.0, "m/s"),
    "wind.gusts": (0.0, 60.0, "m/s"),
    "wind.scale": (0.1, 1000.0, "m"),
    "spawns[].x": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "spawns[].y": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "spawns[].yaw": (-1e3, 1e3, "rad"),
    "imported[].x": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "imported[].y": (-MAX_COORDINATE, MAX_COORDINATE, "m"),
    "imported[].z": (-100.0, 100.0, "m"),
    "imported[].yaw": (-1e3, 1e3, "rad"),
    "imported[].tie_gap": (0.0, 1.0, "m"),
    "physics.dt": (1e-4, 0.1, "s"),
    "physics.gravity": (0.0, 1000.0, "m/s^2"),
    "physics.friction": (1e-6, 100.0, ""),
    "physics.solver_sweeps": (1, 100_000, ""),
    "physics.solver_newton_steps": (0, 100_000, ""),
    "physics.solver_newton_contacts": (0, 1024, ""),
    "physics.solver_constraint_steps": (1, 1000, ""),
}
"""Smallest value, largest value and unit of the numbers of a scene, by path; ``[]`` stands for every entry."""
LENGTHS = {"boxes": 1000, "imported": 1000, "layout.missing": MAX_VINES, "fruit.varieties": 1000}
"""Largest number of entries of lists, by path."""
_NAME = re.compile(r"(?!\.)[^\W_](?:[\w .,+()-]{0,46}[\w.+()-])?")


def find_excess(scene: dict[str, Any]) -> str:
    """Returns a message with field, value and limit if a number, list or name of a scene is beyond its limit; empty
    otherwise. ``scene``: the tables of a whole scene, with all defaults."""
    if not _NAME.fullmatch(scene["name"]):
        return (
            f"name is {scene['name'][:60]!r}; give 1 to 48 letters, digits, blanks or .,_+()-, beginning with a letter "
            "or digit: files are named after it"
        )
    for place, value in _entries(scene):
        path = re.sub(r"\[\d+\]", "[]", place)
        if isinstance(value, list):
            if len(value) > (most := LENGTHS.get(path, len(value))):
                return f"{place} has {len(value)} entries; give at most {most}"
        elif path in LIMITS:
            low, high, unit = LIMITS[path]
            if not low <= value <= high:
                return f"{place} is {_short(value)}; give {_short(low)} to {_short(high)} {unit}".rstrip()
        elif not -MAX_NUMBER <= value <= MAX_NUMBER:
            return f"{place} is {_short(value)}; give a number of at most {MAX_NUMBER:g}"
    rows, vines = (scene["layout"][name] for name in ("rows", "vines"))
    if rows * vines > MAX_VINES:
        return f"layout.rows x layout.vines is {rows} x {vines}; give at most {MAX_VINES} vines, or several scenes"
    for name, count, spacing in (
        ("rows", rows, scene["layout"]["row_spacing"]),
        ("vines", vines, scene["layout"]["vine_spacing"]),
    ):
        if count * spacing > MAX_COORDINATE:
            return f"layout.{name} reach {count * spacing:g} m; give at most {MAX_COORDINATE:g} m"
    bunches = list(scene["fruit"]["bunches"])
    if rows * vines * bunches[1] > MAX_BUNCHES:
        most = MAX_BUNCHES // (rows * vines)
        return f"fruit.bunches is {bunches}; give at most {most} on a vine: {MAX_BUNCHES} in a scene"
    return ""


def _entries(data: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every list and every number in nested tables and lists, with its path; texts, truth values and what is
    missing are left out."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield from _entries(value, f"{place}.{key}" if place else key)
    elif isinstance(data, list | tuple):
        yield place, list(data)
        for i, value in enumerate(data):
            yield from _entries(value, f"{place}[{i}]")
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield place, data


def _short(value: float) -> str:
    """Returns a number as text; a whole number may have thousands of digits."""
    if isinstance(value, float):
        return f"{value:.10g}"
    return str(value) if value.bit_length() < 65 else f"a number of {value.bit_length()} bits"
