"""Fusion of the pictures of a tour into one surface: a truncated signed distance field (TSDF) on sparse voxels."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.clouds import as_matrix, depth_of
from vinesim.perception.open3d_library import load_open3d
from vinesim.perception.tour import TourPicture, check_one_vineyard
from vinesim.scene.camera_geometry import intrinsic_matrix, project_points
from vinesim.scene.values import CameraFrame
from vinesim.sensors.export.files import write_files

VOXEL = 0.004
"""Edge of a voxel unless given [m]."""
MIN_VOXEL = 0.001
"""Smallest edge of a voxel [m]: depth in the files of a tour is rounded to whole millimetres."""
FARTHEST = 2.0
"""Depth beyond which pixels are ignored unless given [m]."""
TRUNCATION = 2.0
"""Truncation of the signed distance [voxel]. It is small, so that the far side of a thin cane does not move the near
side."""
MAX_MEMORY = 4e9
"""Largest memory of the voxels [B]."""
_BLOCK = 8
"""Edge of a block of voxels [voxel]."""
_VOXEL_SIZE = 20
"""Memory of a voxel [B]: distance, weight and colour in single precision."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FusedSurface:
    """A triangle mesh in the world."""

    vertices: np.ndarray
    """[n, 3] m."""
    normals: np.ndarray
    """[n, 3] unit vectors."""
    colours: np.ndarray
    """[n, 3] uint8."""
    triangles: np.ndarray
    """[m, 3] int32, indices of vertices."""
    labels: np.ndarray | None = None
    """[n] int32, label of the object of each vertex (:func:`vinesim.scene.ids.label`), 0 if no picture shows it."""

    def write(self, path: pathlib.Path) -> None:
        """Write a binary PLY file; labels become the property ``label`` of its vertices. Raises OSError."""
        fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        fields += [("label", "<i4")] if self.labels is not None else []
        rows = np.empty(len(self.vertices), fields)
        for axis in range(3):
            rows["xyz"[axis]] = self.vertices[:, axis]
            rows["n" + "xyz"[axis]] = self.normals[:, axis]
            rows[("red", "green", "blue")[axis]] = self.colours[:, axis]
        if self.labels is not None:
            rows["label"] = self.labels
        faces = np.empty(len(self.triangles), [("count", "u1"), ("corner", "<i4", 3)])
        faces["count"] = 3
        faces["corner"] = self.triangles
        types = {"<f4": "float", "u1": "uchar", "<i4": "int"}
        head = ["ply", "format binary_little_endian 1.0", "comment vinesim fuse, metres", f"element vertex {len(rows)}"]
        head += [f"property {types[kind]} {name}" for name, kind in fields]
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
        write_files({path: ["\n".join(head).encode(), rows.tobytes(), faces.tobytes()]})


def fuse(
    pictures: Sequence[CameraFrame | TourPicture],
    *,
    voxel: float = VOXEL,
    farthest: float = FARTHEST,
    exact: bool = True,
    ids: bool = False,
    least_views: int | None = None,
    advance: Callable[[int], None] | None = None,
) -> FusedSurface:
    """Fuse pictures with known poses into one surface.

    Args:
        pictures: pictures of a camera, or pictures of a tour, which are read one after another.
        voxel: edge of a voxel [m].
        farthest: depth beyond which pixels are ignored [m].
        exact: use the exact depth; False: the depth as the camera measures it.
        ids: find the label of each vertex, from the picture whose depth agrees best with it.
        least_views: smallest number of pictures that must see a voxel; surface that fewer see is left out. By default
            2, or 1 for a single picture.
        advance: called with the number of pictures that are done, after each.

    Raises :class:`UsageError` if nothing can be fused, or if the voxels would need more than :data:`MAX_MEMORY`, and
    :class:`.TourError` if pictures of a tour show different vineyards.
    """
    check_one_vineyard([one for one in pictures if isinstance(one, TourPicture)])
    if not MIN_VOXEL <= voxel <= 1.0:
        raise UsageError(f"voxel is {voxel:g} m; give {MIN_VOXEL:g} to 1")
    if least_views is not None and not 1 <= least_views <= len(pictures):
        most = (
            f"1 to {len(pictures)}, the number of pictures" if len(pictures) > 1 else "1, because there is one picture"
        )
        raise UsageError(f"least_views is {least_views}; give {most}")
    if not farthest > 0.0:
        raise UsageError(f"farthest is {farthest:g} m; give more than 0")
    o3d = load_open3d()
    single = o3d.core.float32
    names = ("tsdf", "weight", "color")
    grid = o3d.t.geometry.VoxelBlockGrid(names, (single,) * 3, (1, 1, 3), voxel, _BLOCK, 2000)
    for number, picture in enumerate(pictures):
        frame = _frame_of(picture)
        depth = depth_of(frame, exact)
        # pixel centres are whole numbers here; Open3D cuts off the fraction of a projected point's column and row
        lens = np.reshape(intrinsic_matrix(frame.info), (3, 3))
        lens[:2, 2] += 0.5
        inner = o3d.core.Tensor(lens)
        outer = o3d.core.Tensor(np.linalg.inv(as_matrix(frame.pose)))
        flat = np.where(np.isfinite(depth) & (depth > 0.0) & (depth < farthest), depth, 0.0).astype(np.float32)
        if flat.any():
            image = o3d.t.geometry.Image(o3d.core.Tensor(flat))
            colour = o3d.t.geometry.Image(
                o3d.core.Tensor(np.ascontiguousarray(frame.rgb / np.float32(255.0), np.float32))
            )
            limits = {"depth_scale": 1.0, "depth_max": float(farthest), "trunc_voxel_multiplier": TRUNCATION}
            blocks = grid.compute_unique_block_coordinates(image, inner, outer, **limits)
            size = (grid.hashmap().size() + blocks.shape[0]) * _BLOCK**3 * _VOXEL_SIZE
            if size > MAX_MEMORY:
                raise UsageError(
                    f"voxels of {voxel:g} m need more than {MAX_MEMORY / 1e9:g} GB at picture {number + 1} of "
                    f"{len(pictures)}; give a larger voxel, or a farthest below {farthest:g} m"
                )
            grid.integrate(blocks, image, colour, inner, inner, outer, **limits)
        if advance is not None:
            advance(number + 1)
    if grid.hashmap().size() == 0:
        kind = "exact" if exact else "measured"
        raise UsageError(f"no picture has {kind} depth nearer than {farthest:g} m; give a larger farthest")
    least = min(2, len(pictures)) if least_views is None else least_views
    mesh = grid.extract_triangle_mesh(weight_threshold=least - 0.5)
    if "positions" not in mesh.vertex or not len(mesh.vertex.positions):
        raise UsageError(
            f"the pictures contain no surface that {least} of them see; give least_views 1, or pictures that overlap"
        )
    vertices = mesh.vertex.positions.numpy()
    colours = np.clip(np.round(mesh.vertex.colors.numpy() * 255.0), 0, 255).astype(np.uint8)
    surface = FusedSurface(vertices, mesh.vertex.normals.numpy(), colours, mesh.triangle.indices.numpy())
    return dataclasses.replace(surface, labels=labels_of(vertices, pictures, exact)) if ids else surface


def labels_of(points: np.ndarray, pictures: Sequence[CameraFrame | TourPicture], exact: bool = True) -> np.ndarray:
    """Returns the label [n] int32 of points [n, 3] m in the world: that of the pixel whose depth agrees best with the
    point, over all pictures; 0 for points outside of all pictures."""
    best = np.full(len(points), np.inf)
    found = np.zeros(len(points), np.int32)
    for picture in pictures:
        frame = _frame_of(picture)
        local = frames.rotate(frames.conjugate(frame.pose[3:]), np.asarray(points, float) - frame.pose[:3])
        pixel = np.round(np.nan_to_num(project_points(local, frame.info), nan=-1.0)).astype(int)
        inside = np.flatnonzero(((pixel >= 0) & (pixel < [frame.info.width, frame.info.height])).all(1))
        column, row = pixel[inside].T
        off = np.abs(depth_of(frame, exact)[row, column] - local[inside, 2])
        closer = off < best[inside]  # False for NaN
        best[inside[closer]] = off[closer]
        found[inside[closer]] = frame.labels[row[closer], column[closer]]
    return found


def _frame_of(picture: CameraFrame | TourPicture) -> CameraFrame:
    """Returns a picture, read from its files if necessary. Raises :class:`UsageError` if its lens distorts."""
    frame: Any = picture.read() if isinstance(picture, TourPicture) else picture
    if frame.info.distortion:
        raise UsageError(f"the lens of picture {frame.name!r} distorts; render with a camera without distortion")
    return frame
