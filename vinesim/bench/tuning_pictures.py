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
from vinesim.scene.values import CameraFrame, CameraInfo, CameraOutput, RigidVisual, Shape, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.tune import Trajectory, measure
from vinesim.tune.bunch_track import track_bunch
from vinesim.tune.cane_track import track_cane
from vinesim.tune.marker_track import track_marker
from vinesim.tune.specimen import TIP, base_pose, build_tree

PIECES = 40
"""Number of straight pieces of the drawn cane or peduncle. The chords of 16 pieces made the fitted damping of canes
0.03 % too high."""
CHAINS = {"cane": (48, 4e-3 / 3.0), "bunch": (16, 2e-3)}
"""Segments, and step [s], of the coarser of two simulations of a filmed swing."""
BASE = np.array([0.0, 0.0, 1.2])
"""[3] m, base of the plant above the ground."""
MARGIN = 0.1
"""[m] Distance of the edge of the pictures from the axis of the plant. Pixels beyond are not rendered."""
AWAY = 0.8
"""[m] Distance of the camera from the plane of the swing."""
RADIUS = 0.012
"""[m] Radius of the marker."""
CANE_AWAY = 0.9
"""[m] Distance of the camera from the plane of the swing of a cane without a marker."""
BUNCH_AWAY = 0.5
"""[m] Distance of the camera from the plane of the swing of a bunch."""
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
    """Returns the specimen with markers at the ends of equal pieces, and their names from the base to the tip."""
    count = pieces + 1 if specimen.organ == "bunch" else pieces
    names = tuple(f"node {i}" for i in range(1, count))
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
    swing = _true_swing(case)
    tip = swing.nodes[:, -1]
    middle = 0.5 * (tip.min(0) + tip.max(0))
    pose = look_at(middle - [0.0, AWAY, 0.0], middle)
    ball = Shape("sphere", (RADIUS,), frames.pose(np.zeros(3)), (*PAINT, 1.0), surface="cloth")
    pictures = _pictures(swing, pose, case.experiment.seed, ball, tip)
    first = next(pictures)
    colour = _pick_colour(first, tip[0])
    track = track_marker(
        itertools.chain([first], pictures), colour, radius=RADIUS, source=f"seed {case.experiment.seed}"
    )
    return _compare(track, tip, pose)


def film_cane(case: Case, percent: int = 80) -> FilmedSwing:
    """Film the case's swing without a marker, and follow the cane in the pictures."""
    swing = _true_swing(case)
    share = 0.01 * percent * PIECES
    before, after = swing.nodes[:, int(share)], swing.nodes[:, int(share) + 1]
    point = before + (share % 1.0) * (after - before)
    middle = np.array([VIEW * case.truth.length.value, 0.0, 0.5 * (point[:, 2].min() + point[:, 2].max())])
    pictures, pose = _before_wall(swing, middle, CANE_AWAY, case.experiment.seed)
    source = f"seed {case.experiment.seed}"
    return _compare(track_cane(pictures, case.guess, base=BASE, percent=percent, source=source), point, pose)


def film_bunch(case: Case) -> FilmedSwing:
    """Film the swing of a bunch without a marker, across the view, and follow the bunch in the pictures."""
    swing = _true_swing(dataclasses.replace(case, experiment=dataclasses.replace(case.experiment, angle=0.0)))
    neck, tip = swing.nodes[:, -2], swing.nodes[:, -1]
    middle = 0.5 * (swing.nodes.min((0, 1)) + swing.nodes.max((0, 1)))
    pictures, pose = _before_wall(swing, middle, BUNCH_AWAY, case.experiment.seed)
    track = track_bunch(pictures, case.guess, base=BASE, source=f"seed {case.experiment.seed}")
    along = 1e-3 * int(track.markers[0].split()[0]) - case.truth.length.value
    way = (tip - neck) / np.linalg.norm(tip - neck, axis=1, keepdims=True)
    return _compare(track, neck + along * way, pose)


def _compare(track: Trajectory, true: np.ndarray, pose: np.ndarray) -> FilmedSwing:
    """Returns the track with its error. ``true`` [sample, 3] m: the positions; ``pose`` [7]: that of the camera."""
    return FilmedSwing(track, frames.rotate(frames.conjugate(pose[3:]), track.position[:, 0] - true))


@dataclasses.dataclass(frozen=True, slots=True)
class _Swing:
    """A swing without error, with the specimen's base at :data:`BASE`."""

    specimen: Specimen
    time: np.ndarray
    nodes: np.ndarray
    """[sample, node, 3] m, the base, the ends of the drawn pieces and, of a bunch, its lower end."""


def _true_swing(case: Case) -> _Swing:
    """Returns the swing of the case, extrapolated to infinitely many segments and steps."""
    specimen, names = with_nodes(case.truth, PIECES)
    experiment = dataclasses.replace(case.experiment, markers=names)
    segments, step = CHAINS[specimen.organ]
    coarse, fine = (
        measure(specimen, experiment, exact=True, step=step / finer, segments=segments * finer) for finer in (1, 2)
    )
    path = (4.0 * fine.position - coarse.position) / 3.0  # Richardson: both errors are of second order
    return _Swing(specimen, coarse.time, BASE + np.concatenate([np.zeros_like(path[:, :1]), path], 1))


def _pick_colour(picture: CameraFrame, point: np.ndarray) -> tuple[int, int, int]:
    """Returns the RGB colour that a user would pick in the first picture: the colour at the marker."""
    local = frames.rotate(frames.conjugate(picture.pose[3:]), point - picture.pose[:3])
    column, row = np.round(project_points(local, picture.info)).astype(int)
    red, green, blue = np.median(picture.rgb[row - 2 : row + 3, column - 2 : column + 3], (0, 1)).astype(int).tolist()
    return red, green, blue


def _before_wall(swing: _Swing, middle: np.ndarray, away: float, seed: int) -> tuple[Iterator[CameraFrame], np.ndarray]:
    """Returns the pictures of a swing before a wall, and the pose [7] of the camera, which looks at ``middle`` [3] m
    from the distance ``away`` [m]."""
    pose = look_at(middle - [0.0, away, 0.0], middle)
    wall = Shape("box", WALL, frames.pose(np.zeros(3)), (*GREY, 1.0), surface="cloth")
    behind = np.repeat(middle[None] + np.array([0.0, WALL_AWAY, 0.0]), len(swing.time), 0)
    return _pictures(swing, pose, seed, wall, behind), pose


def _region(nodes: np.ndarray, pose: np.ndarray, info: CameraInfo) -> CameraInfo:
    """Returns the camera that reads only the pixels around ``nodes`` [..., 3] m, so that less is rendered."""
    local = frames.rotate(frames.conjugate(pose[3:]), nodes - pose[:3]).reshape(-1, 3)
    low, high = (
        project_points(ends, info)
        for ends in (local.min(0) - np.array([MARGIN, MARGIN, 0.0]), local.max(0) + np.array([MARGIN, MARGIN, 0.0]))
    )
    left, top = np.maximum(np.floor(low), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high) + 1, (info.width, info.height)).astype(int).tolist()
    return dataclasses.replace(info, width=right - left, height=bottom - top, cx=info.cx - left, cy=info.cy - top)


def _pictures(swing: _Swing, pose: np.ndarray, seed: int, shape: Shape, places: np.ndarray) -> Iterator[CameraFrame]:
    """Yields the pictures that the camera takes at the times of the swing: the plant, and a ``shape`` at ``places``
    [sample, 3] m."""
    model = assemble([build_tree(msgspec.structs.replace(swing.specimen, segments=PIECES))])
    spec = CameraSpec.load("d435")
    info = _region(swing.nodes, pose, spec.info("optical"))
    camera = Camera(spec, info, seed=seed, shadow_period=0.0)  # no shadow lags behind the plant
    visuals = (RigidVisual("thing", Organ.ROBOT, 0, (shape,)),)
    primitives = Primitives(model, grass=0.0)
    for tick, (time, nodes) in enumerate(zip(swing.time, swing.nodes, strict=True)):
        turns = _turns(np.diff(nodes, axis=0), base_pose(swing.specimen)[3:])
        primitives.update(
            Snapshot(
                time=float(time),
                tick=tick,
                body_q=np.concatenate([nodes[:-1], turns], -1),
                bunch_attached=np.ones(len(model.bunch_body), bool),
                visuals=visuals,
                visual_q=frames.pose(places[tick])[None],
                moved_trees=np.zeros(1, np.int64),
            )
        )
        yield camera.render(primitives, pose, float(time), outputs=CameraOutput.RGB | CameraOutput.DEPTH)


def _turns(way: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Returns the orientation ``first`` [4], turned without twist so that its x axis points along each ``way`` [n, 3]:
    [n, 4]."""
    along = frames.rotate(first, np.array([1.0, 0.0, 0.0]))
    axis = np.cross(along, way)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, way @ along)
    return frames.multiply(frames.exp(axis * (angle / np.maximum(sine, 1e-12))[:, None]), first)
