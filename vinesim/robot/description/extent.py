"""Size of a robot: the box around its shapes in its home pose."""

from __future__ import annotations

import itertools

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.urdf import parse_origin

LARGEST = 20.0
"""[m] Length from which on a robot is probably given in a wrong unit. ``SMALLEST``: below which it is."""
SMALLEST = 0.01


def bounds(description: RobotDescription, root: etree._Element) -> np.ndarray | None:
    """Returns the lower and upper corner [2, 3] m of the box around all shapes of a robot at home, in the frame of its
    root link; None if it has no shapes. ``root``: XML of the robot, with the ``bounds`` of meshes."""
    poses = description.link_poses(description.home)
    points = []
    for link in root.iterfind("link"):
        pose = poses.get(link.get("name"))
        for shape in (*link.iterfind("visual"), *link.iterfind("collision")):
            corners = _corners(shape)
            if corners is None or pose is None:
                continue
            origin = parse_origin(shape.find("origin"))
            if origin is not None:
                corners = corners @ origin[:3, :3].T + origin[:3, 3]
            points.append(pose[:3] + frames.rotate(pose[3:], corners))
    if not points:
        return None
    every = np.concatenate(points)
    return np.array([every.min(axis=0), every.max(axis=0)])


def size_warning(box: np.ndarray) -> str | None:
    """Returns a warning about a robot whose ``bounds`` are too large or too small to be true; None if they are not."""
    largest = float((box[1] - box[0]).max())
    if SMALLEST <= largest <= LARGEST:
        return None
    size = f"{largest:.3g} m" if largest > 1.0 else f"{1e3 * largest:.3g} mm"
    return f"it is {size} large, as if its meshes were in another unit (check scale, and the unit of Collada files)"


def _corners(shape: etree._Element) -> np.ndarray | None:
    """Returns the corners [8, 3] m of the box around a shape, in the frame of the shape."""
    form = next(iter(shape.find("geometry")), None) if shape.find("geometry") is not None else None
    if form is None:
        return None
    if form.tag == "mesh":
        if form.get("bounds") is None:
            return None
        scale = np.array([float(word) for word in (form.get("scale") or "1 1 1").split()])
        low, high = np.array([float(word) for word in form.get("bounds").split()]).reshape(2, 3) * scale
    else:
        if form.tag == "box":
            half = 0.5 * np.array([float(word) for word in form.get("size").split()])
        else:
            radius = float(form.get("radius"))
            length = float(form.get("length", 2.0 * radius))
            half = np.array([radius, radius, 0.5 * length + (radius if form.tag == "capsule" else 0.0)])
        low, high = -half, half
    return np.array(list(itertools.product(*zip(low, high, strict=True))))
