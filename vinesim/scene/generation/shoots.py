"""Samples the shapes of shoots at random: points of main axes and laterals (side shoots) in the world, and numbers of
nodes."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames, portable_math
from vinesim.scene import builder
from vinesim.scene.generation.bearers import Bearer, grow_bearers
from vinesim.scene.generation.close_bunches import Canes, hang_bunches
from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.fruit import choose_bunches, sample_fruit
from vinesim.scene.generation.old_wood import seat_on_spurs
from vinesim.scene.generation.shoot_slots import (
    AXIS_SEGMENTS,
    LATERAL_NODES,
    LATERAL_SEGMENTS,
    MAX_NODES,
)
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene


@dataclasses.dataclass
class Shoots:
    """Random numbers and shapes of all shoots; the first axis of each array is the shoot unless noted."""

    vine: np.ndarray
    piece: np.ndarray
    """[shoot] Index of the piece of an arm on which the shoot grows, counted over all arms."""
    up: np.ndarray
    """[shoot, 3] direction that the bodies' z axes lean to."""
    points: np.ndarray
    """[shoot, AXIS_SEGMENTS + 1, 3] m, points along the main axis."""
    length: np.ndarray
    base: np.ndarray
    """[shoot] m, radius at the base of the main axis."""
    has_lateral: np.ndarray
    """[shoot] bool, whether the shoot has a lateral (side shoot)."""
    lateral_at: np.ndarray
    """[shoot] Index of the segment of the main axis whose tip carries the lateral (side shoot)."""
    lateral_points: np.ndarray
    """[shoot, LATERAL_SEGMENTS + 1, 3] m, points along the lateral."""
    has_bunch: np.ndarray
    """[shoot, MAX_BUNCHES] bool, whether the shoot has this bunch."""
    bunch_at: np.ndarray
    """[shoot, MAX_BUNCHES] Index of the segment of the main axis whose tip carries the bunch's peduncle."""
    peduncle: np.ndarray
    """[shoot, MAX_BUNCHES, PEDUNCLE_SEGMENTS + 1, 3] m, points along the peduncle. The last point is the bunch's
    origin.
    """
    bunch_axis: np.ndarray
    """[shoot, MAX_BUNCHES, 3] Direction of the bunch's axis."""
    bunch_up: np.ndarray
    """[shoot, MAX_BUNCHES, 3] Direction that the bunch's z axis leans to."""
    fruit: dict[str, np.ndarray]
    """Properties of the bunches by name, each an array [shoot, MAX_BUNCHES]: mass, count, length, radius, seed,
    variety, pull, thick.
    """
    nodes: np.ndarray
    """[shoot] Number of nodes of the main axis."""
    leaf_normal: np.ndarray
    """[8, shoot, MAX_NODES + LATERAL_NODES] Standard normal random numbers from which the leaves are generated."""
    leaf_uniform: np.ndarray
    """[4, shoot, MAX_NODES + LATERAL_NODES] Uniform random numbers from which the leaves are generated."""
    bearers: tuple[Bearer, ...] = ()
    """Two-year wood on which the shoots stand, in a scene with a date."""
    leaf_grown: np.ndarray | None = None
    """[shoot, MAX_NODES + LATERAL_NODES] Area of each leaf as a share of that of a grown leaf; None: all are grown."""
    woody: float = 1.0
    """Share of the length that has turned woody, in units of that at harvest."""


def sample_shoots(scene: Scene, parameters: VineParameters, structure: FixedStructure) -> Shoots:
    tendone = scene.training == "tendone"
    cane = parameters.cane
    each = int((parameters.arm.tendone_shoots if tendone else parameters.arm.vsp_shoots).value)
    arm_count = structure.arms.shape[1]
    arm_segments = structure.arms.shape[2] - 1
    per_vine = each * arm_count
    vines = len(structure.foot)
    count = per_vine * vines

    def uniform(*shape: int) -> np.ndarray:
        return np.stack([g.random((per_vine, *shape)) for g in structure.rngs]).reshape(count, *shape)

    def normal(*shape: int) -> np.ndarray:
        return np.stack([g.standard_normal((per_vine, *shape)) for g in structure.rngs]).reshape(count, *shape)

    # bases of shoots on their arm: evenly spaced with a small random offset, on alternating sides
    number = np.tile(np.arange(each), arm_count * vines)
    share = 0.17 + 0.81 * (number + 0.2 + 0.6 * uniform()) / each
    seat = None
    dated = None if scene.date is None else grow_bearers(scene, structure, each)
    if dated is not None:
        share = dated.share
    elif scene.clutter.old_wood > 0.0:
        seat = seat_on_spurs(scene, structure, each)
        share = seat.share
    where = share * arm_segments
    piece = np.minimum(where.astype(int), arm_segments - 1)
    arm = structure.arms.reshape(vines * arm_count, arm_segments + 1, 3)[np.repeat(np.arange(vines * arm_count), each)]
    rows = np.arange(count)
    start = arm[rows, piece] + (arm[rows, piece + 1] - arm[rows, piece]) * (where - piece)[:, None]
    if seat is not None:
        start = start + seat.offset
    if dated is not None:
        start = dated.start
    along = frames.normalize((arm[:, -1] - arm[:, 0]) * [1.0, 1.0, 0.0])

    length = cane.length.at(uniform())
    base = 0.5 * cane.base_diameter.at(uniform())
    side_sign = np.where(number % 2, 1.0, -1.0)
    if tendone:
        turn = portable_math.arctan2(along[:, 1], along[:, 0]) + side_sign * (1.0 + 0.6 * uniform())
        heading = np.stack([np.cos(turn), np.sin(turn), -0.38 + 0.15 * uniform()], -1)
        up = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    else:
        lean = normal(2) * [cane.lean_along.value, cane.lean_across.value]
        across = frames.cross(np.array([0.0, 0.0, 1.0]), along)
        heading = along * lean[:, :1] + across * lean[:, 1:] + [0.0, 0.0, 1.0]
        if dated is not None:
            heading = heading + dated.aside
        up = along
    owner = np.repeat(np.arange(vines), per_vine)
    noise = normal(AXIS_SEGMENTS, 3)
    if not tendone:
        noise = noise * cane.crookedness.value
    points = _grow_main_axis(scene, start, heading, length, noise, structure.foot[owner])

    has_lateral = uniform() < cane.lateral_share.value
    lateral_at = (AXIS_SEGMENTS * cane.lateral_place.at(uniform())).astype(int)
    lateral_length = cane.lateral_length.at(uniform())
    sign = np.where(uniform() < 0.5, 1, -1)
    lateral_points = _grow_lateral(points, lateral_at, up, lateral_length, sign, normal(LATERAL_SEGMENTS, 3))

    nodes = np.floor(cane.nodes.value[0] + (cane.nodes.value[1] - cane.nodes.value[0] + 1) * uniform()).astype(int)
    nodes = np.minimum(nodes, MAX_NODES)
    fruit, at, peduncle, bunch_axis, bunch_up = sample_fruit(
        scene, parameters, points, nodes, structure.row[owner], uniform, normal
    )
    rise = np.maximum(peduncle[:, :, 0, 2] - points[:, :1, 2], 0.0)
    stiffness = cane.woody_modulus.value * np.pi / 4.0 * portable_math.power(base, 4)
    burden = fruit["mass"] * -builder.GRAVITY[2] * rise**2 / stiffness[:, None]
    if parameters.bunch.gap is None:
        chosen = choose_bunches(scene, structure, per_vine, peduncle, burden, fruit)
    else:
        canes = Canes(points, base, lateral_points, 0.5 * cane.lateral_diameter.value, has_lateral)
        chosen, peduncle, bunch_up = hang_bunches(
            scene, parameters, structure, canes, peduncle, bunch_axis, bunch_up, burden, fruit
        )
    leaf_normal = np.moveaxis(normal(MAX_NODES + LATERAL_NODES, 8), -1, 0)
    leaf_uniform = np.moveaxis(uniform(MAX_NODES + LATERAL_NODES, 4), -1, 0)
    return Shoots(
        vine=owner,
        piece=np.repeat(np.arange(vines * arm_count), each) * arm_segments + piece,
        up=up,
        points=points,
        length=length,
        base=base,
        has_lateral=has_lateral,
        lateral_at=lateral_at,
        lateral_points=lateral_points,
        has_bunch=chosen,
        bunch_at=at,
        peduncle=peduncle,
        bunch_axis=bunch_axis,
        bunch_up=bunch_up,
        fruit=fruit,
        nodes=nodes,
        leaf_normal=leaf_normal,
        leaf_uniform=leaf_uniform,
        bearers=() if dated is None else dated.bearers,
    )


def _grow_main_axis(
    scene: Scene, start: np.ndarray, heading: np.ndarray, length: np.ndarray, noise: np.ndarray, foot: np.ndarray
) -> np.ndarray:
    """Returns the points of the main axes. The net holds shoots in a tendone, pairs of catch wires hold shoots in a
    hedge."""
    layout = scene.layout
    tendone = scene.training == "tendone"
    points = np.empty((len(start), AXIS_SEGMENTS + 1, 3))
    points[:, 0] = start
    heading = frames.normalize(heading)
    step = (length / AXIS_SEGMENTS)[:, None]
    for i in range(AXIS_SEGMENTS):
        at = points[:, i]
        share = i / AXIS_SEGMENTS
        heading = heading + noise[:, i] * ([0.10, 0.10, 0.06] if tendone else [0.07, 0.05, 0.03])
        if tendone:
            # the part with bunches droops below the net, the rest climbs over it
            low = layout.height - 0.28 + 0.44 * min(2.0 * share, 1.0)
            heading[:, 2] += np.clip(2.2 * (low - at[:, 2]), -0.2, 0.28) * (0.5 + share)
            heading[:, 2] = np.clip(heading[:, 2], -0.42, 0.5)
        else:
            heading[:, 1] = 0.7 * heading[:, 1] + 0.9 * (foot[:, 1] - at[:, 1])
            heading[:, 2] += 0.12
        heading = frames.normalize(heading)
        points[:, i + 1] = at + heading * step
    return points


def _grow_lateral(
    points: np.ndarray, at: np.ndarray, up: np.ndarray, length: np.ndarray, sign: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Returns the points of the laterals, which branch off the main axis at 45 degrees, with small random changes of
    direction."""
    rows = np.arange(len(points))
    start = points[rows, at + 1]
    axis = frames.normalize(points[rows, at + 1] - points[rows, at])
    heading = axis + sign[:, None] * frames.normalize(frames.cross(up, axis)) + 0.25 * up
    result = np.empty((len(points), LATERAL_SEGMENTS + 1, 3))
    result[:, 0] = start
    for i in range(LATERAL_SEGMENTS):
        heading = frames.normalize(heading) + 0.12 * noise[:, i]
        result[:, i + 1] = result[:, i] + frames.normalize(heading) * (length / LATERAL_SEGMENTS)[:, None]
    return result
