"""``vinesim bench camera``: depth, labels and pictures compared with Open3D's ray caster (Embree), in one process.

Both render the same vineyard. Open3D needs a mesh of it (berries as icospheres of 80 triangles, canes as prisms, leaves
as quads), about 0.9 million triangles. Cases alternate. Medians of CPU time of the whole process are compared, so the
number of cores that each uses does not matter.
"""

from __future__ import annotations

import dataclasses
import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import trimesh

from vinesim.bench.scenes import interleaved_medians
from vinesim.core import frames
from vinesim.core.thread_pool import MAX_THREADS, usable_cores
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraInfo, CameraOutput, Measurement
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.camera.stereo import Stereo
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF, SPHEROID

_ROUNDS = 7


def median_cpu_times(*cases: Callable[[], object]) -> list[float]:
    """Returns the median processor time [ms] of each case; the cases run in turn."""
    spent: list[list[float]] = [[] for _ in cases]
    for case in cases:
        case()
    for _ in range(_ROUNDS):
        for case, times in zip(cases, spent, strict=True):
            start = time.process_time()
            case()
            times.append((time.process_time() - start) * 1e3)
    return [statistics.median(times) for times in spent]


def triangle_mesh(primitives: Primitives) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices [n, 3] m and triangles [m, 3] of plants and posts, as finely as another simulator would draw
    them."""
    kind = primitives.shapes.kind.numpy()
    a, b, c = (getattr(primitives.shapes, name).numpy() for name in "abc")
    vertices = []
    faces = []
    first = 0

    def add(points: np.ndarray, triangles: np.ndarray) -> None:
        """Add copies of one mesh. ``points``: vertices of each copy [copy, vertex, 3] m; ``triangles`` [k, 3]: indices
        of a copy's vertices."""
        nonlocal first
        count, each = points.shape[:2]
        vertices.append(points.reshape(-1, 3))
        faces.append((triangles[None] + (first + each * np.arange(count))[:, None, None]).reshape(-1, 3))
        first += count * each

    ball = trimesh.creation.icosphere(1)
    here = kind == SPHEROID
    axis = b[here, None, :3]
    points = ball.vertices[None] * np.ones((here.sum(), 1, 1))
    points = points + axis * ((points * axis).sum(-1, keepdims=True) * (b[here, None, 3:] - 1.0))
    add(a[here, None, :3] + points * a[here, None, 3:], np.asarray(ball.faces))
    here = kind == CONE
    along = b[here, :3] - a[here, :3]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    side = np.cross(along, np.where(np.abs(along[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angle = np.arange(6) * np.pi / 3.0
    ring = side[:, None] * np.cos(angle)[:, None] + other[:, None] * np.sin(angle)[:, None]
    ends = np.concatenate([p[here, None, :3] + ring * p[here, None, 3:] for p in (a, b)], 1)
    k = np.arange(6)
    n = (np.arange(6) + 1) % 6
    add(ends, np.concatenate([np.stack([k, n, k + 6], 1), np.stack([n, n + 6, k + 6], 1)]))
    here = kind == LEAF
    rib = b[here, :3]
    up = c[here, :3]
    size = a[here, 3:]
    across = np.cross(rib, up)
    corners = [
        a[here, :3] + size * (u * across + v * rib) for u, v in ((-0.6, -0.3), (0.6, -0.3), (0.6, 0.9), (-0.6, 0.9))
    ]
    add(np.stack(corners, 1), np.array([[0, 1, 2], [0, 2, 3]]))
    low = a[:, :2].min(0) - 50.0
    high = a[:, :2].max(0) + 50.0
    ground = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
    add(ground[None], np.array([[0, 1, 2], [0, 2, 3]]))
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


def demo_scene() -> tuple[Model, Primitives]:
    """Returns the vineyard of the benches ``camera`` and ``lidar``, without grass."""
    model = generate(load_scene("demo"))
    return model, Primitives(model, grass=0.0)


def embree_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Returns Open3D's ray caster over a triangle mesh."""
    import open3d as o3d

    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))  # pyright: ignore[reportArgumentType, reportCallIssue] it does take arrays
    return rays


def camera() -> Iterator[Measurement]:
    """Measure processor times of the rasteriser and of whole pictures, compared with Open3D if it is installed."""
    _, primitives = demo_scene()
    spec = CameraSpec.load("pinhole")
    info = spec.info("optical")
    pose = look_at(np.array([-0.6, 1.0, 1.45]), np.array([8.0, 1.35, 1.45]))
    seen = CameraRasterizer(info.width, info.height)
    lens = pinhole(info, pose)
    eyes = {name: Camera(spec, info, quality=name) for name in ("fast", "full")}
    cases: list[Callable[[], object]] = [lambda: seen.draw(primitives, lens)]
    cases += [lambda eye=eye: eye.render(primitives, pose) for eye in eyes.values()]
    name = f"depth and labels 640x480, {primitives.count} primitives"
    peer = ""
    if find_spec("open3d") is not None:
        import open3d as o3d

        vertices, faces = triangle_mesh(primitives)
        # pyright: ignore[reportArgumentType, reportCallIssue] it does take arrays
        scene = embree_scene(vertices, faces)
        rays = o3d.core.Tensor(_rays(info, pose))
        cases.append(lambda: scene.cast_rays(rays))
        peer = f"Open3D {o3d.__version__}, {len(faces)} triangles"
    raster, *pictures = median_cpu_times(*cases)
    if peer:
        theirs = pictures.pop()
        yield Measurement("camera", name, raster, "CPU ms", peer, theirs, theirs / raster)
    else:
        yield Measurement("camera", name, raster, "CPU ms")
    for quality, spent in zip(eyes, pictures, strict=True):
        yield Measurement("camera", f"picture 640x480, {quality}, cached shadows", spent, "CPU ms")
    yield from live_camera()


def live_camera() -> Iterator[Measurement]:
    """Measure one live D435 picture with depth, stage by stage, each with its budget."""
    model = generate(load_scene("demo"))
    primitives = Primitives(model)
    spec = CameraSpec.load("d435")
    info = spec.info("optical")
    pose = look_at(np.array([-0.6, 1.0, 1.45]), np.array([8.0, 1.35, 1.45]))
    one, all_cores = (Camera(spec, info, quality="fast", threads=threads) for threads in (1, None))
    plain = Camera(spec.coloured("exact"), info, quality="fast", threads=1)
    wanted = CameraOutput.RGB | CameraOutput.DEPTH
    swaying = np.arange(0, len(model.body_mass) // 20)
    snapshots = [
        dataclasses.replace(rest_snapshot(model), moved_trees=np.unique(model.body_tree[swaying])) for _ in "ab"
    ]
    snapshots[1].body_q[swaying, 2] += 0.01
    frames_made = itertools.count()

    def part_of_shadows() -> None:
        number = next(frames_made)
        primitives.update(snapshots[number % 2])
        one.update_shadows(primitives, pose, float(number))

    def shadows() -> None:
        primitives.layout_version += 1
        one.update_shadows(primitives, pose, 0.0)

    lens = pinhole(info, pose)
    frame = one.render(primitives, pose)
    exact = frame.exact_depth
    assert spec.stereo is not None
    assert exact is not None
    reach = (spec.nearest.value, spec.farthest.value)
    rng = np.random.default_rng(1)
    stereo = Stereo(spec.stereo, info, reach, second_from_first=True)
    cases: list[tuple[str, Callable[[], object], float]] = [
        ("visibility", lambda: one.rasterizer.draw(primitives, lens), 30.0),
        ("visibility, light and tone", lambda: one.render_on_device(primitives, pose), 50.0),
        (
            "second view, matching, noise",
            lambda: stereo.measure(primitives, lens, exact, frame.rgb, rng),
            20.0,
        ),
        ("whole frame, nothing moves", lambda: one.render(primitives, pose, outputs=wanted), 90.0),
        ("the same, exact colours", lambda: plain.render(primitives, pose, outputs=wanted), 90.0),
        ("shadow maps, one vine in twenty moved", part_of_shadows, 15.0),
        ("shadow maps, both drawn anew", shadows, 45.0),
    ]
    for (name, _, budget), spent in zip(cases, median_cpu_times(*(work for _, work, _ in cases)), strict=True):
        yield Measurement("camera", f"live D435, {name}", spent, "CPU ms", "budget", budget, budget / spent)
    by_one, by_all = interleaved_medians(
        *(lambda camera=camera: camera.render(primitives, pose, outputs=wanted) for camera in (one, all_cores))
    )
    cores = min(usable_cores(), MAX_THREADS)
    name = f"live D435, whole frame, {cores} threads"
    yield Measurement("camera", name, 1e3 * by_all, "ms", "one thread", 1e3 * by_one, by_one / by_all)


def _rays(info: CameraInfo, pose: np.ndarray) -> np.ndarray:
    """Returns the origins and directions [height, width, 6] of the rays of all pixels, in the world."""
    u, v = np.meshgrid(np.arange(info.width), np.arange(info.height))
    local = np.stack([(u - info.cx) / info.fx, (v - info.cy) / info.fy, np.ones(u.shape)], -1)
    d = frames.rotate(pose[3:], local)
    return np.concatenate([np.broadcast_to(pose[:3], d.shape), d], -1).astype(np.float32)
