"""Scenes for tests of the sensors."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import trimesh

from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraInfo, RigidVisual, Shape, Snapshot
from vinesim.sensors.camera.camera import CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole

IDEAL = CameraSpec.load("pinhole")
SMALL = IDEAL.info("optical", 0.5)
AHEAD = look_at(np.array([0, 0, 1.0]), np.array([1.0, 0.0, 1.0]))
"""An optical frame 1 m above the origin that looks along +x."""


@functools.cache
def demo() -> Model:
    return generate(load_scene("demo"))


@functools.cache
def empty() -> Model:
    return Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, tie=0, box=0)


def shape(kind: str, *size: float, at=(0.0, 0.0, 0.0), turn=frames.IDENTITY, **others) -> Shape:
    return Shape(kind, tuple(size), frames.pose(np.array(at, float), turn), **others)


def thing(*shapes: Shape, name: str = "thing", organ: Organ = Organ.ROBOT, index: int = 0) -> RigidVisual:
    return RigidVisual(name, organ, index, tuple(shapes))


def world(*links: RigidVisual, model: Model | None = None, at=None, grass: float = 0.0) -> tuple[Primitives, Snapshot]:
    """Primitives that show ``links`` at poses ``at`` [link, 7] (the origin unless given)."""
    model = empty() if model is None else model
    poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(links), 1)) if at is None else np.asarray(at, float)
    view = rest_snapshot(model, links, poses)
    primitives = Primitives(model, grass=grass)
    primitives.update(view)
    return primitives, view


def everything(folder: Path) -> Primitives:
    """The demo scene with grass and one solid of each kind between its rows; ``folder`` takes a mesh."""
    turn = frames.normalize(np.array([0.3, 0.2, -0.4, 0.8]))
    solids = thing(
        shape("box", 0.2, 0.1, 0.3),
        shape("cylinder", 0.08, 0.2, at=(0, 0, 0.5), turn=turn),
        shape("capsule", 0.07, 0.2, at=(0.3, 0, 0.5), turn=turn),
        shape("ellipsoid", 0.1, 0.05, 0.2, at=(-0.3, 0, 0.5), turn=turn),
        shape("sphere", 0.1, at=(0, 0.3, 0.6)),
    )
    trimesh.creation.icosphere(2, radius=0.15).export(folder / "ball.stl")
    ball = thing(shape("mesh", 1.0, 1.0, 1.0, at=(0, -0.3, 0.6), file=str(folder / "ball.stl")), name="mesh", index=1)
    at = np.tile([1.2, 1.0, 0.6, *frames.from_yaw(0.5)], (2, 1))
    return world(solids, ball, model=demo(), at=at, grass=3.0)[0]


def raster(primitives: Primitives, pose: np.ndarray, info: CameraInfo = SMALL) -> tuple[np.ndarray, np.ndarray]:
    """Depth (inf for nothing) and primitive numbers [height, width] by the rasteriser."""
    seen = CameraRasterizer(info.width, info.height)
    seen.draw(primitives, pinhole(info, pose))
    shape = (info.height, info.width)
    return seen.depth.numpy().reshape(shape), seen.primitive.numpy().reshape(shape)


def oracle(primitives: Primitives, pose: np.ndarray, info: CameraInfo = SMALL) -> tuple[np.ndarray, np.ndarray]:
    """The same by the ray caster."""
    return RayCaster(primitives).cast_camera(pinhole(info, pose))


def pixel_rays(info: CameraInfo = SMALL) -> np.ndarray:
    """Rays [height, width, 3] of all pixels in the optical frame, 1 along its axis, float64."""
    u, v = np.meshgrid(np.arange(info.width), np.arange(info.height))
    return np.stack([(u - info.cx) / info.fx, (v - info.cy) / info.fy, np.ones(u.shape)], -1)


def finely(primitives: Primitives, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cones, berries and leaves [k] as triangles: vertices [n, 3] m and faces [m, 3]."""
    shapes = primitives.shapes
    kind = shapes.kind.numpy()
    a, b, c, d = (getattr(shapes, name).numpy().astype(float) for name in "abcd")
    outline = shapes.outline.numpy()
    ball = trimesh.creation.icosphere(3)
    v, u = np.meshgrid(np.linspace(-0.74, 1.24, 100), np.linspace(-0.98, 0.98, 99), indexing="ij")
    corner = np.arange(u.size).reshape(u.shape)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], -1).reshape(-1, 4)
    parts = []
    for i in which:
        if kind[i] == 1:
            points = ball.vertices * a[i, 3]
            points = points + np.outer(points @ b[i, :3], b[i, :3]) * (b[i, 3] - 1.0) + a[i, :3]
            parts.append((points, ball.faces))
        elif kind[i] == 0:
            # the hull of two spheres: a prism between the circles where the tangent cone touches them
            axis = b[i, :3] - a[i, :3]
            length = np.linalg.norm(axis)
            axis /= length
            lean = (a[i, 3] - b[i, 3]) / length
            for end in (a[i], b[i]):
                parts.append((ball.vertices * end[3] + end[:3], ball.faces))
            if abs(lean) < 1.0:
                side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
                side /= np.linalg.norm(side)
                angle = np.arange(96) * (2.0 * np.pi / 96)
                round_ = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(axis, side))
                normal = axis * lean + round_ * np.sqrt(1.0 - lean * lean)
                points = np.concatenate([end[:3] + normal * end[3] for end in (a[i], b[i])])
                k = np.arange(96)
                n = (np.arange(96) + 1) % 96
                parts.append((points, np.concatenate([np.stack([k, n, k + 96], 1), np.stack([n, n + 96, k + 96], 1)])))
        else:
            rib = b[i, :3]
            up = c[i, :3]
            height = d[i, 0] * u**2 + d[i, 1] * v**2 + d[i, 2] * np.abs(u)
            points = (u[..., None] * np.cross(rib, up) + v[..., None] * rib + height[..., None] * up) * a[i, 3] + a[
                i, :3
            ]
            row = ((v.ravel()[quads].mean(1) + 0.75) * 128.0).astype(int)
            column = ((u.ravel()[quads].mean(1) + 1.0) * 128.0).astype(int)
            kept = quads[outline[int(b[i, 3]), row, column] > 0]
            parts.append((points.reshape(-1, 3), np.concatenate([kept[:, [0, 1, 2]], kept[:, [0, 2, 3]]])))
    starts = np.cumsum([0] + [len(points) for points, _ in parts])
    vertices = np.concatenate([points for points, _ in parts])
    return vertices, np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)])
