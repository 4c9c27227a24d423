"""Size of a robot in its home pose: the boxes around its shapes, and the links on which it stands."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.urdf import parse_origin

LARGEST = 20.0
"""[m] Length from which on a robot is probably given in a wrong unit. ``SMALLEST``: below which it is."""
SMALLEST = 0.01


STANDING_SHARE = 0.05
"""Share of a robot's height within which the lowest points of its links count as standing on the ground. GUESSED"""
LEAST_LEGS = 2
"""Number of legs from which on a robot counts as legged."""


def bounds(boxes: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Returns the lower and upper corner [2, 3] m of the box around all ``boxes`` of links; None if there are none."""
    if not boxes:
        return None
    every = np.array(list(boxes.values()))
    return np.array([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])


def feet(description: RobotDescription, boxes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns where a robot on legs touches the ground at home [3] m, in the frame of its root link, by moving link;
    empty for other robots.

    The links that reach lowest are feet if joints move all of them and at least :data:`LEAST_LEGS` do not carry another
    one. ``boxes``: boxes of its links.
    """
    box = bounds(boxes)
    if box is None:
        return {}
    reach = box[0, 2] + STANDING_SHARE * (box[1, 2] - box[0, 2])
    lowest: dict[str, list[np.ndarray]] = {}
    for link, corners in boxes.items():
        if corners[0, 2] <= reach:
            lowest.setdefault(description.link_anchors[link][0], []).append(corners)
    above = {child: parent for parent, child in description.moving_joints.frames}
    carrying = set()
    for link in lowest:
        if link not in above:
            return {}
        while link in above:
            link = description.link_anchors[above[link]][0]
            carrying.add(link)
    found = {link: np.mean(boxes, axis=(0, 1)) for link, boxes in lowest.items() if link not in carrying}
    for place in found.values():
        place[2] = box[0, 2]
    return found if len(found) >= LEAST_LEGS else {}


def link_boxes(description: RobotDescription, root: etree._Element) -> dict[str, np.ndarray]:
    """Returns the lower and upper corner [2, 3] m of the box around the shapes of each link at home, by link, in the
    frame of the root link. ``root``: XML of the robot, with the ``bounds`` of meshes."""
    poses = description.link_poses(description.home)
    found = {}
    for link in root.iterfind("link"):
        pose = poses.get(link.get("name"))
        points = []
        for shape in (*link.iterfind("visual"), *link.iterfind("collision")):
            corners = _corners(shape)
            if corners is None or pose is None:
                continue
            origin = parse_origin(shape.find("origin"))
            if origin is not None:
                corners = corners @ origin[:3, :3].T + origin[:3, 3]
            points.append(pose[:3] + frames.rotate(pose[3:], corners))
        if points:
            every = np.concatenate(points)
            found[link.get("name")] = np.array([every.min(axis=0), every.max(axis=0)])
    return found


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
