"""Leaves that were taken off are not drawn, with their petioles and the small leaves in their axils; all others are."""

from __future__ import annotations

import msgspec
import numpy as np

from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF
from vinesim.world import Physics


def test_only_what_belongs_to_the_leaves_that_are_off_is_drawn_no_longer():
    scene = load_scene("vsp")
    model = generate(msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=1, vines=1)))
    physics = Physics(model)
    primitives = Primitives(model, grass=0.0)
    primitives.update(physics.snapshot())
    rows = np.arange(primitives.plant_count)
    kind = primitives.shapes.kind.numpy()[rows]
    is_leaf = primitives.organ[rows] == int(Organ.LEAF)

    def sizes() -> np.ndarray:
        columns = primitives.local_columns(slice(0, primitives.plant_count))
        return np.stack([columns["a"][:, 3], columns["b"][:, 3]], 1)

    before = sizes().copy()
    segment = int(np.argmax(np.bincount(model.leaf_body)))
    leaves = np.flatnonzero(model.leaf_body == segment)[:1]
    full = physics.snapshot()
    physics.take_leaves(leaves)
    versions = primitives.cluster_version.copy()
    primitives.update(physics.snapshot())
    gone = (sizes()[:, 0] < 1e-5) & (before[:, 0] >= 1e-5)
    carrier = primitives.local_columns(slice(0, primitives.plant_count))["carrier"]
    assert (is_leaf & (carrier == segment))[gone].all()
    assert (gone & (kind == LEAF)).sum() == (gone & (kind == CONE)).sum() >= 1
    at = primitives.local_columns(slice(0, primitives.plant_count))["a"][gone & (kind == LEAF), :3]
    assert (np.abs(at - model.leaf_pose[leaves[0], :3]).max(1) < 1e-6).any()
    np.testing.assert_array_equal(sizes()[~gone], before[~gone])
    assert (primitives.cluster_version != versions).any()
    assert len(primitives.stump_keys) >= gone.sum()  # pages learn of them
    physics.cut(segment, 0.5 * float(model.body_length[segment]))
    primitives.update(physics.snapshot())
    assert (sizes()[gone, 0] < 1e-5).all()
    primitives.update(full)  # a world that was set back
    np.testing.assert_array_equal(sizes(), before)
