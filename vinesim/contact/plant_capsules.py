"""Collision capsules of plants: one for each piece of wood, a few for each bunch, one for each berry cluster."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.materials import materials_of_organs
from vinesim.scene.model import Model
from vinesim.scene.state import State

MAX_SPHERES_PER_BUNCH = 7
HIDDEN = 3
"""Level of detail of the capsule of a spare body, which does not exist until a cut makes the body a stump."""


@dataclasses.dataclass(frozen=True)
class PlantCapsules:
    """Collision shapes of all plants: segments with a radius, sorted by body."""

    tree_start: np.ndarray
    """[tree + 1] Index of the first capsule of each tree; the last entry is the number of capsules."""
    body: np.ndarray
    """[capsule] Index of the body that the capsule belongs to."""
    bunch: np.ndarray
    """[capsule] Index of the bunch that the capsule belongs to; -1 for wood.

    The capsule of a peduncle belongs to its bunch: once the bunch is picked, the remaining stub does not collide.
    """
    level: np.ndarray
    """[capsule] Level of detail at which the capsule exists.

    0: always; 1: while the tree's berry clusters are locked to their bunches (coarse); 2: while the clusters move
    (fine, see ``State.tree_fine``); :data:`HIDDEN`: never.
    """
    start: np.ndarray
    """[capsule, 3] Start of the axis, m, in the body's frame. Equal to ``end`` for a sphere."""
    end: np.ndarray
    """[capsule, 3] End of the axis, m, in the body's frame."""
    radius: np.ndarray
    """[capsule] m, radius."""
    material: np.ndarray
    """[capsule] :class:`Material` of the surface."""


def plant_capsules(model: Model) -> PlantCapsules:
    """Returns a capsule for each piece of wood, a few spheres for each bunch, and a capsule or sphere for each berry
    cluster.

    The spheres collide for bunches without clusters. For bunches with clusters, they collide while the clusters are
    locked (the tree is coarse).
    """
    parts: list[tuple[int, int, int, float, float, float]] = []  # body, bunch, level, start and end along x, radius
    of_body = {int(b): i for i, b in enumerate(model.bunch_body)}
    of_cluster = {
        int(first) + k: i
        for i, (first, count) in enumerate(zip(model.bunch_cluster, model.bunch_clusters, strict=True))
        for k in range(count)
    }
    bunch_of = model.bunch_of_body().tolist()
    is_spare = model.is_spare().tolist()
    lengths = model.body_length.tolist()
    radii = model.body_radius.mean(1).tolist()
    for b, (length, thick) in enumerate(zip(lengths, radii, strict=True)):
        if b in of_body:
            i = of_body[b]
            level = int(model.bunch_clusters[i] > 0)
            for center, radius in spheroid_spheres(0.5 * float(model.bunch_length[i]), float(model.bunch_radius[i])):
                parts.append((b, i, level, center, center, radius))
        elif b in of_cluster:
            half = 0.5 * length
            inset = min(thick, half)
            parts.append((b, of_cluster[b], 2, inset, length - inset, thick))
        elif is_spare[b]:
            parts.append((b, -1, HIDDEN, 0.0, 0.0, 0.0))
        else:
            parts.append((b, bunch_of[b], 0, 0.0, length, thick))
    body, bunch, level, start, end, radius = np.array(parts, float).reshape(-1, 6).T  # also correct without bodies
    along = np.array([1.0, 0.0, 0.0], np.float32)
    return PlantCapsules(
        tree_start=np.searchsorted(body, np.append(model.tree_first, len(model.body_mass))).astype(np.int32),
        body=body.astype(np.int32),
        bunch=bunch.astype(np.int32),
        level=level.astype(np.int32),
        start=start.astype(np.float32)[:, None] * along,
        end=end.astype(np.float32)[:, None] * along,
        radius=radius.astype(np.float32),
        material=materials_of_organs(model.body_organ[body.astype(np.int32)]),
    )


def spheroid_spheres(half_length: float, max_radius: float) -> list[tuple[float, float]]:
    """Returns the centres (along the axis, m from one end) and radii (m) of the largest spheres inside a spheroid.

    The largest sphere about a point c of the axis, between the centres of curvature of the spheroid's ends, has the
    radius R sqrt(1 - c^2 / (a^2 - R^2)).
    """
    a = half_length
    r = max_radius
    furthest = (a * a - r * r) / a if a > r else 0.0
    count = min(1 + 2 * int(np.ceil(furthest / r - 1e-6)), MAX_SPHERES_PER_BUNCH) if furthest > 1e-6 else 1
    if count == 1:
        return [(a + 0.0, min(a, r))]
    return [
        (a + c, min(a, r) * np.sqrt(1.0 - c * c / (a * a - r * r))) for c in np.linspace(-furthest, furthest, count)
    ]


def nearest_body(
    capsules: PlantCapsules, model: Model, state: State, trees: np.ndarray, points: np.ndarray, max_distance: float
) -> tuple[float, int] | None:
    """Returns the distance (m) from ``points`` [k, 3] m to the nearest surface of a plant body, and that body's index.

    Searches ``trees`` [n], whose ``state.body_q`` must be current. A bunch counts as its own body, whether or not its
    clusters move. Returns None if no body is nearer than ``max_distance`` [m].
    """
    c = capsules
    first = c.tree_start[trees].tolist()
    end = c.tree_start[trees + 1].tolist()
    at = np.concatenate([np.arange(*ends) for ends in zip(first, end, strict=True)])
    is_fine = state.tree_fine[model.body_tree[c.body[at]]]
    at = at[(c.level[at] == 0) | (c.level[at] == 1 + is_fine)]
    collides = c.bunch[at] < 0
    collides[~collides] = state.bunch_attached[c.bunch[at[~collides]]]
    at = at[collides]
    pose = state.body_q[c.body[at]].astype(float)
    start = pose[:, :3] + frames.rotate(pose[:, 3:], c.start[at].astype(float))
    along = frames.rotate(pose[:, 3:], (c.end[at] - c.start[at]).astype(float))
    square = np.maximum((along * along).sum(1), 1e-12)
    offset = points[:, None] - start
    t = np.clip((offset * along).sum(-1) / square, 0.0, 1.0)
    gap = (np.linalg.norm(offset - t[..., None] * along, axis=-1) - c.radius[at]).min(0)
    best = int(np.argmin(gap)) if len(gap) else -1
    if best < 0 or gap[best] >= max_distance:
        return None
    body = int(c.body[at[best]])
    bunch = int(c.bunch[at[best]])
    tree = model.body_tree[body]
    is_cluster = body - model.tree_first[tree] >= model.tree_core[tree]
    return float(gap[best]), int(model.bunch_body[bunch]) if is_cluster else body
