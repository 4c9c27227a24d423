"""Bunches as primitives on their bodies: berries are spheroids; rachis and pedicels (berry stalks) are round cones."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene.berries import VARIETIES, BerryLayout, Variety, lay_out_berries, segment_of
from vinesim.scene.ids import Organ, label
from vinesim.scene.look import FruitLook
from vinesim.scene.model import Model
from vinesim.sensors.primitives.plant_primitives import STEM_TINT
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, SPHEROID

_BATCH_SIZE = 256
"""Number of bunches whose primitives are computed together: enough for fast NumPy calls, few enough for small arrays.
"""
_RACHIS_RADIUS = (0.0028, 0.0013)
"""Radius of the rachis at the peduncle and at its tip [m]: GUESSED."""
_MIN_PEDICEL = 0.002
"""Length [m] below which a pedicel (berry stalk) is not drawn."""
_SHOT_BERRY_SIZE = 0.45
"""Size of a berry without seeds, relative to a ripe berry [1]: GUESSED."""
_ROT_COLOUR = np.array([0.130, 0.080, 0.050])
_DRY_COLOUR = np.array([0.070, 0.042, 0.030])
"""Colours of rotten and of shrivelled berries, linear RGB reflectance: GUESSED by eye."""
_DRY_SIZE = 0.72
"""Size of a shrivelled berry, relative to a sound one [1]: GUESSED."""
_BUNCH_SPREAD = np.array([0.08, 0.04, 0.10])
"""Standard deviations of the colour of bunches of wine grapes about that of their variety [1]: GUESSED."""
_CROWDED = 0.27
"""Mean share of light hidden by neighbours from which on the pedicel of a berry of a wine grape is not drawn: berries
cover it. GUESSED."""
_BULGE = 0.05
"""How much a berry of a wine grape that others press on all sides bulges between them, relative to its radius: GUESSED.
"""
_SHOT_BERRY_SHARE = 0.06
"""Share of the berries of a completely unripe bunch that have stayed small and green ("shot berries"). GUESSED."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ripeness:
    """Ripeness of all bunches of a vineyard, from 0 (green and hard) to 1 (as the variety is harvested), and damage."""

    bunch: np.ndarray
    """[bunch] Mean ripeness of the berries of each bunch."""
    seed: int = 0
    """Seed of the random differences in ripeness between berries of a bunch, and of the damage."""
    rot: float = 0.0
    shrivelled: float = 0.0
    sunburn: float = 0.0
    """Shares of the bunches with rotten, shrivelled and sunburnt berries, 0 to 1."""

    @classmethod
    def of(cls, model: Model) -> Ripeness | None:
        """Returns the state of the fruit that the model's scene describes; None if it describes none."""
        fruit = model.look.fruit
        if fruit == FruitLook():
            return None
        low, high = (1.0, 1.0) if fruit.ripeness is None else fruit.ripeness
        rng = np.random.default_rng([model.look.seed, 3])
        bunch = np.round(rng.uniform(low, high, len(model.bunch_body)), 3)
        return cls(bunch, model.look.seed, fruit.rot, fruit.shrivelled, fruit.sunburn)

    @classmethod
    def for_pictures(cls, model: Model, seed: int) -> Ripeness:
        """Returns the state of the fruit that the model's scene describes. If it gives no ripeness, that is
        :meth:`random`."""
        given = cls.of(model)
        drawn = cls.random(len(model.bunch_body), seed)
        if given is None:
            return drawn
        has_ripeness = model.look.fruit.ripeness is not None
        return given if has_ripeness else dataclasses.replace(given, bunch=drawn.bunch)

    @classmethod
    def random(cls, count: int, seed: int) -> Ripeness:
        """Returns the ripeness in a vineyard before harvest: most bunches are ripe, some are turning, few are green."""
        rng = np.random.default_rng([seed, 3])
        return cls(np.round(rng.beta(2.2, 0.7, count), 3), seed)


def bunch_bodies(model: Model, bunch: int) -> np.ndarray:
    """Returns the bodies [piece] that carry the berries of ``bunch``: the bunch's own body, then its berry clusters."""
    first = int(model.bunch_cluster[bunch])
    count = int(model.bunch_clusters[bunch])
    return np.append(model.bunch_body[bunch], np.arange(first, first + count))


def bunch_batches(
    model: Model,
    which: np.ndarray,
    poses: list[np.ndarray] | None,
    carrier: list[np.ndarray],
    group: np.ndarray,
    ripeness: Ripeness | None = None,
) -> list[Batch]:
    """Returns the primitives of berries, rachises and pedicels of some bunches, each on its segment
    (:func:`bunch_bodies`).

    Args:
        model: constants of the vineyard.
        which: numbers of the bunches [k].
        poses: [k][segment, 7] pose of each segment in the frame of its carrier; identity unless given.
        carrier: [k][segment] row of the pose that moves each segment. A bunch without clusters has one segment.
        group: [k] group of each bunch; a cluster of primitives contains one group only.
        ripeness: ripeness of the fruit; None: all fruit is ripe.
    """
    found: list[Batch] = []
    for first in range(0, len(which), _BATCH_SIZE):
        part = slice(first, first + _BATCH_SIZE)
        bunches = _Bunches(model, which[part], poses and poses[part], carrier[part], group[part])
        berries = _Berries.of(model, bunches, ripeness)
        batches = berries.fruit(bunches), bunches.rachis(), berries.pedicels(bunches)
        found += [batch for batch in batches if len(batch)]
    return found


class _Bunches:
    """A batch of bunches [k] and their segments (bodies that carry the berries), all segments in one list."""

    def __init__(
        self,
        model: Model,
        which: np.ndarray,
        poses: list[np.ndarray] | None,
        carrier: list[np.ndarray],
        group: np.ndarray,
    ) -> None:
        self.which = which
        self.layouts: list[BerryLayout] = [
            lay_out_berries(
                float(model.bunch_length[b]),
                float(model.bunch_radius[b]),
                int(model.bunch_berries[b]),
                int(model.bunch_variety[b]),
                int(model.bunch_seed[b]),
            )
            for b in which
        ]
        self._group = group
        self._segments = np.array([len(c) for c in carrier])
        self._first_segment = np.cumsum(self._segments) - self._segments
        self._carrier = np.concatenate(carrier)
        self._poses = None if poses is None else np.concatenate(poses)
        self._length = model.bunch_length[which].astype(float)

    def segment_at(self, position: np.ndarray, bunch: np.ndarray) -> np.ndarray:
        """Returns the segment [n] that carries each of the points ``position`` [n, 3] m, given in their bunches'
        frames.

        ``bunch``: [n] index of each point's bunch in this batch.
        """
        return self._first_segment[bunch] + segment_of(position, self._length[bunch], self._segments[bunch])

    def placed(self, points: np.ndarray, segment: np.ndarray, bunch: np.ndarray) -> np.ndarray:
        """Transform ``points`` [n, 3] m from the frames of their bunches to the frames of their carriers."""
        along = (self._length / self._segments)[bunch] * (segment - self._first_segment[bunch])
        own = points - along[:, None] * np.array([1.0, 0.0, 0.0])
        if self._poses is None:
            return own
        return self._poses[segment, :3] + frames.rotate(self._poses[segment, 3:], own)

    def rotated(self, vectors: np.ndarray, segment: np.ndarray) -> np.ndarray:
        """Rotate ``vectors`` [n, 3] from the frames of their bunches to the frames of their carriers."""
        return vectors if self._poses is None else frames.rotate(self._poses[segment, 3:], vectors)

    def common(self, segment: np.ndarray, bunch: np.ndarray) -> dict[str, Any]:
        """Returns the properties of primitives [n] that depend only on their segment and bunch, as for
        :func:`make_batch`."""
        which = self.which[bunch]
        return {
            "organ": int(Organ.BUNCH),
            "label": label(Organ.BUNCH, 0) + which,
            "group": self._group[bunch],
            "bunch": which,
            "carrier": self._carrier[segment],
        }

    def rachis(self) -> Batch:
        """Returns the primitives of the rachises (axes of the bunches): round cones."""
        lines = [one.rachis for one in self.layouts]
        start, end = (np.concatenate([r[:, k : k - 1 or None].reshape(-1, 3) for r in lines]) for k in (0, 1))
        radius = np.concatenate([np.tile(np.linspace(*_RACHIS_RADIUS, r.shape[1] - 1), len(r)) for r in lines])
        bunch = np.repeat(np.arange(len(lines)), [len(r) * (r.shape[1] - 1) for r in lines])
        segment = self.segment_at(0.5 * (start + end), bunch)
        return make_batch(
            CONE,
            stack_columns(self.placed(start, segment, bunch), radius),
            b=stack_columns(self.placed(end, segment, bunch), 0.9 * radius),
            material=int(materials.STEM),
            tint=STEM_TINT,
            **self.common(segment, bunch),
        )


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Berries:
    """All berries [n] of a batch of bunches [k]."""

    bunch: np.ndarray
    """[n] Index of each berry's bunch in the batch."""
    segment: np.ndarray
    """[n] Segment that carries each berry."""
    position: np.ndarray
    """[n, 3] Centre in the bunch's frame [m]."""
    radius: np.ndarray
    """[n] Radius [m]."""
    axis: np.ndarray
    """[n, 3] Axis of the spheroid, a unit vector."""
    foot: np.ndarray
    """[n, 3] Point on the rachis where the pedicel begins [m]."""
    elongation: np.ndarray
    """[n] Length of the spheroid divided by its width."""
    colour: np.ndarray
    """[n, 3] Colour, linear RGB reflectance."""
    seed: np.ndarray
    """[n] Seed of the pattern of the skin, 0 to 1."""
    depth: np.ndarray
    """[n] Relative distance of the berry from the bunch's axis, 0 to 1."""
    occlusion: np.ndarray
    """[n, 4] Occlusion by other berries, see :func:`_neighbour_occlusion`."""
    damage: np.ndarray
    """[n, 2] Rot, 0 to 1, and dryness, 0 to 1, or sunburn, 0 to -1."""
    is_wine: np.ndarray
    """[n] Whether the berry is a wine grape."""

    @classmethod
    def of(cls, model: Model, bunches: _Bunches, ripeness: Ripeness | None) -> _Berries:
        layouts = bunches.layouts
        which = bunches.which
        count = np.array([len(one.radius) for one in layouts])
        bunch = np.repeat(np.arange(len(layouts)), count)
        position, radius, axis, foot = (
            np.concatenate([getattr(one, name) for one in layouts]) for name in ("position", "radius", "axis", "foot")
        )
        varieties = [VARIETIES[v] for v in model.bunch_variety[which]]
        rngs = [np.random.default_rng(int(model.bunch_seed[b])) for b in which]
        colour = _ripe_colours(np.array([v.colour for v in varieties])[bunch], rngs, count)
        seed = np.concatenate([rng.uniform(size=n) for rng, n in zip(rngs, count, strict=True)])
        colour = colour * _bunch_tones(varieties, model.bunch_seed[which])[bunch]
        first_berry = (np.cumsum(count) - count)[bunch][:, None]
        near = np.concatenate([_padded_neighbours(one.neighbours) for one in layouts])
        near = np.where(near >= 0, near + first_berry, -1)
        is_wine = np.array([v.style != "table" for v in varieties])[bunch]
        crowded = _neighbour_occlusion(position, radius, near)[:, 3] / _CROWDED
        radius = radius * (1.0 + _BULGE * is_wine * np.clip(crowded, 0.0, 1.0))
        rot, dry, burnt = np.zeros((3, len(bunch)))
        if ripeness is not None:
            colour, radius = _ripen(colour, radius, ripeness, which, bunch, varieties)
            if ripeness.rot or ripeness.shrivelled or ripeness.sunburn:
                rot, dry, burnt = _damage(position, model.bunch_length[which].astype(float), ripeness, which, bunch)
                colour, radius = _spoil(colour, radius, rot, dry, burnt)
        away = np.hypot(*position[:, 1:].T)
        edge = np.array([_quantile_80(a) for a in np.split(away, np.cumsum(count)[:-1])])[bunch]
        return cls(
            bunch=bunch,
            segment=bunches.segment_at(position, bunch),
            position=position,
            radius=radius,
            axis=axis,
            foot=foot,
            elongation=np.array([v.elongation for v in varieties])[bunch],
            colour=colour,
            seed=seed,
            depth=np.clip(0.35 + 0.65 * away / np.maximum(edge, 1e-6), 0.0, 1.0),
            occlusion=_neighbour_occlusion(position, radius, near),
            damage=np.stack([rot, dry - burnt], 1),
            is_wine=is_wine,
        )

    def fruit(self, bunches: _Bunches) -> Batch:
        """Returns the primitives of the berries: one spheroid for each."""
        return make_batch(
            SPHEROID,
            stack_columns(bunches.placed(self.position, self.segment, self.bunch), self.radius),
            b=stack_columns(bunches.rotated(self.axis, self.segment), self.elongation),
            c=stack_columns(self.seed, self.depth, self.damage),
            d=stack_columns(bunches.rotated(self.occlusion[:, :3], self.segment), self.occlusion[:, 3]),
            material=int(materials.BERRY),
            tint=self.colour,
            **bunches.common(self.segment, self.bunch),
        )

    def pedicels(self, bunches: _Bunches) -> Batch:
        """Returns the primitives of the pedicels: round cones from the rachis to all berries that do not touch it."""
        end = self.position - self.axis * (self.radius * self.elongation * 0.95)[:, None]
        free = np.linalg.norm(end - self.foot, axis=1) > _MIN_PEDICEL
        free &= ~self.is_wine | (self.occlusion[:, 3] < _CROWDED)
        segment = self.segment[free]
        bunch = self.bunch[free]
        return make_batch(
            CONE,
            stack_columns(bunches.placed(self.foot[free], segment, bunch), 0.0010),
            b=stack_columns(bunches.placed(end[free], segment, bunch), 0.0014),
            material=int(materials.STEM),
            tint=STEM_TINT,
            **bunches.common(segment, bunch),
        )


def _ripe_colours(variety: np.ndarray, rngs: list[np.random.Generator], count: np.ndarray) -> np.ndarray:
    """Returns random colours [n, 3] of ripe berries around the mean colours ``variety`` [n, 3] of their grape
    varieties.

    ``rngs``: [k] random generator of each bunch; ``count``: [k] number of berries of each bunch.
    """
    tone, blush = (np.concatenate([rng.normal(size=n) for rng, n in zip(rngs, count, strict=True)]) for _ in (0, 1))
    colour = variety * (1.0 + 0.13 * tone[:, None])
    reddish = (colour[:, :1] > 2.0 * colour[:, 1:2]) * np.clip(0.5 * blush[:, None], 0.0, 1.0)
    return colour + np.array([0.055, 0.014, 0.010]) * reddish


def _bunch_tones(kinds: list[Variety], seed: np.ndarray) -> np.ndarray:
    """Returns factors [k, 3] by which the colours of bunches differ; 1 for table grapes. ``kinds``: [k] varieties;
    ``seed``: [k] seeds of the bunches."""
    tones = np.stack([np.random.default_rng([int(one), 8]).normal(size=3) for one in seed])
    tones = 1.0 + np.clip(tones, -2.0, 2.0) * _BUNCH_SPREAD
    tones = tones * (0.9 + 0.1 * tones[:, :1])
    return np.where(np.array([kind.style != "table" for kind in kinds])[:, None], tones, 1.0)


def _spoil(
    colour: np.ndarray, radius: np.ndarray, rot: np.ndarray, dry: np.ndarray, burnt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns colours [n, 3] and radii [n] m of berries with ``rot``, ``dry`` and ``burnt`` [n], see
    :func:`_damage`."""
    for share, towards in ((rot, _ROT_COLOUR), (0.85 * dry, _DRY_COLOUR), (0.35 * burnt, 1.6 * _ROT_COLOUR)):
        colour = colour * (1.0 - share[:, None]) + towards * share[:, None]
    return colour, radius * (1.0 - (1.0 - _DRY_SIZE) * dry - 0.10 * rot)


def _ripen(
    colour: np.ndarray,
    radius: np.ndarray,
    ripeness: Ripeness,
    which: np.ndarray,
    owner: np.ndarray,
    kinds: list[Variety],
) -> tuple[np.ndarray, np.ndarray]:
    """Returns colours [n, 3] and radii [n] m of berries after unripeness is applied to those of ripe berries.

    Each berry is interpolated between green and ripe, some varieties through a third colour; a small share stays small
    and green. ``which``: [k] indices of the bunches; ``owner``: [n] bunch of each berry, from 0 to k - 1; ``kinds``:
    [k] varieties.
    """
    count = np.bincount(owner, minlength=len(which))
    draws = zip(which, count, strict=True)
    draw = np.concatenate([np.random.default_rng([ripeness.seed, 4, int(b)]).uniform(size=(n, 2)) for b, n in draws])
    mean = ripeness.bunch[which][owner]
    spread = np.array([kind.veraison for kind in kinds])[owner]
    turns = np.array([kind.turning is not None for kind in kinds])[owner]
    nearness = np.where(turns, np.minimum(mean, 1.0 - mean), 1.0 - mean)  # to the end of veraison, or to either end
    own = mean + spread * np.sqrt(12.0) * (draw[:, 0] - 0.5) * np.minimum(4.0 * nearness, 1.0)
    shot = draw[:, 1] < _SHOT_BERRY_SHARE * (1.0 - mean)
    own = np.where(shot, 0.0, np.clip(own, 0.0, 1.0))
    share = (own * own * (3.0 - 2.0 * own))[:, None]
    green, middle = (
        np.array([getattr(kind, name) or (0.0, 0.0, 0.0) for kind in kinds])[owner] for name in ("unripe", "turning")
    )
    first = np.minimum(2.0 * share, 1.0)
    second = np.maximum(2.0 * share - 1.0, 0.0)
    turned = (green * (1.0 - first) + middle * first) * (1.0 - second) + colour * second
    size = np.where(shot, _SHOT_BERRY_SIZE, 0.9 + 0.1 * own)
    return np.where(turns[:, None], turned, green * (1.0 - share) + colour * share), radius * size


def _damage(
    position: np.ndarray, length: np.ndarray, ripeness: Ripeness, which: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns rot, dryness and sunburn [n] of berries, 0 to 1 each.

    Rot spreads from one berry to those around it, shrivelled berries are mostly near the tip, and sunburn is on one
    side of a bunch. ``position``: [n, 3] m in the bunch's frame; ``length``: [k] m; ``which``, ``owner``: as in
    :func:`_ripen`.
    """
    rot, dry, burnt = np.zeros((3, len(owner)))
    ends = np.cumsum(np.bincount(owner, minlength=len(which)))
    for bunch, begin, end, long in zip(which, np.append(0, ends[:-1]), ends, length, strict=True):
        rng = np.random.default_rng([ripeness.seed, 6, int(bunch)])
        is_rotten, is_dry, is_burnt = rng.uniform(size=3) < [ripeness.rot, ripeness.shrivelled, ripeness.sunburn]
        p = position[begin:end]
        n = end - begin
        reach = rng.uniform(0.12, 0.30) * long
        centre = p[rng.integers(n)]
        side = rng.uniform(0.0, 2.0 * np.pi)
        chance = rng.uniform(size=(3, n))
        if is_rotten:
            away = np.linalg.norm(p - centre, axis=1) / reach
            rot[begin:end] = np.clip(1.6 - away - 0.8 * chance[0], 0.0, 1.0)
        if is_dry:
            share = rng.uniform(0.05, 0.4) * (0.4 + 1.2 * p[:, 0] / long)
            dry[begin:end] = np.where(chance[1] < share, 0.4 + 0.6 * chance[0], 0.0)
        if is_burnt:
            outside = (p[:, 1:] @ [np.cos(side), np.sin(side)]) / max(float(np.abs(p[:, 1:]).max()), 1e-6)
            burnt[begin:end] = np.clip(2.0 * outside - 0.4 - 1.2 * chance[2], 0.0, 1.0)
    return rot, np.where(rot > 0.0, 0.0, dry), np.where((rot > 0.0) | (dry > 0.0), 0.0, burnt)


def _quantile_80(away: np.ndarray) -> float:
    """Returns the 80 % quantile of ``away`` [n], faster than ``np.quantile``."""
    at = 0.8 * (len(away) - 1)
    low = int(at)
    ends = np.partition(away, [low, min(low + 1, len(away) - 1)])
    return float(ends[low] + (at - low) * (ends[min(low + 1, len(away) - 1)] - ends[low]))


def _padded_neighbours(neighbours: np.ndarray) -> np.ndarray:
    """Returns the indices of up to eight neighbours of each berry [n, 8]; missing ones are -1."""
    missing = 8 - neighbours.shape[1]
    return np.pad(neighbours, ((0, 0), (0, missing)), constant_values=-1) if missing else neighbours


def _neighbour_occlusion(position: np.ndarray, radius: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Returns the share of light that neighbouring berries hide from each berry, as (v, w) [n, 4].

    At a surface point with unit normal m the hidden share is w + v . m. A neighbour of radius r whose centre is at
    distance l from that of a berry of radius R hides (0.09 + 0.68 cos) r^2 / (l - 0.55 R)^2, with the cosine between m
    and the direction to the neighbour: GUESSED, by eye.
    """
    there = neighbours >= 0
    apart = position[np.maximum(neighbours, 0)] - position[:, None]
    distance = np.linalg.norm(apart, axis=2)
    direction = apart / np.maximum(distance, 1e-9)[..., None]
    gap = np.maximum(distance - 0.55 * radius[:, None], 0.3 * radius[:, None])
    weight = np.where(there, np.minimum(radius[np.maximum(neighbours, 0)] ** 2 / gap**2, 1.0), 0.0)
    return np.concatenate([0.68 * (weight[..., None] * direction).sum(1), 0.09 * weight.sum(1, keepdims=True)], 1)
