"""Spare bodies: the bodies of stumps that cuts may leave ([why](../decisions/cutting.md)).

A segment of wood is one body. A cut within a segment makes two bodies of it, but the number of bodies of a model never
changes. So a tree has a few bodies without wood, of organ NOTHING, between its core and its berry clusters. Until a
cut makes a spare body a stump, it stands at the tree's root frame, carries no load, and no other body feels it. While
the berry clusters are locked, unused spares are not simulated.
"""

from __future__ import annotations

import numpy as np

from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

SPARES = 2
"""Spare bodies of each tree of a generated vineyard: the number of stumps that cuts may leave in one tree."""
DORMANT_SPARES = 6
"""As :data:`SPARES`, for trees of dormant canes, of which each is cut once or twice."""
PLACE_STEP = 1e-4
"""Unit in which the place of a cut along its segment is counted [m], so that all clients cut at the same place."""
_MASS = 1e-9
"""[kg] Mass of a spare body: nothing, but its joint needs an inertia that can be inverted."""
_INERTIA = 1e-12
"""[kg m^2] Moments of inertia of a spare body."""
_LENGTH = 1e-6
"""[m] Length of a spare body."""
_BODY_INDICES = ("body_parent", "bunch_body", "bunch_cluster", "tie_body", "leaf_body")
"""Fields that contain indices of bodies."""


def with_spares(model: Model, count: int = SPARES) -> Model:
    """Returns the model with ``count`` spare bodies in each tree, behind the other bodies of its core.

    Bodies keep their order; their indices change. Raises :class:`ValueError` if the model has spare bodies already.
    """
    if count < 1 or model.tree_spares.any():
        raise ValueError(f"{count} spare bodies a tree, on trees with {model.tree_spares.max()}; add 1 or more, once")
    trees = len(model.tree_first)
    bodies = len(model.body_mass)
    tree = model.body_tree
    is_cluster = np.arange(bodies) - model.tree_first[tree] >= model.tree_core[tree]
    moved = np.arange(bodies) + count * (tree + is_cluster)
    counts = model.counts() | {"body": bodies + count * trees}
    spared = Model.allocate(**counts)
    for name, field in Model.array_fields().items():
        before = getattr(model, name)
        if name in _BODY_INDICES:
            before = np.where(before >= 0, moved[np.maximum(before, 0)], -1) if bodies else before
        getattr(spared, name)[moved if field.shape[0] == "body" else slice(None)] = before
    spared.tree_first += count * np.arange(trees, dtype=np.int32)
    spared.tree_size += count
    spared.tree_core += count
    spared.tree_spares[:] = count
    spare = np.ones(len(spared.body_mass), bool)
    spare[moved] = False
    owner = np.repeat(np.arange(trees), count)
    spared.body_tree[spare] = owner
    spared.body_organ[spare] = int(Organ.NOTHING)
    spared.body_length[spare] = _LENGTH
    spared.body_mass[spare] = _MASS
    spared.body_inertia[spare] = _INERTIA
    spared.terrain = model.terrain
    spared.look = model.look
    spared.nodes, spared.canes = model.nodes.copy(), model.canes.copy()
    for part in (spared.nodes, spared.canes):
        part.body[:] = moved[part.body] if bodies else part.body
    return spared.check()
