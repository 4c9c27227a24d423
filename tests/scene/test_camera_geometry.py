"""Geometry of pictures."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from vinesim.scene.camera_geometry import (
    back_project,
    depth_millimetres,
    distortion_model,
    intrinsic_matrix,
    measured_points,
    pixel_rays,
    project_points,
)
from vinesim.scene.values import CameraFrame, CameraInfo

INFO = CameraInfo(6, 4, 50.0, 51.0, 2.4, 1.6, "optical")


def _frame() -> CameraFrame:
    rng = np.random.default_rng(2)
    depth = rng.uniform(0.5, 3.0, (4, 6)).astype(np.float32)
    depth[0, :3] = np.nan, np.inf, -np.inf
    rgb = rng.integers(0, 256, (4, 6, 3), np.uint8)
    return CameraFrame(0.0, "camera", INFO, np.array([0, 0, 0, 0, 0, 0, 1.0]), rgb, depth, np.zeros((4, 6), np.int32))


def test_depth_in_millimetres() -> None:
    depth = np.array([[1.2345, np.nan, np.inf], [-np.inf, 0.0004, 70.0]], np.float32)
    assert depth_millimetres(depth).tolist() == [[1234, 0, 0], [0, 0, 0]]
    assert depth_millimetres(np.array([65.535, 65.536], np.float32)).tolist() == [65535, 0]


def test_measured_points_project_to_their_pixels() -> None:
    frame = _frame()
    points = measured_points(frame)
    assert len(points) == 4 * 6 - 3
    xyz = np.stack([points[axis] for axis in "xyz"], 1)
    v, u = np.nonzero(np.isfinite(frame.depth))
    assert project_points(xyz, INFO) == pytest.approx(np.stack([u, v], 1), abs=1e-4)
    assert np.array_equal(points["z"], frame.depth[v, u])
    assert np.array_equal(points["rgb"] >> 8 & 255, frame.rgb[v, u, 1])


def test_every_second_row_and_column() -> None:
    frame = _frame()
    frame.depth[0, :3] = 1.0
    all_points = measured_points(frame).reshape(4, 6)
    assert np.array_equal(measured_points(frame, step=2).reshape(2, 3), all_points[::2, ::2])


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    assert np.isnan(project_points(np.array([0.1, 0.2, -1.0]), INFO)).all()


def test_rays_and_matrix_agree() -> None:
    across, down = pixel_rays(INFO)
    matrix = np.array(intrinsic_matrix(INFO)).reshape(3, 3)
    u, v, w = matrix @ [across[0, 4], down[3, 0], 1.0]
    assert (u, v, w) == pytest.approx((4.0, 3.0, 1.0), abs=1e-5)


@pytest.mark.parametrize(
    "distortion",
    [(), (-0.28, 0.09, 0.0011, -0.0008, -0.012), (0.42, -0.11, 0.0003, -0.0002, 0.004, 0.75, -0.06, 0.002)],
    ids=["none", "plumb_bob", "rational_polynomial"],
)
def test_points_project_as_by_opencv_and_rays_lead_back(distortion: tuple[float, ...]) -> None:
    info = CameraInfo(64, 48, 60.0, 61.0, 30.0, 25.0, "optical", distortion)
    model, coefficients = distortion_model(info)
    assert model == ("rational_polynomial" if len(distortion) == 8 else "plumb_bob")
    rng = np.random.default_rng(3)
    points = np.c_[rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)] * rng.uniform(0.3, 9.0, (200, 1))
    matrix = np.array(intrinsic_matrix(info)).reshape(3, 3)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    assert project_points(points, info) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)
    assert back_project(project_points(points, info), points[:, 2], info) == pytest.approx(points, abs=1e-6)
    across, down = pixel_rays(info)
    rays = np.stack(np.broadcast_arrays(across, down, np.ones((48, 64))), -1)
    rows, columns = np.mgrid[:48, :64]
    assert project_points(rays * 2.5, info) == pytest.approx(np.stack([columns, rows], -1), abs=1e-4)


def test_a_map_that_folds_over_itself_has_no_rays_there() -> None:
    info = dataclasses.replace(INFO, fx=3.0, fy=3.0, distortion=(-0.8, 0.0, 0.0, 0.0, 0.0))
    across, _ = pixel_rays(info)
    assert np.isnan(across[0, 5])
    assert np.isfinite(across[1:3, 2:4]).all()
