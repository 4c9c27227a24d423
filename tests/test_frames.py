"""Poses and quaternions against scipy's Rotation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vinesim.core import frames

G = np.random.default_rng(3)
A, B = (Rotation.random(200, random_state=k) for k in (1, 2))
V = G.normal(size=(200, 3))


def same(q, r):
    """Equal rotations: q and -q are one."""
    return np.abs(np.abs((q * r.as_quat()).sum(-1)) - 1.0).max() < 1e-12


def test_products_rotations_inverses():
    a = A.as_quat()
    b = B.as_quat()
    assert same(frames.multiply(a, b), A * B)
    assert same(frames.conjugate(a), A.inv())
    assert np.allclose(frames.rotate(a, V), A.apply(V), atol=1e-12)


def test_rotation_vectors_and_back():
    assert same(frames.exp(V), Rotation.from_rotvec(V))
    assert np.allclose(frames.log(A.as_quat()), A.as_rotvec(), atol=1e-10)
    assert np.allclose(frames.log(-A.as_quat()), A.as_rotvec(), atol=1e-10)
    small = 1e-9 * V
    assert np.allclose(frames.log(frames.exp(small)), small, rtol=1e-6, atol=1e-20)


def test_matrices_and_back():
    assert np.allclose(frames.to_matrix(A.as_quat()), A.as_matrix(), atol=1e-12)
    assert same(frames.from_matrix(A.as_matrix()), A)
    for half_turn in np.vstack([np.eye(3), [[0.6, 0.8, 0.0]]]):
        r = Rotation.from_rotvec(np.pi * half_turn)
        assert same(frames.from_matrix(r.as_matrix())[None], Rotation.concatenate([r]))


def test_from_x_axis_aligns_x_and_keeps_z_upwards():
    q = frames.from_x_axis(V)
    assert np.allclose(frames.rotate(q, np.array([1.0, 0.0, 0.0])), frames.normalize(V), atol=1e-12)
    z = frames.rotate(q, np.array([0.0, 0.0, 1.0]))
    assert (z[:, 2] > 0.0).all()
    up = frames.from_x_axis(np.array([0.0, 0.0, 1.0]))
    assert np.allclose(frames.rotate(up, np.array([1.0, 0.0, 0.0])), [0.0, 0.0, 1.0])


def test_poses_compose_and_invert():
    a = frames.pose(V, A.as_quat())
    b = frames.pose(V[::-1], B.as_quat())
    joint = frames.compose(a, b)
    assert np.allclose(joint[:, :3], V + A.apply(V[::-1]))
    assert same(joint[:, 3:], A * B)
    back = frames.compose(frames.inverse(a), joint)
    assert np.allclose(back[:, :3], b[:, :3], atol=1e-12)
    assert same(back[:, 3:], B)


def test_quaternion_order_of_mujoco():
    q = np.array([0.1, 0.2, 0.3, 0.9])
    assert frames.to_wxyz(q).tolist() == [0.9, 0.1, 0.2, 0.3]
    assert frames.from_wxyz(frames.to_wxyz(q)).tolist() == q.tolist()


def test_the_z_axis_of_an_optical_frame_is_the_links_x():
    """REP-103: optical z is the link's x, optical x its right (-y), optical y its down (-z)."""
    axes = frames.to_matrix(frames.OPTICAL).T
    assert np.allclose(axes, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)


def test_yaw_rotates_x_to_y():
    assert frames.rotate(frames.from_yaw(np.pi / 2), np.array([1.0, 0.0, 0.0])) == pytest.approx(
        [0.0, 1.0, 0.0], abs=1e-12
    )


def test_a_zero_quaternion_stays_zero():
    assert frames.normalize(np.zeros(3)).tolist() == [0.0, 0.0, 0.0]
