"""Meshes for sensors: simplified, with smooth normals, from a file or from triangles received over the network."""

from __future__ import annotations

from typing import cast

import numpy as np

from vinesim.scene.appearance.lofts import smooth_normals
from vinesim.scene.triangles import TrianglesError
from vinesim.scene.values import Mesh

MAX_SURFACE_FACES = 4000
"""Largest number of triangles of one mesh; finer meshes are simplified."""

_MAX_NEIGHBOURS = 10_000_000
"""Largest number of pairs of corners that share a point, for received triangles. The memory for smooth normals grows
with this number. Meshes of robots have up to a tenth of it."""


def smooth_surface(vertices: np.ndarray, faces: np.ndarray, scale: tuple[float, ...]) -> Mesh:
    """Returns a mesh [m] of ``vertices`` [vertex, 3] and ``faces`` [face, 3], scaled, with smooth normals.

    Vertices that are close to each other are merged until the mesh has at most :data:`MAX_SURFACE_FACES` faces.
    """
    return _with_normals(*simplify(vertices, faces, scale))


def received_surface(corners: np.ndarray, scale: tuple[float, ...]) -> Mesh:
    """Returns the mesh of :func:`read_surface` for triangles that were received over the network, with ``corners``
    [face, 3, 3] m.

    Raises :class:`TrianglesError` if the triangles cannot be simplified or too many of them meet at one point.
    """
    import trimesh

    every = np.arange(3 * len(corners)).reshape(-1, 3)
    merged = trimesh.Trimesh(corners.reshape(-1, 3).astype(float), every, process=True)
    vertices, faces = simplify(np.asarray(merged.vertices), np.asarray(merged.faces), scale)
    _, count = np.unique(np.round(vertices[faces.ravel()], 6), axis=0, return_counts=True)
    if not 1 <= len(faces) <= 4 * MAX_SURFACE_FACES or (count.astype(float) ** 2).sum() > _MAX_NEIGHBOURS:
        raise TrianglesError(f"{len(corners)} triangles that coincide or have no area")
    return _with_normals(vertices, faces)


def read_surface(file: str, scale: tuple[float, ...]) -> Mesh:
    """Returns the mesh in ``file``, simplified and with smooth normals; see :func:`smooth_surface`."""
    import trimesh

    mesh = cast("trimesh.Trimesh", trimesh.load(file, force="mesh", process=True))
    return smooth_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), scale)


def simplify(vertices: np.ndarray, faces: np.ndarray, scale: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices [vertex, 3] m and faces [face, 3] of a scaled mesh with at most :data:`MAX_SURFACE_FACES`
    faces, as far as merging near vertices can reduce them."""
    vertices = vertices * scale
    if np.prod(scale) < 0.0:
        faces = faces[:, ::-1]
    extent = float(np.ptp(vertices, axis=0).max(initial=1e-6))
    cells = 256
    while len(faces) > MAX_SURFACE_FACES and cells > 8:
        spot = np.floor(vertices / extent * cells).astype(np.int64)
        _, member = np.unique(spot, axis=0, return_inverse=True)
        member = member.reshape(-1)
        count = np.bincount(member)
        merged = np.stack([np.bincount(member, vertices[:, k]) / count for k in range(3)], 1)
        linked = member[faces]
        whole = (linked[:, 0] != linked[:, 1]) & (linked[:, 1] != linked[:, 2]) & (linked[:, 0] != linked[:, 2])
        vertices = merged
        faces = linked[whole]
        cells = int(cells * 0.75)
    return vertices, faces


def _with_normals(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(vertices[faces].astype(np.float32), smooth_normals(vertices, faces))
