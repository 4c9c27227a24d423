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
_YOUNG = 0.17
_YOUNGEST = 0.03
"""Ages (:attr:`Model.leaf_age`) between which a leaf's colour changes from young to grown. GUESSED."""
_TURNED = 0.62
"""Age from which a leaf counts as one that the season has turned yellow."""
_UNTURNED = 0.42
"""Age from which leaves show yellow margins."""


_WAX = 0.6
"""Turn of the hue of waxy leaves towards blue, relative to the spread of hues: GUESSED by the share of blue green in
photographs."""
NODE_BEFORE = 1.6
NODE_BEYOND = 0.1
"""Extent of the swelling at a node, before and beyond it, in radii of the cane: GUESSED, by eye."""
_NODE_WIDTH = 1.23
"""Thickness of a node, relative to the cane between nodes: GUESSED, by eye."""
_RIPE_WOOD = (0.3, 1.1)
"""Range of the share of a shoot, from its base, up to which it is brown at harvest: GUESSED."""
_CANE_SPREAD = 0.07
"""Standard deviation of the reflectance of canes from shoot to shoot, for each colour [1]: GUESSED."""
_LOOSE = 0.4
"""[rad] Angle by which blades are turned at random from the poses in the model, in which they face the light alike:
GUESSED, by eye."""
_AXILLARY = (0.74, 0.11, 0.09, 0.06)
"""Shares of the leaves in whose axil 0, 1, 2, ... small leaves of an axillary shoot stand: GUESSED."""
_AXILLARY_SIZE = (0.30, 0.52)
"""Range of the length of a small leaf, relative to the leaf in whose axil it stands: GUESSED."""
_AXILLARY_REACH = (0.03, 0.08)
"""[m] Range of the distance of small leaves from the node: GUESSED."""
_MOST_BENT = np.array([0.5, 0.7, 0.7])
"""Largest curvatures of a leaf: across and along the midrib, and fold at the midrib [leaf units]: GUESSED."""


def cane_batches(model: Model) -> list[Batch]:
    """Returns the primitives of canes and peduncles, one round cone for each segment, and of the nodes of those
    segments of canes that carry no leaf. The nodes of dormant canes are primitives of their own
    (:func:`~vinesim.sensors.primitives.dormant_primitives.dormant_batches`)."""
    bodies = np.flatnonzero((model.body_organ != int(Organ.BUNCH)) & (model.body_length > 0.0))
    seed = np.random.default_rng(5).uniform(size=len(model.tree_first))
    is_spare = model.is_spare()[bodies]  # a spare is drawn when a cut has made it a stump
    organ = np.where(is_spare, int(Organ.CANE), model.body_organ[bodies])
    tree = model.body_tree[bodies]
    bunch_of = model.bunch_of_body()[bodies]
    index = np.where(bunch_of >= 0, bunch_of, tree)
    is_stalk = organ == int(Organ.PEDUNCLE)
    organ, index = wood_classes(model, bodies, organ, index)
    reach = _reach(model)
    tints = _cane_tints(model, reach)
    material = np.where(is_stalk, int(materials.STEM), int(materials.CANE))
    material, tint = wood_looks(model, bodies, material, tints[bodies])
    length = np.where(is_spare, UNSEEN, model.body_length[bodies])
    radius = np.where(is_spare[:, None], UNSEEN, model.body_radius[bodies])
    zero = np.zeros(len(bodies))
    canes = make_batch(
        CONE,
        stack_columns(zero, zero, zero, radius[:, 0]),
        b=stack_columns(length, zero, zero, radius[:, 1]),
        c=stack_columns(np.where(is_stalk, 0.0, reach[bodies]), seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )
    if len(model.nodes.body):
        return [canes]
    bare = np.setdiff1d(bodies[~is_stalk & ~is_spare], model.leaf_body)
    return [canes, *_nodes(model, bare, np.zeros(len(bare)), tints, buds=True)]


def _reach(model: Model) -> np.ndarray:
    """Returns the distance [body] m along the wood from the base of the tree to the start of each body."""
    reach = np.zeros(len(model.body_mass))
    depth = model.depth()
    for level in range(1, int(depth.max(initial=0)) + 1):
        here = np.flatnonzero(depth == level)
        above = model.body_parent[here]
        reach[here] = reach[above] + model.body_length[above]
    return reach


def _cane_tints(model: Model, reach: np.ndarray) -> np.ndarray:
    """Returns the colour [body, 3] of canes and peduncles: shoots ripen from their base, so they are brown below and
    green above, each up to another height. ``reach``: [body] m, see :func:`_reach`."""
    wood = model.look.palette.wood
    rng = np.random.default_rng(5)
    tree = model.body_tree
    seed = rng.uniform(size=len(model.tree_first))[tree]
    ripe = rng.uniform(*_RIPE_WOOD, len(model.tree_first))[tree]
    hue = rng.normal(0.0, _CANE_SPREAD, (len(model.tree_first), 3))[tree]
    longest = np.zeros(len(model.tree_first))
    np.maximum.at(longest, tree, reach)
    share = reach / np.maximum(longest, 1e-6)[tree]
    green = textures.smoothstep(-0.2, 0.2, share - ripe + 0.08 * rng.normal(size=len(tree)))
    green = np.where(model.body_organ == int(Organ.PEDUNCLE), 1.0, green)[:, None]
    brown = np.array(wood.cane) * (0.7 + 0.6 * seed[:, None]) * (1.0 + np.clip(hue, -0.4, 0.4))
    return (1.0 - green) * brown + green * np.array(wood.stem) * (1.0 + 0.5 * np.clip(hue, -0.4, 0.4))


def _nodes(model: Model, body: np.ndarray, along: np.ndarray, tints: np.ndarray, *, buds: bool) -> list[Batch]:
    """Returns the primitives of nodes of canes: swellings, and buds on alternating sides of them.

    ``body``: [node] body of each node; ``along``: [node] m, distance from the start of the body; ``tints``: [body, 3]
    colours of canes.
    """
    if not len(body):
        return []
    share = np.clip(along / np.maximum(model.body_length[body], 1e-6), 0.0, 1.0)
    r = model.body_radius[body, 0] * (1.0 - share) + model.body_radius[body, 1] * share
    axis = along[:, None] * np.array([1.0, 0.0, 0.0])
    reach = np.array([1.0, 0.0, 0.0]) * r[:, None]
    tree = model.body_tree[body]
    common = {
        "material": int(materials.CANE),
        "organ": int(Organ.CANE),
        "label": label(Organ.CANE, 0) + tree,
        "carrier": body,
        "group": tree,
    }
    ratio = np.sqrt(np.array(model.look.palette.wood.node) / np.array(model.look.palette.wood.cane))
    tint = tints[body] * ratio
    swelling = make_batch(
        CONE,
        stack_columns(axis - NODE_BEFORE * reach, 1.02 * r),
        b=stack_columns(axis + NODE_BEYOND * reach, _NODE_WIDTH * r),
        tint=tint,
        **common,
    )
    if not buds:
        return [swelling]
    side = np.where(body % 2, 1.0, -1.0)[:, None] * np.array([0.0, 1.0, 0.0])
    bud = make_batch(
        CONE,
        stack_columns(axis + side * (0.9 * r)[:, None], 0.0034),
        b=stack_columns(axis + side * (r + 0.0045)[:, None] + 0.006 * np.array([1.0, 0.0, 0.0]), 0.0016),
        tint=0.75 * tint,
        **common,
    )
    return [swelling, bud]


def _leaf_tints(colours: LeafColours, age: np.ndarray, tree: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the reflectance [leaf, 3] of the upper sides of leaves of ``age`` [leaf] on shoots ``tree`` [leaf],
    linear RGB."""
    count = len(age)
    youth = np.clip((_YOUNG - age[:, None]) / (_YOUNG - _YOUNGEST), 0.0, 1.0)
    grown = np.array(colours.grown)
    base = grown + youth * (np.array(colours.young) - grown)
    shoot = np.random.default_rng(19).normal(size=int(tree.max(initial=0)) + 1)[tree, None]
    spread = 1.0 + colours.value_spread * np.clip(rng.normal(size=(count, 1)) + 0.8 * shoot, -2.5, 2.5)
    tint = base * (0.62 + 0.8 * rng.uniform(size=(count, 1))) * spread
    tint = tint + np.array(colours.pale) * np.clip(0.7 * rng.normal(size=(count, 1)), 0.0, 2.0)
    # a generator of its own: the shapes of leaves do not depend on the palette
    plain, waxy = np.random.default_rng(41).normal(size=(2, count))
    # wax makes some leaves bluer
    turn = colours.hue_spread * (plain + _WAX * np.clip(waxy, 0.0, 2.0))
    return _turn_hue(np.clip(tint, 0.0, 1.0), turn)


def _turn_hue(linear: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Returns linear RGB [n, 3] whose hue in sRGB is turned by ``turn`` [n] deg; towards blue it is also paler."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    hsv = cv2.cvtColor(encoded[None].astype(np.float32), cv2.COLOR_RGB2HSV)[0]
    hsv[:, 0] = (hsv[:, 0] + turn) % 360.0
    hsv[:, 1] *= 1.0 - 0.35 * np.clip(turn / 25.0, 0.0, 1.0)
    turned = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].astype(float)
    return np.where(turned <= 0.04045, turned / 12.92, ((turned + 0.055) / 1.055) ** 2.4)


def shown_age(colours: LeafColours, age: np.ndarray) -> np.ndarray:
    """Returns the age [leaf] up to which leaves of ``age`` [leaf] show margins: leaves that the season has not turned
    yellow have fewer of them where the palette says so."""
    return age - (1.0 - colours.margins) * np.maximum(age - _UNTURNED, 0.0) * (age < _TURNED)


def leaf_batches(model: Model) -> list[Batch]:
    """Returns the primitives of leaf blades, their petioles, and the cane nodes from which they grow."""
    if not len(model.leaf_body):
        return []
    rng = np.random.default_rng(11)
    leaf, size, petiole_end, rib, up = _blades(model)
    count = len(leaf)
    body = model.leaf_body[leaf]
    tree = model.body_tree[body]
    variety = model.variety_of_trees()[tree]
    shape = leaves.blade_shape(np.arange(count), np.array([*(v.sinus_depth or 0.0 for v in VARIETIES), 0.0])[variety])
    colours = model.look.palette.leaf
    small = np.arange(count) >= len(model.leaf_body)
    age = np.where(small, 0.9 * model.leaf_age[leaf], model.leaf_age[leaf])
    tint = _leaf_tints(colours, age, tree, rng)
    bend = np.stack([rng.normal(-0.12, 0.22, count), rng.normal(-0.18, 0.20, count), rng.uniform(-0.1, 0.5, count)], 1)
    bend = np.clip(
        bend * (1.0 + rng.exponential(0.35, (count, 1))), -_MOST_BENT, _MOST_BENT
    )  # some leaves curl or fold
    common = {"organ": int(Organ.LEAF), "label": label(Organ.LEAF, 0) + tree, "carrier": body, "group": tree}
    blade = make_batch(
        LEAF,
        stack_columns(petiole_end, size * textures.leaf_scale(shape)),
        b=stack_columns(rib, shape),
        c=stack_columns(up, rng.uniform(size=count)),
        d=stack_columns(bend, shown_age(colours, age)),
        material=int(materials.FOLIAGE),
        tint=tint,
        **common,
    )
    petiole = make_batch(
        CONE,
        stack_columns(model.leaf_base[leaf], np.where(small, 0.0012, 0.0017)),
        b=stack_columns(petiole_end, np.where(small, 0.0009, 0.0012)),
        material=int(materials.STEM),
        tint=np.array(colours.petiole) * rng.uniform(0.6, 1.4, (count, 1)),
        **common,
    )
    tints = _cane_tints(model, _reach(model))
    return [blade, petiole, *_nodes(model, model.leaf_body, model.leaf_base[:, 0], tints, buds=False)]


def _blades(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the blades: number of the model's leaf [blade], size [blade] m in the unit of ``Model.leaf_size``, end of
    the petiole [blade, 3] m, midrib and upper normal [blade, 3].

    The first blades are those of the model. After them come the small leaves of axillary shoots, which stand in the
    axils of some leaves. The area of a leaf in the model, by which it weighs and catches wind, is shared among its
    blade and the small ones.
    """
    rng = np.random.default_rng(13)
    count = len(model.leaf_body)
    size = np.array(model.leaf_size, float)
    q = model.leaf_pose[:, 3:]
    rib, up = (frames.rotate(q, np.broadcast_to(np.eye(3)[k], (count, 3))) for k in (0, 2))
    rib, up = _turned(rib, up, _LOOSE, rng)
    many = rng.choice(len(_AXILLARY), count, p=_AXILLARY) * (size > 0.6 * np.median(size))
    leaf = np.repeat(np.arange(count), many)
    ratio = rng.uniform(*_AXILLARY_SIZE, len(leaf))
    given = np.bincount(leaf, ratio**2, count)
    axis = np.array([1.0, 0.0, 0.0])
    stalk = frames.normalize(model.leaf_pose[:, :3] - model.leaf_base)[leaf]
    way = frames.normalize(0.6 * stalk + 0.7 * axis + 0.5 * rng.normal(size=(len(leaf), 3)))
    end = model.leaf_base[leaf] + way * rng.uniform(*_AXILLARY_REACH, (len(leaf), 1))
    small_rib, small_up = _turned(rib[leaf], up[leaf], _LOOSE, rng)
    return (
        np.append(np.arange(count), leaf),
        np.append(size * np.sqrt(1.0 - given), size[leaf] * ratio),
        np.concatenate([model.leaf_pose[:, :3], end]),
        np.concatenate([rib, small_rib]),
        np.concatenate([up, small_up]),
    )


def _turned(rib: np.ndarray, up: np.ndarray, angle: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns midribs and upper normals [n, 3] turned at random, by about ``angle`` rad."""
    rib = frames.normalize(rib + angle * rng.normal(size=rib.shape))
    up = up + angle * rng.normal(size=up.shape)
    return rib, frames.normalize(up - rib * (up * rib).sum(1, keepdims=True))
