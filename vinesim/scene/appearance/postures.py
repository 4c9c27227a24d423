"""Named postures of people from ``data/figures/postures.toml``: positions of head, hands, hips and feet."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import load_toml
from vinesim.scene.appearance.shapes import AppearanceError, Point, Table
from vinesim.scene.values import HumanPose


class Palm(Table, frozen=True):
    """Pose of a hand and its fingers."""

    at: Point
    """[m] Position of the palm."""
    along: Point
    """Direction in which the fingers point."""
    back: Point
    """Direction in which the back of the hand faces."""
    bent: tuple[float, float, float, float, float]
    """Bend of thumb, index, middle, ring and little finger, 0 to 1."""


class Posture(Table, frozen=True):
    """Positions [m] of a person's tracked points; the person faces along x, with the feet around the origin."""

    head: Point | None = None
    tilt: float = 0.0
    """Tilt of the head [rad], positive looking down."""
    hips: Point | None = None
    left: Palm | None = None
    right: Palm | None = None
    left_foot: Point | None = None
    right_foot: Point | None = None


class PostureFile(Table, frozen=True):
    height: float
    postures: dict[str, Posture]


@functools.cache
def _load_postures() -> PostureFile:
    return load_toml(find_data_file("figures", "postures", ".toml"), PostureFile, AppearanceError)


def posture_names() -> tuple[str, ...]:
    """Returns the names of the postures of :func:`apply_posture`."""
    return tuple(_load_postures().postures)


def apply_posture(standing: HumanPose, name: str, height: float) -> HumanPose:
    """Returns the pose of a person of ``height`` [m] in the posture ``name`` of ``data/figures/postures.toml``.

    ``standing``: pose of the same person standing upright. The result has the position of ``standing``, and its poses
    of points that the posture does not define. Raises :class:`AppearanceError` if there is no posture of that name.
    """
    file = _load_postures()
    if name not in file.postures:
        raise AppearanceError(f"posture {name!r} is unknown; give one of: {', '.join(file.postures)}")
    scale = height / file.height
    one = file.postures[name]
    usual = file.postures["stand"]
    points = {}
    for point in ("head", "hips", "left_foot", "right_foot"):
        if at := getattr(one, point) or getattr(usual, point):
            points[point] = frames.compose(standing.root, frames.pose(scale * np.array(at)))
    nod = frames.pose(np.zeros(3), frames.exp(np.array([0.0, one.tilt, 0.0])))
    points["head"] = frames.compose(points.get("head", standing.head), nod)
    for side in ("left", "right"):
        palm = getattr(one, side) or getattr(usual, side)
        if palm:
            turn = frames.from_x_axis(np.array(palm.along), np.array(palm.back))
            points[side] = frames.compose(standing.root, frames.pose(scale * np.array(palm.at), turn))
            points[f"{side}_fingers"] = palm.bent
    return dataclasses.replace(standing, **points)
