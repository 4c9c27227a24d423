"""Daylight: through how much air the sun shines, what that does to its colour, and light that follows a moving sun."""

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.scene.spec import Sun
from vinesim.sensors.camera.sunlight import Sunlight, air_mass, daylight


@pytest.mark.parametrize(("degrees", "mass"), [(90.0, 1.0), (30.0, 1.994), (10.0, 5.59), (0.0, 37.9)])
def test_air_mass_is_the_published_one(degrees: float, mass: float) -> None:
    """Kasten and Young (1989), their table of relative optical air mass, to a hundredth."""
    assert air_mass(np.sin(np.radians(degrees))) == pytest.approx(mass, rel=0.01)


def test_a_low_sun_is_dim_and_red() -> None:
    high = daylight(0.75)[0]
    low = daylight(0.05)[0]
    assert (low < high).all()
    assert low[0] / low[2] > 4.0 * high[0] / high[2]
    assert daylight(-0.3)[0].max() == 0.0
    assert 0.0 < daylight(-0.3)[1] < 0.1


def test_light_follows_a_moving_sun() -> None:
    """Its direction is the sun's to a quarter of a degree; at noon, light is as bright and white as it should be."""
    primitives, _ = sensor_scenes.world()
    sun = Sun(hour=6.6)
    light = Sunlight(sun.direction)
    balances = []
    dim = 1.0
    for time in (0.0, 30.0, 3600.0, 5.4 * 3600.0):
        light.update(primitives, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), time)
        there = np.array([*light.light.sun])
        assert there @ np.array(sun.direction(time)) > np.cos(np.radians(0.26))
        balances.append(light.balance)
        dim = min(dim, light.brightness)
    assert balances[-1] == pytest.approx(1.0, abs=0.02)
    assert dim < 0.5
    assert light.brightness == pytest.approx(1.0, abs=0.06)
