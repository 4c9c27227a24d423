"""The rasteriser against closed forms in double precision and against the ray caster."""

import numpy as np
import pytest
import trimesh

from tests.support import sensor_scenes
from tests.support.long_rows import each_once, long
from vinesim.core import frames
from vinesim.scene.ids import Organ
from vinesim.scene.values import CameraInfo
from vinesim.sensors.export.images import look_at

pytestmark = pytest.mark.slow

SKEW = frames.normalize(np.array([0.3, 0.2, -0.4, 0.8]))


def _march(distance, rays: np.ndarray, eye: np.ndarray, turn: np.ndarray, far: float = 10.0) -> np.ndarray:
    """Depth by sphere tracing a distance field [m] in world coordinates; inf where nothing is met."""
    d = frames.rotate(turn, rays)
    length = np.linalg.norm(d, axis=-1)
    t = np.zeros(rays.shape[:-1])
    for _ in range(400):
        t += distance(eye + d * t[..., None]) / length
    return np.where((t < far) & (distance(eye + d * np.minimum(t, far)[..., None]) < 1e-7), t, np.inf)


def _capsule(a, b, r):
    def distance(p):
        h = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        return np.linalg.norm(p - a - h[..., None] * (b - a), axis=-1) - r

    return distance


def _box(half):
    def distance(p):
        q = np.abs(p) - half
        return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(-1), 0.0)

    return distance


@pytest.mark.parametrize(("kind", "away"), each_once(["sphere", "capsule", "box", "cylinder"], [0.3, 1.5, 3.0]))
def test_depth_is_exact(kind: str, away: float) -> None:
    eye = np.array([-away, 0.02, 1.03])
    pose = look_at(eye, np.array([0.0, 0.0, 1.0]))
    axis = frames.rotate(SKEW, np.array([0.0, 0.0, 0.09]))
    centre = np.array([0.0, 0.0, 1.0])
    local = lambda p: frames.rotate(frames.conjugate(SKEW), p - centre)  # noqa: E731
    made, field = {
        "sphere": (
            sensor_scenes.shape("sphere", 0.08, at=centre),
            lambda p: np.linalg.norm(p - centre, axis=-1) - 0.08,
        ),
        "capsule": (
            sensor_scenes.shape("capsule", 0.05, 0.09, at=centre, turn=SKEW),
            _capsule(centre - axis, centre + axis, 0.05),
        ),
        "box": (
            sensor_scenes.shape("box", 0.1, 0.06, 0.04, at=centre, turn=SKEW),
            lambda p: _box(np.array([0.1, 0.06, 0.04]))(local(p)),
        ),
        "cylinder": (
            sensor_scenes.shape("cylinder", 0.05, 0.09, at=centre, turn=SKEW),
            lambda p: _box(np.array([0.05, 0.09]))(np.stack([np.hypot(*local(p)[..., :2].T).T, local(p)[..., 2]], -1)),
        ),
    }[kind]
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(made))
    info = CameraInfo(160, 120, 420.0, 400.0, 78.2, 61.7, "optical")
    depth, primitive = sensor_scenes.raster(primitives, pose, info)
    truth = _march(field, sensor_scenes.pixel_rays(info), eye, pose[3:])
    here = primitive >= 0
    there = np.isfinite(truth)
    assert there.sum() > 80
    assert (here != there).sum() <= 0.02 * there.sum() + 2  # grazing rays only
    both = here & there
    error = np.abs(depth[both] - truth[both])
    assert error.max() < 2e-4
    assert np.median(error) < 1e-5


def test_a_plane_at_a_known_depth() -> None:
    primitives, _ = sensor_scenes.world(
        sensor_scenes.thing(sensor_scenes.shape("box", 0.5, 5.0, 5.0, at=(2.0, 0.0, 1.0)))
    )
    depth, primitive = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
    assert (primitive >= 0).all()
    assert np.abs(depth - 1.5).max() < 2e-6


VIEWPOINTS = {
    "along the rows": ([-1.9, 1.0, 1.45], [6.0, 1.2, 1.4]),
    "up into the canopy": ([1.2, 1.2, 1.3], [1.3, 1.2, 2.0]),
    "down on a vine": ([0.9, 0.7, 2.2], [0.0, 0.0, 0.3]),
    "grazing the canopy": ([-2.0, 1.2, 1.95], [3.0, 1.2, 1.97]),
    "inside the canopy": ([1.1, 0.2, 1.97], [2.0, 0.4, 1.95]),
    "along a wire": ([1.0, 0.0, 2.02], [3.0, 0.0, 2.0]),
    "solids": ([0.2, 0.1, 1.2], [1.2, 1.0, 0.9]),
    "solids at arm's length": ([1.0, 0.85, 1.1], [1.2, 1.0, 1.1]),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return sensor_scenes.everything(tmp_path_factory.mktemp("mesh"))


@pytest.mark.parametrize("where", VIEWPOINTS)
def test_the_ray_caster_sees_the_same(scene, where: str) -> None:
    pose = look_at(*map(np.array, VIEWPOINTS[where]))
    depth, primitive = sensor_scenes.raster(scene, pose)
    truth, ids = sensor_scenes.oracle(scene, pose)
    same = primitive == ids
    assert len(np.unique(ids)) > 10
    assert same.mean() >= 0.999
    close = same & (truth < 20.0)
    assert np.quantile(np.abs(depth[close] - truth[close]), 0.9999) < 3e-4  # the rest: curled leaves seen edge-on


def test_the_ray_caster_sees_the_same_from_anywhere(scene) -> None:
    rng = np.random.default_rng(4)
    agree = 0
    total = 0
    for _ in range(6):
        eye = rng.uniform([0.0, 0.0, 1.5], [5.0, 2.5, 2.2])
        pose = look_at(eye, eye + rng.normal(size=3))
        agree += (sensor_scenes.raster(scene, pose)[1] == sensor_scenes.oracle(scene, pose)[1]).sum()
        total += sensor_scenes.SMALL.width * sensor_scenes.SMALL.height
    assert agree / total >= 0.999


@pytest.mark.parametrize(
    ("kind", "side"),
    each_once(["sphere", "capsule", "cylinder", "box", "ellipsoid"], [(0.0, 0.06), (0.06, 0.0), (-0.05, 0.05)]),
)
def test_what_crosses_the_pinhole_plane_is_seen(kind: str, side: tuple[float, float]) -> None:
    """A solid beside the pinhole, half of it behind: seen as the ray caster sees it."""
    size = {
        "sphere": (0.05,),
        "capsule": (0.03, 0.2),
        "cylinder": (0.03, 0.2),
        "box": (0.2, 0.03, 0.04),
        "ellipsoid": (0.2, 0.03, 0.04),
    }[kind]
    turn = frames.exp(np.array([0.0, 1.3, 0.0])) if kind in ("capsule", "cylinder") else frames.IDENTITY
    primitives, _ = sensor_scenes.world(
        sensor_scenes.thing(sensor_scenes.shape(kind, *size, at=(0.01, side[0], 1.0 + side[1]), turn=turn))
    )
    _, primitive = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
    _, ids = sensor_scenes.oracle(primitives, sensor_scenes.AHEAD)
    assert (ids >= 0).sum() > 50
    assert (primitive == ids).mean() >= 0.999


GRAZING = {
    "sphere": ((0.3,), (0.0, 0.0, 0.302)),
    "capsule": ((0.05, 0.6), (0.0, 0.0, 0.052)),
    "cylinder": ((0.05, 0.6), (0.0, 0.0, 0.052)),
    "box": ((0.6, 0.6, 0.05), (0.0, 0.0, 0.052)),
    "ellipsoid": ((0.6, 0.3, 0.05), (0.0, 0.0, 0.052)),
    "mesh": ((1.0, 1.0, 1.0), (0.0, 0.0, 0.052)),
}
"""A solid and a point 2 mm above its middle: seen from there, all of it is grazed."""


@pytest.mark.parametrize(("kind", "away"), each_once(list(GRAZING), [0.0, 0.7, 1.5]))
def test_what_is_grazed_is_seen(kind: str, away: float, tmp_path) -> None:
    """Along a surface, from 2 mm above it, from its middle, its end and beyond."""
    size, above = GRAZING[kind]
    file = tmp_path / "slab.stl"
    trimesh.creation.box((1.2, 1.2, 0.1)).subdivide().export(file)
    turn = frames.exp(np.array([0.0, np.pi / 2.0, 0.0])) if kind in ("capsule", "cylinder") else frames.IDENTITY
    made = sensor_scenes.shape(
        kind, *size, at=(0.0, 0.0, 1.0), turn=turn, **({"file": str(file)} if kind == "mesh" else {})
    )
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(made))
    eye = np.array([-away, 0.0, 1.0]) + above
    pose = look_at(eye, eye + np.array([1.0, 0.05, -0.01]))
    depth, primitive = sensor_scenes.raster(primitives, pose)
    truth, ids = sensor_scenes.oracle(primitives, pose)
    same = primitive == ids
    assert (ids >= 0).sum() > 50
    assert same.mean() >= 0.999
    assert np.median(np.abs(depth[same & (ids >= 0)] - truth[same & (ids >= 0)])) < 2e-5


def test_leaves_seen_edge_on() -> None:
    model = sensor_scenes.demo()
    primitives, view = sensor_scenes.world(model=model)
    blade = frames.compose(view.body_q[model.leaf_body], model.leaf_pose)[::400]
    shown = 0
    for pose in blade:
        eye = pose[:3] + frames.rotate(pose[3:], np.array([-0.25, 0.02, 0.003]))
        camera = look_at(eye, pose[:3] + frames.rotate(pose[3:], np.array([0.05, 0.0, 0.0])))
        primitive = sensor_scenes.raster(primitives, camera)[1]
        ids = sensor_scenes.oracle(primitives, camera)[1]
        shown += (primitives.organ[ids[ids >= 0]] == int(Organ.LEAF)).any()
        assert (primitive == ids).mean() >= 0.999
    assert shown >= len(blade) // 2


def test_a_mesh_that_crosses_the_pinhole_plane_is_seen(tmp_path) -> None:
    file = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2, radius=0.05).export(file)
    for side in ((0.0, 0.06), (0.06, 0.0), (-0.05, 0.05)):
        ball = sensor_scenes.shape("mesh", 1.0, 1.0, 1.0, at=(0.01, side[0], 1.0 + side[1]), file=str(file))
        primitives, _ = sensor_scenes.world(sensor_scenes.thing(ball))
        primitive = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)[1]
        ids = sensor_scenes.oracle(primitives, sensor_scenes.AHEAD)[1]
        assert (ids >= 0).sum() > 50
        assert (primitive == ids).mean() >= 0.999


def test_leaves_that_cross_the_pinhole_plane_are_seen() -> None:
    model = sensor_scenes.demo()
    primitives, view = sensor_scenes.world(model=model)
    leaf = view.body_q[model.leaf_body]
    blade = frames.compose(leaf, model.leaf_pose)[::300]
    crossing = 0
    for pose in blade:
        eye = pose[:3] + frames.rotate(pose[3:], np.array([0.03, 0.0, 0.004]))
        camera = look_at(eye, eye + frames.rotate(pose[3:], np.array([1.0, 0.2, -0.15])))
        primitive = sensor_scenes.raster(primitives, camera)[1]
        ids = sensor_scenes.oracle(primitives, camera)[1]
        crossing += (primitives.organ[ids[ids >= 0]] == int(Organ.LEAF)).mean() > 0.3
        assert (primitive == ids).mean() >= 0.999
    assert crossing >= len(blade) // 2


def test_a_camera_inside_a_housing_looks_out(tmp_path) -> None:
    file = tmp_path / "housing.stl"
    trimesh.creation.box((0.2, 0.2, 0.2)).export(file)
    shell = (
        sensor_scenes.shape("mesh", 1.0, 1.0, 1.0, at=(0, 0, 1), file=str(file)),
        sensor_scenes.shape("box", 0.1, 0.1, 0.1, at=(0, 0, 1)),
    )
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.5, 5.0, 5.0, at=(2.0, 0.0, 1.0)), name="wall", index=1)
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(*shell), wall)
    depth, _ = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
    assert np.abs(depth - 1.5).max() < 2e-6


@pytest.mark.parametrize("kind", ["ellipsoid", *long("cylinder", "box")])
def test_solids_all_around_the_pinhole_are_seen(kind: str) -> None:
    """Long and flat ones of any attitude, touching the eye or around it, beside, behind and in front of it."""
    rng = np.random.default_rng(11)
    seen = 0
    for _ in range(60):
        size = rng.uniform(0.005, 0.12, 3) * rng.choice([0.2, 1.0, 3.0], 3)
        at = np.array([0.0, 0.0, 1.0]) + rng.normal(size=3) * rng.choice([0.02, 0.08, 0.3])
        turn = frames.normalize(rng.normal(size=4))
        parts = sensor_scenes.shape(kind, *size[: 2 if kind == "cylinder" else 3], at=at, turn=turn)
        primitives, _ = sensor_scenes.world(sensor_scenes.thing(parts))
        _, primitive = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
        _, ids = sensor_scenes.oracle(primitives, sensor_scenes.AHEAD)
        assert (primitive == ids).mean() >= 0.999
        seen += (ids >= 0).sum() > 20
    assert 8 <= seen <= 55


def test_nothing_in_the_world_is_ground_and_sky() -> None:
    primitives, _ = sensor_scenes.world()
    depth, primitive = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
    assert set(np.unique(primitive)) == {-2, -1}
    row = int(sensor_scenes.SMALL.cy) + 60
    assert depth[row, 10] == pytest.approx(sensor_scenes.SMALL.fy / (row - sensor_scenes.SMALL.cy), rel=1e-5)


@pytest.mark.long
def test_depth_of_fine_meshes() -> None:
    """Open3D (Embree) sees berries as icospheres of 1,280 triangles, canes as prisms of 96 sides between such spheres,
    and leaves as sheets of some 6,000.
    """
    o3d = pytest.importorskip("open3d", reason="the peer of this test")
    primitives, _ = sensor_scenes.world(model=sensor_scenes.demo())
    pose = look_at(np.array([0.9, 0.75, 1.45]), np.array([1.1, 0.0, 1.5]))
    depth, primitive = sensor_scenes.raster(primitives, pose)
    shown = np.unique(primitive[primitive >= 0])
    scene = o3d.t.geometry.RaycastingScene()
    vertices, faces = sensor_scenes.finely(primitives, shown)
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    rays = frames.rotate(pose[3:], sensor_scenes.pixel_rays())
    rays = np.concatenate([np.broadcast_to(pose[:3], rays.shape), rays], -1).astype(np.float32)
    theirs = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    both = (primitive >= 0) & np.isfinite(theirs)
    assert both.sum() > 0.9 * (primitive >= 0).sum() > 1e4
    kind = primitives.shapes.kind.numpy()[primitive]
    error = np.abs(np.where(both, depth, 0.0) - np.where(both, theirs, 0.0))
    assert np.median(error[both]) <= 2e-4
    for one in (0, 1, 2):  # cones, berries, leaves
        assert np.median(error[both & (kind == one)]) <= 2e-4
