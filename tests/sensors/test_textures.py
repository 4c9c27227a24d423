"""Baked tables."""

import numpy as np
import pytest

from vinesim.scene import leaves
from vinesim.sensors.primitives import textures


def test_outlines_have_the_area_of_the_leaf() -> None:
    table, _ = textures.leaf_outlines()
    for shape in range(leaves.SHAPE_COUNT):
        texels = (table[shape] > 0).sum() * (2.0 / textures.TEXTURE_SIZE) ** 2
        assert texels * textures.leaf_scale(np.array(shape)) ** 2 == pytest.approx(leaves.BLADE_AREA, rel=0.02)


def test_octagons_hold_their_outlines() -> None:
    table, hull = textures.leaf_outlines()
    u, v = textures._grid(textures.TEXTURE_SIZE)
    for shape in range(textures.OUTLINE_COUNT):
        inside = table[shape] > 0
        p = np.stack([u[inside], v[inside]], 1)
        for k in range(8):
            a = hull[shape, k]
            b = hull[shape, (k + 1) % 8]
            edge = b - a
            out = (p - a) @ np.array([-edge[1], edge[0]]) / np.linalg.norm(edge)
            inner = (hull[shape].mean(0) - a) @ np.array([-edge[1], edge[0]])
            assert (out * np.sign(inner)).min() > -1e-3


def test_noise_tiles() -> None:
    for table in (textures.noise_texture(), textures.soil_texture()):
        seam = np.abs(table[0] - table[-1]).mean((0,))
        inside = np.abs(np.diff(table, axis=0)).mean((0, 1))
        assert (seam < 1.5 * inside).all()


def test_the_tone_curve_rises_from_black_to_white() -> None:
    curve = textures.tone_curve().astype(int)
    assert (np.diff(curve) >= 0).all()
    assert (curve[0], curve[-1]) == (0, 255)
    assert curve[int(np.sqrt(0.18) * 1024)] == pytest.approx(140, abs=12)  # a grey card stays mid-grey


def test_the_sun_is_where_it_is_said_to_be() -> None:
    sun = np.array([0.3, -0.5, 0.6]) / np.linalg.norm([0.3, -0.5, 0.6])
    sky = textures.sky_texture(tuple(sun), (3.3, 2.95, 2.35))
    row, column = np.unravel_index(sky.sum(-1).argmax(), sky.shape[:2])
    assert (row / (textures.SKY_ROWS - 1)) ** 2 == pytest.approx(sun[2], abs=0.02)
    assert (column / (textures.SKY_COLUMNS - 1) - 0.5) * 2.0 * np.pi == pytest.approx(
        np.arctan2(sun[1], sun[0]), abs=0.02
    )
    assert np.isfinite(sky).all()
