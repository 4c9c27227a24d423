"""Leaves at nodes of shoots, from random numbers: petiole, blade, age, and what they weigh and how they drag."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.plant_parameters import Leaf
from vinesim.scene.spec import Scene

LATERAL_AREA = 0.55
"""[1] Area of a leaf of a side shoot over one of a main axis. GUESSED."""


@dataclasses.dataclass(frozen=True, slots=True)
class LeafNodes:
    """Where leaves stand on their bodies; all arrays broadcast against [...]."""

    turn: np.ndarray
    """[..., 4] quaternion of the body in the world."""
    along: np.ndarray
    """[...] m from the body's origin."""
    thick: np.ndarray
    """[...] m, radius of the body there."""
    share: np.ndarray
    """[...] of the length of the axis, from its base."""
    up: np.ndarray
    """[..., 3] across which, and across the axis, leaves stand on either side."""
    hand: np.ndarray
    """[..., 1] 1 or -1: on which side."""
    grown: np.ndarray
    """[...] area of a grown leaf there over that of one on a main axis."""


def grow_leaves(
    scene: Scene, leaf: Leaf, nodes: LeafNodes, normal: np.ndarray, uniform: np.ndarray
) -> dict[str, np.ndarray]:
    """Leaves of a scene's season at ``nodes``.

    Args:
        scene: its season and training.
        leaf: sizes and weights.
        nodes: where.
        normal: [8, ...] standard normal numbers.
        uniform: [4, ...] uniform numbers.

    Returns:
        ``present`` [...] whether it has not fallen; ``base`` [..., 3] m and ``pose`` [..., 7] as in
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

    # blades lie on the light: flat over the net, hanging and facing outwards in a hedge
    flat = frames.normalize(out * [1.0, 1.0, 0.0])
    midrib = frames.normalize(flat + 0.3 * swing * axis + ((-0.45 if tendone else -1.0) + 0.3 * droop) * up)
    upper = up + (0.0 if tendone else 0.9) * flat + 0.3 * np.concatenate(lean, -1)
    pose = np.concatenate([blade, frames.multiply(frames.conjugate(turn), frames.from_x_axis(midrib, upper))], -1)
    age = np.where(turned < scene.season.yellow, 0.75, 0.05 + 0.45 * (1.0 - share)) + 0.08 * ageing[..., 0]
    mass = leaf.mass_per_area.value * area + leaf.petiole_mass.value * np.sqrt(shrink)
    return {
        "present": fate < scene.season.leafiness,
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
    """Bodies with point masses; products of inertia are dropped.

    Args:
        mass: [body...] kg.
        com: [body..., 3] m, in body frames.
        inertia: [body..., 3] kg m^2, principal moments about the centre of mass.
        at: indices [...] of the bodies.
        weight: [...] kg.
        where: [..., 3] m, in body frames.

    Returns:
        Mass, centre of mass and moments of inertia.
    """
    total = mass.copy()
    first = mass[..., None] * com
    second = inertia + mass[..., None] * _squared_distances(com)
    np.add.at(total, at, weight)
    np.add.at(first, at, weight[..., None] * where)
    np.add.at(second, at, weight[..., None] * _squared_distances(where))
    com = first / np.where(total > 0.0, total, 1.0)[..., None]  # none in slots that are left out
    return total, com, second - total[..., None] * _squared_distances(com)


def _squared_distances(p: np.ndarray) -> np.ndarray:
    """Squared distance of points from the three axes."""
    square = p * p
    return square.sum(-1, keepdims=True) - square
