"""Collision capsules of plants: one for each piece of wood, a few for each bunch, one for each berry cluster, and one
for each leaf if leaves can be touched."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene import leaves
from vinesim.scene.materials import Material, materials_of_organs
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

MAX_SPHERES_PER_BUNCH = 7
HIDDEN = 3
"""Level of detail of the capsule of a spare body, which does not exist until a cut makes the body a stump. Also of
leaves, which stand outside of the ranges of trees."""
MIN_PETIOLE_LENGTH = 0.01
"""[m] A shorter petiole is as stiff as one of this length."""


@dataclasses.dataclass(frozen=True)
class PlantCapsules:
    """Collision shapes of all plants: segments with a radius, sorted by body. Leaves come after all other shapes,
    sorted by tree."""

    tree_start: np.ndarray
    """[tree + 1] Index of the first capsule of each tree; the last entry is the number of capsules
    that are no leaves."""
    leaf_start: np.ndarray
    """[tree + 1] Index of the first leaf of each tree; the last entry is the number of capsules."""
    leaf: np.ndarray
    """[k] Number in the model of each leaf that has a capsule."""
    leaf_reach: np.ndarray
    """[tree] m, largest distance of a point of a leaf's capsule from the axis of the body that carries the leaf."""
    body: np.ndarray
    """[capsule] Index of the body that the capsule belongs to."""
    bunch: np.ndarray
    """[capsule] Index of the bunch that the capsule belongs to; -1 for wood.

    The capsule of a peduncle belongs to its bunch: once the bunch is picked, the remaining stub does not collide.
    """
    branch: np.ndarray
    """[capsule] Number of the unbranched axis of its tree to which wood belongs: 0 for the main axis, more for side
    shoots; -1 for bunches and peduncles.

    Capsules of one axis do not touch each other.
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
    stiffness: np.ndarray
    """[capsule] N/m, stiffness of contacts of a leaf, which gives way by its petiole; 0: that of the materials."""


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
    tree_start = np.searchsorted(body, np.append(model.tree_first, len(model.body_mass))).astype(np.int32)
    return PlantCapsules(
        tree_start=tree_start,
        leaf_start=np.full(len(tree_start), len(body), np.int32),
        leaf=np.zeros(0, np.int32),
        leaf_reach=np.zeros(len(model.tree_first), np.float32),
        body=body.astype(np.int32),
        bunch=bunch.astype(np.int32),
        branch=np.where(bunch < 0, branches(model)[body.astype(np.int32)], -1).astype(np.int32),
        level=level.astype(np.int32),
        start=start.astype(np.float32)[:, None] * along,
        end=end.astype(np.float32)[:, None] * along,
        radius=radius.astype(np.float32),
        material=materials_of_organs(model.body_organ[body.astype(np.int32)]),
        stiffness=np.zeros(len(body)),
    )


def with_leaves(capsules: PlantCapsules, model: Model, parameters: PhysicsParameters) -> PlantCapsules:
    """Returns the capsules, followed by one for each leaf, along the lower part of its midrib
    (:data:`leaves.BLADE_LENGTH`).

    The capsule stays on the body that carries the leaf. It gives way by overlapping: its contact has the stiffness of
    the petiole against a force at the middle of the capsule.
    """
    order = np.argsort(model.body_tree[model.leaf_body], kind="stable")
    pose = model.leaf_pose[order].astype(float)
    base = model.leaf_base[order].astype(float)
    size = model.leaf_size[order].astype(float)
    body = model.leaf_body[order]
    length = leaves.BLADE_LENGTH * size
    start = pose[:, :3]
    end = start + length[:, None] * frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0]))
    radius = leaves.BLADE_RADIUS * size
    petiole = np.maximum(np.linalg.norm(start - base, axis=1), MIN_PETIOLE_LENGTH)
    stiffness = leaves.petiole_stiffness(
        petiole, leaves.PETIOLE_DIAMETER * size, 0.5 * length, parameters.petiole_modulus
    )
    on_axis = np.array([1.0, 0.0, 0.0]) * np.clip(base[:, :1], 0.0, model.body_length[body].astype(float)[:, None])
    away = np.maximum(np.linalg.norm(start - on_axis, axis=1), np.linalg.norm(end - on_axis, axis=1)) + radius
    tree = model.body_tree[body]
    reach = np.zeros(len(model.tree_first), np.float32)
    np.maximum.at(reach, tree, away.astype(np.float32))
    count = len(capsules.body)
    of_leaves = {
        "body": body,
        "bunch": np.full(len(body), -1),
        "branch": np.full(len(body), -1),
        "level": np.full(len(body), HIDDEN),
        "start": start,
        "end": end,
        "radius": radius,
        "material": np.full(len(body), int(Material.LEAF)),
        "stiffness": stiffness,
    }
    joined = {
        name: np.concatenate([before := getattr(capsules, name), values]).astype(before.dtype)
        for name, values in of_leaves.items()
    }
    leaf_start = count + np.searchsorted(tree, np.arange(len(model.tree_first) + 1))
    return dataclasses.replace(capsules, leaf_start=leaf_start.astype(np.int32), leaf=order, leaf_reach=reach, **joined)


def pass_leaves(capsules: PlantCapsules, model: Model, parts: list[tuple[int, float, float]]) -> None:
    """Pass the leaves of a divided segment to the bodies on which they grow now. ``parts``: body, start [m] and end [m]
    of each part of the segment, from its joint to its tip; all parts have the frame of the segment."""
    bodies = [body for body, _, _ in parts]
    tree = model.body_tree[bodies[-1]]
    first = int(capsules.tree_start[-1])
    of_tree = np.arange(int(capsules.leaf_start[tree]), int(capsules.leaf_start[tree + 1]))
    here = of_tree[model.leaf_body[capsules.leaf[of_tree - first]] == bodies[-1]]
    node = model.leaf_base[capsules.leaf[here - first], 0]
    ends = [end for _, _, end in parts[:-1]]
    capsules.body[here] = np.array(bodies, np.int32)[np.searchsorted(ends, node, side="right")]


def branches(model: Model) -> np.ndarray:
    """Returns the number of the unbranched axis [body] to which each body of a tree belongs: an axis continues with the
    first child of each body. 0 for the axis that begins at the tree's root."""
    branch = np.zeros(len(model.body_mass), np.int32)
    parent = model.body_parent
    has_parent = parent >= 0
    first_child = np.full(len(parent) + 1, len(parent))
    np.minimum.at(first_child, parent[has_parent], np.flatnonzero(has_parent))
    starts = has_parent & (first_child[parent] != np.arange(len(parent)))
    number = np.cumsum(starts)
    before = np.concatenate([[0], number])[model.tree_first[model.body_tree]]
    for body in np.flatnonzero(has_parent).tolist():
        branch[body] = number[body] - before[body] if starts[body] else branch[parent[body]]
    return branch


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
