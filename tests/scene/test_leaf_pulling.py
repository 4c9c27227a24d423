"""Leaf pulling: leaves are missing in the fruit zone, and nothing else changes."""

import msgspec
import numpy as np
import pytest

from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.spec import load_scene


def test_pulled_leaves_are_missing_in_the_fruit_zone_alone():
    """All other leaves, wood and bunches keep their numbers; shares within four standard deviations."""
    scene = load_scene("cordon")
    models = []
    for left in (1.0, 0.3, 0.0):
        season = msgspec.structs.replace(scene.season, fruit_zone_leafiness=left, fruit_zone=0.35)
        models.append(generate_uncached(msgspec.structs.replace(scene, season=season)))
    full, some, none = models
    body_q = full.forward_kinematics(full.joint_settled)
    base = body_q[full.leaf_body, :3]  # a leaf is less than a segment of its shoot, 0.12 m, above the body's origin
    height = base[:, 2] - full.tree_pose[full.body_tree[full.leaf_body], 2]
    kept = [np.isin(full.leaf_pose[:, :3], one.leaf_pose[:, :3]).all(1) for one in (some, none)]
    assert kept[0].sum() == len(some.leaf_size)
    assert kept[1].sum() == len(none.leaf_size)
    assert not (kept[1] & ~kept[0]).any()
    assert kept[1][height > 0.4].all()
    low = height < 0.1
    assert not kept[1][low].any()
    assert kept[0][low].mean() == pytest.approx(0.3, abs=4.0 * (0.21 / low.sum()) ** 0.5)
    for one in (some, none):
        assert np.array_equal(one.bunch_seed, full.bunch_seed)
        assert np.array_equal(one.fixed_start, full.fixed_start)
        assert np.array_equal(one.body_length, full.body_length)
