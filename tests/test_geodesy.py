"""Positions on the Earth: worked examples of the surveyors, round trips, and the axes of the tangent plane."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.core import geodesy
from vinesim.core.geodesy import APRILIA, Geodetic

STATION = Geodetic(53.0 + 48.0 / 60.0 + 33.820 / 3600.0, 2.0 + 7.0 / 60.0 + 46.380 / 3600.0, 73.0)
"""The point of the worked examples of IOGP guidance note 7-2, in methods 9602 and 9837."""


def test_the_worked_example_of_geocentric_coordinates():
    """IOGP guidance note 7-2, method 9602: given to 1 mm."""
    assert geodesy.geocentric(STATION) == pytest.approx([3771793.968, 140253.342, 5124304.349], abs=1e-3)


def test_the_worked_example_of_topocentric_coordinates():
    """IOGP guidance note 7-2, method 9837: given to 1 mm."""
    origin = Geodetic(55.0, 5.0, 200.0)
    assert geodesy.to_local(STATION, origin) == pytest.approx([-189013.869, -128642.040, -4220.171], abs=1e-3)
    back = geodesy.from_local(np.array([-189013.869, -128642.040, -4220.171]), origin)
    assert tuple(back)[:2] == pytest.approx(STATION[:2], abs=1e-8)
    assert back.altitude == pytest.approx(STATION.altitude, abs=1e-3)


@pytest.mark.parametrize("datum", [APRILIA, Geodetic(-33.9, 18.4, 10.0), Geodetic(0.0, 180.0, 0.0), Geodetic(90, 0, 5)])
def test_a_position_comes_back_within_a_micrometre(datum):
    rng = np.random.default_rng(4)
    for local in rng.uniform(-500.0, 500.0, (50, 3)):
        again = geodesy.to_local(geodesy.from_local(local, datum), datum)
        assert again == pytest.approx(local, abs=2e-6 if abs(datum.latitude) < 89.0 else 1e-5)


def test_x_points_to_the_east_y_to_the_north_and_z_up():
    """A metre to the north is 1/(M + h) rad, one to the east 1/((N + h) cos latitude) rad; M, N: radii of curvature."""
    latitude = np.radians(APRILIA.latitude)
    squared = geodesy.FLATTENING * (2.0 - geodesy.FLATTENING)
    curved = 1.0 - squared * np.sin(latitude) ** 2
    meridian = geodesy.SEMI_MAJOR * (1.0 - squared) / curved**1.5 + APRILIA.altitude
    normal = geodesy.SEMI_MAJOR / np.sqrt(curved) + APRILIA.altitude
    east, north, up = (np.array(geodesy.from_local(axis, APRILIA)) - APRILIA for axis in np.eye(3))
    assert np.radians(east[1]) == pytest.approx(1.0 / (normal * np.cos(latitude)), rel=1e-6)
    assert np.radians(north[0]) == pytest.approx(1.0 / meridian, rel=1e-6)
    assert up == pytest.approx([0.0, 0.0, 1.0], abs=1e-8)
