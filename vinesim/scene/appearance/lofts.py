"""Builds shapes from their descriptions: lofts (meshes through rings), other kinds of shape, smooth normals."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.scene.appearance.shapes import Paint, ShapeSpec, rod_shape, surface_fields
from vinesim.scene.values import Mesh, Shape


def build_shapes(spec: ShapeSpec, paints: dict[str, Paint], scale: float, mirror: bool) -> list[Shape]:
    """Returns the shapes of one description: one shape, or for a loft a mesh for each paint. With ``twin`` the mirrored
    shapes follow.

    ``scale`` [1] multiplies all lengths. ``mirror``: whether the shapes are mirrored to the other side (y).
    """
    sides = (False, True) if spec.twin else (mirror,)
    if spec.kind == "loft":
        return [shape for side in sides for shape in loft_shapes(spec, paints, scale, side)]
    assert isinstance(spec.paint, str)
    paint = paints[spec.paint]
    found = []
    for side in sides:
        over = np.array([1.0, -1.0 if side else 1.0, 1.0])
        if spec.kind in ("cone", "cylinder"):
            start, end = (tuple(over * point) for point in (spec.start, spec.end))
            found.append(rod_shape(start, end, spec.radius, scale, paint, spec.kind))
        else:
            turn = frames.exp(np.array(spec.turn) * [over[1], 1.0, over[1]])
            pose = frames.pose(scale * over * spec.at, turn)
            found.append(Shape(spec.kind, tuple(scale * h for h in spec.half), pose, *surface_fields(paint)))
    return found


def loft_shapes(spec: ShapeSpec, paints: dict[str, Paint], scale: float, mirror: bool) -> list[Shape]:
    """Returns the meshes through the rings of a loft, one for each paint. Whole rings have lids at both ends."""
    place, rear, front, wide, aside = np.array([(*ring, 0.0)[:5] for ring in spec.rings]).T
    whole = spec.arc[1] - spec.arc[0] >= 360.0
    first, last = (np.radians(arc) for arc in (spec.arc, spec.arc_end or spec.arc))
    widest = max(first[1] - first[0], last[1] - last[0])
    steps = spec.sides if whole else max(int(np.ceil(spec.sides * widest / (2.0 * np.pi))), 1)
    up = np.linspace(0.0, 1.0, len(place))[:, None]
    around = np.arange(steps + (not whole)) / steps
    low, high = (first[k] * (1.0 - up) + last[k] * up for k in (0, 1))
    angle = low + (high - low) * around
    bow = np.stack([np.cos(angle), np.sin(angle)])
    bow = np.sign(bow) * np.abs(bow) ** (2.0 / spec.square)
    deep = 0.5 * (front - rear) + spec.swell
    ahead = 0.5 * (front + rear)[:, None] + deep[:, None] * bow[0]
    left = aside[:, None] + (wide + spec.swell)[:, None] * bow[1]
    axis = np.broadcast_to(place[:, None], ahead.shape)
    # x ahead, y left, z along; for a limb, whose axis is x, the front is z and the ring order is reversed
    points = np.stack([ahead, left, axis] if spec.along == "z" else [axis, left, ahead], -1)
    reverse = spec.along == "x"
    if mirror:
        points = points * [1.0, -1.0, 1.0]
        reverse = not reverse
    count = len(around)
    vertices = scale * points.reshape(-1, 3)
    i = np.arange(count if whole else count - 1)
    j = (i + 1) % count
    paint = [spec.paint] * (len(place) - 1) if isinstance(spec.paint, str) else list(spec.paint)
    strips: dict[str, list[np.ndarray]] = {name: [] for name in paint}
    for k, name in enumerate(paint):
        a = count * k + i
        b = count * k + j
        strips[name] += [np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)]
    if whole:
        middles = scale * points[[0, -1]].mean(1)
        top = count * (len(place) - 1)
        strips[paint[0]].append(np.stack([j, i, np.full(count, len(vertices))], 1))
        strips[paint[-1]].append(np.stack([top + i, top + j, np.full(count, len(vertices) + 1)], 1))
        vertices = np.concatenate([vertices, middles])
    every = np.concatenate([face for faces in strips.values() for face in faces])
    every = every[:, ::-1] if reverse else every
    ends = np.cumsum([sum(map(len, faces)) for faces in strips.values()])[:-1]
    meshes = zip(strips, np.split(vertices[every], ends), np.split(smooth_normals(vertices, every), ends), strict=True)
    return [
        Shape("mesh", (1.0,), frames.pose(np.zeros(3)), *surface_fields(paints[name]), Mesh(corners, normals))
        for name, corners, normals in meshes
    ]


CREASE_ANGLE = np.radians(50.0)
"""Angle [rad] between adjacent faces above which they form an edge. Below it they form one smooth surface."""


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, crease: float = float(CREASE_ANGLE)) -> np.ndarray:
    """Returns the unit normals [face, 3, 3] at the corners of a mesh: the area-weighted mean over the faces around each
    corner.

    Args:
        vertices: [vertex, 3] m.
        faces: [face, 3] indices, counter-clockwise from outside.
        crease: faces at a larger angle [rad] to each other are not averaged.
    """
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = frames.normalize(area + 1e-30)
    _, spot = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    at = spot.reshape(-1)[faces.ravel()]
    order = np.argsort(at, kind="stable")
    first = np.searchsorted(at[order], at, "left")
    size = np.searchsorted(at[order], at, "right") - first
    mine = np.repeat(np.arange(len(at)), size)
    other = order[np.repeat(first - (np.cumsum(size) - size), size) + np.arange(len(mine))] // 3
    near = (unit[mine // 3] * unit[other]).sum(1) > np.cos(crease)
    total = np.stack([np.bincount(mine[near], area[other[near], k], len(at)) for k in range(3)], 1)
    lost = np.linalg.norm(total, axis=1) < 1e-14
    total[lost] = unit[np.flatnonzero(lost) // 3]
    return frames.normalize(total).reshape(-1, 3, 3)
