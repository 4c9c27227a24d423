"""Convex hulls of meshes for contacts with plants: planes and edges of the hull that MuJoCo made of each mesh."""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from vinesim.core.warp_arrays import SharedArrays
from vinesim.kernels.contact import structs

_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
COPLANAR_COSINE = 1.0 - 1e-9
"""[1] Triangles whose normals agree better than this are one face."""


def hull_numbers(m: mujoco.MjModel, ids: np.ndarray) -> np.ndarray:
    """[geom] number of the hull of each of the geoms ``ids``: of its mesh, -1 for other kinds and for flat meshes."""
    mesh = np.where(m.geom_type[ids] == _MESH, m.geom_dataid[ids], -1)
    has_hull = np.append(m.mesh_graphadr >= 0, False)
    return np.where(has_hull[mesh], mesh, -1).astype(np.int32)


def hull_arrays(m: mujoco.MjModel) -> SharedArrays:
    """Hulls of all meshes of a world; those without a hull are empty."""
    planes = [np.zeros((0, 4))]
    edges = [np.zeros((0, 2, 3))]
    sides = [np.zeros((0, 2), int)]
    plane_counts = [0]
    edge_counts = [0]
    center = np.zeros((m.nmesh, 3))
    of_mesh = m.geom_type == _MESH
    center[m.geom_dataid[of_mesh]] = m.geom_aabb[of_mesh, :3]
    for mesh in range(m.nmesh):
        if m.mesh_graphadr[mesh] >= 0:
            vertices, triangles = _graph(m, mesh)
            found = _cached_hull((vertices - center[mesh]).tobytes(), triangles.tobytes())
            planes.append(found[0])
            edges.append(found[1])
            sides.append(found[2] + sum(plane_counts))
        plane_counts.append(len(planes[-1]) if m.mesh_graphadr[mesh] >= 0 else 0)
        edge_counts.append(len(edges[-1]) if m.mesh_graphadr[mesh] >= 0 else 0)
    corners = np.concatenate(edges)
    side = np.concatenate(sides).astype(np.int32)
    return SharedArrays(
        structs.Hulls,
        first_plane=np.cumsum(plane_counts, dtype=np.int32),
        first_edge=np.cumsum(edge_counts, dtype=np.int32),
        plane=np.concatenate(planes),
        edge_start=corners[:, 0].copy(),
        edge_end=corners[:, 1].copy(),
        edge_left=side[:, 0].copy(),
        edge_right=side[:, 1].copy(),
    )


def _graph(m: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [vertex, 3] m of a mesh's hull, and its triangles [triangle, 3] as numbers of vertices.

    MuJoCo's ``mesh_graph``: counts of vertices and triangles, two lists for the vertices of which the second says where
    they are in the mesh, the neighbours (vertices and 3 triangles), and the triangles by their place in the mesh.
    """
    graph = m.mesh_graph[m.mesh_graphadr[mesh] :]
    count, faces = graph[:2].tolist()
    places = graph[2 + count : 2 + 2 * count]
    triangles = graph[2 + 3 * count + 3 * faces :][: 3 * faces].reshape(-1, 3)
    number = np.zeros(int(m.mesh_vertnum[mesh]), int)
    number[places] = np.arange(count)
    return m.mesh_vert[m.mesh_vertadr[mesh] + places].astype(float), number[triangles]


@functools.lru_cache(1024)  # a world is compiled anew whenever an actor joins
def _cached_hull(vertices: bytes, triangles: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """:func:`faces_and_edges` of arrays that are given as bytes."""
    return faces_and_edges(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(triangles, int).reshape(-1, 3))


def faces_and_edges(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planes [plane, 4] (outward normal, offset), edges [edge, 2, 3] m and their two planes [edge, 2] of a hull.

    ``vertices`` [vertex, 3] m, ``triangles`` [triangle, 3] vertices. Triangles in one plane are one face; no edge is
    between them.
    """
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    has_area = area > 1e-12 * np.square(np.ptp(vertices, axis=0).max())
    triangles = triangles[has_area]
    normal = normal[has_area] / area[has_area, None]
    outward = np.einsum("fi,fi->f", normal, vertices[triangles[:, 0]] - vertices.mean(0)) >= 0.0
    normal[~outward] *= -1.0
    # of triangles in one plane, the largest gives the plane: slivers have poor normals
    by_area = np.argsort(-area[has_area], kind="stable")
    plane_of = np.full(len(triangles), -1)
    kept = []
    for triangle in by_area.tolist():
        same = np.flatnonzero(normal[kept] @ normal[triangle] > COPLANAR_COSINE) if kept else np.zeros(0, int)
        plane_of[triangle] = same[0] if len(same) else len(kept)
        if not len(same):
            kept.append(triangle)
    n = normal[kept]
    planes = np.column_stack([n, (n @ vertices.T).max(1)])  # so that no vertex is outside by rounding
    beside: dict[tuple[int, int], list[int]] = {}
    for triangle, plane in zip(triangles.tolist(), plane_of.tolist(), strict=True):
        for i, k in ((0, 1), (1, 2), (2, 0)):
            pair = min(triangle[i], triangle[k]), max(triangle[i], triangle[k])
            beside.setdefault(pair, []).append(plane)
    edges = [(pair, (found[0], found[-1])) for pair, found in beside.items() if len(found) < 2 or found[0] != found[1]]
    ends = np.array([pair for pair, _ in edges], int).reshape(-1, 2)
    return planes, vertices[ends], np.array([sides for _, sides in edges], int).reshape(-1, 2)
