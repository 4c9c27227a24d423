"""Leaves: outlines of blades, and leaves at the nodes of shoots.

An outline is in polar form around the petiole's junction, with theta = 0 at the tip: a smooth five-cornered blade, from
which sinuses are cut, with small irregular teeth. There are outlines of three depths of sinus, from nearly entire to
deeply five-lobed, with some leaves that insects have holed or whose tips are torn off. All outlines have the same area;
lengths are in units of ``Model.leaf_size``, about half of the blade's width.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.core import frames
from vinesim.scene.plant_parameters import Leaf
from vinesim.scene.spec import Scene

BLADE_AREA = 2.3318158002798466
"""[leaf_size^2] Area of each flat blade without its holes. The number defines the unit ``leaf_size``, so that leaves
have the sizes that they had when an earlier set of outlines had this mean area."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Lobing:
    """Sinuses of leaves, by their greatest notes of OIV descriptor 094. Depths are guesses, tuned by eye."""

    note: float
    upper: float
    lower: float
    """Depth of the upper and lower lateral sinuses, as a fraction of the blade's radius."""
    width: float
    """Half width of a sinus [rad]."""


_LOBINGS = (_Lobing(2.0, 0.06, 0.04, 0.16), _Lobing(6.0, 0.26, 0.15, 0.17), _Lobing(9.0, 0.50, 0.32, 0.16))
_VARIANTS = 4
"""Number of outlines of each depth of sinus: two whole ones, one with holes, one with a torn lobe."""
SHAPE_COUNT = len(_LOBINGS) * _VARIANTS
"""Number of different outlines."""
_HOLED = 2
_TORN = 3
"""Numbers of the variants with holes and with a torn lobe."""

_BLADE = (
    (0.0, 1.0), (14.0, 0.95), (27.0, 0.90), (40.0, 0.89), (52.0, 0.93), (68.0, 0.88), (84.0, 0.83), (98.0, 0.81),
    (112.0, 0.82), (135.0, 0.72), (152.0, 0.64), (165.0, 0.52), (174.0, 0.22), (180.0, 0.06),
)  # fmt: skip
"""Angle from the midrib [deg] and radius of the blade without sinuses, in units of the midrib."""
_TIPS = ((0.0, 0.16), (52.0, 0.13), (112.0, 0.08))
"""Angle [deg] of the lobes' tips, and by how much the tips stand out."""
_SINUSES = (27.0, 84.0)
"""Angles of the upper and lower lateral sinuses [deg]."""
_PETIOLE_SINUS = np.radians(163.0)
"""Angle from which on there are no teeth."""
_TOOTH_WIDTH = (0.06, 0.13)
_TOOTH_LENGTH = (0.03, 0.065)
"""Range of the widths and lengths of teeth, in units of the midrib: GUESSED."""
_KNOTS = 4096


@functools.cache
def _blade(shape: int) -> np.ndarray:
    """Returns the radius of the outline [_KNOTS + 1] at equal steps of the angle from -pi to pi, in units of the
    midrib."""
    lobing = _LOBINGS[shape // _VARIANTS]
    rng = np.random.default_rng([shape, 9])
    theta = np.linspace(-np.pi, np.pi, _KNOTS + 1)
    angle, length = np.array(_BLADE).T
    radius = np.interp(np.abs(theta), np.radians(angle), length)
    around = np.exp(-0.5 * (np.arange(-200, 201) * (2.0 * np.pi / _KNOTS) / 0.07) ** 2)
    radius = np.convolve(np.pad(radius[:-1], 200, mode="wrap"), around / around.sum(), "valid")
    radius = np.append(radius, radius[0])
    for side in (1.0, -1.0):
        for (at, tall), turn in zip(_TIPS, rng.normal(0.0, 0.03, 3), strict=True):
            away = np.abs(theta - side * (np.radians(at) + turn))
            radius += (1.0 if at else 0.5) * tall * np.exp(-away / 0.10)
        for at, deep in zip(_SINUSES, (lobing.upper, lobing.lower), strict=True):
            away = (theta - side * (np.radians(at) + rng.normal(0.0, 0.04))) / (lobing.width * rng.uniform(0.8, 1.2))
            radius *= 1.0 - deep * rng.uniform(0.75, 1.25) * np.exp(-(np.abs(away) ** 2.5))
    for wave in range(1, 6):
        radius *= 1.0 + 0.012 * np.cos(wave * theta + rng.uniform(0.0, 2.0 * np.pi))
    whole = radius + _teeth(theta, radius, rng)
    if shape % _VARIANTS != _TORN:
        return whole
    away = np.cos(theta - np.radians(rng.choice([0.0, 52.0, -52.0]) + rng.normal(0.0, 12.0)))
    cut = rng.uniform(0.66, 0.82) * (1.0 + 0.04 * np.cos(9.0 * theta) + 0.03 * np.cos(23.0 * theta))
    return np.where(away > 0.6, np.minimum(whole, cut / np.maximum(away, 0.6)), whole)


def _teeth(theta: np.ndarray, radius: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the height of the teeth at the angles ``theta`` [n] rad of an outline of ``radius`` [n]: convex, of
    random width and length."""
    place = radius[:, None] * np.stack([np.cos(theta), np.sin(theta)], 1)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    ends = np.append(0.0, np.cumsum(rng.uniform(*_TOOTH_WIDTH, 200)))
    tooth = np.searchsorted(ends, along, side="right") - 1
    share = (along - ends[tooth]) / (ends[tooth + 1] - ends[tooth])
    height = rng.uniform(*_TOOTH_LENGTH, 200)[tooth] * (1.0 - np.abs(1.7 * share - 0.9).clip(0.0, 1.0) ** 1.4)
    return height * np.clip((_PETIOLE_SINUS - np.abs(theta)) / 0.15, 0.0, 1.0)


@functools.cache
def blade_holes(shape: int) -> np.ndarray:
    """Returns the round holes of a blade: u and v of the centre and radius [hole, 3], in units of the midrib; u is
    across the midrib, v along it. Holes do not overlap."""
    if shape % _VARIANTS != _HOLED:
        return np.zeros((0, 3))
    rng = np.random.default_rng([shape, 10])
    holes = np.zeros((0, 3))
    while len(holes) < 7:
        turn, away, wide = rng.uniform(-2.2, 2.2), rng.uniform(0.15, 0.55), 0.012 + 0.05 * rng.uniform() ** 3
        one = np.array([away * np.sin(turn), away * np.cos(turn), wide])
        if (np.hypot(*(holes[:, :2] - one[:2]).T) > holes[:, 2] + wide).all():
            holes = np.concatenate([holes, one[None]])
    return holes


@functools.cache
def midrib_length(shape: int) -> float:
    """Returns the length of the midrib from the petiole to the tip of the whole lobe [leaf_size]."""
    theta = np.linspace(-np.pi, np.pi, _KNOTS + 1)
    blade = float(np.trapezoid(0.5 * _blade(shape) ** 2, theta))
    return float(np.sqrt(BLADE_AREA / (blade - np.pi * (blade_holes(shape)[:, 2] ** 2).sum())))


def blade_outline(theta: np.ndarray, shape: int = 0) -> np.ndarray:
    """Returns the distance from the petiole's junction to the blade's edge at the angle ``theta`` [rad], -pi to pi, in
    units of ``leaf_size``."""
    knots = np.linspace(-np.pi, np.pi, _KNOTS + 1)
    return np.interp(np.asarray(theta, float), knots, _blade(shape)) * midrib_length(shape)


def blade_shape(leaf: np.ndarray, sinus_depth: np.ndarray | None = None) -> np.ndarray:
    """Returns the index of the outline [leaf] of each leaf, computed from the leaf's number, so that it is equal on all
    clients.

    ``sinus_depth``: [leaf] depth of the sinuses of the leaf's variety, note of OIV descriptor 094; 0 or None: leaves
    have all outlines.
    """
    scrambled = (np.asarray(leaf, np.uint32) * np.uint32(2654435761) >> np.uint32(16)).astype(np.int32)
    mixed = scrambled % SHAPE_COUNT
    if sinus_depth is None:
        return mixed
    depth = np.searchsorted([one.note for one in _LOBINGS[:-1]], sinus_depth)
    return np.where(np.asarray(sinus_depth) > 0.0, depth * _VARIANTS + scrambled % _VARIANTS, mixed)


# Leaves as obstacles: a capsule for the blade, on the spring of the petiole.


BLADE_LENGTH = 0.7
"""[leaf_size] Length of the axis of a leaf's collision capsule, from the end of the petiole along the midrib, which is
1.02 to 1.13 long. GUESSED"""
BLADE_RADIUS = 0.459
"""[leaf_size] Radius of a leaf's collision capsule. DERIVED: seen from a random direction, the capsule covers the same
area as the blade: pi r (L / 2 + r) = BLADE_AREA / 2, with L = BLADE_LENGTH."""
PETIOLE_DIAMETER = 0.031
"""[leaf_size] Diameter of a petiole. GUESSED: 2.5 mm at a leaf of 0.015 m^2."""


def petiole_stiffness(length: np.ndarray, diameter: np.ndarray, lever: np.ndarray, modulus: float) -> np.ndarray:
    """Returns the stiffness [...] N/m against which a leaf gives way to a force across its petiole.

    The petiole is a round cantilever of ``length`` [...] m and ``diameter`` [...] m with Young's ``modulus`` [Pa]; the
    blade is rigid, and the force acts on it at the distance ``lever`` [...] m from the petiole's end. Euler-Bernoulli
    beam (Gere and Timoshenko, Mechanics of Materials): k = E I / (L^3 / 3 + L^2 a + L a^2), valid for deflections that
    are small against the length.
    """
    flexural = modulus * np.pi * diameter**4 / 64.0
    return flexural / (length**3 / 3.0 + length**2 * lever + length * lever**2)


# Leaves at nodes of shoots, from random numbers: petiole, blade, age, mass and drag.


LATERAL_AREA = 0.55
"""[1] Ratio of the leaf area on a side shoot to the leaf area on a main axis. GUESSED."""


@dataclasses.dataclass(frozen=True, slots=True)
class LeafNodes:
    """Positions of leaves on their bodies; all arrays broadcast against [...]."""

    turn: np.ndarray
    """[..., 4] quaternion of the body in the world."""
    along: np.ndarray
    """[...] m, distance of the node from the body's origin."""
    thick: np.ndarray
    """[...] m, radius of the body at the node."""
    share: np.ndarray
    """[...] position of the node as a fraction of the axis' length, from its base."""
    up: np.ndarray
    """[..., 3] direction perpendicular to the plane in which leaves stand on both sides of the axis."""
    hand: np.ndarray
    """[..., 1] side of the leaf, 1 or -1."""
    reach: np.ndarray
    """[...] m, distance of the node from the base of its shoot."""
    grown: np.ndarray
    """[...] ratio of the area of a grown leaf at this node to the area on a main axis."""


def grow_leaves(
    scene: Scene, leaf: Leaf, nodes: LeafNodes, normal: np.ndarray, uniform: np.ndarray
) -> dict[str, np.ndarray]:
    """Grow leaves at ``nodes`` according to the scene's season.

    Args:
        scene: its season and training are used.
        leaf: sizes and weights of leaves.
        nodes: positions of the leaves.
        normal: [8, ...] standard normal random numbers.
        uniform: [4, ...] uniform random numbers.

    Returns:
        ``present`` [...] is false for fallen leaves; ``base`` [..., 3] m and ``pose`` [..., 7] are as in
        :class:`~vinesim.scene.model.Model`; ``area`` [...] m^2; ``age`` [...]; ``mass`` [...] kg; ``drag`` [...] m^2.
    """
    forward, rise, droop, swing, *lean, ageing = normal[..., None]
    fate, turned, far, large = uniform
    turn = nodes.turn
    share = nodes.share
    hand = nodes.hand

    tendone = scene.training == "tendone"
    axis = frames.rotate(turn, np.array([1.0, 0.0, 0.0]))
    up = np.array([0.0, 0.0, 1.0])
    sideways = frames.normalize(frames.cross(nodes.up, axis))
    climb = (0.55 + 0.3 * rise) * (1.0 if tendone else 0.35)
    out = frames.normalize(hand * sideways + 0.35 * forward * axis + climb * up)
    young = np.clip((share - 0.75) / 0.25, 0.0, 1.0)
    shrink = nodes.grown * (1.0 - (1.0 - leaf.young_area.value) * young)
    area = leaf.area.at(large) * shrink
    petiole = leaf.petiole.at(far) * np.sqrt(shrink)
    local = frames.rotate(frames.conjugate(turn), out)
    along = nodes.along
    base = np.stack([along, 0.0 * along, 0.0 * along], -1) + nodes.thick[..., None] * local
    blade = base + petiole[..., None] * local

    # blades face the light: flat above the net in a tendone, hanging and facing outwards in a hedge
    flat = frames.normalize(out * [1.0, 1.0, 0.0])
    midrib = frames.normalize(flat + 0.3 * swing * axis + ((-0.45 if tendone else -1.0) + 0.3 * droop) * up)
    upper = up + (0.0 if tendone else 0.9) * flat + 0.3 * np.concatenate(lean, -1)
    pose = np.concatenate([blade, frames.multiply(frames.conjugate(turn), frames.from_x_axis(midrib, upper))], -1)
    age = np.where(turned < scene.season.yellow, 0.75, 0.05 + 0.45 * (1.0 - share)) + 0.08 * ageing[..., 0]
    mass = leaf.mass_per_area.value * area + leaf.petiole_mass.value * np.sqrt(shrink)
    season = scene.season
    stay = season.leafiness * np.where(nodes.reach < season.fruit_zone, season.fruit_zone_leafiness, 1.0)
    return {
        "present": fate < stay,
        "base": base,
        "pose": pose,
        "area": area,
        "age": np.clip(age, 0.0, 1.0),
        "mass": mass,
        "drag": leaf.drag.value * area,
    }


def add_point_masses(
    mass: np.ndarray,
    com: np.ndarray,
    inertia: np.ndarray,
    at: tuple[np.ndarray, ...],
    weight: np.ndarray,
    where: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add point masses to bodies; products of inertia are dropped.

    Args:
        mass: [body...] kg.
        com: [body..., 3] m, in body frames.
        inertia: [body..., 3] kg m^2, principal moments about the centre of mass.
        at: indices [...] of the bodies.
        weight: [...] kg, the point masses.
        where: [..., 3] m, their positions in body frames.

    Returns:
        New arrays of mass, centre of mass and moments of inertia.
    """
    total = mass.copy()
    first = mass[..., None] * com
    second = inertia + mass[..., None] * _squared_distances(com)
    np.add.at(total, at, weight)
    np.add.at(first, at, weight[..., None] * where)
    np.add.at(second, at, weight[..., None] * _squared_distances(where))
    com = first / np.where(total > 0.0, total, 1.0)[..., None]  # masked slots have no mass
    return total, com, second - total[..., None] * _squared_distances(com)


def _squared_distances(p: np.ndarray) -> np.ndarray:
    """Returns the squared distances [..., 3] of points [..., 3] from the three axes."""
    square = p * p
    return square.sum(-1, keepdims=True) - square
