"""The model: forward kinematics against composed transforms, depth, digest."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vinesim.core import frames
from vinesim.scene import builder

WOOD = builder.RodMaterial(1e9, 900.0)


@pytest.fixture
def model():
    trees = []
    for k in range(3):
        tree = builder.TreeBuilder(frames.pose(np.array([k, 0.5 * k, 2.0]), frames.from_yaw(0.3 * k)), vine=k)
        tree.add_rod(-1, 0.8, (0.004, 0.002), WOOD, 4 + k, rest=frames.exp(np.array([0.1, 0.2, 0.3])))
        tree.add_rod(1, 0.3, (0.002, 0.001), WOOD, 2, rest=frames.from_yaw(0.7))
        trees.append(tree)
    return builder.assemble(trees)


def test_forward_kinematics_is_the_chain_of_transforms(model):
    joint_q = Rotation.random(len(model.body_mass), random_state=5).as_quat()
    found = model.forward_kinematics(joint_q)

    def matrix(position, quaternion):
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
        return m

    for body in range(len(joint_q)):
        chain = np.eye(4)
        at = body
        while at >= 0:
            chain = matrix(model.body_offset[at], model.body_rest[at]) @ matrix(np.zeros(3), joint_q[at]) @ chain
            root = model.tree_pose[model.body_tree[at]]
            at = int(model.body_parent[at])
        chain = matrix(root[:3], root[3:]) @ chain
        assert np.allclose(found[body, :3], chain[:3, 3], atol=1e-6)
        assert np.allclose(frames.to_matrix(found[body, 3:]), chain[:3, :3], atol=1e-6)


def test_depth_counts_ancestors(model):
    for body, depth in enumerate(model.depth()):
        count = 0
        at = model.body_parent[body]
        while at >= 0:
            count = count + 1
            at = model.body_parent[at]
        assert count == depth


def test_bodies_of_a_tree(model):
    assert [model.bodies_of(t) for t in range(3)] == [slice(0, 6), slice(6, 13), slice(13, 21)]
    assert model.tree_vine.tolist() == [0, 1, 2]


def test_the_digest_depends_on_every_bit(model):
    before = model.digest()
    changed = model.copy()
    assert changed.digest() == before
    changed.body_mass[3] = np.nextafter(changed.body_mass[3], np.float32(1.0))
    assert changed.digest() != before
    assert len(before) == 16


def test_an_empty_model_is_valid():
    empty = builder.assemble([])
    assert empty.forward_kinematics(empty.joint_settled).shape == (0, 7)
    assert set(empty.counts().values()) == {0}
