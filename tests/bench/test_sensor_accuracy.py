"""``python -m benchmarks sensors`` on a few of its cases."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import sensor_accuracy
from benchmarks.sensor_accuracy import DepthStatistics, depth_noise_formula, measure_plane, measure_ranges
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.sensors.camera.camera import CameraSpec
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot


def test_noise_on_a_plane_is_that_of_the_formula(monkeypatch) -> None:
    monkeypatch.setattr(sensor_accuracy, "RANGES", (0.5, 2.0))
    spec = CameraSpec.load("d435")
    found = measure_plane(spec)
    assert list(found.fill.values()) == [1.0, 1.0]
    for distance, error in found.error.items():
        assert error == pytest.approx(float(depth_noise_formula(spec, np.array(distance))), rel=0.2)


def test_depth_statistics_need_enough_pixels() -> None:
    depths = DepthStatistics()
    exact = np.full(1000, 2.0)
    measured = exact + 0.01 * np.random.default_rng(1).standard_normal(1000)
    measured[:100] = np.nan
    depths.add(2.0, exact, measured)
    depths.add(3.0, exact[:400], measured[:400])
    assert depths.fill == {2.0: 0.9}
    assert depths.error[2.0] == pytest.approx(0.01, rel=0.1)


def test_a_lidar_with_errors_loses_some_returns_and_mixes_some() -> None:
    scan = measure_ranges("vlp16", Primitives(generate(load_scene("demo"))))
    assert 0.7 < scan.returned < 1.2
    assert 0.02 < scan.mixed < 0.5
    assert len(scan.real) == pytest.approx(scan.returned * len(scan.exact))


@pytest.mark.long
def test_the_rasterizer_agrees_with_ray_casting(tmp_path) -> None:
    model = generate(load_scene("demo"))
    pictures = sensor_accuracy.compare_with_rays(CameraSpec.load("d435"), model, rest_snapshot(model))
    picture, cast = pictures["warp"], pictures["rays"]
    same = picture.primitive == cast.primitive
    assert same.mean() > 0.999
    both = same & np.isfinite(cast.depth)
    assert np.median(np.abs(picture.depth[both] - cast.depth[both])) < 1e-5
    sensor_accuracy._compare(tmp_path, pictures)
    assert (tmp_path / "sensors-rasterizer.png").stat().st_size > 10_000


@pytest.mark.long
def test_pictures_are_drawn(tmp_path) -> None:
    spec = CameraSpec.load("d435")
    one = DepthStatistics({0.5: 0.001, 2.0: 0.02}, {0.5: 1.0, 2.0: 0.9})
    some = sensor_accuracy.RangeStatistics(np.array([1.0, 2.0]), np.array([1.0]), 0.5, 0.1)
    sensor_accuracy._draw(tmp_path / "new", spec, {"plane": one}, {"a": some, "b": some}, np.array([[0.1, 0.6]]))
    names = {"sensors-depth.png", "sensors-lidar.png", "sensors-berries.png"}
    assert {p.name for p in (tmp_path / "new").iterdir()} == names
