"""From a scene to a model: poles, wires and old wood stand fixed; every shoot is a tree with leaves and bunches.

Shoots are rows of a table with the same slots each (main axis, side shoot, two stalks with a bunch); what a shoot does
not have is masked out at the end, so nothing here loops over plants except the drawing of random numbers. Each vine
draws from its own stream, named by (seed, row, place): no vine knows how many others there are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vinesim import frames
from vinesim.scene import berries, builder, leaves, plant_parameters
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene

PIECES = 14
"""Bodies of a shoot's main axis."""
SIDE_PIECES = 4
"""Bodies of a side shoot."""
STALK_PIECES = 2
"""Bodies of a peduncle."""
BUNCHES = 2
"""Most bunches on a shoot."""
NODES = 25
"""Most leaves on a shoot's main axis."""
SIDE_NODES = 6
"""Leaves of a side shoot."""
ARM_PIECES = 5
TRUNK_PIECES = 7

Draw = Callable[..., np.ndarray]
"""Random numbers [shoot, ...] of the shape asked for, each shoot's from the stream of its vine."""

_SIDE = slice(PIECES, PIECES + SIDE_PIECES)
_CORE = PIECES + SIDE_PIECES + BUNCHES * (STALK_PIECES + 1)
_SLOTS = _CORE + BUNCHES * builder.MAX_CLUSTERS
_BOUND = 10
"""The piece of a shoot at whose beginning a string binds it to the net."""
_CLEAR = 0.02
"""Least gap between a bunch and its neighbours, poles and trunks [m]."""
_UPRIGHT = 0.6
"""Most m g a^2 / EI of bunches at height a above the base of their shoot; a uniform column buckles at 2.47."""


def _stalk(which: int) -> slice:
    """Slots of one peduncle and, last, its bunch."""
    first = PIECES + SIDE_PIECES + which * (STALK_PIECES + 1)
    return slice(first, first + STALK_PIECES + 1)


def _clusters(which: int) -> slice:
    """Slots of one bunch's berry clusters."""
    first = _CORE + which * builder.MAX_CLUSTERS
    return slice(first, first + builder.MAX_CLUSTERS)


def generate(scene: Scene) -> Model:
    """The model of a scene; the same scene gives the same bits."""
    parts = plant_parameters.load_plant(scene.plants)
    wood = _old_wood(scene, parts)
    shoots = _draw_shoots(scene, parts, wood)
    bodies = _bodies(scene, parts, shoots)
    leaf = _leaves(scene, parts, shoots, bodies)
    model = _model(scene, parts, wood, shoots, bodies, leaf, _ties(scene, parts, shoots, bodies))
    return builder.solve_rest_pose(model).check()


# ---- old wood and trellis ------------------------------------------------------------------------------------------


@dataclasses.dataclass
class _Wood:
    """Vines with the numbers each has drawn, their arms, and everything that stands still."""

    foot: np.ndarray
    """[vine, 3] m"""
    row: np.ndarray
    """[vine]"""
    draws: list[np.random.Generator]
    arms: np.ndarray
    """[vine, arm, point, 3] m"""
    trunk: np.ndarray
    """[vine, point, 3] m"""
    fixed: dict[str, np.ndarray]


def _old_wood(scene: Scene, parts: plant_parameters.VineParameters) -> _Wood:
    layout, tendone = scene.layout, scene.training == "tendone"
    row, place = (a.ravel() for a in np.mgrid[0 : layout.rows, 0 : layout.vines])
    foot = np.stack([place * layout.vine_spacing, row * layout.row_spacing, 0.0 * row], -1)
    draws = [
        np.random.default_rng(np.random.SeedSequence(scene.seed, spawn_key=(int(r), int(p))))
        for r, p in zip(row, place, strict=True)
    ]
    arm_count = int((parts.arm.tendone_arms if tendone else parts.arm.vsp_arms).value)
    wobble = np.stack([g.normal(size=(TRUNK_PIECES + 1, 3)) for g in draws])
    bend = np.stack([g.normal(size=(arm_count, ARM_PIECES + 1, 3)) for g in draws])

    head = layout.height - (0.06 if tendone else 0.03)
    up = np.linspace(0.0, 1.0, TRUNK_PIECES + 1)[:, None]
    beside = parts.trunk.beside_pole.value
    side = np.array([0.0, beside, 0.0] if tendone else [beside, 0.0, 0.0])
    trunk = foot[:, None] + up * [0.0, 0.0, head] + side * (1.0 - 0.45 * up)
    trunk += np.cumsum(wobble, 1) * [0.015, 0.015, 0.0] * np.sin(np.pi * np.minimum(up, 0.5))

    angle = 2.0 * np.pi * np.arange(arm_count) / arm_count
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    reach = parts.arm.share.value * np.where(np.abs(out[:, 1]) > 0.5, layout.row_spacing, layout.vine_spacing)
    along = np.linspace(0.0, 1.0, ARM_PIECES + 1)[:, None]
    arms = trunk[:, -1, None, None] + out[:, None] * reach[:, None, None] * along
    sway = np.cumsum(bend, 2) * [0.016, 0.016, 0.008]
    sway[:, :, 0] = 0.0
    arms = arms + sway
    arms[..., 2] = np.minimum(arms[..., 2] + 0.03 * along[:, 0], layout.height - 0.005)

    thick = 0.5 * parts.trunk.diameter.at(up[:, 0])
    thin = 0.5 * parts.arm.diameter.at(along[:, 0])
    count = len(foot)
    radius = 0.5 * parts.trellis.pole_diameter.value
    pieces = [
        _chains(trunk, thick, Organ.TRUNK, np.arange(count)),
        _chains(arms.reshape(-1, ARM_PIECES + 1, 3), thin, Organ.ARM, np.arange(count * arm_count)),
        _chains(
            foot[:, None] + np.array([[0, 0, -0.3], [0, 0, layout.height + (0.1 if tendone else 1.15)]]),
            np.array([radius, radius]), Organ.POLE, np.arange(count),
        ),
        *_wires(scene, parts),
    ]  # fmt: skip
    fixed = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    return _Wood(foot, row, draws, arms, trunk, fixed)


def _chains(points: np.ndarray, radius: np.ndarray, organ: Organ, index: np.ndarray) -> dict[str, np.ndarray]:
    """Round cones along polylines [chain, point, 3]."""
    pieces = points.shape[1] - 1
    pairs = np.broadcast_to(np.stack([radius[:-1], radius[1:]], -1), (len(points), pieces, 2))
    return {
        "fixed_start": points[:, :-1].reshape(-1, 3),
        "fixed_end": points[:, 1:].reshape(-1, 3),
        "fixed_radius": pairs.reshape(-1, 2),
        "fixed_organ": np.full(len(points) * pieces, int(organ)),
        "fixed_index": np.repeat(index, pieces),
    }


def _wires(scene: Scene, parts: plant_parameters.VineParameters) -> list[dict[str, np.ndarray]]:
    """A net at the roof (tendone), or a fruiting wire and pairs of catch wires in each row (vsp)."""
    layout, trellis = scene.layout, parts.trellis
    wide, deep = (layout.vines - 1) * layout.vine_spacing, (layout.rows - 1) * layout.row_spacing
    over_x, over_y = 0.5 * layout.vine_spacing, 0.5 * layout.row_spacing
    # a wire runs from pole to pole: points half a field before the first and behind the last one
    xs = np.unique([-over_x, *(np.arange(layout.vines) * layout.vine_spacing), wide + over_x])
    ys = np.unique([-over_y, *(np.arange(layout.rows) * layout.row_spacing), deep + over_y])
    radius = 0.5 * trellis.wire_diameter.value
    if scene.training == "tendone":
        step_y = layout.row_spacing / max(round(layout.row_spacing / trellis.tendone_wire_spacing.value), 1)
        step_x = layout.vine_spacing / max(round(layout.vine_spacing / trellis.tendone_wire_spacing.value), 1)
        at_y = np.arange(-over_y, deep + over_y + 1e-6, step_y)
        at_x = np.arange(-over_x, wide + over_x + 1e-6, step_x)
        along_x = np.stack(np.broadcast_arrays(xs[None], at_y[:, None], layout.height), -1)
        along_y = np.stack(np.broadcast_arrays(at_x[:, None], ys[None], layout.height + 2.0 * radius), -1)
        lines = [along_x, along_y]
    else:
        apart = radius + 0.5 * trellis.pole_diameter.value
        heights = layout.height + trellis.vsp_wire_spacing.value * np.arange(1, int(trellis.vsp_wires.value) + 1)
        across = [(0.0, layout.height), *((side * apart, z) for z in heights for side in (-1.0, 1.0))]
        rows = np.arange(layout.rows) * layout.row_spacing
        lines = [np.stack(np.broadcast_arrays(xs[None], (rows + y)[:, None], z), -1) for y, z in across]
    first, pieces = 0, []
    for line in lines:
        pieces.append(_chains(line, np.full(line.shape[1], radius), Organ.WIRE, first + np.arange(len(line))))
        first += len(line)
    return pieces


# ---- shoots --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class _Shoots:
    """What is drawn of each shoot, first axis: shoot."""

    vine: np.ndarray
    ref: np.ndarray
    """[shoot, 3] direction that a body's z axis leans to."""
    points: np.ndarray
    """[shoot, PIECES + 1, 3] m, main axis."""
    length: np.ndarray
    base: np.ndarray
    """[shoot] radius at the base [m]"""
    side: np.ndarray
    """[shoot] bool: has a side shoot"""
    side_at: np.ndarray
    """[shoot] piece of the main axis whose tip carries it"""
    side_points: np.ndarray
    """[shoot, SIDE_PIECES + 1, 3] m"""
    bunch: np.ndarray
    """[shoot, BUNCHES] bool"""
    bunch_at: np.ndarray
    """[shoot, BUNCHES] piece of the main axis whose tip carries the stalk"""
    stalk: np.ndarray
    """[shoot, BUNCHES, STALK_PIECES + 1, 3] m, the last point is the bunch's origin"""
    hang: np.ndarray
    """[shoot, BUNCHES, 3] direction of the bunch's axis"""
    roll: np.ndarray
    """[shoot, BUNCHES, 3] direction that the bunch's z axis leans to"""
    fruit: dict[str, np.ndarray]
    """[shoot, BUNCHES] mass, count, length, radius, seed, variety, pull, thick"""
    nodes: np.ndarray
    """[shoot] nodes of the main axis"""
    leaf_luck: np.ndarray
    """[8, shoot, NODES + SIDE_NODES] standard normal numbers"""
    leaf_chance: np.ndarray
    """[4, shoot, NODES + SIDE_NODES] uniform numbers"""


def _draw_shoots(scene: Scene, parts: plant_parameters.VineParameters, wood: _Wood) -> _Shoots:
    tendone, cane = scene.training == "tendone", parts.cane
    each = int((parts.arm.tendone_shoots if tendone else parts.arm.vsp_shoots).value)
    arm_count = wood.arms.shape[1]
    per_vine, vines = each * arm_count, len(wood.foot)
    count = per_vine * vines

    def uniform(*shape: int) -> np.ndarray:
        return np.stack([g.random((per_vine, *shape)) for g in wood.draws]).reshape(count, *shape)

    def normal(*shape: int) -> np.ndarray:
        return np.stack([g.standard_normal((per_vine, *shape)) for g in wood.draws]).reshape(count, *shape)

    # where a shoot springs from its arm: evenly, a little shuffled, alternating sides
    number = np.tile(np.arange(each), arm_count * vines)
    share = 0.17 + 0.81 * (number + 0.2 + 0.6 * uniform()) / each
    where = share * ARM_PIECES
    piece = np.minimum(where.astype(int), ARM_PIECES - 1)
    arm = wood.arms.reshape(vines * arm_count, ARM_PIECES + 1, 3)[np.repeat(np.arange(vines * arm_count), each)]
    pick = np.arange(count)
    start = arm[pick, piece] + (arm[pick, piece + 1] - arm[pick, piece]) * (where - piece)[:, None]
    along = frames.normalize((arm[:, -1] - arm[:, 0]) * [1.0, 1.0, 0.0])

    length = cane.length.at(uniform())
    base = 0.5 * cane.base_diameter.at(uniform())
    side_sign = np.where(number % 2, 1.0, -1.0)
    if tendone:
        turn = np.arctan2(along[:, 1], along[:, 0]) + side_sign * (1.0 + 0.6 * uniform())
        heading = np.stack([np.cos(turn), np.sin(turn), -0.38 + 0.15 * uniform()], -1)
        ref = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    else:
        lean = normal(2) * [0.12, 0.05]
        across = np.cross([0.0, 0.0, 1.0], along)
        heading = along * lean[:, :1] + across * lean[:, 1:] + [0.0, 0.0, 1.0]
        ref = along
    owner = np.repeat(np.arange(vines), per_vine)
    points = _main_axis(scene, start, heading, length, normal(PIECES, 3), wood.foot[owner])

    side = uniform() < cane.lateral_share.value
    side_at = 6 + (5 * uniform()).astype(int)
    side_long, hand = cane.lateral_length.at(uniform()), np.where(uniform() < 0.5, 1, -1)
    side_points = _side_axis(points, side_at, ref, side_long, hand, normal(SIDE_PIECES, 3))

    nodes = np.floor(cane.nodes.value[0] + (cane.nodes.value[1] - cane.nodes.value[0] + 1) * uniform()).astype(int)
    nodes = np.minimum(nodes, NODES)
    fruit, at, stalk, hang, roll = _draw_fruit(scene, parts, points, nodes, wood.row[owner], uniform, normal)
    rise = np.maximum(stalk[:, :, 0, 2] - points[:, :1, 2], 0.0)
    stiffness = cane.woody_modulus.value * np.pi / 4.0 * base**4
    burden = fruit["mass"] * -builder.GRAVITY[2] * rise**2 / stiffness[:, None]
    chosen = _choose_bunches(scene, wood, per_vine, stalk, burden, fruit)
    leaf_luck = np.moveaxis(normal(NODES + SIDE_NODES, 8), -1, 0)
    leaf_chance = np.moveaxis(uniform(NODES + SIDE_NODES, 4), -1, 0)
    return _Shoots(
        vine=owner, ref=ref, points=points, length=length, base=base, side=side, side_at=side_at,
        side_points=side_points, bunch=chosen, bunch_at=at, stalk=stalk, hang=hang, roll=roll, fruit=fruit,
        nodes=nodes, leaf_luck=leaf_luck, leaf_chance=leaf_chance,
    )  # fmt: skip


def _main_axis(
    scene: Scene, start: np.ndarray, heading: np.ndarray, length: np.ndarray, luck: np.ndarray, foot: np.ndarray
) -> np.ndarray:
    """Points of the shoots: over the net they are held between its wires, in a hedge between the catch wires."""
    layout, tendone = scene.layout, scene.training == "tendone"
    points = np.empty((len(start), PIECES + 1, 3))
    points[:, 0] = start
    heading = frames.normalize(heading)
    step = (length / PIECES)[:, None]
    for i in range(PIECES):
        at, share = points[:, i], i / PIECES
        heading = heading + luck[:, i] * ([0.10, 0.10, 0.06] if tendone else [0.07, 0.05, 0.03])
        if tendone:
            # the bearing part droops below the net, the rest climbs over it
            low = layout.height - 0.28 + 0.44 * min(2.0 * share, 1.0)
            heading[:, 2] += np.clip(2.2 * (low - at[:, 2]), -0.2, 0.28) * (0.5 + share)
            heading[:, 2] = np.clip(heading[:, 2], -0.42, 0.5)
        else:
            heading[:, 1] = 0.7 * heading[:, 1] + 0.9 * (foot[:, 1] - at[:, 1])
            heading[:, 2] += 0.12
        heading = frames.normalize(heading)
        points[:, i + 1] = at + heading * step
    return points


def _side_axis(
    points: np.ndarray, at: np.ndarray, ref: np.ndarray, length: np.ndarray, sign: np.ndarray, luck: np.ndarray
) -> np.ndarray:
    """Points of the side shoots: 45 degrees off the main axis, then on with a little wander."""
    pick = np.arange(len(points))
    start, axis = points[pick, at + 1], frames.normalize(points[pick, at + 1] - points[pick, at])
    heading = axis + sign[:, None] * frames.normalize(np.cross(ref, axis)) + 0.25 * ref
    result = np.empty((len(points), SIDE_PIECES + 1, 3))
    result[:, 0] = start
    for i in range(SIDE_PIECES):
        heading = frames.normalize(heading) + 0.12 * luck[:, i]
        result[:, i + 1] = result[:, i] + frames.normalize(heading) * (length / SIDE_PIECES)[:, None]
    return result


# ---- fruit ---------------------------------------------------------------------------------------------------------


def _draw_fruit(
    scene: Scene,
    parts: plant_parameters.VineParameters,
    points: np.ndarray,
    nodes: np.ndarray,
    row: np.ndarray,
    uniform: Draw,
    normal: Draw,
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two bunches for every shoot, of which :func:`_choose_bunches` keeps some: fruit, at, stalk, hang, roll."""
    fruit, stalk = parts.bunch, parts.peduncle
    sigma = np.sqrt(np.log(1.0 + fruit.mass_variation.value**2))
    mass = fruit.mass.value * np.exp(sigma * normal(BUNCHES) - 0.5 * sigma**2)
    mass = np.clip(mass, *fruit.mass_range.value)
    names = [v.name for v in berries.VARIETIES]
    in_turn = np.array([names.index(name) for name in scene.fruit.varieties])
    variety = np.broadcast_to(in_turn[row % len(in_turn)][:, None], mass.shape)
    juice = mass * (1.0 - fruit.stem_share.value)
    berry_mass = np.array([v.mass for v in berries.VARIETIES])[variety]
    count = np.clip(np.round(juice / berry_mass), berries.MIN_BERRIES, berries.MAX_BERRIES).astype(int)
    seed = (uniform(BUNCHES) * 2.0**32).astype(np.uint32)
    size = np.array([v.volume_radius for v in berries.VARIETIES])[variety] * np.cbrt(juice / (count * berry_mass))
    hull = berries.hull_size(count, seed) * size[..., None]
    drawn = {
        "mass": mass, "count": count, "length": hull[..., 0], "radius": hull[..., 1], "seed": seed, "variety": variety,
        "pull": stalk.pull.at(uniform(BUNCHES)), "thick": 0.5 * stalk.diameter.at(_share(mass, fruit.mass_range)),
    }  # fmt: skip

    # opposite the third to sixth leaf and one or two nodes further on, never both on one piece's tip
    low, high = parts.cane.first_bunch_node.value
    node = low + (high - low) * uniform()
    node = np.stack([node, node + 2.2], -1)
    at = np.clip(np.round(node / nodes[:, None] * PIECES).astype(int) - 1, 1, PIECES - 2)
    at[:, 1] = np.maximum(at[:, 1], at[:, 0] + 1)
    pick = np.arange(len(points))[:, None]
    top = points[pick, at + 1]
    long = stalk.length.at(uniform(BUNCHES)) / STALK_PIECES
    angle = 2.0 * np.pi * uniform(BUNCHES)
    level = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    tilt = np.clip(0.10 + 0.04 * normal(BUNCHES), 0.02, 0.18)[..., None]
    if scene.training == "vsp":  # beside its upright shoot, out of the hedge
        level = frames.normalize(level * [0.4, 1.0, 0.0])
        tilt = tilt + 0.10
    first = frames.normalize(level * tilt - [0.0, 0.0, 1.0])
    second = frames.normalize(level * 0.3 * tilt - [0.0, 0.0, 1.0])
    middle = top + first * long[..., None]
    end = middle + second * long[..., None]
    hang = frames.normalize(0.02 * normal(BUNCHES, 3) - [0.0, 0.0, 1.0])
    return drawn, at, np.stack([top, middle, end], 2), hang, level


def _share(value: np.ndarray, within: plant_parameters.Range) -> np.ndarray:
    """How far ``value`` lies between the ends of a range, 0..1."""
    low, high = within.value
    return (value - low) / (high - low)


def _choose_bunches(
    scene: Scene, wood: _Wood, per_vine: int, stalk: np.ndarray, burden: np.ndarray, fruit: dict[str, np.ndarray]
) -> np.ndarray:
    """Thin each vine to its number of bunches.

    None is kept that touches a pole, a trunk or a bunch already kept, or under which an upright shoot would buckle.
    """
    layout = scene.layout
    low, high = scene.fruit.bunches
    slots = per_vine * BUNCHES
    top = stalk[:, :, -1].reshape(-1, slots, 3)
    length, radius = (fruit[k].reshape(-1, slots) for k in ("length", "radius"))
    burden = burden.reshape(-1, slots)
    level = top[..., :2] - wood.foot[:, None, :2]
    inside = (
        np.abs(level) + radius[..., None] + 0.5 * _CLEAR < 0.5 * np.array([layout.vine_spacing, layout.row_spacing])
    ).all(-1)
    # the pole and the trunk, whose head lies 5-15 cm beside it
    trunk = wood.trunk[:, :, None, :2] - top[:, None, :, :2]
    beside = np.sqrt((trunk * trunk).sum(-1)).min(1)
    clear = (np.linalg.norm(level, axis=-1) > radius + 0.05 + _CLEAR) & (beside > radius + 0.06 + _CLEAR)
    kept = np.zeros((len(top), slots), bool)
    for number, g in enumerate(wood.draws):
        wanted = int(g.integers(low, high + 1))
        # the first bunch of a shoot is likelier kept than its second
        order = np.argsort(g.random(slots) + 0.45 * (np.arange(slots) % BUNCHES), kind="stable")
        order = order[(inside & clear)[number, order]]
        t, r, h = top[number, order], radius[number, order], length[number, order]
        apart = np.sqrt(((t[:, None, :2] - t[None, :, :2]) ** 2).sum(-1))
        middle = t[:, 2] - 0.5 * h
        rise = np.abs(middle[:, None] - middle[None])
        touch = (apart < r[:, None] + r[None] + _CLEAR) & (rise < 0.5 * (h[:, None] + h[None]) + 0.03)
        load, free, shoot = burden[number, order], np.ones(len(order), bool), order // BUNCHES
        carried = np.zeros(per_vine)
        for i in range(len(order)):
            if wanted and free[i] and carried[shoot[i]] + load[i] < _UPRIGHT:
                kept[number, order[i]] = True
                free &= ~touch[i]
                carried[shoot[i]] += load[i]
                wanted -= 1
    return kept.reshape(-1, BUNCHES)


# ---- bodies --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class _Bodies:
    """[shoot, slot]: the table that becomes the model's bodies."""

    present: np.ndarray
    parent: np.ndarray
    """Slot, -1 for the root."""
    organ: np.ndarray
    origin: np.ndarray
    turn: np.ndarray
    """World pose as drawn."""
    length: np.ndarray
    radius: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    stiffness: np.ndarray
    half: np.ndarray
    """Spring of what of a piece of wood lies behind its middle."""
    damping: np.ndarray
    drag: np.ndarray
    """Drag area Cd A [m^2]."""
    head: dict[str, np.ndarray]
    """[shoot, BUNCHES] mass, com, inertia of what of a bunch is no cluster."""


def _bodies(scene: Scene, parts: plant_parameters.VineParameters, s: _Shoots) -> _Bodies:
    count = len(s.vine)
    shape = (count, _SLOTS)
    b = _Bodies(
        present=np.ones(shape, bool), parent=np.zeros(shape, int), organ=np.full(shape, int(Organ.CANE)),
        origin=np.zeros((*shape, 3)), turn=np.zeros((*shape, 4)), length=np.zeros(shape), radius=np.zeros((*shape, 2)),
        mass=np.zeros(shape), com=np.zeros((*shape, 3)), inertia=np.zeros((*shape, 3)),
        stiffness=np.zeros((*shape, 3)), half=np.zeros((*shape, 3)), damping=np.zeros((*shape, 3)),
        drag=np.zeros(shape),
        head={"mass": np.zeros((count, BUNCHES)), "com": np.zeros((count, BUNCHES, 3)),
              "inertia": np.zeros((count, BUNCHES, 3))},
    )  # fmt: skip
    cane, stalk = parts.cane, parts.peduncle

    tip = 0.5 * cane.tip_diameter.value
    share = np.linspace(0.0, 1.0, PIECES + 1)
    radius = s.base[:, None] + (tip - s.base[:, None]) * share
    green = np.clip((share[:-1] - cane.woody_share.value) / 0.2 + 0.5, 0.0, 1.0)
    modulus = np.exp(np.log(cane.woody_modulus.value) * (1.0 - green) + np.log(cane.green_modulus.value) * green)
    parent = np.broadcast_to(np.arange(-1, PIECES - 1), (count, PIECES))
    _rod(b, slice(0, PIECES), s.points, radius, modulus, cane.density.value, cane.damping.value, s.ref, parent)

    thin = 0.5 * cane.lateral_diameter.value
    radius = np.broadcast_to(np.linspace(thin, 0.6 * thin, SIDE_PIECES + 1), (count, SIDE_PIECES + 1))
    parent = np.concatenate(
        [s.side_at[:, None], np.broadcast_to(np.arange(PIECES, PIECES + SIDE_PIECES - 1), (count, SIDE_PIECES - 1))], 1
    )
    modulus = np.full(SIDE_PIECES, cane.green_modulus.value)
    _rod(b, _SIDE, s.side_points, radius, modulus, cane.density.value, cane.damping.value, s.ref, parent)
    b.present[:, _SIDE] = s.side[:, None]

    for k in range(BUNCHES):
        slots = _stalk(k)
        pieces = slice(slots.start, slots.stop - 1)
        thick = s.fruit["thick"][:, k]
        radius = np.broadcast_to(thick[:, None], (count, STALK_PIECES + 1))
        chain = np.broadcast_to(np.arange(slots.start, slots.stop - 2), (count, STALK_PIECES - 1))
        parent = np.concatenate([s.bunch_at[:, k, None], chain], 1)
        modulus = np.full(STALK_PIECES, stalk.modulus.value)
        _rod(b, pieces, s.stalk[:, k], radius, modulus, stalk.density.value, stalk.damping.value, s.roll[:, k], parent)
        b.organ[:, pieces] = int(Organ.PEDUNCLE)

        _bunch(parts, s, b, k)
        b.present[:, slots] = s.bunch[:, k, None]
    across = b.radius.sum(-1) * b.length  # of wood seen from the side
    b.drag[:, :_CORE] += np.where(b.organ == int(Organ.BUNCH), 0.0, cane.drag.value * across)[:, :_CORE]
    return b


def _bunch(parts: plant_parameters.VineParameters, s: _Shoots, b: _Bodies, k: int) -> None:
    """Fill the slots of the bunch at the end of stalk ``k`` and of its clusters."""
    bunch, clusters = _stalk(k).stop - 1, _clusters(k)
    b.present[:, clusters] = False
    has = np.flatnonzero(s.bunch[:, k])
    if len(has) == 0:
        return
    mass, long, wide, count, seed = (s.fruit[name][has, k] for name in ("mass", "length", "radius", "count", "seed"))
    pieces = builder.segment_bunches(mass, long, wide, count, seed, parts.rachis, parts.bunch.stem_share.value)
    b.mass[has, bunch], b.com[has, bunch], b.inertia[has, bunch] = pieces.compound()
    for name, head in b.head.items():
        head[has, k] = getattr(pieces, name)[:, 0]
    b.organ[:, bunch] = b.organ[:, clusters] = int(Organ.BUNCH)
    b.parent[:, bunch] = bunch - 1
    b.origin[:, bunch] = s.stalk[:, k, -1]
    b.turn[:, bunch] = frames.from_x_axis(s.hang[:, k], s.roll[:, k])
    b.length[has, bunch], b.radius[has, bunch] = long, wide[:, None]
    b.stiffness[:, bunch], b.damping[:, bunch] = b.stiffness[:, bunch - 1], b.damping[:, bunch - 1]
    # the wind takes hold of the bunch as a whole
    b.drag[has, bunch] = parts.bunch.drag.value * 0.5 * np.pi * wide * long

    most = pieces.mass.shape[1] - 1
    number = np.arange(1, most + 1)
    slots = np.arange(clusters.start, clusters.start + most)
    at = np.ix_(has, slots)
    b.present[at] = number < pieces.count[:, None]
    b.parent[at] = np.where(number == 1, bunch, slots - 1)
    b.turn[at] = b.turn[has, bunch, None]
    along = frames.rotate(b.turn[has, bunch], np.array([1.0, 0.0, 0.0])) * pieces.length[:, None]
    b.origin[at] = b.origin[has, bunch, None] + number[:, None] * along[:, None]
    b.length[at] = pieces.length[:, None]
    for name in ("radius", "mass", "com", "inertia", "stiffness"):
        getattr(b, name)[at] = getattr(pieces, name)[:, 1:]
    b.damping[at] = parts.rachis.damping.value * pieces.stiffness[:, 1:]


def _rod(
    b: _Bodies, slots: slice, points: np.ndarray, radius: np.ndarray, modulus: np.ndarray, density: float,
    damping: float, up: np.ndarray, parent: np.ndarray,
) -> None:  # fmt: skip
    """Fill the slots of one axis: points [shoot, piece + 1, 3], radius [shoot, piece + 1], modulus [piece].

    It is a root, or grows on its parent's tip.
    """
    along = np.diff(points, axis=1)
    length = np.linalg.norm(along, axis=-1)
    start, end = radius[:, :-1], radius[:, 1:]
    mass, inertia, near, b.half[:, slots] = builder.segment_properties(length, start, end, modulus, density)
    b.parent[:, slots] = parent
    b.origin[:, slots] = points[:, :-1]
    b.turn[:, slots] = turn = frames.from_x_axis(along, up[:, None])
    slack = 1.0 / near
    slack[:, 1:] += 1.0 / b.half[:, slots][:, :-1]
    if (parent[:, 0] >= 0).all():
        grown_on = np.arange(len(parent)), parent[:, 0]
        axes = frames.to_matrix(frames.multiply(frames.conjugate(b.turn[grown_on]), turn[:, 0]))
        slack[:, 0] += np.einsum("si,sij->sj", 1.0 / b.half[grown_on], axes**2)
    stiffness = 1.0 / slack
    b.length[:, slots] = length
    b.radius[:, slots] = np.stack([start, end], -1)
    b.mass[:, slots] = mass
    b.com[:, slots, 0] = 0.5 * length
    b.inertia[:, slots] = inertia
    b.stiffness[:, slots] = stiffness
    b.damping[:, slots] = damping * stiffness


# ---- leaves --------------------------------------------------------------------------------------------------------


def _leaves(scene: Scene, parts: plant_parameters.VineParameters, s: _Shoots, b: _Bodies) -> dict[str, np.ndarray]:
    """Leaves at the nodes, left and right in turn, and their weight on the bodies that carry them."""
    count, leaf = len(s.vine), parts.leaf
    node = np.arange(NODES + SIDE_NODES)
    main = node < NODES
    many = np.where(main, s.nodes[:, None], SIDE_NODES)
    rank = np.where(main, node, node - NODES)
    share = np.minimum((rank + 0.7) / many, 0.999)
    forward, rise, droop, swing, *lean, ageing = s.leaf_luck[..., None]
    fate, turned, far, large = s.leaf_chance
    present = (rank < many) & (fate < scene.season.leafiness) & (main | s.side[:, None])

    pieces = np.where(main, PIECES, SIDE_PIECES)
    piece = (share * pieces).astype(int)
    slot = np.where(main, piece, PIECES + piece)
    pick = np.arange(count)[:, None]
    length, turn = b.length[pick, slot], b.turn[pick, slot]
    x = (share * pieces - piece) * length
    thick = b.radius[pick, slot, 0]

    tendone = scene.training == "tendone"
    axis = frames.rotate(turn, np.array([1.0, 0.0, 0.0]))
    up = np.array([0.0, 0.0, 1.0])
    sideways = frames.normalize(np.cross(s.ref[:, None], axis))
    hand = np.where((rank + s.side_at[:, None]) % 2, 1.0, -1.0)[..., None]
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
    _load(b, slot, weight, blade)
    np.add.at(b.drag, (np.broadcast_to(pick, slot.shape), slot), np.where(present, leaf.drag.value * area, 0.0))
    return {
        "present": present, "slot": slot, "base": base, "pose": pose, "area": area, "age": np.clip(age, 0.0, 1.0)
    }  # fmt: skip


def _load(b: _Bodies, slot: np.ndarray, weight: np.ndarray, where: np.ndarray) -> None:
    """Add point masses [shoot, leaf] at ``where`` in body frames; products of inertia are dropped."""
    mass, first, second = b.mass.copy(), b.mass[..., None] * b.com, b.inertia + b.mass[..., None] * _lever(b.com)
    pick = np.broadcast_to(np.arange(len(slot))[:, None], slot.shape)
    np.add.at(mass, (pick, slot), weight)
    np.add.at(first, (pick, slot), weight[..., None] * where)
    np.add.at(second, (pick, slot), weight[..., None] * _lever(where))
    b.mass, b.com = mass, first / np.where(mass > 0.0, mass, 1.0)[..., None]  # none in slots that are left out
    b.inertia = second - mass[..., None] * _lever(b.com)


def _lever(p: np.ndarray) -> np.ndarray:
    """Squared distance of points from the three axes."""
    square = p * p
    return square.sum(-1, keepdims=True) - square


# ---- ties ----------------------------------------------------------------------------------------------------------


def _ties(scene: Scene, parts: plant_parameters.VineParameters, s: _Shoots, b: _Bodies) -> dict[str, np.ndarray]:
    """Where shoots pass wires closely: over the net they are tied to it or lie on it, in a hedge wires hold them.

    A taut wire pushed aside half way between two posts gives way with 4 tension / span.
    """
    layout, trellis, tendone = scene.layout, parts.trellis, scene.training == "tendone"
    start, end = s.points[:, :-1], s.points[:, 1:]
    spacing = np.array([layout.vine_spacing, layout.row_spacing])
    low, high = -0.5 * spacing, (np.array([layout.vines, layout.rows]) - 0.5) * spacing
    if tendone:
        lines = [
            (axis, low[axis], d / max(round(d / trellis.tendone_wire_spacing.value), 1))
            for axis, d in enumerate(spacing)
        ]
    else:
        lines = [(2, layout.height, trellis.vsp_wire_spacing.value)]
    crossings = []
    for axis, first, step in lines:
        share, found = _crossing(start[..., axis], end[..., axis], first, step)
        point = start + share[..., None] * (end - start)
        found &= (point[..., :2] >= low).all(-1) & (point[..., :2] <= high).all(-1)
        apart = point[..., 2] - layout.height
        if not tendone:
            wire = np.round(apart / step)
            found &= (wire >= 1) & (wire <= trellis.vsp_wires.value)
            apart = point[..., 1] - layout.row_spacing * np.round(point[..., 1] / layout.row_spacing)
        crossings.append((share, np.where(found, np.abs(apart), np.inf)))
    share, apart = (np.stack(values, -1) for values in zip(*crossings, strict=True))
    tied = apart < trellis.tie_reach.value
    if tendone:  # strings bind the end to the net: a long shoot that is free beyond its middle falls over
        share[:, _BOUND, 0] = 0.0
        tied[:, _BOUND, 0] = np.abs(start[:, _BOUND, 2] - layout.height) < trellis.tie_string.value
    shoot, slot, which = np.nonzero(tied)
    along = share[shoot, slot, which] * b.length[shoot, slot]
    stiffness = 4.0 * trellis.wire_tension.value / layout.vine_spacing
    return {
        "shoot": shoot, "slot": slot, "point": along[:, None] * [1.0, 0.0, 0.0],
        "anchor": start[shoot, slot] + share[shoot, slot, which, None] * (end - start)[shoot, slot],
        "stiffness": np.full(len(slot), stiffness),
        "damping": np.full(len(slot), trellis.tie_damping.value * stiffness),
    }  # fmt: skip


def _crossing(start: np.ndarray, end: np.ndarray, first: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Where pieces from ``start`` to ``end`` [...] cross one of parallel lines: share of their length, and whether."""
    low, high = (start - first) / step, (end - first) / step
    line = np.maximum(np.floor(low), np.floor(high))
    found = np.floor(low) != np.floor(high)
    return np.where(found, (line - low) / np.where(found, high - low, 1.0), 0.0), found


# ---- the model -----------------------------------------------------------------------------------------------------


def _model(
    scene: Scene, parts: plant_parameters.VineParameters, wood: _Wood, s: _Shoots, b: _Bodies, leaf: dict[str, np.ndarray],
    ties: dict[str, np.ndarray],
) -> Model:  # fmt: skip
    """Leave out what is masked, number the rest, and make drawn world poses relative."""
    size = b.present.sum(1)
    first = np.cumsum(size) - size
    number = first[:, None] + np.cumsum(b.present, 1) - 1
    has = b.present
    tree = np.broadcast_to(np.arange(len(size))[:, None], has.shape)[has]
    bunch = np.stack([number[:, _stalk(k).stop - 1] for k in range(BUNCHES)], 1)
    order = np.argsort(leaf["slot"], axis=1, kind="stable")  # leaves lie in the order of their bodies
    pick = np.arange(len(order))[:, None]
    leaf = {name: value[pick, order] for name, value in leaf.items()}
    shown = leaf["present"]
    carrier = number[pick, leaf["slot"]][shown]

    model = Model.allocate(
        tree=len(size), body=int(size.sum()), bunch=int(s.bunch.sum()), leaf=int(shown.sum()),
        fixed=len(wood.fixed["fixed_start"]), tie=len(ties["slot"]), box=len(scene.boxes),
    )  # fmt: skip
    model.tree_first[:], model.tree_size[:], model.tree_vine[:] = first, size, s.vine
    model.tree_core[:] = b.present[:, :_CORE].sum(1)
    model.tree_pose[:] = frames.pose(b.origin[:, 0], b.turn[:, 0])

    parent = b.parent[has]
    root = parent < 0
    model.body_tree[:] = tree
    model.body_parent[:] = np.where(root, -1, number[tree, np.maximum(parent, 0)])
    base = np.where(root[:, None], model.tree_pose[tree], frames.pose(b.origin, b.turn)[tree, np.maximum(parent, 0)])
    drawn = frames.compose(frames.inverse(base), frames.pose(b.origin, b.turn)[has])
    model.body_offset[:], model.body_rest[:] = drawn[:, :3], frames.normalize(drawn[:, 3:])
    for name in ("organ", "mass", "com", "inertia", "length", "radius", "drag"):
        getattr(model, f"body_{name}")[:] = getattr(b, name)[has]
    model.joint_stiffness[:], model.joint_damping[:] = b.stiffness[has], b.damping[has]

    fruit = {name: value[s.bunch] for name, value in s.fruit.items()}
    model.bunch_body[:] = bunch[s.bunch]
    model.bunch_berries[:] = fruit["count"]
    for name in ("length", "radius", "seed", "variety", "pull"):
        getattr(model, f"bunch_{name}")[:] = fruit[name]
    model.bunch_bend[:] = parts.peduncle.bend_strength.value * np.pi / 4.0 * fruit["thick"] ** 3
    model.bunch_cluster[:] = np.stack([number[:, _clusters(k).start] for k in range(BUNCHES)], 1)[s.bunch]
    model.bunch_clusters[:] = np.stack([b.present[:, _clusters(k)].sum(1) for k in range(BUNCHES)], 1)[s.bunch]
    for name, head in b.head.items():
        getattr(model, f"bunch_head_{name}")[:] = head[s.bunch]

    model.tie_body[:] = number[ties["shoot"], ties["slot"]]
    for name in ("point", "anchor", "stiffness", "damping"):
        getattr(model, f"tie_{name}")[:] = ties[name]

    model.leaf_body[:] = carrier
    model.leaf_base[:], model.leaf_pose[:], model.leaf_age[:] = (
        leaf["base"][shown],
        leaf["pose"][shown],
        leaf["age"][shown],
    )
    blade = np.mean([leaves.blade_area(shape) for shape in range(leaves.SHAPE_COUNT)])
    model.leaf_size[:] = np.sqrt(leaf["area"][shown] / blade)

    for name, value in wood.fixed.items():
        getattr(model, name)[:] = value
    for i, box in enumerate(scene.boxes):
        model.box_pose[i] = frames.pose(np.array([box.x, box.y, 0.0]), frames.from_yaw(box.yaw))
        model.box_size[i], model.box_mass[i] = box.size, box.mass
    return model
