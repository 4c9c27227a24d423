"""Spur heads, stubs of old cuts and burls on trunks and arms, as pieces of the fixed structure, which can be touched.

Winter pruning leaves two buds of each shoot. Over the years they build a *spur head*: a clump of short thick wood with
the stubs of old cuts, on which two shoots stand.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.gnarl import MAX_STEP, random_directions, vine_generators
from vinesim.scene.ids import Organ
from vinesim.scene.spec import Scene

SHOOTS_ON_SPUR = 2
_KNOBS = 8
"""Number of knobs of a spur head."""
_ARM_BURLS = 4
_ARM_STUBS = 2
_TRUNK_BURLS = 6
_TRUNK_STUBS = 1
MAX_PIECES_PER_SPUR = 1 + SHOOTS_ON_SPUR + _KNOBS + 2
"""Neck, one foot for each shoot, knobs, and at most two stubs."""
_SPUR_HEIGHT = (0.022, 0.105)
"""[m] Least and greatest height of a spur head above the surface of its arm: GUESSED from photographs."""


@dataclasses.dataclass(frozen=True, eq=False)
class SpurSeats:
    """Where shoots stand on spur heads; shoots are numbered arm by arm."""

    share: np.ndarray
    """[shoot] Position along the arm, 0 to 1."""
    offset: np.ndarray
    """[shoot, 3] m, from the arm's axis to the base of the shoot."""


def seat_on_spurs(scene: Scene, structure: FixedStructure, each: int) -> SpurSeats:
    """Returns the places of ``each`` shoots on every arm, two on a spur head."""
    age = scene.clutter.old_wood
    vines, count, points = structure.arms.shape[:3]
    heads = (each + SHOOTS_ON_SPUR - 1) // SHOOTS_ON_SPUR
    number = np.arange(each) // SHOOTS_ON_SPUR
    last = np.arange(each) % SHOOTS_ON_SPUR - 0.5
    upright = scene.training == "vsp"
    share = []
    offset = []
    rngs = vine_generators(scene, structure.row, structure.place, 2)
    for vine in range(vines):
        g = rngs[vine]
        for arm in range(count):
            axis = structure.arms[vine, arm]
            along = frames.normalize((axis[-1] - axis[0]) * [1.0, 1.0, 0.0])
            across = frames.cross(np.array([0.0, 0.0, 1.0]), along)
            at = 0.15 + 0.83 * (np.arange(heads) + 0.25 + 0.5 * g.random(heads)) / heads
            radius = np.interp(at * (points - 1), np.arange(points), structure.arm_radius[vine, arm])
            tall = g.random(heads)
            high = radius * 0.8 + age * (_SPUR_HEIGHT[0] + (_SPUR_HEIGHT[1] - _SPUR_HEIGHT[0]) * tall * np.sqrt(tall))
            lean = 0.35 * g.normal(size=heads)
            if not upright:  # below a net, spurs grow sideways, to alternating sides
                lean = np.where(np.arange(heads) % 2, 1.0, -1.0) * (1.2 + 0.5 * g.random(heads))
            out = frames.normalize(across * lean[:, None] + [0.0, 0.0, 1.0])
            apart = age * (0.018 + 0.012 * g.random(each)) * last
            above = 1.0 - 0.25 * g.random(each) * (last > 0.0)
            share.append(at[number])
            offset.append(out[number] * (high[number] * above)[:, None] + along * apart[:, None])
    return SpurSeats(np.concatenate(share), np.concatenate(offset))


def with_old_wood(
    scene: Scene, structure: FixedStructure, start: np.ndarray, has_cordons: bool = True
) -> FixedStructure:
    """Returns the structure with spur heads below the shoots, and with stubs and burls, at the end of its pieces.

    ``start``: [shoot, 3] m, bases of the shoots, arm by arm; ``has_cordons``: False for cane-pruned vines, whose trunks
    alone are old. Without old wood the structure is returned unchanged. A
    stub was cut: its piece has the same radius at both ends. No other piece of wood has.
    """
    age = scene.clutter.old_wood
    if age == 0.0:
        return structure
    vines, count = structure.arms.shape[:2]
    each = len(start) // (vines * count)
    start = start.reshape(vines, count, each, 3)
    rngs = vine_generators(scene, structure.row, structure.place, 3)
    pieces = _Pieces()
    for vine in range(vines):
        g = rngs[vine]
        for arm in range(count if has_cordons else 0):
            axis = structure.arms[vine, arm]
            radius = structure.arm_radius[vine, arm]
            index = vine * count + arm
            for first in range(0, each, SHOOTS_ON_SPUR):
                _add_spur(pieces, g, age, axis, radius, start[vine, arm, first : first + SHOOTS_ON_SPUR], index)
            _add_lumps(pieces, g, age, axis, radius, _ARM_BURLS, _ARM_STUBS, Organ.ARM, index)
        axis = structure.trunk[vine]
        radius = structure.trunk_radius[vine]
        _add_lumps(pieces, g, age, axis, radius, _TRUNK_BURLS, _TRUNK_STUBS, Organ.TRUNK, vine)
    added = pieces.arrays()
    fixed = {name: np.concatenate([value, added[name]]) for name, value in structure.fixed.items()}
    return dataclasses.replace(structure, fixed=fixed)


class _Pieces:
    """A growing list of rigid pieces of wood."""

    def __init__(self) -> None:
        self._rows: list[tuple[np.ndarray, np.ndarray, float, float, Organ, int]] = []

    def add(self, start: np.ndarray, end: np.ndarray, thick: float, thin: float, organ: Organ, index: int) -> None:
        self._rows.append((start, end, thick, thin, organ, index))

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the ``fixed_`` arrays of the pieces. Shoots do not twist them: their shear modulus is 0."""
        start, end, thick, thin, organ, index = zip(*self._rows, strict=True)
        nothing = np.zeros(len(start))
        return {
            "fixed_start": np.array(start),
            "fixed_end": np.array(end),
            "fixed_radius": np.stack([thick, thin], -1),
            "fixed_organ": np.array([int(one) for one in organ]),
            "fixed_index": np.array(index),
            "fixed_tension": nothing,
            "fixed_stretch": nothing,
            "fixed_strength": nothing,
            "fixed_shear_modulus": nothing,
        }


def _add_spur(
    pieces: _Pieces,
    g: np.random.Generator,
    age: float,
    axis: np.ndarray,
    radius: np.ndarray,
    shoots: np.ndarray,
    index: int,
) -> None:
    """Add the spur head below ``shoots`` [1 or 2, 3] m, which stand on the arm with points ``axis`` and ``radius``."""
    middle = shoots.mean(0)
    nearest = int(np.argmin(((axis - middle) ** 2).sum(1)))
    foot = axis[nearest]
    thick = float(radius[nearest])
    # the foot of the spur is straight below the shoots, between the points of the axis
    way = axis[min(nearest + 1, len(axis) - 1)] - axis[max(nearest - 1, 0)]
    way = frames.normalize(way)
    foot = foot + way * np.clip(((middle - foot) * way).sum(), -0.03, 0.03)
    rise = middle - foot
    out = frames.normalize(rise)
    head = foot + rise * g.uniform(0.55, 0.75)
    wide = age * g.uniform(0.018, 0.034) + (1.0 - age) * 0.007
    root = float(np.clip(0.92 * thick, wide - MAX_STEP, wide + MAX_STEP))
    pieces.add(foot + out * 0.2 * thick, head, root, wide, Organ.ARM, index)
    for base in shoots:
        thin = age * g.uniform(0.0065, 0.0085) + (1.0 - age) * 0.005
        pieces.add(head, base, min(0.62 * wide, thin + MAX_STEP), thin, Organ.ARM, index)
    for direction in random_directions(g, _KNOBS):
        direction = frames.normalize(direction + 0.25 * out)
        size = age * g.uniform(0.30, 0.75) * wide
        centre = head - rise * g.uniform(-0.05, 0.6)
        reach = wide * g.uniform(0.65, 1.15)
        pieces.add(centre, centre + direction * reach, 1.05 * size, size, Organ.ARM, index)
    for direction in random_directions(g, 1 + int(g.random() < 0.5)):
        direction = frames.normalize(direction + 0.9 * out)
        size = g.uniform(0.0048, 0.0078)
        length = wide + age * g.uniform(0.012, 0.04)
        pieces.add(head, head + direction * length, size, size, Organ.ARM, index)


def _add_lumps(
    pieces: _Pieces,
    g: np.random.Generator,
    age: float,
    axis: np.ndarray,
    radius: np.ndarray,
    burls: int,
    stubs: int,
    organ: Organ,
    index: int,
) -> None:
    """Add burls and stubs of old cuts at random places of a trunk or arm with points ``axis`` and ``radius``."""
    lowest = 2 if organ is Organ.TRUNK else 0  # lumps stay above the ground
    for number in range(burls + stubs):
        k = int(g.integers(lowest, len(axis) - 1))
        share = g.random()
        place = axis[k] * (1.0 - share) + axis[k + 1] * share
        thick = float(radius[k] * (1.0 - share) + radius[k + 1] * share)
        along = frames.normalize(axis[k + 1] - axis[k])
        side = random_directions(g, 1)[0]
        side = frames.normalize(side - along * (side * along).sum())
        if number < burls:
            size = age * thick * g.uniform(0.45, 0.75)
            root = place + side * (thick - 0.62 * size)
            tip = root + along * size * g.uniform(0.6, 2.2) + side * 0.12 * size
            pieces.add(root, tip, size, max(0.75 * size, size - MAX_STEP), organ, index)
        else:
            size = g.uniform(0.0055, 0.011)
            way = frames.normalize(side + along * g.uniform(-0.6, 0.6))
            pieces.add(place, place + way * (thick + age * g.uniform(0.012, 0.05)), size, size, organ, index)
