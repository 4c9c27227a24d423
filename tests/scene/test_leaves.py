"""Leaf outlines: symmetric, of unit half width, with the area that counting points gives."""

import numpy as np
import pytest

from vinesim.scene import leaves


@pytest.mark.parametrize("shape", range(leaves.SHAPE_COUNT))
def test_outlines_have_unit_half_width_and_the_stated_area(shape):
    theta = np.linspace(-np.pi, np.pi, 2001)
    r = leaves.blade_outline(theta, shape)
    assert np.abs(r * np.sin(theta)).max() == pytest.approx(1.0, abs=1e-3)
    assert np.allclose(r, r[::-1])
    grid = np.linspace(-2.0, 2.0, 801)
    x, y = np.meshgrid(grid, grid)
    inside = np.hypot(x, y) < leaves.blade_outline(np.arctan2(y, x), shape)
    assert inside.mean() * 16.0 == pytest.approx(leaves.blade_area(shape), rel=0.01)


def test_an_outline_has_five_lobes_and_a_sinus():
    r = leaves.blade_outline(np.radians([0.0, 28.0, 54.0, 85.0, 112.0, 180.0]), 1)
    assert r[1] < min(r[0], r[2])
    assert r[3] < r[2]
    assert r[5] < 0.1 * r[0]


def test_shapes_are_distributed_over_leaves():
    counts = np.bincount(leaves.blade_shape(np.arange(4000)), minlength=leaves.SHAPE_COUNT)
    assert counts.min() > 800
