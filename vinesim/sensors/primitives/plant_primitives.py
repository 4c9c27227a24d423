"""Canes, peduncles (stalks of bunches) and leaves as primitives."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.berries import VARIETIES
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF

_CANE_TINT = (0.30, 0.17, 0.08)
STEM_TINT = (0.19, 0.22, 0.075)
"""Colours [linear RGB reflectance] of brown canes (``_CANE_TINT``) and of green stems, peduncles and rachises: GUESSED
by eye."""


_MOST_BENT = np.array([0.5, 0.7, 0.7])
"""Largest curvatures of a leaf: across and along the midrib, and fold at the midrib [leaf units]: GUESSED."""


def cane_batch(model: Model) -> Batch:
    """Returns the primitives of canes and peduncles: one round cone for each segment."""
    bodies = np.flatnonzero((model.body_organ != int(Organ.BUNCH)) & (model.body_length > 0.0))
    rng = np.random.default_rng(5)
    seed = rng.uniform(size=len(model.tree_first))
    organ = model.body_organ[bodies]
    tree = model.body_tree[bodies]
    index = tree.copy()
    bunch_of = model.bunch_of_body()[bodies]
    index = np.where(bunch_of >= 0, bunch_of, index)
    # shoots become brown from the base: they are green towards the tip, brown where the wood is thick
    green = np.clip(1.6 - model.body_radius[bodies].mean(1) / 0.0022, 0.0, 1.0) * (seed[tree] < 0.6)
    green = np.where(organ == int(Organ.PEDUNCLE), 1.0, green)[:, None]
    tint = (1.0 - green) * np.array(_CANE_TINT) * (0.7 + 0.6 * seed[tree, None]) + green * np.array(STEM_TINT)
    material = np.where(green[:, 0] > 0.5, int(materials.STEM), int(materials.CANE))
    length = model.body_length[bodies]
    zero = np.zeros(len(bodies))
    return make_batch(
        CONE,
        stack_columns(zero, zero, zero, model.body_radius[bodies, 0]),
        b=stack_columns(length, zero, zero, model.body_radius[bodies, 1]),
        c=stack_columns(zero, seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )


def leaf_batches(model: Model) -> list[Batch]:
    """Returns the primitives of leaf blades, their petioles, and the cane nodes from which they grow."""
    count = len(model.leaf_body)
    if not count:
        return []
    rng = np.random.default_rng(11)
    variety = model.variety_of_trees()[model.body_tree[model.leaf_body]]
    shape = leaves.blade_shape(np.arange(count), np.array([*(v.sinus_depth or 0.0 for v in VARIETIES), 0.0])[variety])
    q = model.leaf_pose[:, 3:]
    rib, up = (frames.rotate(q, np.broadcast_to(np.eye(3)[k], (count, 3))) for k in (0, 2))
    base = model.leaf_base
    petiole_end = model.leaf_pose[:, :3]
    size = model.leaf_size * textures.leaf_scale(shape)
    young = rng.uniform(size=(count, 1))
    tint = np.array([0.042, 0.115, 0.016]) * (0.75 + 0.6 * young) * (1.0 + 0.10 * rng.normal(size=(count, 1)))
    tint = tint + np.array([0.030, 0.035, 0.0]) * np.clip(0.7 * rng.normal(size=(count, 1)), 0.0, 2.0)
    bend = np.stack([rng.normal(-0.10, 0.16, count), rng.normal(-0.16, 0.14, count), rng.uniform(0.0, 0.45, count)], 1)
    bend = np.clip(
        bend * (1.0 + rng.exponential(0.35, (count, 1))), -_MOST_BENT, _MOST_BENT
    )  # some leaves curl or fold
    body = model.leaf_body
    tree = model.body_tree[model.leaf_body]
    names = label(Organ.LEAF, 0) + tree
    blade = make_batch(
        LEAF,
        stack_columns(petiole_end, size),
        b=stack_columns(rib, shape),
        c=stack_columns(up, rng.uniform(size=count)),
        d=stack_columns(bend, model.leaf_age),
        material=int(materials.FOLIAGE),
        tint=tint,
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    petiole = make_batch(
        CONE,
        stack_columns(base, 0.0017),
        b=stack_columns(petiole_end, 0.0012),
        material=int(materials.STEM),
        tint=(0.21, 0.13, 0.06),
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    # a node is 1.45 times as thick as the cane between nodes
    along = np.clip(base[:, 0] / np.maximum(model.body_length[body], 1e-6), 0.0, 1.0)
    r = model.body_radius[body, 0] * (1.0 - along) + model.body_radius[body, 1] * along
    reach = np.array([1.0, 0.0, 0.0]) * r[:, None]
    axis = base * np.array([1.0, 0.0, 0.0])
    node = make_batch(
        CONE,
        stack_columns(axis - 0.7 * reach, 1.25 * r),
        b=stack_columns(axis + 0.4 * reach, 1.45 * r),
        material=int(materials.CANE),
        tint=(0.24, 0.15, 0.07),
        organ=int(Organ.CANE),
        label=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )
    return [blade, petiole, node]
