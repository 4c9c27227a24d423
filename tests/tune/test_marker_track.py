"""Tracks from pictures: a ball of one colour is found where it is, by a fifth of a pixel, and gaps are gaps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.values import CameraFrame
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.tune import TrajectoryError, track_marker

RADIUS = 0.012
PINK = (0.85, 0.05, 0.35)
EYE = look_at(np.array([0.0, -0.8, 1.2]), np.array([0.0, 0.0, 1.2]))
D435 = CameraSpec.load("d435")


def film(centres: np.ndarray, camera: Camera, decoy: float = 0.5 * RADIUS) -> list[CameraFrame]:
    """Pictures, 0.1 s apart, of a pink ball at centres [picture, 3] m and of a second, smaller one."""
    ball, other = (
        sensor_scenes.thing(
            sensor_scenes.shape("sphere", r, rgba=(*PINK, 1.0), surface="cloth"), name=f"ball {r}", index=i
        )
        for i, r in enumerate((RADIUS, decoy))
    )
    pictures = []
    primitives, view = sensor_scenes.world(ball, other)
    for i, centre in enumerate(centres):
        poses = frames.pose(np.array([centre, [0.2, 0.1, 1.4]]), np.tile(frames.IDENTITY, (2, 1)))
        primitives.update(dataclasses.replace(view, visual_q=poses))
        pictures.append(camera.render(primitives, EYE, 0.1 * i))
    return pictures


def places(count: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.uniform([-0.2, -0.1, 1.05], [0.1, 0.1, 1.35], (count, 3))


def colour_at(picture: CameraFrame, point: np.ndarray) -> tuple[int, int, int]:
    column, row = np.round(project_points(to_camera(picture, point), picture.info)).astype(int)
    red, green, blue = picture.rgb[row, column].tolist()
    return red, green, blue


def to_camera(picture: CameraFrame, points: np.ndarray) -> np.ndarray:
    return frames.rotate(frames.conjugate(picture.pose[3:]), points - picture.pose[:3])


@pytest.mark.long
@pytest.mark.parametrize(
    "distortion",
    [
        pytest.param((), id="a pinhole", marks=pytest.mark.long),
        pytest.param((0.12, -0.25, 0.001, -0.0005, 0.05), id="a lens that distorts"),
    ],
)
def test_the_ball_of_a_d435_is_found_within_a_fifth_of_a_pixel_and_the_errors_of_its_depth(distortion) -> None:
    centres = places(24)
    info = dataclasses.replace(D435.info("optical"), distortion=distortion)
    pictures = film(centres, Camera(D435, info, seed=3))
    track = track_marker(pictures, colour_at(pictures[0], centres[0]), radius=RADIUS)
    np.testing.assert_allclose(track.time, 0.1 * np.arange(24))
    found, true = (to_camera(pictures[0], points) for points in (track.position[:, 0], centres))
    off = project_points(found, info) - project_points(true, info)
    assert np.sqrt(np.mean(off**2)) < 0.2
    assert np.abs(off).max() < 0.6
    ahead = found[:, 2] - true[:, 2]
    assert np.sqrt(np.mean(ahead**2)) < 0.006
    assert abs(ahead.mean()) < 0.003


def test_a_ball_that_is_hidden_or_leaves_the_picture_is_a_gap() -> None:
    centres = places(12)
    centres[3] = [3.0, 0.0, 1.2]  # out of sight
    centres[5] = [0.0, 0.0, 1.2 + 0.8 * 239.5 / 617.0]  # at the edge
    pictures = film(centres, Camera(D435, D435.info("optical")), decoy=1e-3)
    track = track_marker(pictures, colour_at(pictures[0], centres[0]), radius=RADIUS)
    assert np.flatnonzero(np.isnan(track.position).any((1, 2))).tolist() == [3, 5]


def test_pictures_without_the_marker_are_refused() -> None:
    centres = places(9)
    pictures = film(centres, Camera(D435, D435.info("optical")))
    with pytest.raises(TrajectoryError, match="was found in none of 9 pictures; pick"):
        track_marker(pictures, (0, 0, 255), radius=RADIUS)
    with pytest.raises(TrajectoryError, match="3 samples"):
        track_marker(pictures[:3], (255, 0, 80), radius=RADIUS)
