"""Rigid geoms that plants collide with: MuJoCo's geoms, and the actor and link that each belongs to."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np

from vinesim.rigid.hulls import hull_numbers

_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))  # NumPy would compare with MuJoCo's own type entry by entry
    for name in ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
)
PLANE_HALF_SIZE = 1e6
"""[m] Half edge of the box around the ground."""


@dataclasses.dataclass(frozen=True)
class RigidGeoms:
    """Rigid geoms that plants can touch, sorted by MuJoCo geom."""

    id: np.ndarray
    """[geom] index in MuJoCo's geom arrays."""
    body: np.ndarray
    """[geom] MuJoCo body."""
    kind: np.ndarray
    """[geom] MuJoCo's type: 0 plane, 2 sphere, 3 capsule, 4 ellipsoid, 5 cylinder, 6 box, 7 mesh; a flat mesh stands as
    its box."""
    hull: np.ndarray
    """[geom] number of its convex hull in :func:`vinesim.rigid.hulls.hull_arrays`; -1 unless it is a mesh."""
    size: np.ndarray
    """[geom, 3] as MuJoCo writes it for the kind; of a mesh, half edges of its box."""
    half: np.ndarray
    """[geom, 3] half edges of the box around the shape, in its own axes; of a plane, :data:`PLANE_HALF_SIZE` and no
    height."""
    center: np.ndarray
    """[geom, 3] m, centre of the shape in the geom's frame (not zero for meshes)."""
    radius: np.ndarray
    """[geom] of the bounding sphere about the middle."""
    material: np.ndarray
    """[geom] :class:`Material`"""
    friction: np.ndarray
    """[geom] Coulomb coefficient of its own; 0: that of the two materials in contact."""
    dof: np.ndarray
    """[geom] last degree of freedom that moves it (-1: none); its ancestors follow ``dof_parentid``."""
    root: np.ndarray
    """[geom] root body of its kinematic tree, about whose centre of mass MuJoCo writes ``cvel`` and ``cdof``."""
    actor: tuple[str, ...]
    link: tuple[str, ...]


def owned_geoms(m: mujoco.MjModel, owner: dict[int, tuple[str, str]]) -> RigidGeoms:
    """All geoms of some MuJoCo bodies; ``owner`` maps their numbers to actor and link."""
    ids = np.flatnonzero(np.isin(m.geom_bodyid, list(owner)))
    return _of(m, ids, [owner[body] for body in m.geom_bodyid[ids].tolist()])


def colliding(m: mujoco.MjModel, geoms: RigidGeoms) -> RigidGeoms:
    """Those of ``geoms`` that collide now: the geoms of a hand change with what it holds, and nothing else of them."""
    rows = np.flatnonzero(m.geom_contype[geoms.id] != 0)
    names = [field.name for field in dataclasses.fields(RigidGeoms) if field.name not in ("actor", "link")]
    arrays: dict[str, Any] = {name: getattr(geoms, name)[rows] for name in names}
    actor, link = (tuple(map(column.__getitem__, rows.tolist())) for column in (geoms.actor, geoms.link))
    return RigidGeoms(actor=actor, link=link, **arrays)


def static_geoms(m: mujoco.MjModel) -> RigidGeoms:
    """Ground, trellis and old wood: MuJoCo's first geoms, independent of the actors that join and leave."""
    ids = np.flatnonzero((m.geom_bodyid == 0) & (m.geom_contype != 0))
    return _of(m, ids, [("world", m.geom(g).name) for g in ids.tolist()])


def _of(m: mujoco.MjModel, ids: np.ndarray, names: list[tuple[str, str]]) -> RigidGeoms:
    """The properties of some geoms ``ids`` [k]; ``names``: actor and link of each."""
    moved_by = m.body_weldid  # a body without joints moves with the one that it is welded to
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
    """The geoms of one list, then those of another."""
    names = [field.name for field in dataclasses.fields(RigidGeoms) if field.name not in ("actor", "link")]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names}
    return RigidGeoms(actor=first.actor + second.actor, link=first.link + second.link, **arrays)


def persistent_names(geoms: RigidGeoms) -> list[tuple[str, str, int]]:
    """[geom] a name that outlives a recompilation: actor, link and the geom's number on that link."""
    seen: dict[tuple[str, str], int] = {}
    names = []
    for actor, link in zip(geoms.actor, geoms.link, strict=True):
        number = seen[actor, link] = seen.get((actor, link), -1) + 1
        names.append((actor, link, number))
    return names
