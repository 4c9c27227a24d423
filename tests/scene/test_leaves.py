"""Leaf outlines: all of one area, five lobes of three depths, small teeth; holes count in the area."""

import itertools

import numpy as np
import pytest

from vinesim.scene import leaves
from vinesim.scene.berries import VARIETIES
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.sensors.primitives import textures

SHAPES = range(leaves.SHAPE_COUNT)
THETA = np.linspace(-np.pi, np.pi, 4001)


@pytest.mark.parametrize("shape", SHAPES)
def test_outlines_have_the_stated_area_without_their_holes(shape):
    """Oracle: points are counted, outside of holes."""
    grid = np.linspace(-2.0, 2.0, 1201)
    x, y = np.meshgrid(grid, grid)
    inside = np.hypot(x, y) < leaves.blade_outline(np.arctan2(y, x), shape)
    unit = leaves.midrib_length(shape)
    for u, v, radius in leaves.blade_holes(shape):
        hole = np.hypot(y - u * unit, x - v * unit) < radius * unit
        assert inside[hole].all()  # holes are in the blade
        inside &= ~hole
    assert inside.mean() * 16.0 == pytest.approx(leaves.BLADE_AREA, rel=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_drawn_blades_have_the_stated_area(shape):
    """What cameras see: the signed distances of the texture."""
    distance = textures.leaf_outlines()[0][shape]
    area = (distance > 0).mean() * 4.0 * leaves.midrib_length(shape) ** 2
    assert area == pytest.approx(leaves.BLADE_AREA, rel=0.012)
    border = np.concatenate([distance[0], distance[-1], distance[:, 0], distance[:, -1]])
    assert border.max() < 0  # the blade is within its texture


def test_sinuses_deepen_from_nearly_entire_to_five_lobes():
    depth = []
    for shape in SHAPES:
        r = leaves.blade_outline(np.radians([0.0, 27.0, 52.0]), shape)
        depth.append(1.0 - r[1] / min(r[0], r[2]))
    whole = np.reshape(depth, (3, -1))[:, :2].mean(1)
    assert whole[0] < 0.2 < whole[1] < 0.35 < whole[2]
    for shape in SHAPES:
        r = leaves.blade_outline(np.radians([0.0, 180.0]), shape)
        assert r[1] < 0.15 * max(r)  # the petiole sinus


@pytest.mark.parametrize("shape", [s for s in SHAPES if s % 4 < 3])
def test_teeth_are_small_and_many(shape):
    """A tooth is a local maximum of the outline; its height is that above the notches beside it."""
    r = leaves.blade_outline(THETA, shape) / leaves.midrib_length(shape)
    tip = np.flatnonzero((r[1:-1] > r[:-2]) & (r[1:-1] >= r[2:])) + 1
    notch = np.flatnonzero((r[1:-1] < r[:-2]) & (r[1:-1] <= r[2:])) + 1
    assert 25 < len(tip) < 75
    between = [r[a:b].min() for a, b in itertools.pairwise(tip)]
    height = r[tip[:-1]] - np.array(between)
    assert len(notch) > 20
    assert 0.01 < np.median(height) < 0.06


def test_leaves_have_the_outlines_of_their_variety():
    number = np.arange(6000)
    counts = np.bincount(leaves.blade_shape(number), minlength=leaves.SHAPE_COUNT)
    assert counts.min() > 400
    for depth, of in ((1.0, 0), (5.0, 1), (9.0, 2)):
        shape = leaves.blade_shape(number, np.full(len(number), depth))
        assert set(shape // 4) == {of}
        assert np.bincount(shape % 4).min() > 1200
    assert np.array_equal(leaves.blade_shape(number, np.zeros(len(number))), leaves.blade_shape(number))


def test_trees_know_their_variety():
    model = generate(load_scene("vsp"))
    variety = model.variety_of_trees()
    assert {VARIETIES[v].name for v in variety} <= {"black", "redglobe"}
    assert np.array_equal(variety[model.body_tree[model.bunch_body]], model.bunch_variety)
