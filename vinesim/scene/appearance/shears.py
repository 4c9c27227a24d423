"""Pruning shears for a person's hand: shapes of both halves, their hinge, and the region and force of cutting."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import numpy as np

from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import load_toml
from vinesim.scene.appearance.lofts import build_shapes
from vinesim.scene.appearance.shapes import AppearanceError, Paint, Point, ShapeSpec, Table, check_spec
from vinesim.scene.values import Shape

SHEARS_PARTS = ("shears_blade", "shears_hook")
"""Link names of the halves of shears; the full name begins with the side of the hand: ``left_shears_blade``."""


class ShearsFile(Table, frozen=True):
    source: str
    bolt: Point
    """[m] Position of the hinge of both halves, in the palm's frame."""
    opening: float
    """Angle of each half from its closed position when the shears are open [rad]."""
    mouth: Point
    """[m] Middle of the space between the open blades, in the palm's frame."""
    mouth_half: Point
    """[m] Half edges of the space between the blades: along them, from one to the other, across their plane."""
    force: float
    """Largest force of the closing blades [N]."""
    speed: float
    """Speed with which the edges of the blades approach each other [m/s]."""
    blade: Literal["bypass", "anvil", "saw"]
    """How the blades cut."""
    paints: dict[str, Paint]
    parts: dict[Literal["blade", "hook"], tuple[ShapeSpec, ...]]


@dataclasses.dataclass(frozen=True, eq=False)
class ShearsModel:
    """Shapes, poses and cutting region of shears, in the frame of the palm that holds them."""

    parts: dict[str, tuple[Shape, ...]]
    """Shapes by part name, see :data:`SHEARS_PARTS`."""
    open: np.ndarray
    """Poses [2, 7] of the parts when the shears are open."""
    closed: np.ndarray
    """Poses [2, 7] of the parts when the shears are closed."""
    mouth: np.ndarray
    """Pose [7] of the box between the open blades: x along them, y from one to the other, z across their plane."""
    mouth_half: np.ndarray
    """[3] m, half edges of that box."""
    force: float
    """Largest force of the closing blades [N]."""
    speed: float
    """Speed with which the edges of the blades approach each other [m/s]."""
    blade: str
    """How the blades cut, see ``vinesim.interaction.cutting_force.BLADE_FACTORS``."""


@functools.cache
def load_shears(name: str = "shears") -> ShearsModel:
    """Returns the shears of ``data/figures``. Raises :class:`AppearanceError` if the file cannot be read."""
    path = find_data_file("figures", name, ".toml")
    file = load_toml(path, ShearsFile, AppearanceError)
    for name, value in (("force", file.force), ("speed", file.speed)):
        if not value > 0.0:
            raise AppearanceError(f"{path}: {name} is {value}; give more than 0")
    parts = {}
    for link in SHEARS_PARTS:
        half: Literal["blade", "hook"] = "blade" if link == "shears_blade" else "hook"
        if half not in file.parts:
            raise AppearanceError(f"{path}: parts has no {half}; give its shapes")
        for i, spec in enumerate(file.parts[half]):
            check_spec(file.paints, spec, f"{path}: parts.{half}[{i}]")
        parts[link] = tuple(
            shape for spec in file.parts[half] for shape in build_shapes(spec, file.paints, 1.0, mirror=False)
        )
    bolt = np.array(file.bolt)
    turned = [frames.pose(bolt, frames.from_yaw(sign * file.opening)) for sign in (1.0, -1.0)]
    return ShearsModel(
        parts=parts,
        open=np.stack(turned),
        closed=np.stack([frames.pose(bolt)] * 2),
        mouth=frames.pose(np.array(file.mouth)),
        mouth_half=np.array(file.mouth_half),
        force=file.force,
        speed=file.speed,
        blade=file.blade,
    )
