"""Bodies of all shoots in one table [shoot, slot]: poses as generated, masses, inertias, springs. A slot is a column of
the table, see :mod:`~vinesim.scene.generation.shoot_slots`.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.core import frames, portable_math
from vinesim.scene import builder
from vinesim.scene.berries import VARIETIES
from vinesim.scene.generation.shoot_slots import (
    AXIS_SEGMENTS,
    CORE_SLOTS,
    LATERAL_NODES,
    LATERAL_SEGMENTS,
    LATERAL_SLOTS,
    MAX_BUNCHES,
    MAX_NODES,
    PEDUNCLE_SEGMENTS,
    SLOT_COUNT,
    cluster_slots,
    peduncle_slots,
)
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.ids import Organ
from vinesim.scene.leaves import LATERAL_AREA, LeafNodes, add_point_masses, grow_leaves
from vinesim.scene.plant_parameters import Cane as CaneParameters
from vinesim.scene.plant_parameters import Peduncle as PeduncleParameters
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene


@dataclasses.dataclass
class Bodies:
    """Table of bodies [shoot, slot] from which the model is built. A slot is a column of the table: a segment, a bunch
    or a berry cluster. Poses are in the world, as generated.
    """

    present: np.ndarray
    """[shoot, slot] bool: the shoot has this body."""
    parent: np.ndarray
    """[shoot, slot] Slot (column of the table) of the parent body, -1 for the root."""
    organ: np.ndarray
    """[shoot, slot] :class:`Organ`."""
    origin: np.ndarray
    """[shoot, slot, 3] m, world position of the body's origin."""
    turn: np.ndarray
    """[shoot, slot, 4] orientation of the body in the world, quaternion xyzw."""
    length: np.ndarray
    """[shoot, slot] m, length of the body."""
    radius: np.ndarray
    """[shoot, slot, 2] m, radius of the body at its start and at its end."""
    mass: np.ndarray
    """[shoot, slot] kg, mass of the body."""
    com: np.ndarray
    """[shoot, slot, 3] m, centre of mass in the body's frame."""
    inertia: np.ndarray
    """[shoot, slot, 3] kg m^2, principal moments of inertia about the centre of mass."""
    stiffness: np.ndarray
    """[shoot, slot, 3] N m/rad, stiffness of the body's joint."""
    half: np.ndarray
    """[shoot, slot, 3] N m/rad, stiffness of the spring that represents the outer half of a segment (from its middle to
    its tip).
    """
    damping: np.ndarray
    """[shoot, slot, 3] N m s/rad, damping of the body's joint."""
    drag: np.ndarray
    """[shoot, slot] m^2, drag area Cd A."""
    head: dict[str, np.ndarray]
    """[shoot, MAX_BUNCHES, ...] mass, com and inertia of the head of each bunch, the part outside its clusters."""


def build_bodies(parameters: VineParameters, shoots: Shoots) -> Bodies:
    """Returns the bodies of main axes, laterals, peduncles and bunches, with the drag of wood and bunches."""
    count = len(shoots.vine)
    cane = parameters.cane
    peduncle = parameters.peduncle
    bodies = _allocate(count)
    tip = 0.5 * cane.tip_diameter.value
    share = np.linspace(0.0, 1.0, AXIS_SEGMENTS + 1)
    radius = shoots.base[:, None] + (tip - shoots.base[:, None]) * share
    green = np.clip((share[:-1] - cane.woody_share.value * shoots.woody) / 0.2 + 0.5, 0.0, 1.0)
    woody = math.log(cane.woody_modulus.value)
    soft = math.log(cane.green_modulus.value)
    modulus = portable_math.exp(woody * (1.0 - green) + soft * green)
    parent = np.broadcast_to(np.arange(-1, AXIS_SEGMENTS - 1), (count, AXIS_SEGMENTS))
    _fill_rod(bodies, slice(0, AXIS_SEGMENTS), shoots.points, radius, modulus, cane, shoots.up, parent)

    thin = 0.5 * cane.lateral_diameter.value
    radius = np.broadcast_to(np.linspace(thin, 0.6 * thin, LATERAL_SEGMENTS + 1), (count, LATERAL_SEGMENTS + 1))
    chain = np.arange(AXIS_SEGMENTS, AXIS_SEGMENTS + LATERAL_SEGMENTS - 1)
    parent = _chain_parents(shoots.lateral_at, chain)
    modulus = np.full(LATERAL_SEGMENTS, cane.green_modulus.value)
    _fill_rod(bodies, LATERAL_SLOTS, shoots.lateral_points, radius, modulus, cane, shoots.up, parent)
    bodies.present[:, LATERAL_SLOTS] = shoots.has_lateral[:, None]

    for k in range(MAX_BUNCHES):
        slots = peduncle_slots(k)
        segments = slice(slots.start, slots.stop - 1)
        thick = shoots.fruit["thick"][:, k]
        radius = np.broadcast_to(thick[:, None], (count, PEDUNCLE_SEGMENTS + 1))
        parent = _chain_parents(shoots.bunch_at[:, k], np.arange(slots.start, slots.stop - 2))
        modulus = np.full(PEDUNCLE_SEGMENTS, peduncle.modulus.value)
        _fill_rod(bodies, segments, shoots.peduncle[:, k], radius, modulus, peduncle, shoots.bunch_up[:, k], parent)
        bodies.organ[:, segments] = int(Organ.PEDUNCLE)

        _fill_bunch(parameters, shoots, bodies, k)
        bodies.present[:, slots] = shoots.has_bunch[:, k, None]
    across = bodies.radius.sum(-1) * bodies.length  # area of the wood seen from the side
    wood = np.where(bodies.organ == int(Organ.BUNCH), 0.0, cane.drag.value * across)
    bodies.drag[:, :CORE_SLOTS] += wood[:, :CORE_SLOTS]
    return bodies


def _allocate(count: int) -> Bodies:
    """Returns a table of zeros for ``count`` shoots, with all bodies present."""
    shape = (count, SLOT_COUNT)
    return Bodies(
        present=np.ones(shape, bool),
        parent=np.zeros(shape, int),
        organ=np.full(shape, int(Organ.CANE)),
        origin=np.zeros((*shape, 3)),
        turn=np.zeros((*shape, 4)),
        length=np.zeros(shape),
        radius=np.zeros((*shape, 2)),
        mass=np.zeros(shape),
        com=np.zeros((*shape, 3)),
        inertia=np.zeros((*shape, 3)),
        stiffness=np.zeros((*shape, 3)),
        half=np.zeros((*shape, 3)),
        damping=np.zeros((*shape, 3)),
        drag=np.zeros(shape),
        head={
            "mass": np.zeros((count, MAX_BUNCHES)),
            "com": np.zeros((count, MAX_BUNCHES, 3)),
            "inertia": np.zeros((count, MAX_BUNCHES, 3)),
        },
    )


def _chain_parents(first: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """Returns the parent slots [shoot, segment] of the segments of a rod that grows on the body in slot ``first``
    [shoot]. A slot is a column of the table of bodies.

    ``chain`` [segment - 1]: slots of all segments of the rod except the last one.
    """
    return np.concatenate([first[:, None], np.broadcast_to(chain, (len(first), len(chain)))], 1)


def _fill_bunch(parameters: VineParameters, shoots: Shoots, bodies: Bodies, k: int) -> None:
    """Fill the columns (slots) of the table of bodies for the bunch at the end of peduncle ``k`` and for its berry
    clusters.
    """
    bunch = peduncle_slots(k).stop - 1
    clusters = cluster_slots(k)
    bodies.present[:, clusters] = False
    has = np.flatnonzero(shoots.has_bunch[:, k])
    if len(has) == 0:
        return
    mass, long, wide, count, seed, variety = (
        shoots.fruit[name][has, k] for name in ("mass", "length", "radius", "count", "seed", "variety")
    )
    pieces = builder.segment_bunches(
        mass, long, wide, count, seed, variety, parameters.rachis, parameters.bunch.stem_share.value
    )
    bodies.mass[has, bunch], bodies.com[has, bunch], bodies.inertia[has, bunch] = pieces.compound()
    for name, head in bodies.head.items():
        head[has, k] = getattr(pieces, name)[:, 0]
    bodies.organ[:, bunch] = bodies.organ[:, clusters] = int(Organ.BUNCH)
    bodies.parent[:, bunch] = bunch - 1
    bodies.origin[:, bunch] = shoots.peduncle[:, k, -1]
    bodies.turn[:, bunch] = frames.from_x_axis(shoots.bunch_axis[:, k], shoots.bunch_up[:, k])
    bodies.length[has, bunch] = long
    bodies.radius[has, bunch] = wide[:, None]
    bodies.stiffness[:, bunch] = bodies.stiffness[:, bunch - 1]
    bodies.damping[:, bunch] = bodies.damping[:, bunch - 1]
    # wind acts on the bunch as a whole, not on its clusters
    bodies.drag[has, bunch] = parameters.bunch.drag.value * 0.5 * np.pi * wide * long

    most = pieces.mass.shape[1] - 1
    number = np.arange(1, most + 1)
    slots = np.arange(clusters.start, clusters.start + most)
    at = np.ix_(has, slots)
    bodies.present[at] = number < pieces.count[:, None]
    bodies.parent[at] = np.where(number == 1, bunch, slots - 1)
    bodies.turn[at] = bodies.turn[has, bunch, None]
    along = frames.rotate(bodies.turn[has, bunch], np.array([1.0, 0.0, 0.0])) * pieces.length[:, None]
    bodies.origin[at] = bodies.origin[has, bunch, None] + number[:, None] * along[:, None]
    bodies.length[at] = pieces.length[:, None]
    for name in ("radius", "mass", "com", "inertia", "stiffness"):
        getattr(bodies, name)[at] = getattr(pieces, name)[:, 1:]
    bodies.damping[at] = parameters.rachis.damping.value * pieces.stiffness[:, 1:]


def _fill_rod(
    bodies: Bodies,
    slots: slice,
    points: np.ndarray,
    radius: np.ndarray,
    modulus: np.ndarray,
    wood: CaneParameters | PeduncleParameters,
    up: np.ndarray,
    parent: np.ndarray,
) -> None:
    """Fill the columns (slots) of the table of bodies for one rod of every shoot, which is either a root or grows on
    the tip of its parent.

    Args:
        bodies: the table.
        slots: slots of the segments.
        points: [shoot, segment + 1, 3] m, ends of the segments.
        radius: [shoot, segment + 1] m, radii at these points.
        modulus: [segment] Pa, Young's modulus.
        wood: parameters with density and damping of the wood.
        up: [shoot, 3] direction that the z axes lean to.
        parent: [shoot, segment] slots of the parents.
    """
    along = np.diff(points, axis=1)
    length = np.linalg.norm(along, axis=-1)
    start = radius[:, :-1]
    end = radius[:, 1:]
    mass, inertia, near, bodies.half[:, slots] = builder.segment_properties(
        length, start, end, modulus, wood.density.value
    )
    bodies.parent[:, slots] = parent
    bodies.origin[:, slots] = points[:, :-1]
    bodies.turn[:, slots] = turn = frames.from_x_axis(along, up[:, None])
    compliance = 1.0 / near
    compliance[:, 1:] += 1.0 / bodies.half[:, slots][:, :-1]
    if (parent[:, 0] >= 0).all():
        grown_on = np.arange(len(parent)), parent[:, 0]
        axes = frames.to_matrix(frames.multiply(frames.conjugate(bodies.turn[grown_on]), turn[:, 0]))
        compliance[:, 0] += np.einsum("si,sij->sj", 1.0 / bodies.half[grown_on], axes**2)
    stiffness = 1.0 / compliance
    bodies.length[:, slots] = length
    bodies.radius[:, slots] = np.stack([start, end], -1)
    bodies.mass[:, slots] = mass
    bodies.com[:, slots, 0] = 0.5 * length
    bodies.inertia[:, slots] = inertia
    bodies.stiffness[:, slots] = stiffness
    bodies.damping[:, slots] = wood.damping.value * stiffness


# Leaves at the nodes of shoots: positions of the nodes, and the leaves' weight on the bodies that carry them.


def _leaf_size(parameters: VineParameters, variety: np.ndarray) -> np.ndarray:
    """Returns the ratio [...] of the leaf area of each ``variety`` [...] to that of the plant's file."""
    usual = parameters.leaf.area.at(0.5)
    return np.array([(v.leaf_area or usual) / usual for v in VARIETIES])[variety]


def place_leaves(scene: Scene, parameters: VineParameters, shoots: Shoots, bodies: Bodies) -> dict[str, np.ndarray]:
    """Place leaves at the nodes, alternately left and right, and add their weight to the bodies that carry them."""
    node = np.arange(MAX_NODES + LATERAL_NODES)
    main = node < MAX_NODES
    many = np.where(main, shoots.nodes[:, None], LATERAL_NODES)
    rank = np.where(main, node, node - MAX_NODES)
    share = np.minimum((rank + 0.7) / many, 0.999)

    pieces = np.where(main, AXIS_SEGMENTS, LATERAL_SEGMENTS)
    piece = (share * pieces).astype(int)
    slot = np.where(main, piece, AXIS_SEGMENTS + piece)
    rows = np.arange(len(shoots.vine))[:, None]
    turn = bodies.turn[rows, slot]
    along = (share * pieces - piece) * bodies.length[rows, slot]
    place = bodies.origin[rows, slot] + frames.rotate(turn, along[..., None] * [1.0, 0.0, 0.0])
    grown = 1.0 if shoots.leaf_grown is None else shoots.leaf_grown
    nodes = LeafNodes(
        turn=turn,
        along=along,
        reach=np.linalg.norm(place - bodies.origin[:, :1], axis=-1),
        thick=bodies.radius[rows, slot, 0],
        share=share,
        up=shoots.up[:, None],
        hand=np.where((rank + shoots.lateral_at[:, None]) % 2, 1.0, -1.0)[..., None],
        grown=np.where(main, 1.0, LATERAL_AREA) * _leaf_size(parameters, shoots.fruit["variety"][:, :1]) * grown,
    )
    leaf = grow_leaves(scene, parameters.leaf, nodes, shoots.leaf_normal, shoots.leaf_uniform)
    present = (rank < many) & leaf["present"] & (main | shoots.has_lateral[:, None])

    at = np.broadcast_to(rows, slot.shape), slot
    bodies.mass, bodies.com, bodies.inertia = add_point_masses(
        bodies.mass, bodies.com, bodies.inertia, at, np.where(present, leaf["mass"], 0.0), leaf["pose"][..., :3]
    )
    np.add.at(bodies.drag, at, np.where(present, leaf["drag"], 0.0))
    return {"slot": slot} | leaf | {"present": present}
