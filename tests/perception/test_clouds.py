"""Pictures and scans as clouds of Open3D: a point is on the ray of its pixel, at its depth, with its colour and id."""

import sys

import numpy as np
import pytest

import vinesim
from vinesim.core.errors import UsageError
from vinesim.perception import Open3DMissing, register, relative_pose
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.ids import LABEL_STRIDE

EYE = (1.5, -1.2, 1.4)


@pytest.fixture(scope="module")
def simulation() -> vinesim.Simulation:
    return vinesim.Simulation("demo")


@pytest.fixture(scope="module")
def frame(simulation):
    return vinesim.Camera("d435", size=(160, 120), quality="fast").render(
        simulation, vinesim.look_at(EYE, (1.5, 0.5, 1.6))
    )


@pytest.fixture(scope="module")
def scan(simulation):
    return vinesim.Lidar("vlp16").scan(simulation, (1.5, -1.2, 1.0, 0.0, 0.0, 0.6, 0.8))


def test_each_point_of_a_picture_is_on_the_ray_of_its_pixel(frame):
    cloud = frame.to_point_cloud(exact=True, ids=True)
    points, pixels, labels, colours = (
        cloud.point[name].numpy() for name in ("positions", "pixels", "labels", "colors")
    )
    assert len(points) == np.isfinite(frame.exact_depth).sum()
    np.testing.assert_allclose(project_points(points, frame.info), pixels, atol=1e-3)
    column, row = pixels.T
    np.testing.assert_allclose(points[:, 2], frame.exact_depth[row, column], atol=1e-6)
    np.testing.assert_array_equal(labels[:, 0], frame.labels[row, column])
    np.testing.assert_allclose(colours * 255.0, frame.rgb[row, column], atol=1e-3)


def test_points_in_the_world_are_where_vine_and_ground_are(frame):
    cloud = frame.to_point_cloud(world=True, exact=True, ids=True)
    points = cloud.point.positions.numpy()
    ground = cloud.point.labels.numpy()[:, 0] // LABEL_STRIDE == vinesim.Organ.GROUND
    assert ground.sum() > 100
    assert abs(np.median(points[ground, 2])) < 1e-3  # some of it is grass
    assert points[ground, 2].min() > -1e-3
    own = frame.to_point_cloud(exact=True).point.positions.numpy()
    np.testing.assert_allclose(np.linalg.norm(points - EYE, axis=1), np.linalg.norm(own, axis=1), rtol=1e-5)


def test_measured_depth_and_steps_leave_points_out(frame):
    assert len(frame.to_point_cloud().point.positions) == np.isfinite(frame.depth).sum()
    coarse = frame.to_point_cloud(exact=True, ids=True, step=4)
    assert (coarse.point.pixels.numpy() % 4 == 0).all()
    assert len(coarse.point.positions) == np.isfinite(frame.exact_depth[::4, ::4]).sum()
    with pytest.raises(UsageError, match="step is 0; give 1 or more"):
        frame.to_point_cloud(step=0)


def test_a_scan_has_all_its_points_with_ids(scan):
    cloud = scan.to_open3d(ids=True)
    np.testing.assert_array_equal(cloud.point.positions.numpy(), scan.xyz)
    np.testing.assert_array_equal(cloud.point.labels.numpy()[:, 0], scan.labels)
    np.testing.assert_array_equal(cloud.point.ring.numpy()[:, 0], scan.ring)
    moved = scan.to_open3d(world=True).point.positions.numpy()
    ground = scan.organs == vinesim.Organ.GROUND
    assert abs(np.quantile(moved[ground, 2], 0.2)) < 0.03
    away = moved - np.array([1.5, -1.2, 1.0])
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.linalg.norm(scan.xyz, axis=1), rtol=1e-4)


def test_registration_of_two_pictures_finds_the_true_motion(simulation, frame):
    """From 30 mm and 2 degrees off, within 2 mm and 0.1 degrees."""
    other = vinesim.Camera("d435", size=(160, 120), quality="fast").render(
        simulation, vinesim.look_at((1.55, -1.17, 1.42), (1.5, 0.5, 1.6))
    )
    true = relative_pose(other.pose, frame.pose)
    coarse = true.copy()
    coarse[:3] += [0.02, -0.02, 0.01]
    coarse[3:] = vinesim.frames.multiply(coarse[3:], vinesim.frames.exp(np.radians([1.0, -1.5, 1.0])))
    found = register(
        other.to_point_cloud(exact=True), frame.to_point_cloud(exact=True), coarse, reaches=(0.1, 0.03, 0.01)
    )
    metres, angle = found.error(true)
    assert metres < 2e-3
    assert np.degrees(angle) < 0.1
    started = found.__class__(coarse, 0.0, 0.0).error(true)
    assert started[0] == pytest.approx(0.03)
    with pytest.raises(UsageError, match="moving cloud has 0 points"):
        register(other.to_point_cloud().select_by_index(np.zeros(0, np.int64)), frame.to_point_cloud())


def test_without_open3d_one_line_says_what_to_install(frame, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(Open3DMissing, match=r"pip install 'vinesim\[perception\]'") as said:
        frame.to_point_cloud()
    assert said.value.exit_code == 3
    assert "\n" not in str(said.value)
