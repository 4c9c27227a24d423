"""Leaves: the outline of a blade (five lobes, saw teeth, a sinus at the petiole), and leaves at the nodes of shoots.

The outline is in polar form around the petiole's junction, with theta = 0 at the tip. A lobe at angle t with its tip at
distance L is the wedge ``r = L / (cos D + kappa |sin D|)``, D = theta - t; the blade is the union of its lobes. All
lengths are in units of ``Model.leaf_size``, half of the blade's largest width.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.core import frames
from vinesim.scene.plant_parameters import Leaf
from vinesim.scene.spec import Scene

SHAPE_COUNT = 4
"""Number of different outlines, from deeply cut to round."""

_LOBES = ((0.0, 1.0), (np.radians(54.0), 0.88), (np.radians(112.0), 0.66))
"""Angle [rad] and length of middle, upper and lower lobes."""
_KAPPA = ((1.15, 1.0, 0.75), (1.45, 1.3, 0.9), (0.95, 0.85, 0.65), (1.3, 1.15, 0.8))
"""Slenderness kappa of the middle, upper and lower lobes in each shape."""
_TEETH = 0.075
_TEETH_PER_LOBE = 11.0


def _blade(theta: np.ndarray, shape: int) -> np.ndarray:
    """Returns the radius of the outline in units of the length of the middle lobe."""
    radius = np.full_like(theta, 0.05)
    for (angle, length), kappa in zip(_LOBES, _KAPPA[shape], strict=True):
        for side in (1.0, -1.0) if angle else (1.0,):
            away = np.abs((theta - side * angle + np.pi) % (2.0 * np.pi) - np.pi)
            tooth = (_TEETH_PER_LOBE * away**0.85 + 0.17 * shape) % 1.0
            depth = _TEETH * np.clip(away / 0.06, 0.0, 1.0) * np.abs(2.0 * tooth - 1.0)
            wedge = length * (1.0 - depth) / (np.cos(away) + kappa * np.sin(away))
            radius = np.maximum(radius, np.where(away < 1.25, wedge, 0.0))
    closing = np.clip((np.pi - np.abs(theta) - 0.10) / 0.42, 0.0, 1.0)
    return radius * (0.06 + 0.94 * closing * closing * (3.0 - 2.0 * closing))


@functools.cache
def _circle(shape: int) -> tuple[float, float]:
    """Returns the half width and area of the unscaled blade."""
    theta = np.linspace(-np.pi, np.pi, 4001)
    radius = _blade(theta, shape)
    width = float(np.abs(radius * np.sin(theta)).max())
    return width, float(np.trapezoid(0.5 * radius * radius, theta))


def blade_outline(theta: np.ndarray, shape: int = 0) -> np.ndarray:
    """Returns the distance from the petiole's junction to the blade's edge at the angle ``theta`` [rad], -pi to pi, in
    units of ``leaf_size``."""
    return _blade(np.asarray(theta, float), shape) / _circle(shape)[0]


def blade_area(shape: int = 0) -> float:
    """Returns the area of the flat blade [leaf_size^2]."""
    width, blade = _circle(shape)
    return blade / width**2


def blade_shape(leaf: np.ndarray) -> np.ndarray:
    """Returns the index of the outline [leaf] of each leaf, computed from the leaf's number, so that it is equal on all
    clients."""
    scrambled = np.asarray(leaf, np.uint32) * np.uint32(2654435761)
    return (scrambled >> np.uint32(16)).astype(np.int32) % SHAPE_COUNT


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
