"""Distances of segments and primitives against MuJoCo, dense sampling, and the definition."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from vinesim.core import frames
from vinesim.kernels.contact import distance

KINDS = {
    "plane": (0, (0.0, 0.0, 0.0)),
    "sphere": (2, (0.05, 0.0, 0.0)),
    "capsule": (3, (0.04, 0.1, 0.0)),
    "ellipsoid": (4, (0.05, 0.08, 0.1)),
    "cylinder": (5, (0.06, 0.09, 0.0)),
    "box": (6, (0.05, 0.07, 0.1)),
}


@wp.kernel
def _closest(
    # in
    kind: int,
    size: wp.vec3d,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    # out
    found_out: wp.array(dtype=wp.vec4d),
):
    """Normal and distance where one segment is closest to a primitive."""
    i = wp.tid()
    t = distance.closest_on_segment(kind, size, start[i], end[i])
    found_out[i] = distance.primitive_distance(kind, size, start[i] + t * (end[i] - start[i]))


def closest(kind: str, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    number, size = KINDS[kind]
    found = wp.zeros(len(start), dtype=wp.vec4d, device="cpu")
    ends = [wp.array(x, dtype=wp.vec3d, device="cpu") for x in (start, end)]
    wp.launch(_closest, len(start), inputs=[number, wp.vec3d(*size), *ends], outputs=[found], device="cpu")
    return found.numpy()


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder"])
@pytest.mark.parametrize("length", [0.0, 0.3])
def test_distance_of_segments_is_mujocos(kind, length):
    rng = np.random.default_rng(5)
    number, size = KINDS[kind]
    spec = mujoco.MjSpec()
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.worldbody.add_geom(type=mujoco.mjtGeom(number), size=size)
    body = spec.worldbody.add_body(mocap=True)
    thin = 0.001
    kind_of = mujoco.mjtGeom.mjGEOM_CAPSULE if length else mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(type=kind_of, size=[thin, length / 2, 0])
    world = spec.compile()
    data = mujoco.MjData(world)
    middle = rng.normal(size=(200, 3)) * 0.15
    turn = frames.normalize(rng.normal(size=(200, 4)))
    turn[:20] = frames.IDENTITY  # parallel to axes and faces
    axis = frames.rotate(turn, np.array([0.0, 0.0, length / 2]))
    mine = closest(kind, middle - axis, middle + axis)
    compared = 0
    for i in range(len(middle)):
        data.mocap_pos[0] = middle[i]
        data.mocap_quat[0] = frames.to_wxyz(turn[i])
        mujoco.mj_forward(world, data)
        gap = mujoco.mj_geomDistance(world, data, 0, 1, 10.0, None)
        if gap > 0.0:
            assert mine[i, 3] - thin == pytest.approx(gap, abs=2e-6)
            compared += 1
    assert compared > 80
    np.testing.assert_allclose(np.linalg.norm(mine[:, :3], axis=1), 1.0, atol=1e-12)


def test_the_lowest_point_of_a_segment_is_closest_to_a_plane():
    start = np.array([[0, 0, 0.2], [0, 0, 0.1], [0.3, 0, 0.1]])
    end = np.array([[1, 0, 0.1], [1, 0, 0.3], [0.9, 0, 0.1]])
    found = closest("plane", start, end)
    np.testing.assert_allclose(found[:, 3], 0.1, atol=1e-15)
    np.testing.assert_array_equal(found[:, :3], [[0, 0, 1]] * 3)


def test_distance_of_segments_and_a_box_equals_dense_sampling():
    """Against sampling, as MuJoCo's distance of a box to a capsule that pierces it is positive."""
    rng = np.random.default_rng(5)
    size = np.array(KINDS["box"][1])
    middle = rng.normal(size=(200, 3)) * 0.15
    turn = frames.normalize(rng.normal(size=(200, 4)))
    axis = frames.rotate(turn, np.array([0.0, 0.0, 0.15]))
    points = middle[:, None] + np.linspace(-1.0, 1.0, 2001)[:, None] * axis[:, None]
    beyond = np.abs(points) - size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    inside = beyond.max(-1)
    truth = np.where(inside < 0.0, inside, outside).min(1)
    mine = closest("box", middle - axis, middle + axis)[:, 3]
    assert (truth < 0.0).sum() > 20
    assert (mine <= truth + 1e-9).all()
    np.testing.assert_allclose(mine, truth, atol=1.5e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_distance_grows_along_its_normal_and_is_negative_inside(kind):
    rng = np.random.default_rng(2)
    points = rng.normal(size=(400, 3)) * 0.1
    found = closest(kind, points, points)
    step = 1e-5
    moved = closest(kind, points + step * found[:, :3], points + step * found[:, :3])
    smooth = (np.abs(found[:, 3]) < 0.01) if kind == "ellipsoid" else np.full(len(points), True)
    np.testing.assert_allclose(
        (moved[:, 3] - found[:, 3])[smooth] / step, 1.0, atol=0.1 if kind == "ellipsoid" else 1e-4
    )
    size = np.array(KINDS[kind][1])
    if kind in ("box", "ellipsoid"):
        inside = (np.abs(points) < size).all(1) if kind == "box" else ((points / size) ** 2).sum(1) < 1.0
        assert ((found[:, 3] < 0.0) == inside).all()


numbers = st.integers(-200, 200).map(lambda k: k / 1000.0)
points = st.tuples(numbers, numbers, numbers)


def true_distance(kind: str, p: np.ndarray) -> np.ndarray:
    """Signed distance of points [n, 3], straight from the definition; the ellipsoid's only on and outside of it."""
    size = np.array(KINDS[kind][1])
    if kind == "sphere":
        return np.linalg.norm(p, axis=1) - size[0]
    if kind == "capsule":
        return np.linalg.norm(p - np.clip(p[:, 2:], -size[1], size[1]) * [0, 0, 1], axis=1) - size[0]
    if kind == "box":
        beyond = np.abs(p) - size
        return np.where((beyond < 0).all(1), beyond.max(1), np.linalg.norm(np.maximum(beyond, 0), axis=1))
    across = np.hypot(p[:, 0], p[:, 1]) - size[0]
    along = np.abs(p[:, 2]) - size[1]
    inside = (across < 0) & (along < 0)
    return np.where(inside, np.maximum(across, along), np.hypot(np.maximum(across, 0), np.maximum(along, 0)))


@given(kind=st.sampled_from(["sphere", "capsule", "cylinder", "box"]), start=points, end=points)
def test_distance_of_a_segment_is_the_minimum_over_its_points(kind, start, end):
    a = np.array(start, float)
    b = np.array(end, float)
    along = np.linspace(0.0, 1.0, 2001)[:, None]
    truth = true_distance(kind, a + along * (b - a)).min()
    step = np.linalg.norm(b - a) / 2000
    mine = closest(kind, a[None], b[None])[0]
    assert truth - step - 1e-9 <= mine[3] <= truth + 1e-9 or mine[3] == pytest.approx(truth, abs=step + 1e-9)
    assert np.linalg.norm(mine[:3]) == pytest.approx(1.0, abs=1e-9)


def ellipsoid_distance(p: np.ndarray) -> np.ndarray:
    """Distance of points [n, 3] outside of the ellipsoid, by bisection of the Lagrange multiplier of its closest
    point."""
    square = np.array(KINDS["ellipsoid"][1]) ** 2
    low = np.zeros(len(p))
    high = np.linalg.norm(p, axis=1) * np.sqrt(square.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        outside = (square * (p / (square + middle[:, None])) ** 2).sum(1) > 1.0
        low = np.where(outside, middle, low)
        high = np.where(outside, high, middle)
    return np.linalg.norm(p - square * p / (square + low[:, None]), axis=1)


def test_distance_of_an_ellipsoid_is_exact_outside_and_of_first_order_inside():
    """Inside, the error is quadratic: below 2 % at 5 mm, and below 5 um for contacts within a millimetre."""
    rng = np.random.default_rng(3)
    size = np.array(KINDS["ellipsoid"][1])
    surface = size * frames.normalize(rng.normal(size=(2000, 3)))
    normal = frames.normalize(surface / size**2)
    truth = rng.uniform(-0.005, 0.005, len(surface))
    points = surface + truth[:, None] * normal
    found = closest("ellipsoid", points, points)
    outside = truth > 0.0
    np.testing.assert_allclose(found[outside, 3], truth[outside], atol=1e-9)
    np.testing.assert_allclose(found[outside, :3], normal[outside], atol=1e-7)
    assert (np.abs(found[:, 3] - truth) <= 4.0 * truth**2 + 1e-12).all()  # 1/m
    angle = np.linalg.norm(np.cross(found[:, :3], normal), axis=1)
    assert (angle <= 14.0 * np.abs(truth) + 1e-7).all()  # rad/m
    np.testing.assert_allclose(ellipsoid_distance(points[outside]), truth[outside], atol=1e-12)


@given(start=points, end=points)
def test_distance_of_a_segment_and_an_ellipsoid_has_the_right_sign_and_is_exact_outside(start, end):
    size = np.array(KINDS["ellipsoid"][1])
    a = np.array(start, float)
    b = np.array(end, float)
    p = a + np.linspace(0.0, 1.0, 2001)[:, None] * (b - a)
    mine = closest("ellipsoid", a[None], b[None])[0]
    depth = (np.linalg.norm(p / size, axis=1) - 1.0).min()
    if abs(depth) > 2e-3:
        assert np.sign(mine[3]) == np.sign(depth)
    if depth > 0.0:
        truth = ellipsoid_distance(p).min()
        step = np.linalg.norm(b - a) / 2000
        assert truth - step - 1e-8 <= mine[3] <= truth + 1e-8


@wp.kernel
def _crossing(
    # in
    a: wp.array(dtype=wp.vec3d),
    b: wp.array(dtype=wp.vec3d),
    c: wp.array(dtype=wp.vec3d),
    d: wp.array(dtype=wp.vec3d),
    # out
    found_out: wp.array(dtype=distance.vec6d),
):
    """Normal, distance and places where two segments are closest."""
    i = wp.tid()
    found_out[i] = distance.segment_segment_distance(a[i], b[i], c[i], d[i])


@given(a=points, b=points, c=points, d=points)
def test_distance_of_two_segments_is_the_minimum_over_their_points(a, b, c, d):
    ends = [np.array([x], float) for x in (a, b, c, d)]
    found = wp.zeros(1, dtype=distance.vec6d, device="cpu")
    wp.launch(
        _crossing, 1, inputs=[wp.array(x, dtype=wp.vec3d, device="cpu") for x in ends], outputs=[found], device="cpu"
    )
    mine = found.numpy()[0]
    t = np.linspace(0.0, 1.0, 301)[:, None]
    one, other = (x + t * (y - x) for x, y in (ends[:2], ends[2:]))
    truth = np.linalg.norm(one[:, None] - other[None], axis=-1).min()
    step = (np.linalg.norm(ends[1] - ends[0]) + np.linalg.norm(ends[3] - ends[2])) / 600
    assert truth - step - 1e-7 <= mine[3] <= truth + 1e-7
    assert np.linalg.norm(mine[:3]) == pytest.approx(1.0, abs=1e-9)


def test_a_segment_along_a_face_has_its_contact_in_the_middle():
    start = np.array([[0.06, 0.0, -0.04]])
    end = np.array([[0.06, 0.0, 0.04]])

    assert closest("box", start, end)[0] == pytest.approx([1.0, 0.0, 0.0, 0.01])


@wp.kernel
def _outside(
    # in
    half: wp.vec3d,
    reach: wp.float64,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    # out
    is_outside_out: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    is_outside_out[i] = distance.is_outside_box(half, start[i], end[i], reach)


@pytest.mark.parametrize(
    ("kind", "half"),
    [
        ("sphere", (0.05,) * 3),
        ("capsule", (0.04, 0.04, 0.14)),
        ("cylinder", (0.06, 0.06, 0.09)),
        ("box", KINDS["box"][1]),
    ],
)
def test_what_is_outside_the_box_of_a_shape_is_out_of_reach(kind, half):
    rng = np.random.default_rng(8)
    reach = 0.02
    start, end = rng.normal(size=(2, 5000, 3)) * 0.12
    is_outside = np.zeros(len(start), np.bool_)
    ends = [wp.array(x, dtype=wp.vec3d, device="cpu") for x in (start, end)]
    outputs = [wp.array(is_outside, dtype=wp.bool, device="cpu", copy=False)]
    wp.launch(_outside, len(start), inputs=[wp.vec3d(*half), reach, *ends], outputs=outputs, device="cpu")
    is_far = closest(kind, start, end)[:, 3] > reach
    assert is_far[is_outside].all()
    assert is_outside.sum() > 0.5 * is_far.sum()  # it finds most
