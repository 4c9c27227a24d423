"""Contacts of rigid bodies with uneven ground.

MuJoCo tests a body against every triangular prism of a height field on its own. So a body that slides also meets the
inner sides of prisms: a crate on an incline of 10 cm cells slid at less than half of the acceleration that friction
allows. A body on many cells exceeds MuJoCo's 50 contacts a pair, and is then held on one side only. Here MuJoCo only
finds which geoms are near the ground, by its height field and, beyond it, by a plane above the ground. Their contacts
are then replaced by contacts of points of their surface, with the ground's normal (docs/decisions/terrain.md).
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.scene.terrain import Terrain

SAMPLE_SPACING = 0.15
"""[m] Distance between the sample points of a box. GUESSED: with more, boxes follow cells of 10 cm more closely."""
MAX_FACE_SAMPLES = 5
"""Largest number of sample points along an edge of a box."""
COMPASS = 8
"""Number of horizontal directions; the contact points of a geom are its deepest point, and the outermost one in each of
these directions."""
APART = 1.0
"""Gap [m] of MuJoCo's contacts that are not used."""
_HEIGHT_FIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
"""MuJoCo's type of the height field; that of a plane is less, those of all other geoms are greater."""
_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)


class GroundContacts:
    """Replaces MuJoCo's contacts with the height field of ``terrain`` in each step."""

    def __init__(self, terrain: Terrain) -> None:
        self._terrain = terrain
        self._samples: dict[int, tuple[np.ndarray, float]] = {}
        """Points of each geom's surface, or axis, in its frame [n, 3] m, and the radius around them [m]."""
        angle = np.linspace(0.0, 2.0 * np.pi, COMPASS, endpoint=False)
        self._compass = np.stack([np.cos(angle), np.sin(angle)])

    def use_world(self) -> None:
        """Forget the shapes of geoms, because MuJoCo's world was recompiled or its bodies changed."""
        self._samples.clear()

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After ``mj_step1``: replace the contacts with the ground, and make MuJoCo's constraints again."""
        if d.ncon == 0:
            return
        pair = d.contact.geom
        kind = m.geom_type[pair].min(1)
        ours = np.flatnonzero(kind <= _HEIGHT_FIELD)
        if not len(ours):
            return
        geom = pair[ours].max(1)  # the ground has MuJoCo's first geoms
        is_near = (kind[ours] == _HEIGHT_FIELD) | self._reaches_out(d.geom_xpos[geom], m.geom_rbound[geom])
        contact = d.contact
        contact.exclude[ours] = 1
        contact.dist[ours] = APART
        contact.efc_address[ours] = -1
        if is_near.any():
            self._add_contacts(m, d, ours[is_near], geom[is_near])
        mujoco.mj_makeConstraint(m, d)
        mujoco.mj_island(m, d)
        mujoco.mj_projectConstraint(m, d)
        mujoco.mj_fwdVelocity(m, d)

    def _add_contacts(self, m: mujoco.MjModel, d: mujoco.MjData, slots: np.ndarray, geom: np.ndarray) -> None:
        """Add the contacts of geoms with the ground. ``slots`` [n]: indices of contacts that are not used; ``geom``
        [n]: the geom of each."""
        geoms = np.unique(geom)
        point, normal, gap, owner = self._touching(m, d, geoms)
        count = [int((owner == one).sum()) for one in geoms.tolist()]
        rooms = [self._make_room(m, d, slots[geom == one], n) for one, n in zip(geoms.tolist(), count, strict=True)]
        contact = d.contact
        for one, room in zip(geoms.tolist(), rooms, strict=True):
            found = np.flatnonzero(owner == one)
            found = found[np.argsort(gap[found], kind="stable")][: len(room)]
            room = room[: len(found)]
            contact.exclude[room] = gap[found] >= contact.includemargin[room]
            contact.dist[room] = gap[found]
            contact.pos[room] = point[found]
            sign = np.where(contact.geom[room, 0] == one, -1.0, 1.0)[:, None]
            contact.frame[room] = _axes(sign * normal[found])

    def _reaches_out(self, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Whether geoms at ``center`` [n, 3] m with bounding spheres of ``radius`` [n] m reach beyond the grid [n]."""
        low = center[:, :2] - radius[:, None] < self._terrain.origin
        high = center[:, :2] + radius[:, None] > self._terrain.end
        return (low | high).max(1)

    @staticmethod
    def _make_room(m: mujoco.MjModel, d: mujoco.MjData, slots: np.ndarray, count: int) -> np.ndarray:
        """Returns the indices of ``count`` contacts of a geom with the ground, or more: its ``slots``, and copies of
        the first as long as MuJoCo has room for contacts."""
        first = d.ncon
        while len(slots) + d.ncon - first < count and mujoco.mj_addContact(m, d, d.contact[slots[0]]) == 0:
            pass
        return np.concatenate([slots, np.arange(first, d.ncon)])

    def _touching(
        self, m: mujoco.MjModel, d: mujoco.MjData, geoms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns the contact points of ``geoms`` [k] with the ground: position halfway between both surfaces [n, 3] m,
        upward normal [n, 3], gap [n] m and geom [n]."""
        samples = [self._samples_of(m, geom) for geom in geoms.tolist()]
        count = [len(points) for points, _ in samples]
        owner = np.repeat(geoms, count)
        radius = np.repeat([thick for _, thick in samples], count)
        rotation = d.geom_xmat[owner].reshape(-1, 3, 3)
        local = np.concatenate([points for points, _ in samples])
        point = d.geom_xpos[owner] + np.einsum("nij,nj->ni", rotation, local)
        normal = self._terrain.normal(point[:, 0], point[:, 1])
        round_ = m.geom_type[owner] == _ELLIPSOID
        if round_.any():  # the point of an ellipsoid that is lowest along the normal
            size = m.geom_size[owner[round_]]
            down = size * np.einsum("nji,nj->ni", rotation[round_], -normal[round_])
            lowest = size * down / np.linalg.norm(down, axis=1, keepdims=True)
            point[round_] += np.einsum("nij,nj->ni", rotation[round_], lowest)
            normal[round_] = self._terrain.normal(point[round_, 0], point[round_, 1])
        gap = (point[:, 2] - self._terrain.height(point[:, 0], point[:, 1])) * normal[:, 2] - radius
        chosen = self._choose(owner, point, gap, m.geom_margin[owner])
        point = point[chosen] - (radius + 0.5 * gap)[chosen, None] * normal[chosen]
        return point, normal[chosen], gap[chosen], owner[chosen]

    def _choose(self, owner: np.ndarray, point: np.ndarray, gap: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Returns the sample points [n] that become contacts: of the points within the margin, the deepest one of each
        geom, and the outermost ones."""
        near = np.flatnonzero(gap < margin)
        kept = []
        for one in np.unique(owner[near]).tolist():
            mine = near[owner[near] == one]
            out = (point[mine, :2] @ self._compass).argmax(0)
            kept.append(np.unique([*mine[out], mine[gap[mine].argmin()]]))
        return np.concatenate(kept) if kept else np.zeros(0, int)

    def _samples_of(self, m: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
        found = self._samples.get(geom)
        if found is None:
            found = self._samples[geom] = _sample(m, geom)
        return found


def _sample(m: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Returns sample points of a geom's surface, or of its axis, in its frame [n, 3] m, and the radius around them."""
    kind = int(m.geom_type[geom])
    size = m.geom_size[geom]
    if kind in (_SPHERE, _ELLIPSOID):
        return np.zeros((1, 3)), float(size[0]) if kind == _SPHERE else 0.0
    if kind == _CAPSULE:
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, 0.0], [0.0, 0.0, size[1]]]), float(size[0])
    if kind == _CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
        return np.concatenate([ring + np.array([0.0, 0.0, z]) for z in (-size[1], 0.0, size[1])]), 0.0
    if kind == _MESH:
        return _hull_vertices(m, int(m.geom_dataid[geom])), 0.0
    return _box_surface(tuple(size.tolist())), 0.0


@functools.cache
def _box_surface(half: tuple[float, float, float]) -> np.ndarray:
    """Returns points [n, 3] m of the surface of a box with edges 2 ``half`` m."""
    parts = [int(np.clip(np.ceil(2.0 * edge / SAMPLE_SPACING), 1, MAX_FACE_SAMPLES - 1)) for edge in half]
    lines = [np.linspace(-edge, edge, count + 1) for edge, count in zip(half, parts, strict=True)]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    return grid[(np.abs(grid) >= np.array(half) - 1e-12).any(1)]


def _hull_vertices(m: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Returns the vertices [n, 3] m of a mesh's convex hull; of the whole mesh if MuJoCo made no hull."""
    first = int(m.mesh_vertadr[mesh])
    if m.mesh_graphadr[mesh] < 0:
        return m.mesh_vert[first : first + int(m.mesh_vertnum[mesh])].astype(float)
    graph = m.mesh_graph[m.mesh_graphadr[mesh] :]
    count = int(graph[0])
    return m.mesh_vert[first + graph[2 + count : 2 + 2 * count]].astype(float)


def _axes(normal: np.ndarray) -> np.ndarray:
    """Returns MuJoCo's contact frames [n, 9]: the normal, then two tangents, row by row."""
    along = frames.normalize(frames.cross(np.broadcast_to([0.0, 1.0, 0.0], normal.shape), normal))
    return np.concatenate([normal, along, frames.cross(normal, along)], 1)
