"""Canes, peduncles (stalks of bunches) and leaves as primitives."""

from __future__ import annotations

import cv2
import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.berries import VARIETIES
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.palette import DEFAULT, LeafColours
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.dormant_primitives import wood_classes, wood_looks
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF

STEM_TINT = DEFAULT.wood.stem
"""Colour [linear RGB reflectance] of the rachis and the stalks of berries."""
UNSEEN = 1e-6
"""Radius and length [m] with which wood is drawn that is not there: too small to be seen."""
_YOUNG = 0.15
_YOUNGEST = 0.03
"""Ages (:attr:`Model.leaf_age`) between which a leaf's colour changes from young to grown. GUESSED."""
_TURNED = 0.62
"""Age from which a leaf counts as one that the season has turned yellow."""
_UNTURNED = 0.42
"""Age from which leaves show yellow margins."""


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
    organ, index = wood_classes(model, bodies, organ, index)
    # shoots become brown from the base: they are green towards the tip, brown where the wood is thick
    green = np.clip(1.6 - model.body_radius[bodies].mean(1) / 0.0022, 0.0, 1.0) * (seed[tree] < 0.6)
    green = np.where(organ == int(Organ.PEDUNCLE), 1.0, green)[:, None]
    wood = model.look.palette.wood
    tint = (1.0 - green) * np.array(wood.cane) * (0.7 + 0.6 * seed[tree, None]) + green * np.array(wood.stem)
    material = np.where(green[:, 0] > 0.5, int(materials.STEM), int(materials.CANE))
    material, tint = wood_looks(model, bodies, material, tint)
    is_spare = model.is_spare()[bodies]  # a spare is drawn when a cut has made it a stump
    length = np.where(is_spare, UNSEEN, model.body_length[bodies])
    radius = np.where(is_spare[:, None], UNSEEN, model.body_radius[bodies])
    zero = np.zeros(len(bodies))
    return make_batch(
        CONE,
        stack_columns(zero, zero, zero, radius[:, 0]),
        b=stack_columns(length, zero, zero, radius[:, 1]),
        c=stack_columns(zero, seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )


def _leaf_tints(colours: LeafColours, age: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the reflectance [leaf, 3] of the upper sides of leaves of ``age`` [leaf], linear RGB."""
    count = len(age)
    youth = np.clip((_YOUNG - age[:, None]) / (_YOUNG - _YOUNGEST), 0.0, 1.0)
    grown = np.array(colours.grown)
    base = grown + youth * (np.array(colours.young) - grown)
    tint = (
        base * (0.75 + 0.6 * rng.uniform(size=(count, 1))) * (1.0 + colours.value_spread * rng.normal(size=(count, 1)))
    )
    tint = tint + np.array(colours.pale) * np.clip(0.7 * rng.normal(size=(count, 1)), 0.0, 2.0)
    if colours.hue_spread > 0.0:
        # a generator of its own: the shapes of leaves do not depend on the palette
        turn = colours.hue_spread * np.random.default_rng(41).normal(size=count)
        tint = _turn_hue(np.clip(tint, 0.0, 1.0), turn)
    return tint


def _turn_hue(linear: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Returns linear RGB [n, 3] whose hue in sRGB is turned by ``turn`` [n] deg."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    hsv = cv2.cvtColor(encoded[None].astype(np.float32), cv2.COLOR_RGB2HSV)[0]
    hsv[:, 0] = (hsv[:, 0] + turn) % 360.0
    turned = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].astype(float)
    return np.where(turned <= 0.04045, turned / 12.92, ((turned + 0.055) / 1.055) ** 2.4)


def shown_age(colours: LeafColours, age: np.ndarray) -> np.ndarray:
    """Returns the age [leaf] up to which leaves of ``age`` [leaf] show margins: leaves that the season has not turned
    yellow have fewer of them where the palette says so."""
    return age - (1.0 - colours.margins) * np.maximum(age - _UNTURNED, 0.0) * (age < _TURNED)


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
    colours = model.look.palette.leaf
    tint = _leaf_tints(colours, model.leaf_age, rng)
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
        d=stack_columns(bend, shown_age(colours, model.leaf_age)),
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
        tint=colours.petiole,
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
        tint=model.look.palette.wood.node,
        organ=int(Organ.CANE),
        label=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )
    return [blade, petiole, node]
