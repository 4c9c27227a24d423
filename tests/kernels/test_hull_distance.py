"""Distances of segments and convex hulls against quadratic programs, SciPy's hulls and MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import scipy.optimize
import scipy.spatial
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays
from vinesim.kernels.contact import distance, hull_distance, structs
from vinesim.rigid.collision_geoms import hull_arrays

TOLERANCE = 0.002


@wp.kernel
def _closest(
    # in
    hulls: structs.Hulls,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    reach: wp.float64,
    # out
    found_out: wp.array(dtype=distance.vec5d),
    interval_out: wp.array(dtype=wp.vec2d),
):
    """Where one segment is closest to the first hull, and the part of it that lies along that."""
    i = wp.tid()
    found_out[i] = hull_distance.segment_hull_distance(hulls, 0, start[i], end[i], reach)
    interval_out[i] = hull_distance.interval_along_hull(hulls, 0, start[i], end[i], found_out[i], wp.float64(TOLERANCE))


class Hull:
    """The hull that MuJoCo makes of points, as the contact kernels see it."""

    def __init__(self, points: np.ndarray) -> None:
        spec = mujoco.MjSpec()
        mesh = spec.add_mesh(name="hull", uservert=points.ravel(), maxhullvert=64)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[1e-3, 0.1, 0])
        self.world = spec.compile()
        self.arrays: SharedArrays = hull_arrays(self.world)
        m = self.world
        graph = m.mesh_graph
        places = graph[2 + graph[0] : 2 + 2 * graph[0]]
        self.vertices = m.mesh_vert[places].astype(float) - m.geom_aabb[0, :3]
        """[vertex, 3] m, in the frame of the arrays."""
        self.equations = scipy.spatial.ConvexHull(self.vertices).equations

    def closest(self, start: np.ndarray, end: np.ndarray, reach: float = 1e30) -> tuple[np.ndarray, np.ndarray]:
        """Distances [n, 5] and intervals [n, 2] of segments."""
        found = wp.zeros(len(start), dtype=distance.vec5d, device="cpu")
        interval = wp.zeros(len(start), dtype=wp.vec2d, device="cpu")
        ends = [wp.array(x, dtype=wp.vec3d, device="cpu") for x in (start, end)]
        inputs = [self.arrays.struct, *ends, wp.float64(reach)]
        wp.launch(_closest, len(start), inputs=inputs, outputs=[found, interval], device="cpu")
        return found.numpy(), interval.numpy()

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Points [n, 3] of the mesh's own frame in that of the arrays: MuJoCo turns meshes into axes of inertia."""
        m = self.world
        turned = frames.rotate(frames.conjugate(frames.from_wxyz(m.geom_quat[0])), points - m.geom_pos[0])
        return turned - m.geom_aabb[0, :3]

    def true_distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Outside, by least squares over convex combinations; inside, by the planes at 8001 places of the segment."""
        places = a + np.linspace(0.0, 1.0, 8001)[:, None] * (b - a)
        depth = (places @ self.equations[:, :3].T + self.equations[:, 3]).max(1).min()
        if depth <= 0.0:
            return float(depth)
        count = len(self.vertices)
        heavy = 1e3
        system = np.zeros((5, count + 2))
        system[:3, :count], system[:3, count], system[:3, count + 1] = self.vertices.T, -a, -b
        system[3, :count] = system[4, count:] = heavy
        weights, _ = scipy.optimize.nnls(system, np.array([0.0, 0.0, 0.0, heavy, heavy]))
        weights[:count] /= weights[:count].sum()
        weights[count:] /= weights[count:].sum()
        return float(np.linalg.norm(system[:3] @ weights))


def random_hull(rng: np.random.Generator) -> Hull:
    """Of 4 to 500 points in a box of some decimetres, flat or round."""
    points = rng.normal(size=(int(rng.integers(4, 500)), 3))
    if rng.random() < 0.5:
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Hull(points * rng.uniform(0.02, 0.2, 3))


def random_segments(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    middle = rng.normal(size=(count, 3)) * 0.15
    half = rng.normal(size=(count, 3)) * 0.05
    half[::5] = 0.0
    return middle - half, middle + half


@pytest.mark.parametrize("seed", range(6))
def test_distance_of_segments_is_that_of_a_quadratic_program(seed: int) -> None:
    """Within a tenth of a millimetre, inside and outside; and it grows along its normal as the segment moves."""
    rng = np.random.default_rng(seed)
    hull = random_hull(rng)
    assert len(hull.vertices) <= 64
    start, end = random_segments(rng, 60)
    found, _ = hull.closest(start, end)
    truth = np.array([hull.true_distance(a, b) for a, b in zip(start, end, strict=True)])
    np.testing.assert_allclose(found[:, 3], truth, atol=1e-4)
    outside = truth > 1e-3
    assert outside.sum() > 10
    np.testing.assert_allclose(found[outside, 3], truth[outside], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1.0, atol=1e-9)
    step = 1e-5
    moved, _ = hull.closest(start + step * found[:, :3], end + step * found[:, :3])
    np.testing.assert_allclose((moved[outside, 3] - found[outside, 3]) / step, 1.0, atol=1e-3)


def test_distance_of_segments_is_mujocos() -> None:
    """Of the same hull: what plants touch is what rigid bodies touch."""
    rng = np.random.default_rng(7)
    hull = random_hull(rng)
    m = hull.world
    data = mujoco.MjData(m)
    compared = 0
    for _ in range(100):
        place = rng.normal(size=3) * 0.2
        turn = frames.normalize(rng.normal(size=4))
        data.mocap_pos[0] = place
        data.mocap_quat[0] = frames.to_wxyz(turn)
        mujoco.mj_forward(m, data)
        gap = mujoco.mj_geomDistance(m, data, 0, 1, 10.0, None)
        axis = frames.rotate(turn, np.array([0.0, 0.0, 0.1]))
        start, end = (hull.to_local(p[None]) for p in (place - axis, place + axis))
        if gap > 0.0:
            assert hull.closest(start, end)[0][0, 3] - 1e-3 == pytest.approx(gap, abs=1e-5)
            compared += 1
    assert compared > 40


def test_beyond_its_reach_the_distance_is_a_lower_bound() -> None:
    rng = np.random.default_rng(3)
    hull = random_hull(rng)
    start, end = random_segments(rng, 200)
    exact = hull.closest(start, end)[0][:, 3]
    bound = hull.closest(start, end, reach=0.05)[0][:, 3]
    near = exact < 0.05
    assert near.sum() > 20
    assert (~near).sum() > 20
    np.testing.assert_array_equal(bound[near], exact[near])
    assert (bound <= exact).all()
    assert (bound[~near] > 0.0).all()


BRICK = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.02, 0.02)])


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        ((-0.2, 0.0, 0.03), (0.2, 0.0, 0.03), (0.25, 0.75)),  # over the top, beyond both ends
        ((-0.05, 0.0, 0.03), (0.05, 0.0, 0.03), (0.0, 1.0)),  # all of it above the top
        ((0.0, 0.0, 0.03), (0.4, 0.0, 0.03), (0.0, 0.25)),
        ((-0.2, 0.06, 0.03), (0.2, 0.06, 0.03), (0.25, 0.75)),  # along an edge
        ((0.0, 0.0, 0.03), (0.0, 0.0, 0.3), (0.0, 0.0)),  # stands on the top
        ((0.05, 0.01, 0.03), (0.05, 0.01, 0.03), (0.0, 0.0)),  # a sphere
    ],
)
def test_what_lies_along_a_face_or_an_edge_has_two_ends(
    start: tuple[float, ...], end: tuple[float, ...], expected: tuple[float, float]
) -> None:
    hull = Hull(BRICK)
    first, last = (hull.to_local(np.array([point])) for point in (start, end))
    found, interval = hull.closest(first, last)
    np.testing.assert_allclose(interval[0], expected, atol=1e-4)
    assert found[0, 3] == pytest.approx(0.01 if expected != (0.25, 0.75) or start[1] == 0.0 else 0.01 * 2**0.5)


def test_a_brick_has_the_faces_and_edges_of_a_box() -> None:
    """Of 12 triangles six faces and twelve edges are left."""
    arrays = Hull(BRICK).arrays
    assert (len(arrays.plane), len(arrays.edge_start)) == (6, 12)
    np.testing.assert_allclose(np.sort(arrays.plane[:, 3]), [0.02, 0.02, 0.05, 0.05, 0.1, 0.1], atol=1e-7)
