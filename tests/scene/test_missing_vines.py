"""Vines that a scene leaves out to make room for others."""

from __future__ import annotations

import pathlib

import msgspec
import numpy as np
import pytest

from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.spec import SceneError, load_scene

SCENE = pathlib.Path(__file__).parents[2] / "examples" / "plants" / "scene.toml"


def test_vines_that_are_missing_change_no_other(tmp_path):
    scene = load_scene(SCENE)
    scene = msgspec.structs.replace(scene, imported=(), layout=msgspec.structs.replace(scene.layout, missing=((0, 0),)))
    less = generate_uncached(scene)
    full = generate_uncached(msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, missing=())))
    there = full.tree_vine[full.body_tree] == 1
    for name in ("body_mass", "body_inertia", "body_rest", "joint_stiffness", "body_drag"):
        np.testing.assert_array_equal(getattr(less, name), getattr(full, name)[there], err_msg=name)
    for organ in (Organ.POLE, Organ.WIRE):
        kind = full.fixed_organ == int(organ)
        np.testing.assert_array_equal(less.fixed_start[less.fixed_organ == int(organ)], full.fixed_start[kind])
    assert (less.fixed_organ == int(Organ.TRUNK)).sum() * 2 == (full.fixed_organ == int(Organ.TRUNK)).sum()
    for missing, said in (
        ("[[0, 2]]", r"layout.missing\[0\] is \[0, 2\]; give \[0 to 0, 0 to 1\]: row, place"),
        ("[[0, 0], [0, 1]]", "names all 2 vines; leave one"),
    ):
        (tmp_path / "scene.toml").write_text(SCENE.read_text().replace("[[0, 1]]", missing))
        (tmp_path / "vine.toml").write_text((SCENE.parent / "vine.toml").read_text())
        with pytest.raises(SceneError, match=said):
            load_scene(tmp_path / "scene.toml")
