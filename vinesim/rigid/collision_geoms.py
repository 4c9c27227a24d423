"""Geoms of the rigid world that plants can collide with, and convex hulls of their meshes."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import mujoco
import numpy as np

from vinesim.core.warp_arrays import SharedArrays
from vinesim.kernels.contact import structs
from vinesim.scene.terrain import Terrain

_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))  # int: NumPy compares with MuJoCo's enum entry by entry
    for name in ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
)
PLANE_HALF_SIZE = 1e6
"""Half edge [m] of the bounding box of the ground plane."""
TILE_SIZE = 4.0
"""Side [m] of the squares into which uneven ground is divided. TUNED: a tree reaches over at most four."""
TILE_DEPTH = 1.0
"""Depth [m] of the box of a tile below the lowest point of its ground. A capsule below it does not touch the ground."""
TILE_OVERHANG = 20.0
"""Length [m] by which the tiles at the edge of uneven ground extend beyond it."""


@dataclasses.dataclass(frozen=True)
class RigidGeoms:
    """Arrays of the rigid geoms that plants can collide with, sorted by MuJoCo's geom index."""

    id: np.ndarray
    """[geom] index in MuJoCo's geom arrays."""
    body: np.ndarray
    """[geom] index of the geom's MuJoCo body."""
    kind: np.ndarray
    """[geom] MuJoCo's type: 0 plane, 1 tile of uneven ground, 2 sphere, 3 capsule, 4 ellipsoid, 5 cylinder, 6 box, 7
    mesh. A flat mesh is replaced by its bounding box."""
    hull: np.ndarray
    """[geom] index of the convex hull in :func:`hull_arrays`; -1 if the geom has none."""
    size: np.ndarray
    """[geom, 3] size as in MuJoCo's ``geom_size``; for a mesh, half edges of its bounding box."""
    half: np.ndarray
    """[geom, 3] m, half edges of the bounding box in the geom's axes. A plane has :data:`PLANE_HALF_SIZE` along x and
    y, and 0 along z.
    """
    center: np.ndarray
    """[geom, 3] m, centre of the shape in the geom's frame (not zero for meshes)."""
    radius: np.ndarray
    """[geom] m, radius of the bounding sphere around ``center``."""
    material: np.ndarray
    """[geom] contact material, a number of :class:`Material`."""
    friction: np.ndarray
    """[geom] the geom's own Coulomb coefficient; 0: the coefficient depends on the two materials in contact."""
    dof: np.ndarray
    """[geom] last degree of freedom that moves the geom (-1: none); ``dof_parentid`` gives its ancestors."""
    root: np.ndarray
    """[geom] root body of the geom's kinematic tree. MuJoCo's ``cvel`` and ``cdof`` refer to the tree's centre of mass.
    """
    actor: tuple[str, ...]
    link: tuple[str, ...]


def owned_geoms(m: mujoco.MjModel, owner: dict[int, tuple[str, str]]) -> RigidGeoms:
    """Returns all geoms of the MuJoCo bodies in ``owner``, which maps a body's index to its actor and link."""
    ids = np.flatnonzero(np.isin(m.geom_bodyid, list(owner)))
    return _of(m, ids, [owner[body] for body in m.geom_bodyid[ids].tolist()])


def colliding(m: mujoco.MjModel, geoms: RigidGeoms) -> RigidGeoms:
    """Returns the subset of ``geoms`` whose collisions are enabled; the hands of people disable theirs while they hold
    something."""
    return _rows(geoms, np.flatnonzero(m.geom_contype[geoms.id] != 0))


def static_geoms(m: mujoco.MjModel, terrain: Terrain | None = None) -> RigidGeoms:
    """Returns the geoms of ground, trellis and old wood, which are MuJoCo's first geoms, whichever actors exist.

    Uneven ground is a list of square tiles with the index of MuJoCo's height field, so that their boxes are low. The
    plane by which MuJoCo finds bodies beyond the height field is not among the geoms.
    """
    ids = np.flatnonzero((m.geom_bodyid == 0) & (m.geom_contype != 0))
    if terrain is not None:
        ids = ids[m.geom_type[ids] != _PLANE]
    geoms = _of(m, ids, [("world", m.geom(g).name) for g in ids.tolist()])
    if terrain is None:
        return geoms
    low, high = _tiles(terrain)
    ground = _of(m, np.zeros(len(low), int), [("world", "ground")] * len(low))
    half = 0.5 * (high - low)
    center = 0.5 * (high + low) - m.geom_pos[0]
    tiles = dataclasses.replace(ground, center=center, half=half, radius=np.linalg.norm(half, axis=1))
    return concatenate(tiles, _rows(geoms, np.arange(1, len(ids))))


def _tiles(terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and the upper corners [tile, 3] m of boxes around squares of the ground; those at its edge
    extend beyond the grid."""
    side = max(round(TILE_SIZE / terrain.cell), 1)
    lines = []
    for axis, nodes in enumerate(terrain.residual.shape[::-1]):
        line = terrain.origin[axis] + terrain.cell * np.arange(0, nodes - 1, side)
        lines.append(np.concatenate([[line[0] - TILE_OVERHANG], line[1:], [terrain.end[axis] + TILE_OVERHANG]]))
    # every node of the grid, and the ends beyond it, where the ground is linear
    x, y = (
        np.concatenate([line[:1], start + terrain.cell * np.arange(nodes), line[-1:]])
        for line, start, nodes in zip(lines, terrain.origin, terrain.residual.shape[::-1], strict=True)
    )
    height = terrain.height(x, y[:, None])
    low = []
    high = []
    for y0, y1 in itertools.pairwise(lines[1]):
        for x0, x1 in itertools.pairwise(lines[0]):
            # one node more on each side, because borders of tiles are nodes up to rounding
            rows = slice(max(int(np.searchsorted(y, y0)) - 1, 0), int(np.searchsorted(y, y1)) + 2)
            columns = slice(max(int(np.searchsorted(x, x0)) - 1, 0), int(np.searchsorted(x, x1)) + 2)
            part = height[rows, columns]
            low.append((x0, y0, part.min() - TILE_DEPTH))
            high.append((x1, y1, part.max()))
    return np.array(low), np.array(high)


def _rows(geoms: RigidGeoms, rows: np.ndarray) -> RigidGeoms:
    """Returns the ``rows`` [k] of a list of geoms."""
    names = [field.name for field in dataclasses.fields(RigidGeoms) if field.name not in ("actor", "link")]
    arrays: dict[str, Any] = {name: getattr(geoms, name)[rows] for name in names}
    actor, link = (tuple(map(column.__getitem__, rows.tolist())) for column in (geoms.actor, geoms.link))
    return RigidGeoms(actor=actor, link=link, **arrays)


def _of(m: mujoco.MjModel, ids: np.ndarray, names: list[tuple[str, str]]) -> RigidGeoms:
    """Returns the properties of the MuJoCo geoms ``ids`` [k]; ``names`` [k]: actor and link of each geom."""
    moved_by = m.body_weldid  # a body without joints moves with the body to which it is welded
    last = np.where(m.body_dofnum > 0, m.body_dofadr + m.body_dofnum - 1, -1)[moved_by]
    body = m.geom_bodyid[ids]
    kind = m.geom_type[ids].copy()
    size = m.geom_size[ids].copy()
    mesh = kind == _MESH
    size[mesh] = m.geom_aabb[ids][mesh, 3:]
    hull = hull_numbers(m, ids)
    kind[mesh & (hull < 0)] = _BOX
    center = np.where(mesh[:, None], m.geom_aabb[ids, :3], 0.0)
    radius = np.where(mesh, np.linalg.norm(size, axis=1), m.geom_rbound[ids])
    half = size.copy()
    round_ = (kind == _SPHERE) | (kind == _CAPSULE)
    half[round_] = size[round_, :1] + size[round_, 1:2] * [0.0, 0.0, 1.0]
    cylinder = kind == _CYLINDER
    half[cylinder] = size[cylinder][:, [0, 0, 1]]
    plane = kind == _PLANE
    half[plane] = (PLANE_HALF_SIZE, PLANE_HALF_SIZE, 0.0)
    radius[plane] = np.inf
    return RigidGeoms(
        id=ids.astype(np.int32),
        body=body.astype(np.int32),
        kind=kind.astype(np.int32),
        hull=hull,
        size=size,
        half=half,
        center=center,
        radius=radius,
        material=m.geom_user[ids, 0].astype(np.int32),
        friction=np.where(m.geom_user[ids, 1] > 0.0, m.geom_friction[ids, 0], 0.0),
        dof=last.astype(np.int32)[body],
        root=m.body_rootid[body].astype(np.int32),
        actor=tuple(actor for actor, _ in names),
        link=tuple(link for _, link in names),
    )


def concatenate(first: RigidGeoms, second: RigidGeoms) -> RigidGeoms:
    """Returns one list with the geoms of ``first``, followed by the geoms of ``second``."""
    names = [field.name for field in dataclasses.fields(RigidGeoms) if field.name not in ("actor", "link")]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names}
    return RigidGeoms(actor=first.actor + second.actor, link=first.link + second.link, **arrays)


def persistent_names(geoms: RigidGeoms) -> list[tuple[str, str, int]]:
    """Returns for each geom a name that stays valid when MuJoCo's world is recompiled: actor, link, number on the
    link."""
    seen: dict[tuple[str, str], int] = {}
    names = []
    for actor, link in zip(geoms.actor, geoms.link, strict=True):
        number = seen[actor, link] = seen.get((actor, link), -1) + 1
        names.append((actor, link, number))
    return names


# Convex hulls of meshes, for contacts with plants: planes and edges of the hull that MuJoCo computed for each mesh.


COPLANAR_COSINE = 1.0 - 1e-9
"""Least cosine between the normals of triangles that form one face of a hull."""


def hull_numbers(m: mujoco.MjModel, ids: np.ndarray) -> np.ndarray:
    """Returns the index of the convex hull of each geom in ``ids`` [geom]: the index of its mesh; -1 for geoms that are
    not meshes and for flat meshes."""
    mesh = np.where(m.geom_type[ids] == _MESH, m.geom_dataid[ids], -1)
    has_hull = np.append(m.mesh_graphadr >= 0, False)
    return np.where(has_hull[mesh], mesh, -1).astype(np.int32)


def hull_arrays(m: mujoco.MjModel, terrain: Terrain | None = None) -> SharedArrays:
    """Returns the convex hulls of all meshes of a world, and its uneven ground; a mesh without a hull has an empty
    entry."""
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
        ground=np.zeros((0, 0), np.float32) if terrain is None else terrain.residual,
        ground_frame=np.zeros(5) if terrain is None else np.array([*terrain.origin, terrain.cell, *terrain.slope]),
    )


def _graph(m: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices [vertex, 3] m of the hull of ``mesh``, and its triangles [triangle, 3] as indices of
    vertices.

    MuJoCo's ``mesh_graph`` contains the numbers of vertices and triangles, two lists with an entry for each vertex (the
    second one is its index in the mesh), the neighbours (vertices + 3 triangles entries), and the triangles as indices
    in the mesh.
    """
    graph = m.mesh_graph[m.mesh_graphadr[mesh] :]
    count, faces = graph[:2].tolist()
    places = graph[2 + count : 2 + 2 * count]
    triangles = graph[2 + 3 * count + 3 * faces :][: 3 * faces].reshape(-1, 3)
    number = np.zeros(int(m.mesh_vertnum[mesh]), int)
    number[places] = np.arange(count)
    return m.mesh_vert[m.mesh_vertadr[mesh] + places].astype(float), number[triangles]


@functools.lru_cache(1024)  # the world is recompiled whenever an actor joins
def _cached_hull(vertices: bytes, triangles: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns :func:`faces_and_edges` of arrays that are given as bytes, because a cache needs hashable arguments."""
    return faces_and_edges(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(triangles, int).reshape(-1, 3))


def faces_and_edges(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns planes [plane, 4] (outward normal, offset), edges [edge, 2, 3] m and the two planes of each edge [edge,
    2].

    ``vertices`` [vertex, 3] m and ``triangles`` [triangle, 3] (indices of vertices) describe a hull. Triangles in one
    plane form one face without edges between them.
    """
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    has_area = area > 1e-12 * np.square(np.ptp(vertices, axis=0).max())
    triangles = triangles[has_area]
    normal = normal[has_area] / area[has_area, None]
    outward = np.einsum("fi,fi->f", normal, vertices[triangles[:, 0]] - vertices.mean(0)) >= 0.0
    normal[~outward] *= -1.0
    # the largest triangle of a face defines its plane, because slivers have poor normals
    by_area = np.argsort(-area[has_area], kind="stable")
    plane_of = np.full(len(triangles), -1)
    kept = []
    for triangle in by_area.tolist():
        same = np.flatnonzero(normal[kept] @ normal[triangle] > COPLANAR_COSINE) if kept else np.zeros(0, int)
        plane_of[triangle] = same[0] if len(same) else len(kept)
        if not len(same):
            kept.append(triangle)
    n = normal[kept]
    planes = np.column_stack([n, (n @ vertices.T).max(1)])  # the maximum keeps all vertices inside despite rounding
    beside: dict[tuple[int, int], list[int]] = {}
    for triangle, plane in zip(triangles.tolist(), plane_of.tolist(), strict=True):
        for i, k in ((0, 1), (1, 2), (2, 0)):
            pair = min(triangle[i], triangle[k]), max(triangle[i], triangle[k])
            beside.setdefault(pair, []).append(plane)
    edges = [(pair, (found[0], found[-1])) for pair, found in beside.items() if len(found) < 2 or found[0] != found[1]]
    ends = np.array([pair for pair, _ in edges], int).reshape(-1, 2)
    return planes, vertices[ends], np.array([sides for _, sides in edges], int).reshape(-1, 2)
