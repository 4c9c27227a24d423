"""The plants of a batch: one model with the trees of all worlds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinesim.plants.articulation_solver import spans
from vinesim.scene.model import Model

_OF_BODY = {"bunch": ("bunch_body", "bunch_cluster"), "tie": ("tie_body",), "leaf": ("leaf_body",)}
"""Arrays that contain indices of bodies, by the kind of item that they describe. The first one names the item's
body."""
_STANDING = ("fixed", "box")
"""Kinds of items that all worlds share."""


def plants_of_worlds(models: Sequence[Model], count: int) -> Model:
    """Returns one model with the plants of ``count`` worlds: world w has those of ``models[w % len(models)]``.

    Tree t of world w gets the number ``t * count + w``. What stands still, terrain and boxes are those of the first
    model. Raises :class:`ValueError` if the models have different numbers of trees, or if there are none.
    """
    if not models or count < 1:
        raise ValueError(f"{len(models)} models for {count} worlds: give at least one of each")
    trees = len(models[0].tree_first)
    if odd := [i for i, model in enumerate(models) if len(model.tree_first) != trees]:
        other = len(models[odd[0]].tree_first)
        raise ValueError(f"model {odd[0]} has {other} trees, model 0 has {trees}: all worlds need as many trees")
    first = np.cumsum([0, *(len(model.tree_first) for model in models[:-1])])
    return gathered(joined(models), (np.arange(trees)[:, None] + first[np.arange(count) % len(models)]).ravel())


def joined(models: Sequence[Model]) -> Model:
    """Returns one model with the trees of all models, in their order."""
    counts = {
        kind: sum(model.counts()[kind] for model in models) if kind not in _STANDING else models[0].counts()[kind]
        for kind in models[0].counts()
    }
    whole = Model.allocate(**counts)
    start = dict.fromkeys(counts, 0)
    for model in models:
        added = model.counts()
        for name, dim in Model.array_fields().items():
            kind = str(dim.shape[0])
            if kind in _STANDING:
                continue
            value = getattr(model, name)
            here = slice(start[kind], start[kind] + added[kind])
            if name in ("tree_first", "body_parent", *(name for names in _OF_BODY.values() for name in names)):
                value = np.where(value >= 0, value + start["body"], value)
            elif name == "body_tree":
                value = value + start["tree"]
            getattr(whole, name)[here] = value
        for kind in start:
            start[kind] += added[kind]
    _take_standing(models[0], whole)
    return whole


Items = dict[str, tuple[np.ndarray, np.ndarray]]
"""For each kind: indices of the items, sorted by tree, and where the items of each tree begin in them [tree + 1]."""


def items_of_trees(model: Model) -> Items:
    """Returns the bunches, ties and leaves of each tree of a model."""
    items = {}
    for kind, (of, *_) in _OF_BODY.items():
        owner = model.body_tree[getattr(model, of)]
        order = np.argsort(owner, kind="stable")
        items[kind] = order, np.searchsorted(owner[order], np.arange(len(model.tree_first) + 1))
    return items


def gathered(pool: Model, trees: np.ndarray, items: Items | None = None) -> Model:
    """Returns a model with the ``trees`` [k] of another one, which may repeat. ``items``: :func:`items_of_trees` of
    the other model, which spares much time if it is given with each of many calls."""
    size = pool.tree_size[trees]
    first = np.cumsum(size) - size
    shift = first - pool.tree_first[trees]
    rows = {"tree": trees, "body": spans(pool.tree_first[trees], size)}
    moved = {"tree": shift, "body": np.repeat(shift, size)}
    for kind, (order, start) in (items or items_of_trees(pool)).items():
        begin, end = start[trees], start[trees + 1]
        rows[kind] = order[spans(begin, end - begin)]
        moved[kind] = np.repeat(shift, end - begin)
    sizes = {kind: len(rows[kind]) for kind in rows}
    gathered = Model.allocate(**(pool.counts() | sizes))
    for name, dim in Model.array_fields().items():
        kind = str(dim.shape[0])
        if kind not in _STANDING:
            getattr(gathered, name)[:] = getattr(pool, name)[rows[kind]]
    gathered.tree_first[:] = first
    gathered.body_tree[:] = np.repeat(np.arange(len(trees)), size)
    for kind, names in (("body", ("body_parent",)), *_OF_BODY.items()):
        for name in names:
            values = getattr(gathered, name)
            values += np.where(values >= 0, moved[kind], 0).astype(values.dtype)
    _take_standing(pool, gathered)
    return gathered


def _take_standing(source: Model, target: Model) -> None:
    """Copy what all worlds share."""
    for name, dim in Model.array_fields().items():
        if dim.shape[0] in _STANDING:
            getattr(target, name)[:] = getattr(source, name)
    target.terrain = source.terrain
    target.look = source.look
