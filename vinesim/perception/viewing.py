"""Files of points and surfaces: reading, a picture without a window, and Open3D's viewer."""

from __future__ import annotations

import dataclasses
import itertools
import os
import pathlib
import sys

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.clouds import as_matrix, picture_cloud
from vinesim.perception.open3d_library import load_open3d
from vinesim.perception.tour import open_tour
from vinesim.scene.camera_geometry import intrinsic_matrix
from vinesim.scene.values import CameraFrame, CameraInfo
from vinesim.sensors.export.images import look_at
from vinesim.sensors.recorded_pictures import read_pictures

SUFFIXES = (".ply", ".pcd", ".xyz", ".pts", ".stl", ".obj")
"""Suffixes of files that Open3D reads."""
FIELD_OF_VIEW = np.radians(60.0)
"""Horizontal field of view of pictures without a window [rad]."""
FILLED = 0.95
"""Share of the width or height of a picture without a window that the shape fills, unless the user chooses a view."""
BACKGROUND = (245, 245, 245)
"""Colour of pictures without a window where nothing is seen, sRGB."""


class NoDisplay(RuntimeError):
    """A window cannot be opened here. The message is one line with the remedy."""

    exit_code = 3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A point cloud or a triangle mesh, ready to be drawn."""

    points: np.ndarray
    """[n, 3] m, points or vertices."""
    colours: np.ndarray
    """[n, 3] 0 to 1, sRGB."""
    triangles: np.ndarray
    """[m, 3] indices of vertices; size 0 for a cloud."""

    def __len__(self) -> int:
        return len(self.points)

    @property
    def text(self) -> str:
        """Size of the shape, for people."""
        extent = " x ".join(f"{edge:.2f}" for edge in np.ptp(self.points, axis=0))
        kind = (
            f"{len(self)} vertices, {len(self.triangles)} triangles" if self.triangles.size else f"{len(self)} points"
        )
        return f"{kind}, {extent} m"


def read_shape(path: pathlib.Path, number: int = 0, image: str | None = None, depth: str | None = None) -> Shape:
    """Returns the cloud or mesh of a file.

    Args:
        path: a file that Open3D reads, or RGB-D pictures: an MCAP file, or a folder of rosbag2, ``vinesim render`` or
            ``vinesim dataset``.
        number: index of the picture whose cloud is returned, with depth as it was measured.
        image: topic of the colours in a recording that has several.
        depth: topic of the depth in a recording that has several.

    Raises :class:`UsageError` if the file contains no points.
    """
    if not path.exists():
        raise UsageError(f"{path} is not there; give a file {', '.join(SUFFIXES)} or .mcap")
    if path.is_dir() or path.suffix.lower() == ".mcap":
        return _picture_shape(path, number, image, depth)
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path} has the suffix {path.suffix!r}; give a file {', '.join(SUFFIXES)} or .mcap")
    o3d = load_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        has_faces = path.suffix.lower() in (".stl", ".obj") or (path.suffix.lower() == ".ply" and _has_faces(path))
        shape = o3d.io.read_triangle_mesh(str(path)) if has_faces else o3d.io.read_point_cloud(str(path))
    points = np.asarray(shape.vertices if has_faces else shape.points)
    if not len(points):
        raise UsageError(f"{path} contains no points that Open3D can read; write it again")
    colours = np.asarray(shape.vertex_colors if has_faces else shape.colors)
    triangles = np.asarray(shape.triangles) if has_faces else np.zeros((0, 3), int)
    return Shape(points, colours if len(colours) else np.full_like(points, 0.5), triangles)


def draw(
    shape: Shape,
    width: int = 960,
    height: int = 720,
    eye: np.ndarray | None = None,
    target: np.ndarray | None = None,
) -> np.ndarray:
    """Returns a picture [height, width, 3] uint8 of a shape, computed without a window or a GPU.

    Args:
        shape: the shape to draw.
        width: columns of the picture [px].
        height: rows of the picture [px].
        eye: position [3] m of the camera; by default in front of the shape (-y), a little above, and so far away that
            the shape fills the picture.
        target: point [3] m that the camera looks at; by default the middle of the shape.
    """
    focal = 0.5 * width / np.tan(0.5 * FIELD_OF_VIEW)
    info = CameraInfo(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), "optical")
    start, middle = _fitting_view(shape.points, info)
    if target is not None:
        start = start + target - middle
        middle = target
    pose = look_at(start if eye is None else eye, middle)
    return _draw_mesh(shape, info, pose) if shape.triangles.size else _draw_points(shape, info, pose)


def _fitting_view(points: np.ndarray, info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """Returns position and target [3] m of a camera in front of points [n, 3] m, in whose picture 99 % of them just
    fit."""
    turn = look_at(np.zeros(3), np.array([-0.25, 0.9, -0.35]))[3:]
    seen = frames.rotate(frames.conjugate(turn), points.astype(float))  # columns: right, down, away
    middle = np.quantile(seen, (0.005, 0.995), axis=0).mean(axis=0)
    slopes = 0.5 * FILLED * np.array([info.width / info.fx, info.height / info.fy])
    away = 0.0
    for _ in range(8):  # near parts look larger, so the middle of the picture is found step by step
        aside = seen - middle
        away = max(np.quantile((np.abs(aside[:, :2]) / slopes).max(axis=1) - aside[:, 2], 0.99), 0.01)
        projected = aside[:, :2] / np.maximum(aside[:, 2] + away, 0.01 * away)[:, None]
        middle[:2] += away * np.quantile(projected, (0.005, 0.995), axis=0).mean(axis=0)
    return frames.rotate(turn, middle - [0.0, 0.0, away]), frames.rotate(turn, middle)


def show(shape: Shape, title: str) -> None:
    """Show a shape in Open3D's viewer until its window is closed. Raises :class:`NoDisplay` if no window can open."""
    if not has_display():
        raise NoDisplay("there is no display for Open3D's viewer; give --out picture.png, or set DISPLAY")
    o3d = load_open3d()
    if shape.triangles.size:
        drawn = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(shape.points), o3d.utility.Vector3iVector(shape.triangles)
        )
        drawn.vertex_colors = o3d.utility.Vector3dVector(shape.colours)
        drawn.compute_vertex_normals()
    else:
        drawn = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(shape.points))
        drawn.colors = o3d.utility.Vector3dVector(shape.colours)
    viewer = o3d.visualization.Visualizer()
    if not viewer.create_window(title):
        raise NoDisplay("Open3D's viewer cannot open a window on this display; give --out picture.png")
    viewer.add_geometry(drawn)
    try:
        while viewer.poll_events():
            viewer.update_renderer()
    finally:
        viewer.destroy_window()


def has_display() -> bool:
    """Returns whether a window can be opened, as far as the environment tells."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _picture_shape(path: pathlib.Path, number: int, image: str | None, depth: str | None) -> Shape:
    """Returns the cloud of one RGB-D picture of a recording, tour or data set."""
    is_tour = (path / "camera.json").exists() or any(path.glob("*/camera.json"))
    if is_tour:
        pictures = (one.read() for one in open_tour(path))
    else:
        pictures = read_pictures(path, image=image, depth=depth, rate=1.0)
    for frame in itertools.islice(pictures, number, None):
        return _cloud_shape(frame, path)
    raise UsageError(f"{path} has no picture number {number}; give a smaller --picture")


def _cloud_shape(frame: CameraFrame, path: pathlib.Path) -> Shape:
    cloud = picture_cloud(frame, world=True)
    points = cloud.point.positions.numpy().astype(float)
    if not len(points):
        raise UsageError(f"{path}: its picture has no depth; give another --picture")
    return Shape(points, cloud.point.colors.numpy().astype(float), np.zeros((0, 3), int))


def _has_faces(path: pathlib.Path) -> bool:
    """Returns whether the header of a PLY file declares faces."""
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:2] == [b"element", b"face"]:
                return int(words[2]) > 0
            if words == [b"end_header"]:
                break
    return False


def _draw_points(shape: Shape, info: CameraInfo, pose: np.ndarray) -> np.ndarray:
    o3d = load_open3d()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(shape.points, np.float32)))
    cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(shape.colours, np.float32))
    lens = o3d.core.Tensor(np.reshape(intrinsic_matrix(info), (3, 3)).astype(float))
    outer = o3d.core.Tensor(np.linalg.inv(as_matrix(pose)))
    image = cloud.project_to_rgbd_image(info.width, info.height, lens, outer, depth_scale=1.0, depth_max=1e4)
    depth = image.depth.as_tensor().numpy()[..., 0]
    colours = (np.clip(image.color.as_tensor().numpy(), 0.0, 1.0) * 255.0).round().astype(np.uint8)
    return np.where((depth > 0.0)[..., None], colours, np.array(BACKGROUND, np.uint8))


def _draw_mesh(shape: Shape, info: CameraInfo, pose: np.ndarray) -> np.ndarray:
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(shape.triangles, np.uint32)
    scene.add_triangles(o3d.core.Tensor(np.ascontiguousarray(shape.points, np.float32)), o3d.core.Tensor(corners))
    lens = o3d.core.Tensor(np.reshape(intrinsic_matrix(info), (3, 3)).astype(float))
    outer = o3d.core.Tensor(np.linalg.inv(as_matrix(pose)))
    rays = scene.create_rays_pinhole(lens, outer, info.width, info.height)
    hit = scene.cast_rays(rays)
    triangle = hit["primitive_ids"].numpy()
    is_hit = triangle != scene.INVALID_ID
    corner = corners[np.where(is_hit, triangle, 0)]
    share = hit["primitive_uvs"].numpy()
    weights = np.stack([1.0 - share.sum(-1), share[..., 0], share[..., 1]], -1)
    colour = (shape.colours[corner] * weights[..., None]).sum(-2)
    toward = frames.rotate(pose[3:], np.array([0.0, 0.0, -1.0]))
    light = 0.35 + 0.65 * np.abs((hit["primitive_normals"].numpy() * toward).sum(-1))
    picture = np.clip(255.0 * colour * light[..., None], 0, 255).round().astype(np.uint8)
    return np.where(is_hit[..., None], picture, np.array(BACKGROUND, np.uint8))
