"""Bunches as primitives on their bodies: berries are spheroids; rachis and pedicels (berry stalks) are round cones."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene.berries import VARIETIES, BerryLayout, lay_out_berries, segment_of
from vinesim.scene.ids import Organ, label
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
_GREEN = np.array([0.085, 0.150, 0.022])
"""Colour of a hard green berry, linear RGB reflectance: GUESSED by eye."""
_SHOT_BERRY_SIZE = 0.45
"""Size of a berry without seeds, relative to a ripe berry [1]: GUESSED."""
_RIPENESS_SPREAD = 0.10
"""Standard deviation of the ripeness (0 to 1) of berries within a bunch. GUESSED."""
_SHOT_BERRY_SHARE = 0.06
"""Share of the berries of a completely unripe bunch that have stayed small and green ("shot berries"). GUESSED."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ripeness:
    """Ripeness of all bunches of a vineyard, from 0 (green and hard) to 1 (as the variety is harvested)."""

    bunch: np.ndarray
    """[bunch] Mean ripeness of the berries of each bunch."""
    seed: int = 0
    """Seed of the random differences in ripeness between berries of a bunch."""

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
        if ripeness is not None:
            colour, radius = _apply_ripeness(colour, radius, ripeness, which, count)
        away = np.hypot(*position[:, 1:].T)
        edge = np.array([_quantile_80(a) for a in np.split(away, np.cumsum(count)[:-1])])[bunch]
        first_berry = (np.cumsum(count) - count)[bunch][:, None]
        near = np.concatenate([_padded_neighbours(one.neighbours) for one in layouts])
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
            occlusion=_neighbour_occlusion(position, radius, np.where(near >= 0, near + first_berry, -1)),
        )

    def fruit(self, bunches: _Bunches) -> Batch:
        """Returns the primitives of the berries: one spheroid for each."""
        return make_batch(
            SPHEROID,
            stack_columns(bunches.placed(self.position, self.segment, self.bunch), self.radius),
            b=stack_columns(bunches.rotated(self.axis, self.segment), self.elongation),
            c=stack_columns(self.seed, self.depth, 0.0, 0.0),
            d=stack_columns(bunches.rotated(self.occlusion[:, :3], self.segment), self.occlusion[:, 3]),
            material=int(materials.BERRY),
            tint=self.colour,
            **bunches.common(self.segment, self.bunch),
        )

    def pedicels(self, bunches: _Bunches) -> Batch:
        """Returns the primitives of the pedicels: round cones from the rachis to all berries that do not touch it."""
        end = self.position - self.axis * (self.radius * self.elongation * 0.95)[:, None]
        free = np.linalg.norm(end - self.foot, axis=1) > _MIN_PEDICEL
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
    colour = variety * (1.0 + 0.10 * tone[:, None])
    reddish = (colour[:, :1] > 2.0 * colour[:, 1:2]) * np.clip(0.5 * blush[:, None], 0.0, 1.0)
    return colour + np.array([0.055, 0.014, 0.010]) * reddish


def _apply_ripeness(
    colour: np.ndarray, radius: np.ndarray, ripeness: Ripeness, which: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns colours [n, 3] and radii [n] m of berries after unripeness is applied to those of ripe berries.

    Each berry is interpolated between green and ripe; a small share stays small and green. ``which``: [k] indices of
    the bunches; ``count``: [k] number of berries of each bunch.
    """
    owner = np.repeat(np.arange(len(which)), count)
    draws = zip(which, count, strict=True)
    draw = np.concatenate([np.random.default_rng([ripeness.seed, 4, int(b)]).uniform(size=(n, 2)) for b, n in draws])
    mean = ripeness.bunch[which][owner]
    own = mean + _RIPENESS_SPREAD * np.sqrt(12.0) * (draw[:, 0] - 0.5) * np.minimum(4.0 * (1.0 - mean), 1.0)
    shot = draw[:, 1] < _SHOT_BERRY_SHARE * (1.0 - mean)
    own = np.where(shot, 0.0, np.clip(own, 0.0, 1.0))
    share = (own * own * (3.0 - 2.0 * own))[:, None]
    size = np.where(shot, _SHOT_BERRY_SIZE, 0.9 + 0.1 * own)
    return _GREEN * (1.0 - share) + colour * share, radius * size


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

    At a surface point with unit normal m the hidden share is w + v . m. A neighbour of radius r at distance l hides
    (1/4 + 0.85 cos) r^2 / l^2, with the cosine between m and the direction to the neighbour.
    """
    there = neighbours >= 0
    apart = position[np.maximum(neighbours, 0)] - position[:, None]
    distance = np.linalg.norm(apart, axis=2)
    direction = apart / np.maximum(distance, 1e-9)[..., None]
    gap = np.maximum(distance - 0.55 * radius[:, None], 0.3 * radius[:, None])
    weight = np.where(there, np.minimum(radius[np.maximum(neighbours, 0)] ** 2 / gap**2, 1.0), 0.0)
    return np.concatenate([0.42 * (weight[..., None] * direction).sum(1), 0.07 * weight.sum(1, keepdims=True)], 1)
