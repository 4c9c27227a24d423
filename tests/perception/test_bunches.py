"""Volume and berries of bunches from depth, against closed forms and against the scene."""

import numpy as np
import pytest

import vinesim
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception import measure_bunch, true_bunch, true_volumes
from vinesim.perception.bunches import BunchPoints, fit_berries, hull_volume
from vinesim.scene.berries import DENSITY

FOCAL = 617.0
LEVEL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def spheroid(centre, radius: float, elongation: float, axis) -> np.ndarray:
    """Points [120, 120, 3] m of a spheroid, as a camera at the origin sees it."""
    across, down = np.meshgrid(*(np.arange(-60, 60) / FOCAL,) * 2)
    ray = np.stack([across, down, np.ones_like(across)], -1)
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    metric = np.eye(3) - (1.0 - 1.0 / elongation**2) * np.outer(axis, axis)
    a = np.einsum("...i,ij,...j", ray, metric, ray)
    b = ray @ metric @ centre
    disc = b**2 - a * (centre @ metric @ centre - radius**2)
    depth = np.where(disc > 0.0, (b - np.sqrt(np.maximum(disc, 0.0))) / a, np.nan)
    return ray * depth[..., None]


@pytest.mark.parametrize("elongation", [1.05, 1.2])
@pytest.mark.parametrize("axis", [(0.1, 1.0, 0.3), (1.0, 0.2, -0.6)])
def test_an_exact_spheroid_is_found(elongation, axis):
    centre = np.array([0.004, -0.006, 0.5])
    (found,) = fit_berries(BunchPoints(spheroid(centre, 0.0105, elongation, axis), LEVEL, FOCAL), 1e-4)
    assert np.linalg.norm(found.centre - centre) < 2e-4
    assert found.diameter == pytest.approx(0.021, abs=2e-4)
    assert found.length == pytest.approx(0.021 * elongation, abs=4e-4)
    assert 0.9 < found.visible <= 1.0


def test_whole_millimetres_cost_less_than_two_millimetres():
    """An upright berry is the worst case: its curvature is that of a larger ball."""
    centre = np.array([0.0, 0.0, 0.5])
    points = spheroid(centre, 0.0105, 1.147, (0.0, 1.0, 0.0))
    depth = points[..., 2:]
    (found,) = fit_berries(BunchPoints(points / depth * np.round(depth, 3), LEVEL, FOCAL), 3e-4)
    assert found.diameter == pytest.approx(0.021, abs=2e-3)


@pytest.mark.parametrize("sides", [1, 3])
def test_the_hull_of_a_cylinder_has_its_volume(sides):
    """Points of a standing cylinder on the half that each camera sees."""
    rng = np.random.default_rng(1)
    clouds, eyes = [], []
    for k in range(sides):
        to = 2.0 * np.pi * k / sides
        angle = to + np.arcsin(rng.uniform(-1.0, 1.0, 6000))
        clouds.append(np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), rng.uniform(1.0, 1.2, 6000)], 1))
        eyes.append(np.array([np.cos(to), np.sin(to), 1.1]))
    volume, has_sides = hull_volume(clouds, eyes)
    assert has_sides == (sides > 1)
    assert volume == pytest.approx(np.pi * 0.05**2 * 0.2, rel=0.04)


@pytest.fixture(scope="module")
def simulation() -> vinesim.Simulation:
    return vinesim.Simulation("demo")


@pytest.fixture(scope="module")
def looked_at(simulation):
    """Three bunches, each from three sides, 0.55 m away."""
    camera = vinesim.Camera("d435", quality="fast")
    found = {}
    for bunch in (2, 3, 10):
        middle = true_bunch(simulation, bunch).centres.mean(0)
        around = [
            frames.rotate(frames.from_yaw(k * 2.0 * np.pi / 3.0), np.array([0.0, -0.55, -0.08])) for k in range(3)
        ]
        found[bunch] = [camera.render(simulation, vinesim.look_at(middle + way, middle)) for way in around]
    return found


def test_volume_and_diameters_are_those_of_the_scene(simulation, looked_at):
    """Volume within 10 % on average and diameters within 1 mm on average; no berry is invented."""
    volumes, diameters = [], []
    for bunch, pictures in looked_at.items():
        truth = true_bunch(simulation, bunch)
        found = measure_bunch(pictures, bunch, exact=True)
        assert found.has_sides
        volumes.append(found.volume / truth.volume - 1.0)
        away = np.linalg.norm(truth.centres[None] - np.array([one.centre for one in found.berries])[:, None], axis=2)
        nearest = away.argmin(1)
        assert len(set(nearest)) == len(nearest) > 0.5 * len(truth.centres)  # each berry once
        assert np.quantile(away.min(1), 0.9) < 2e-3
        diameters += [one.diameter - truth.diameters[k] for one, k in zip(found.berries, nearest, strict=True)]
    assert np.abs(volumes).mean() < 0.10
    assert np.abs(diameters).mean() < 1e-3


def test_true_volumes_are_those_of_the_berries_in_the_scene(simulation):
    volumes = true_volumes(simulation.model)
    for bunch in (0, 5, 40):
        truth = true_bunch(simulation, bunch)
        assert len(truth.diameters) == simulation.model.bunch_berries[bunch]
        assert truth.volume == pytest.approx(volumes[bunch], rel=1e-5)
        assert truth.mass == DENSITY * truth.volume
    with pytest.raises(UsageError, match="bunch is 84; the vineyard has 84"):
        true_bunch(simulation, 84)


def test_a_bunch_that_no_picture_shows_is_one_line(looked_at):
    with pytest.raises(UsageError, match="no picture shows 60 pixels of bunch 77 with depth"):
        measure_bunch(looked_at[2], 77)
