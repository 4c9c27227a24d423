"""Bunches: samples the mass, berries and peduncle of two bunches for each shoot at random, and selects the bunches that
a vine keeps: a random number within the scene's limits, without bunches that touch wood or other bunches."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vinesim.core import frames, portable_math
from vinesim.scene import berries
from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.shoot_slots import AXIS_SEGMENTS, MAX_BUNCHES, PEDUNCLE_SEGMENTS
from vinesim.scene.plant_parameters import Bunch, Range, VineParameters
from vinesim.scene.spec import Scene
from vinesim.scene.strength import peduncle_strength

Sampler = Callable[..., np.ndarray]
"""Function that returns random numbers [shoot, *shape] for a given ``shape``. Each shoot uses the random number
generator of its vine."""

MIN_GAP = 0.02
"""Smallest gap between a bunch and neighbouring bunches, poles and trunks [m]."""
_THINNEST = -0.3
"""Place of the thinnest stalk on the plant file's range of stalks, whose ends are those of the lightest (0) and of the
heaviest bunch (1) of table grapes. Stalks of lighter bunches of wine grapes are not thinner. GUESSED."""
MAX_BUCKLING_LOAD = 0.6
"""Largest m g a^2 / EI of bunches at height a above the base of their shoot; a uniform column buckles at 2.47."""


def sample_fruit(
    scene: Scene,
    parameters: VineParameters,
    points: np.ndarray,
    nodes: np.ndarray,
    row: np.ndarray,
    uniform: Sampler,
    normal: Sampler,
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sample the properties of two bunches for every shoot at random. :func:`choose_bunches` then selects the bunches
    that the vines keep.

    Args:
        scene: scene with the varieties and the training system.
        parameters: distributions of the properties.
        points: [shoot, AXIS_SEGMENTS + 1, 3] m, points along the main axis of each shoot.
        nodes: [shoot] number of nodes of each shoot.
        row: [shoot] row of the vineyard in which each shoot is.
        uniform: sampler of uniform random numbers from 0 to 1.
        normal: sampler of standard normal random numbers.

    Returns:
        ``fruit``, ``bunch_at``, ``peduncle`` and ``bunch_axis`` as in :class:`~vinesim.scene.generation.shoots.Shoots`,
        and the horizontal direction [shoot, MAX_BUNCHES, 3] to which the peduncle tilts.
    """
    fruit = parameters.bunch
    peduncle = parameters.peduncle
    chance = normal(MAX_BUNCHES)
    names = [v.name for v in berries.VARIETIES]
    in_turn = np.array([names.index(name) for name in scene.fruit.varieties])
    variety = np.broadcast_to(in_turn[row % len(in_turn)][:, None], chance.shape)
    mean, sigma, low, high = _bunch_masses(fruit)[:, variety]
    mass = mean * portable_math.exp(sigma * chance - 0.5 * sigma**2)
    mass = np.clip(mass, low, high)
    juice = mass * (1.0 - fruit.stem_share.value)
    berry_mass = np.array([v.mass for v in berries.VARIETIES])[variety]
    most = np.array([berries.most_berries(v) for v in range(len(berries.VARIETIES))])[variety]
    count = np.clip(np.round(juice / berry_mass), berries.MIN_BERRIES, most).astype(int)
    seed = (uniform(MAX_BUNCHES) * 2.0**32).astype(np.uint32)
    volume_radius = np.array([v.volume_radius for v in berries.VARIETIES])[variety]
    size = volume_radius * portable_math.cbrt(juice / (count * berry_mass))
    hull = berries.hull_size(count, seed, variety) * size[..., None]
    weak, strongest = np.array([v.peduncle_pull or peduncle.pull.value for v in berries.VARIETIES]).T[:, variety]
    pull, strong = peduncle_strength(uniform(MAX_BUNCHES), weak, strongest)
    drawn = {
        "mass": mass,
        "count": count,
        "length": hull[..., 0],
        "radius": hull[..., 1],
        "seed": seed,
        "variety": variety,
        "pull": pull,
        "strong": strong,
        "thick": 0.5 * peduncle.diameter.at(np.maximum(_fraction(mass, fruit.mass_range), _THINNEST)),
    }

    # the second bunch grows about two nodes above the first one, never at the tip of the same segment
    low, high = parameters.cane.first_bunch_node.value
    node = low + (high - low) * uniform()
    node = np.stack([node, node + 2.2], -1)
    at = np.clip(np.round(node / nodes[:, None] * AXIS_SEGMENTS).astype(int) - 1, 0, AXIS_SEGMENTS - 2)
    at[:, 1] = np.maximum(at[:, 1], at[:, 0] + 1)
    rows = np.arange(len(points))[:, None]
    top = points[rows, at + 1]
    shortest, longest = np.array([v.peduncle_length or peduncle.length.value for v in berries.VARIETIES]).T[:, variety]
    long = (shortest + (longest - shortest) * uniform(MAX_BUNCHES)) / PEDUNCLE_SEGMENTS
    angle = 2.0 * np.pi * uniform(MAX_BUNCHES)
    level = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    tilt = np.clip(0.10 + 0.04 * normal(MAX_BUNCHES), 0.02, 0.18)[..., None]
    if scene.training == "vsp":  # the bunch hangs beside its upright shoot, outside the hedge
        level = frames.normalize(level * [0.4, 1.0, 0.0])
        tilt = tilt + 0.10
    first = frames.normalize(level * tilt - [0.0, 0.0, 1.0])
    second = frames.normalize(level * 0.3 * tilt - [0.0, 0.0, 1.0])
    middle = top + first * long[..., None]
    end = middle + second * long[..., None]
    axis = frames.normalize(0.02 * normal(MAX_BUNCHES, 3) - [0.0, 0.0, 1.0])
    return drawn, at, np.stack([top, middle, end], 2), axis, level


def _bunch_masses(bunch: Bunch) -> np.ndarray:
    """Returns mean [kg], sigma of the lognormal distribution, smallest and largest mass [kg] of the bunches of all
    varieties [4, variety]. ``bunch``: parameters of varieties without their own."""
    masses = []
    for kind in berries.VARIETIES:
        variation = bunch.mass_variation.value if kind.bunch_mass_variation is None else kind.bunch_mass_variation
        mean = bunch.mass.value if kind.bunch_mass is None else kind.bunch_mass
        ends = kind.bunch_mass_range or bunch.mass_range.value
        masses.append((mean, math.sqrt(math.log(1.0 + variation**2)), *ends))
    return np.array(masses).T


def _fraction(value: np.ndarray, within: Range) -> np.ndarray:
    """Returns the position of ``value`` between the ends of a range, from 0 to 1."""
    low, high = within.value
    return (value - low) / (high - low)


def choose_bunches(
    scene: Scene,
    structure: FixedStructure,
    per_vine: int,
    peduncle: np.ndarray,
    burden: np.ndarray,
    fruit: dict[str, np.ndarray],
) -> np.ndarray:
    """Select the bunches that each vine keeps: at most a random number within ``Scene.fruit.bunches``, in random order.

    A bunch is not kept if its gap to a pole, a trunk, the border of its vine's plot or a bunch that is already kept is
    too small (:data:`MIN_GAP`), or if its upright shoot would buckle.

    Args:
        scene: scene with the layout and the limits of the number of bunches.
        structure: vines with their random number generators and trunks.
        per_vine: number of shoots of each vine.
        peduncle: [shoot, MAX_BUNCHES, points, 3] m, points along each peduncle; the last one is the bunch's origin.
        burden: [shoot, MAX_BUNCHES] m g a^2 / EI of each bunch. The sum over the bunches that a shoot keeps is below
            :data:`MAX_BUCKLING_LOAD`.
        fruit: properties of the bunches by name, from :func:`sample_fruit`.

    Returns:
        [shoot, MAX_BUNCHES] bool, whether each bunch is kept.
    """
    layout = scene.layout
    low, high = scene.fruit.bunches
    slots = per_vine * MAX_BUNCHES
    top = peduncle[:, :, -1].reshape(-1, slots, 3)
    length, radius = (fruit[k].reshape(-1, slots) for k in ("length", "radius"))
    burden = burden.reshape(-1, slots)
    level = top[..., :2] - structure.foot[:, None, :2]
    inside = (
        np.abs(level) + radius[..., None] + 0.5 * MIN_GAP < 0.5 * np.array([layout.vine_spacing, layout.row_spacing])
    ).all(-1)
    # the pole stands at the foot, the trunk's head 5-15 cm beside it
    trunk = structure.trunk[:, :, None, :2] - top[:, None, :, :2]
    beside = np.sqrt((trunk * trunk).sum(-1)).min(1)
    clear = (np.linalg.norm(level, axis=-1) > radius + 0.05 + MIN_GAP) & (beside > radius + 0.06 + MIN_GAP)
    kept = np.zeros((len(top), slots), bool)
    for number, g in enumerate(structure.rngs):
        wanted = int(g.integers(low, high + 1))
        # the first bunch of a shoot is more likely to be kept than the second
        order = np.argsort(g.random(slots) + 0.45 * (np.arange(slots) % MAX_BUNCHES), kind="stable")
        order = order[(inside & clear)[number, order]]
        t = top[number, order]
        r = radius[number, order]
        h = length[number, order]
        apart = np.sqrt(((t[:, None, :2] - t[None, :, :2]) ** 2).sum(-1))
        middle = t[:, 2] - 0.5 * h
        rise = np.abs(middle[:, None] - middle[None])
        touch = (apart < r[:, None] + r[None] + MIN_GAP) & (rise < 0.5 * (h[:, None] + h[None]) + 0.03)
        load = burden[number, order]
        free = np.ones(len(order), bool)
        shoot = order // MAX_BUNCHES
        load_kept = np.zeros(per_vine)
        for i in range(len(order)):
            if wanted and free[i] and load_kept[shoot[i]] + load[i] < MAX_BUCKLING_LOAD:
                kept[number, order[i]] = True
                free &= ~touch[i]
                load_kept[shoot[i]] += load[i]
                wanted -= 1
    return kept.reshape(-1, MAX_BUNCHES)
