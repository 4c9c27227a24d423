"""Nodes and buds of dormant vines as primitives, and the classes of dormant wood in labels."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE

_BUD_TINT = np.array([0.20, 0.105, 0.055])
"""Linear RGB reflectance of the brown scales of a closed bud: GUESSED by eye."""
_WOOL_TINT = np.array([0.42, 0.30, 0.22])
"""Linear RGB reflectance of the wool of a swelling bud: GUESSED by eye."""
_BURST_TINT = np.array([0.19, 0.27, 0.07])
"""Linear RGB reflectance of the leaves of a bursting bud: GUESSED by eye."""
_CLOSED = 0.009
"""[m] Length up to which a bud is closed."""
_SWELLING = 1.24
"""Thickness of a node, as a multiple of that of the cane: GUESSED from photographs."""


def wood_classes(
    model: Model, bodies: np.ndarray, organ: np.ndarray, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the class of ``bodies`` [k] in labels and their index in it; ``organ``, ``index`` [k] in vineyards
    without dormant wood. Dormant wood has the id of its cane as its index."""
    canes = model.canes
    if not len(canes.body):
        return organ, index
    cane = canes.of_bodies(len(model.body_mass))[bodies]
    two_year = (cane >= 0) & (canes.year[cane] == 2)
    return np.where(two_year, int(Organ.SPUR), organ), np.where(cane >= 0, cane, index)


def wood_looks(
    model: Model, bodies: np.ndarray, material: np.ndarray, tint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns material [k] and colour [k, 3], linear RGB, of ``bodies`` [k]. Last year's canes are brown up to their
    tips, each with a brown of its own; two-year wood has grey bark. ``material``, ``tint``: those in vineyards without
    dormant wood."""
    canes = model.canes
    if not len(canes.body):
        return material, tint
    wood = model.look.palette.wood
    cane = canes.of_bodies(len(model.body_mass))[bodies]
    rng = np.random.default_rng(6)
    bright = rng.uniform(0.75, 1.3, (len(canes.body), 1))
    pale = rng.uniform(0.25, 0.85, (len(canes.body), 1))
    grey = np.array(wood.bark_light)
    young = 0.8 * bright * ((1.0 - pale) * np.array(wood.cane) + pale * 1.2 * grey)
    old = 0.85 * bright * (0.75 * grey + 0.25 * np.array(wood.cane))
    is_old = canes.year == 2
    chosen = np.where(is_old[:, None], old, young)
    kind = np.where(is_old, int(materials.BARK), int(materials.CANE))
    dormant = cane >= 0
    return np.where(dormant, kind[cane], material), np.where(dormant[:, None], chosen[cane], tint)


def dormant_batches(model: Model) -> list[Batch]:
    """Returns the primitives of nodes and buds; none in vineyards without dormant wood."""
    nodes = model.nodes
    if not len(nodes.body):
        return []
    body = nodes.body
    tree = model.body_tree[body]
    share = np.clip(nodes.along / np.maximum(model.body_length[body], 1e-6), 0.0, 1.0)
    r = model.body_radius[body, 0] * (1.0 - share) + model.body_radius[body, 1] * share
    tint = 0.8 * wood_looks(model, body, np.zeros(len(body), int), np.zeros((len(body), 3)))[1]
    zero = np.zeros(len(body))
    swollen = [
        make_batch(
            CONE,
            stack_columns(nodes.along + start * r, zero, zero, thick * r),
            b=stack_columns(nodes.along + end * r, zero, zero, thin * r),
            material=int(materials.CANE),
            tint=tint,
            organ=int(Organ.NODE),
            label=label(Organ.NODE, 0) + np.arange(len(body)),
            carrier=body,
            group=tree,
        )
        for start, thick, end, thin in ((-1.6, 1.0, 0.0, _SWELLING), (0.0, _SWELLING, 0.8, 1.03))
    ]
    has = np.flatnonzero(nodes.bud >= 0)
    if not len(has):
        return swollen
    pose = nodes.bud_pose[has].astype(float)
    way = frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0]))
    long = nodes.bud_length[has, None].astype(float)
    wide = nodes.bud_radius[has].astype(float)
    closed = np.minimum(long, _CLOSED)
    rng = np.random.default_rng(7)
    woolly = rng.uniform(0.0, 0.35, (len(has), 1))
    names = label(Organ.BUD, 0) + nodes.bud[has]
    common = {"organ": int(Organ.BUD), "label": names, "carrier": body[has], "group": tree[has]}
    buds = [  # a bud is a blunt cone: a thick lower half and a pointed upper half
        make_batch(
            CONE,
            stack_columns(pose[:, :3], wide),
            b=stack_columns(pose[:, :3] + 0.45 * closed * way, 0.92 * wide),
            material=int(materials.CANE),
            tint=_BUD_TINT * (1.0 - woolly) + _WOOL_TINT * woolly,
            **common,
        ),
        make_batch(
            CONE,
            stack_columns(pose[:, :3] + 0.45 * closed * way, 0.92 * wide),
            b=stack_columns(pose[:, :3] + closed * way, 0.25 * wide),
            material=int(materials.CANE),
            tint=_BUD_TINT * (1.0 - woolly) + _WOOL_TINT * woolly,
            **common,
        ),
    ]
    burst = long[:, 0] > _CLOSED
    if burst.any():
        one = {name: value if isinstance(value, int) else value[burst] for name, value in common.items()}
        start = pose[burst, :3] + 0.6 * closed[burst] * way[burst]
        buds.append(
            make_batch(
                CONE,
                stack_columns(start, 0.85 * wide[burst]),
                b=stack_columns(pose[burst, :3] + long[burst] * way[burst], 0.35 * wide[burst]),
                material=int(materials.STEM),
                tint=_BURST_TINT * rng.uniform(0.8, 1.3, (int(burst.sum()), 1)),
                **one,
            )
        )
    return [*swollen, *buds]
