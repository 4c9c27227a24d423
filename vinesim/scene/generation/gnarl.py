"""Shapes of old trunks and arms: bends, burls and varying thickness; and the kinds of posts.

All of it comes from random generators of its own, so the numbers of the shoots of a vine stay the same.
"""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.scene.spec import Clutter, Scene

ARM_PIECES = 20
"""Number of pieces of an old arm: one every 4 to 5 cm."""
TRUNK_PIECES = 14
"""Number of pieces of an old trunk."""
POST_KINDS = ("wood", "concrete", "steel")
POST_RADIUS = {"steel": 0.026}
"""[m] Radius in contacts of those kinds of posts that are not as thick as the plant file says. GUESSED."""
MAX_STEP = 0.006
"""[m] Largest difference of the radii of a piece: in contacts with rigid bodies a piece has its mean radius, so picture
and contact differ by at most half of it."""
_OLD_ARM = (0.028, 0.019)
"""[m] Radius of an old arm at the trunk and at its end: GUESSED from photographs, 4 to 6 cm thick."""
_DROP = 0.10
"""[m] Depth of the head of an old trunk below that of a young one; the arms rise from it in a bow. GUESSED."""
_KNOTS = 9
"""Number of random values along a trunk or arm, between which its bends are smooth."""


def vine_generators(scene: Scene, row: np.ndarray, place: np.ndarray, stage: int) -> list[np.random.Generator]:
    """Returns the random generator of each vine [vine] for one ``stage`` of its old wood."""
    # spawn keys of length 4: those of vines have length 2, those of imported plants 3
    return [
        np.random.default_rng(np.random.SeedSequence(scene.seed, spawn_key=(int(r), int(p), 1, stage)))
        for r, p in zip(row, place, strict=True)
    ]


def post_kinds(clutter: Clutter, seed: int, row: np.ndarray) -> np.ndarray:
    """Returns the kind of each post [post], a name of ``Clutter.posts`` other than "mixed"; ``row``: [post] its row of
    vines."""
    if clutter.posts != "mixed":
        return np.full(len(row), clutter.posts, "U8")
    chosen = [
        np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(r), 0, 2, 0))).integers(len(POST_KINDS))
        for r in range(int(row.max(initial=0)) + 1)
    ]
    return np.array(POST_KINDS)[np.array(chosen)[row]]


def gnarled_trunks(
    scene: Scene, row: np.ndarray, place: np.ndarray, trunk: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [vine, point, 3] m and radii [vine, point] m of old trunks, from those of young ones."""
    age = scene.clutter.old_wood
    rngs = vine_generators(scene, row, place, 0)
    points, thick = _resampled(trunk, TRUNK_PIECES), _resampled(radius[..., None], TRUNK_PIECES)[..., 0]
    up = np.linspace(0.0, 1.0, TRUNK_PIECES + 1)
    head = points[:, -1, 2] - trunk[:, 0, 2]
    points[..., 2] = trunk[:, :1, 2] + (points[..., 2] - trunk[:, :1, 2]) * (1.0 - age * _DROP / head)[:, None]
    bend = np.stack([_smooth(g.normal(size=(_KNOTS, 2)), TRUNK_PIECES) for g in rngs])
    free = (4.0 * up * (1.0 - up))[:, None]
    points[..., :2] += age * 0.034 * bend * free
    lumps = np.stack([_smooth(g.uniform(-1.0, 1.0, (2 * _KNOTS, 1)), TRUNK_PIECES)[:, 0] for g in rngs])
    foot = 0.35 * np.maximum(1.0 - up / 0.14, 0.0) ** 2
    shoulder = 0.16 * np.maximum(1.0 - (1.0 - up) / 0.2, 0.0)
    return points, _gentle(thick * (1.0 + age * (0.20 * lumps + foot + shoulder - 0.12)))


def gnarled_arms(
    scene: Scene, row: np.ndarray, place: np.ndarray, arms: np.ndarray, radius: np.ndarray, head: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [vine, arm, point, 3] m and radii [vine, arm, point] m of old arms, from those of young ones.

    ``head``: [vine, 3] m, upper end of each trunk, from which the arms rise in a bow.
    """
    age = scene.clutter.old_wood
    count = arms.shape[1]
    rngs = vine_generators(scene, row, place, 1)
    points, thick = _resampled(arms, ARM_PIECES), _resampled(radius[..., None], ARM_PIECES)[..., 0]
    along = np.linspace(0.0, 1.0, ARM_PIECES + 1)
    points[..., 2] -= (arms[:, :, :1, 2] - head[:, None, None, 2]) * np.maximum(1.0 - along / 0.28, 0.0) ** 2
    bend = np.stack([[_bends(g) for _ in range(count)] for g in rngs])
    points += np.sqrt(age) * bend * np.minimum(along / 0.2, 1.0)[:, None]
    points[..., 2] = np.minimum(points[..., 2], scene.layout.height + 0.02)
    lumps = np.stack(
        [[_smooth(g.uniform(-1.0, 1.0, (2 * _KNOTS, 1)), ARM_PIECES)[:, 0] for _ in range(count)] for g in rngs]
    )
    old = (_OLD_ARM[0] * (1.0 - along) + _OLD_ARM[1] * along) * (1.0 + 0.30 * lumps)
    join = np.maximum(1.0 - along / 0.1, 0.0) * 0.010
    return points, _gentle(thick + age * (old + join - thick))


def _bends(rng: np.random.Generator) -> np.ndarray:
    """Returns random displacements [point, 3] m of an old arm: wide bows and short kinks. Younger arms bend less, with
    the square root of their age: GUESSED."""
    wide = _smooth(rng.normal(size=(_KNOTS // 2, 3)), ARM_PIECES) * [0.006, 0.016, 0.024]
    return wide + _smooth(rng.normal(size=(_KNOTS, 3)), ARM_PIECES) * [0.006, 0.012, 0.013]


def _gentle(radius: np.ndarray) -> np.ndarray:
    """Returns ``radius`` [..., point] m, changed so that neighbours differ by at most :data:`MAX_STEP`."""
    radius = radius.copy()
    for i in range(1, radius.shape[-1]):
        before = radius[..., i - 1]
        radius[..., i] = np.clip(radius[..., i], before - MAX_STEP, before + MAX_STEP)
    return radius


def _resampled(points: np.ndarray, pieces: int) -> np.ndarray:
    """Returns ``pieces`` + 1 points [..., point, k] at equal steps along polylines [..., point, k]."""
    at = np.linspace(0.0, points.shape[-2] - 1.0, pieces + 1)
    i = np.minimum(at.astype(int), points.shape[-2] - 2)
    share = (at - i)[:, None]
    return points[..., i, :] * (1.0 - share) + points[..., i + 1, :] * share


def _smooth(knots: np.ndarray, pieces: int) -> np.ndarray:
    """Returns values [piece + 1, k] that change smoothly between the random ``knots`` [knot, k]."""
    at = np.linspace(0.0, len(knots) - 1.0, pieces + 1)
    i = np.minimum(at.astype(int), len(knots) - 2)
    share = (at - i)[:, None]
    share = share * share * (3.0 - 2.0 * share)
    return knots[i] * (1.0 - share) + knots[i + 1] * share


def random_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns ``count`` random unit vectors [count, 3]."""
    return frames.normalize(rng.normal(size=(count, 3)))
