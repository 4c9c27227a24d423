"""Cameras with distortion: what they show lies where OpenCV, and so image_geometry, projects it."""

from __future__ import annotations

import dataclasses
import json
import pathlib

import cv2
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.scene import camera_geometry
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export import dataset
from vinesim.sensors.export.mix import load_mix
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.lens_map import lens_map
from vinesim.sensors.spec_file import SensorError

BARREL = (-0.28, 0.09, 0.0011, -0.0008, -0.012)
PINCUSHION = (0.09, -0.02, -0.001, 0.0015, 0.003)
RATIONAL = (0.42, -0.11, 0.0003, -0.0002, 0.004, 0.75, -0.06, 0.002)
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "rational": RATIONAL}
POSE = sensor_scenes.look_at(np.array([0.0, 0.0, 9.0]), np.array([1.0, 0.0, 9.0]))


def _info(distortion: tuple[float, ...]) -> CameraInfo:
    return dataclasses.replace(sensor_scenes.SMALL, distortion=distortion)


def _matrix(info: CameraInfo) -> np.ndarray:
    return np.array([[info.fx, 0.0, info.cx], [0.0, info.fy, info.cy], [0.0, 0.0, 1.0]])


def _projected(points: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Pixels [point, 2] of points [point, 3] m of the optical frame, by OpenCV."""
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, _matrix(info), np.array(info.distortion))[0].reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES)
def test_small_balls_lie_on_their_pixels(lens: str) -> None:
    info = _info(LENSES[lens])
    wanted = np.stack(np.meshgrid([6.0, 90.0, 160.0, 230.0, 313.0], [6.0, 70.0, 120.0, 233.0]), -1).reshape(-1, 2)
    rays = cv2.undistortPoints(wanted[:, None], _matrix(info), np.array(info.distortion)).reshape(-1, 2)
    local = np.c_[rays, np.ones(len(rays))] * np.linspace(1.2, 3.0, len(rays))[:, None]
    places = POSE[:3] + frames.rotate(POSE[3:], local)
    balls = [
        sensor_scenes.thing(sensor_scenes.shape("sphere", 0.015), name=f"ball {i}", organ=Organ.BOX, index=i)
        for i in range(len(places))
    ]
    at = np.c_[places, np.tile([0, 0, 0, 1.0], (len(places), 1))]
    primitives, _ = sensor_scenes.world(*balls, at=at)
    frame = Camera(sensor_scenes.IDEAL, info, sun=(0.4, 0.5, 0.77)).render(primitives, POSE)
    for i, pixel in enumerate(_projected(local, info)):
        rows, columns = np.nonzero(frame.labels == label(Organ.BOX, i))
        assert np.hypot(columns.mean() - pixel[0], rows.mean() - pixel[1]) < 1.0, f"ball {i} of {pixel}"
    # without its distortion, the same camera shows the outer ones elsewhere
    assert np.abs(_projected(local, dataclasses.replace(info, distortion=camera_geometry.NONE)) - wanted).max() > 4.0


@pytest.mark.parametrize("lens", LENSES)
def test_labels_and_depth_are_those_of_rays_and_truth_counts_the_same_pixels(lens: str) -> None:
    info = _info(LENSES[lens])
    model = sensor_scenes.demo()
    primitives = Primitives(model)
    view = rest_snapshot(model)
    bunch = int(np.argmin(np.linalg.norm(view.body_q[model.bunch_body, :3] - [2.0, 0.7, 1.6], axis=1)))
    middle = view.body_q[model.bunch_body[bunch], :3].astype(float)
    pose = sensor_scenes.look_at(middle + np.array([-0.9, 0.5, -0.2]), middle)
    camera = Camera(sensor_scenes.IDEAL, info, sun=(0.4, 0.5, 0.77))
    frame = camera.render(primitives, pose)
    grid = np.stack(np.meshgrid(np.arange(info.width), np.arange(info.height)), -1).reshape(-1, 1, 2).astype(float)
    rays = cv2.undistortPoints(grid, _matrix(info), np.array(info.distortion)).reshape(-1, 2)
    caster = RayCaster(primitives)
    depth, primitive = caster.cast(pose[:3], frames.rotate(pose[3:], np.c_[rays, np.ones(len(rays))]))
    depth, primitive = (values.reshape(info.height, info.width) for values in (depth, primitive))
    truth = np.where(primitive >= 0, primitives.label[np.maximum(primitive, 0)], label(Organ.GROUND, 0))
    truth = np.where(primitive == -1, 0, truth)
    around = np.lib.stride_tricks.sliding_window_view(truth, (3, 3))
    found = (around == frame.labels[1:-1, 1:-1, None, None]).any((2, 3))
    assert found.mean() > 0.99  # twigs thinner than a pixel are met by one ray and missed by its neighbours
    flat = (frame.labels == truth) & (frame.labels == label(Organ.GROUND, 0)) & np.isfinite(depth)
    assert flat.sum() > 500
    assert np.median(np.abs(frame.depth[flat] / depth[flat] - 1.0)) < 0.01

    seen = ground_truth.render_buffers(primitives, info, pose)
    assert np.array_equal(seen.labels, frame.labels)
    live = ground_truth.visible_bunches(primitives, view, info, pose, camera.rasterizer)
    truths = {one.bunch: one for one in ground_truth.bunch_truths(primitives, view, seen, caster)}
    assert {one.bunch for one in live} >= {bunch}
    for one in live:
        same = truths[one.bunch]
        assert one.pixels == same.pixels == (frame.labels == one.label).sum()
        assert one.amodal_box == same.amodal_box
        assert one.cut is not None
        assert one.cut_pixel is not None
        local = frames.rotate(frames.conjugate(pose[3:]), one.cut - pose[:3])
        assert one.cut_pixel == pytest.approx(_projected(local[None], info)[0], abs=1e-6)


def test_a_picture_that_opencv_straightens_is_that_of_the_pinhole() -> None:
    info = _info(BARREL)
    primitives = Primitives(sensor_scenes.demo())
    pose = sensor_scenes.look_at(np.array([-0.6, 1.0, 1.45]), np.array([8.0, 1.35, 1.45]))
    plain = dataclasses.replace(info, distortion=())
    bent, straight = (
        Camera(sensor_scenes.IDEAL, one, sun=(0.4, 0.5, 0.77), exposure=0.75).render(primitives, pose).rgb
        for one in (info, plain)
    )

    def difference(picture: np.ndarray) -> float:
        inner = np.s_[20:-20, 20:-20]
        blurred = [cv2.GaussianBlur(one, (0, 0), 2.0)[inner].astype(float) for one in (picture, straight)]
        return float(np.abs(blurred[0] - blurred[1]).mean())

    straightened = cv2.undistort(bent, _matrix(info), np.array(info.distortion))
    assert difference(straightened) < 5.0  # leaves smaller than a pixel were sampled at other places
    assert difference(bent) > 3.0 * difference(straightened), (difference(bent), difference(straightened))


@pytest.mark.parametrize(
    ("coefficients", "words"),
    [
        ("[0.1, 0.0, 0.0]", "3 coefficients; give 5"),
        ("[-3.0, 0.0, 0.0, 0.0, 0.0]", "folds the picture"),
        ("[0.0, 0.0, 0.0, 2000.0, 0.0]", "is 2000 1; give -1000 to 1000"),
    ],
)
def test_coefficients_that_cannot_be_are_refused(tmp_path: pathlib.Path, coefficients: str, words: str) -> None:
    with pytest.raises(SensorError, match=words):
        CameraSpec.load(_camera_file(tmp_path, coefficients))


def _camera_file(folder: pathlib.Path, coefficients: str) -> str:
    """A D435 whose lens has distortion."""
    shipped = find_data_file("cameras", "d435", ".toml").read_text(encoding="utf-8")
    line = f'distortion = {{ value = {coefficients}, unit = "1", grade = "GUESSED", source = "a test" }}\n'
    file = folder / "bent.toml"
    file.write_text(shipped.replace("[stereo]", line + "[stereo]"), encoding="utf-8")
    return str(file)


def _read_png(file: pathlib.Path) -> np.ndarray:
    found = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def test_a_data_set_says_and_shows_the_distortion(tmp_path: pathlib.Path) -> None:
    scene = tmp_path / "vine.toml"
    scene.write_text(
        'name = "one vine"\nseed = 1\ntraining = "tendone"\n'
        "layout = { rows = 1, vines = 1, row_spacing = 2.5, vine_spacing = 2.5, height = 2.0 }\n"
        'fruit = { bunches = [6, 8], varieties = ["italia"] }\n'
    )
    camera = _camera_file(tmp_path, str(list(BARREL)))
    plan = dataset.DatasetPlan(load_mix("around", str(scene), camera), 5, (160, 120))
    out = tmp_path / "set"
    dataset.prepare_folder(plan, out, 1)
    assert list(dataset.render_images(plan, out, [0])) == [0]
    record = json.loads((out / "records/000000.json").read_text())
    told = record["camera"]
    assert (told["distortion_model"], told["d"]) == ("plumb_bob", list(BARREL))
    info = CameraSpec.load(camera).info("optical", size=(160, 120))
    channels = _read_png(out / "ids/000000.png").astype(int)  # blue, green, red
    ids = channels @ [65536, 256, 1]
    millimetres = _read_png(out / "depth/000000.png")
    position = np.array(told["position"])
    turn = np.array(told["quaternion_xyzw"])
    checked = 0
    for one in record["bunches"]:
        if one["cut_pixel"] is None:
            continue
        local = frames.rotate(frames.conjugate(turn), np.array(one["cut"]) - position)
        assert one["cut_pixel"] == pytest.approx(_projected(local[None], info)[0], abs=0.01)
        rows, columns = np.nonzero(ids == one["label"])
        assert len(rows) == one["pixels"]
        if not len(rows):
            continue
        # depth and the rays that OpenCV finds for these pixels lead into the bunch's box
        grid = np.stack([columns, rows], -1).reshape(-1, 1, 2).astype(float)
        rays = cv2.undistortPoints(grid, _matrix(info), np.array(told["d"])).reshape(-1, 2)
        points = np.c_[rays, np.ones(len(rays))] * millimetres[rows, columns, None] * 1e-3
        away = position + frames.rotate(turn, points) - np.array(one["box_3d"]["position"])
        inside = frames.rotate(frames.conjugate(np.array(one["box_3d"]["quaternion_xyzw"])), away)
        assert (np.abs(inside) <= 0.5 * np.array(one["box_3d"]["size"]) + 0.008).all()  # a pixel is 5 mm at 1 m
        checked += 1
    assert checked


def test_without_distortion_nothing_is_moved() -> None:
    view = lens_map(sensor_scenes.SMALL)
    drawn = np.zeros((2, 3))
    assert view.pinhole == sensor_scenes.SMALL
    assert view.nearest(drawn) is drawn
