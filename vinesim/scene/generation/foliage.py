"""Leaves at the nodes of shoots: where they are, how large, and what they weigh on the bodies that carry them."""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.scene.generation.plant_bodies import Bodies
from vinesim.scene.generation.shoot_slots import AXIS_SEGMENTS, LATERAL_NODES, LATERAL_SEGMENTS, MAX_NODES
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene


def place_leaves(scene: Scene, parameters: VineParameters, shoots: Shoots, bodies: Bodies) -> dict[str, np.ndarray]:
    """Leaves at the nodes, left and right in turn, and their weight on the bodies that carry them."""
    count, leaf = len(shoots.vine), parameters.leaf
    node = np.arange(MAX_NODES + LATERAL_NODES)
    main = node < MAX_NODES
    many = np.where(main, shoots.nodes[:, None], LATERAL_NODES)
    rank = np.where(main, node, node - MAX_NODES)
    share = np.minimum((rank + 0.7) / many, 0.999)
    forward, rise, droop, swing, *lean, ageing = shoots.leaf_normal[..., None]
    fate, turned, far, large = shoots.leaf_uniform
    present = (rank < many) & (fate < scene.season.leafiness) & (main | shoots.has_lateral[:, None])

    pieces = np.where(main, AXIS_SEGMENTS, LATERAL_SEGMENTS)
    piece = (share * pieces).astype(int)
    slot = np.where(main, piece, AXIS_SEGMENTS + piece)
    rows = np.arange(count)[:, None]
    length, turn = bodies.length[rows, slot], bodies.turn[rows, slot]
    x = (share * pieces - piece) * length
    thick = bodies.radius[rows, slot, 0]

    tendone = scene.training == "tendone"
    axis = frames.rotate(turn, np.array([1.0, 0.0, 0.0]))
    up = np.array([0.0, 0.0, 1.0])
    sideways = frames.normalize(frames.cross(shoots.up[:, None], axis))
    hand = np.where((rank + shoots.lateral_at[:, None]) % 2, 1.0, -1.0)[..., None]
    climb = (0.55 + 0.3 * rise) * (1.0 if tendone else 0.35)
    out = frames.normalize(hand * sideways + 0.35 * forward * axis + climb * up)
    young = np.clip((share - 0.75) / 0.25, 0.0, 1.0)
    shrink = np.where(main, 1.0, 0.55) * (1.0 - (1.0 - leaf.young_area.value) * young)
    area = leaf.area.at(large) * shrink
    petiole = leaf.petiole.at(far) * np.sqrt(shrink)
    local = frames.rotate(frames.conjugate(turn), out)
    base = np.stack([x, 0.0 * x, 0.0 * x], -1) + thick[..., None] * local
    blade = base + petiole[..., None] * local

    # blades lie on the light: flat over the net, hanging and facing outwards in a hedge
    flat = frames.normalize(out * [1.0, 1.0, 0.0])
    midrib = frames.normalize(flat + 0.3 * swing * axis + ((-0.45 if tendone else -1.0) + 0.3 * droop) * up)
    upper = up + (0.0 if tendone else 0.9) * flat + 0.3 * np.concatenate(lean, -1)
    pose = np.concatenate([blade, frames.multiply(frames.conjugate(turn), frames.from_x_axis(midrib, upper))], -1)
    age = np.where(turned < scene.season.yellow, 0.75, 0.05 + 0.45 * (1.0 - share)) + 0.08 * ageing[..., 0]

    weight = np.where(present, leaf.mass_per_area.value * area + leaf.petiole_mass.value * np.sqrt(shrink), 0.0)
    _add_point_masses(bodies, slot, weight, blade)
    np.add.at(bodies.drag, (np.broadcast_to(rows, slot.shape), slot), np.where(present, leaf.drag.value * area, 0.0))
    return {
        "present": present, "slot": slot, "base": base, "pose": pose, "area": area, "age": np.clip(age, 0.0, 1.0)
    }  # fmt: skip


def _add_point_masses(bodies: Bodies, slot: np.ndarray, weight: np.ndarray, where: np.ndarray) -> None:
    """Add point masses [shoot, leaf] at ``where`` in body frames; products of inertia are dropped."""
    mass, first, second = (
        bodies.mass.copy(),
        bodies.mass[..., None] * bodies.com,
        bodies.inertia + bodies.mass[..., None] * _squared_distances(bodies.com),
    )
    rows = np.broadcast_to(np.arange(len(slot))[:, None], slot.shape)
    np.add.at(mass, (rows, slot), weight)
    np.add.at(first, (rows, slot), weight[..., None] * where)
    np.add.at(second, (rows, slot), weight[..., None] * _squared_distances(where))
    bodies.mass, bodies.com = (
        mass,
        first / np.where(mass > 0.0, mass, 1.0)[..., None],
    )  # none in slots that are left out
    bodies.inertia = second - mass[..., None] * _squared_distances(bodies.com)


def _squared_distances(p: np.ndarray) -> np.ndarray:
    """Squared distance of points from the three axes."""
    square = p * p
    return square.sum(-1, keepdims=True) - square
