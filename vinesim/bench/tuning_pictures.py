"""Tracks of ``vinesim bench tune`` from pictures: an RGB-D camera films the simulated swing, and a marker is found in
each picture.

The camera is the D435 of ``data/cameras`` with its errors. It is 0.8 m from the tip and looks across the plane of the
swing. The marker is a ball of 24 mm without mass. Pictures are sharp, without motion blur or rolling shutter. The
colour of the marker is picked in the first picture.

Or the camera films the bare cane before a wall, 0.9 m from the cane, and the cane itself is followed.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import msgspec
import numpy as np

from vinesim.bench.tuning_cases import Case
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.ids import Organ
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.values import CameraFrame, CameraOutput, RigidVisual, Shape, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.tune import Trajectory, measure
from vinesim.tune.cane_track import track_cane
from vinesim.tune.marker_track import track_marker
from vinesim.tune.specimen import TIP, build_tree

SEGMENTS = 192
"""Number of segments of the filmed chain. A chain of 64 segments swings 0.01 % too slowly, and tracks as exact as these
would show it."""
STEP = 2.5e-4
"""Step of the filmed simulation [s]. Steps of 1 ms slow the swing as much as a modulus that is 0.007 to 0.02 % too
small, which a track from pictures can resolve."""
PIECES = 16
"""Number of straight pieces of the drawn cane."""
HEIGHT = 1.2
"""[m] Height of the base above the ground."""
AWAY = 0.8
"""[m] Distance of the camera from the plane of the swing."""
RADIUS = 0.012
"""[m] Radius of the marker."""
CANE_AWAY = 0.9
"""[m] Distance of the camera from the plane of the swing of a cane without a marker."""
VIEW = 0.58
"""[1] Place of the cane at the middle of the picture, as a fraction of its length."""
WALL = (1.5, 0.02, 1.1)
"""Half sizes of the wall [m]."""
WALL_AWAY = 0.5
"""[m] Distance of the wall behind the plane of the swing."""
GREY = (0.35, 0.38, 0.42)
"""sRGB colour of the wall."""
PAINT = (0.85, 0.05, 0.35)
"""sRGB colour of the marker: a pink that no vineyard has."""


def with_nodes(specimen: Specimen, pieces: int) -> tuple[Specimen, tuple[str, ...]]:
    """Returns the specimen with markers at the ends of equal pieces, and the markers' names from the base to the
    tip."""
    names = tuple(f"node {i}" for i in range(1, pieces))
    along = {name: specimen.length.value * (i + 1) / pieces for i, name in enumerate(names)}
    return msgspec.structs.replace(specimen, markers=along), (*names, TIP)


@dataclasses.dataclass(frozen=True, slots=True)
class FilmedSwing:
    """A track from pictures, and its true error."""

    track: Trajectory
    error: np.ndarray
    """Error of the marker's position along the camera's axes right, down and forward [sample, 3] m; NaN where the
    marker was not found."""


def film(case: Case) -> FilmedSwing:
    """Film the case's swing and track the marker in the pictures."""
    specimen, true = _true_swing(case)
    tip = true.position[:, -1] + [0.0, 0.0, HEIGHT]
    middle = 0.5 * (tip.min(0) + tip.max(0))
    pose = look_at(middle - [0.0, AWAY, 0.0], middle)
    ball = Shape("sphere", (RADIUS,), frames.pose(np.zeros(3)), (*PAINT, 1.0), surface="cloth")
    pictures = _pictures(specimen, true, pose, case.experiment.seed, ball, tip)
    first = next(pictures)
    colour = _pick_colour(first, tip[0])
    track = track_marker(
        itertools.chain([first], pictures), colour, radius=RADIUS, source=f"seed {case.experiment.seed}"
    )
    off = frames.rotate(frames.conjugate(pose[3:]), track.position[:, 0] - tip)
    return FilmedSwing(track, off)


def film_cane(case: Case, percent: int = 80) -> FilmedSwing:
    """Film the case's swing without a marker, and follow the cane in the pictures."""
    specimen, true = _true_swing(case)
    share = 0.01 * percent * PIECES
    before, after = true.position[:, int(share) - 1], true.position[:, int(share)]
    point = before + (share % 1.0) * (after - before) + [0.0, 0.0, HEIGHT]
    middle = np.array([VIEW * specimen.length.value, 0.0, 0.5 * (point[:, 2].min() + point[:, 2].max())])
    pose = look_at(middle - [0.0, CANE_AWAY, 0.0], middle)
    wall = Shape("box", WALL, frames.pose(np.zeros(3)), (*GREY, 1.0), surface="cloth")
    behind = np.repeat(middle[None] + np.array([0.0, WALL_AWAY, 0.0]), len(true.time), 0)
    pictures = _pictures(specimen, true, pose, case.experiment.seed, wall, behind)
    base = np.array([0.0, 0.0, HEIGHT])
    track = track_cane(pictures, case.guess, base=base, percent=percent, source=f"seed {case.experiment.seed}")
    off = frames.rotate(frames.conjugate(pose[3:]), track.position[:, 0] - point)
    return FilmedSwing(track, off)


def _true_swing(case: Case) -> tuple[Specimen, Trajectory]:
    """Returns the specimen with a marker at the end of each piece, and the exact track of these markers."""
    specimen, names = with_nodes(case.truth, PIECES)
    fine = msgspec.structs.replace(specimen, segments=SEGMENTS)
    return specimen, measure(fine, dataclasses.replace(case.experiment, markers=names), exact=True, step=STEP)


def _pick_colour(picture: CameraFrame, point: np.ndarray) -> tuple[int, int, int]:
    """Returns the RGB colour that a user would pick in the first picture: the colour at the marker."""
    local = frames.rotate(frames.conjugate(picture.pose[3:]), point - picture.pose[:3])
    column, row = np.round(project_points(local, picture.info)).astype(int)
    red, green, blue = np.median(picture.rgb[row - 2 : row + 3, column - 2 : column + 3], (0, 1)).astype(int).tolist()
    return red, green, blue


def _pictures(
    specimen: Specimen, true: Trajectory, pose: np.ndarray, seed: int, shape: Shape, places: np.ndarray
) -> Iterator[CameraFrame]:
    """Yields the pictures that the camera takes at the times of the track: the cane, and a ``shape`` at ``places``
    [sample, 3] m."""
    model = assemble([build_tree(msgspec.structs.replace(specimen, segments=PIECES))])
    spec = CameraSpec.load("d435")
    camera = Camera(spec, spec.info("optical"), seed=seed)
    visuals = (RigidVisual("thing", Organ.ROBOT, 0, (shape,)),)
    primitives = Primitives(model, grass=0.0)
    length = specimen.length.value / PIECES
    for tick, (time, nodes) in enumerate(zip(true.time, true.position, strict=True)):
        nodes = np.vstack([np.zeros(3), nodes]) + np.array([0.0, 0.0, HEIGHT])
        turns = frames.from_x_axis(np.diff(nodes, axis=0) / length)
        primitives.update(
            Snapshot(
                time=float(time),
                tick=tick,
                body_q=np.concatenate([nodes[:-1], turns], -1),
                bunch_attached=np.ones(0, bool),
                visuals=visuals,
                visual_q=frames.pose(places[tick])[None],
                moved_trees=np.zeros(1, np.int64),
            )
        )
        yield camera.render(primitives, pose, float(time), outputs=CameraOutput.RGB | CameraOutput.DEPTH)
