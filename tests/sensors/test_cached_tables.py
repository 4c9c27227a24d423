"""Baked tables from the cache on disk: bit for bit what is computed."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from vinesim.core import disk_cache
from vinesim.sensors.primitives import textures

TABLES = ("leaf_outlines", "leaf_texture", "noise_texture", "soil_texture", "sky_layers")


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_as_it_was_computed(name: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    cached = getattr(textures, f"_{name}")
    forget = getattr(cached, "cache_clear", lambda: None)  # layers of the sky are not kept in the process
    forget()
    computed = cached()  # the folder is empty
    assert len(list(tmp_path.glob(f"{name.replace('_', '-')}-*.npz"))) == 1
    forget()
    monkeypatch.setattr(disk_cache, "_write", None)  # from here on it must come from the disk
    read = cached()
    assert read is not computed
    assert list(read) == list(computed)
    for key, table in computed.items():
        assert (read[key].dtype, read[key].tobytes()) == (table.dtype, table.tobytes())


def test_ridges_and_trees_end_below_the_rows_that_are_mixed() -> None:
    layers = textures._sky_layers()
    assert not layers["ridges"][:, -1].any()
    assert not layers["tree_share"][-1].any()


def test_the_sky_is_brightest_at_the_sun() -> None:
    height = 0.6
    sun = (np.sqrt(1.0 - height**2), 0.0, height)
    table = textures.sky_texture(sun, (2.0, 1.8, 1.5))
    row, column = np.unravel_index(np.argmax(table.sum(-1)), table.shape[:2])
    assert abs((row / (textures.SKY_ROWS - 1)) ** 2 - height) < 0.01
    assert abs(column / (textures.SKY_COLUMNS - 1) * 2.0 * np.pi - np.pi) < 0.01
