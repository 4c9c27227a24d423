"""Parts of a segment of wood: mass, inertia and spring of the part between two places along it.

A segment is a uniform rod, with the point masses of its leaves, and of a weight at one end if its centre of mass says
so. Mass, first and second moments of the parts of a segment add up to those of the segment.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP

SHORTEST = 5e-4
"""Shortest part that a cut leaves on either side [m]. A shorter part would be too light for its joint."""
_LEAST_END_MASS = 1e-5
"""Share of the wood's mass below which a weight at the end of a segment is rounding."""


def place_between(start: float, end: float, at: float, body: int) -> float:
    """Returns the place [m] of a cut at ``at`` [m] in wood from ``start`` to ``end`` [m]: a multiple of
    :data:`PLACE_STEP`, not closer than :data:`SHORTEST` to an end.

    ``body`` is named in errors. Raises :class:`ValueError` if ``at`` is not in this wood, or the wood is too short.
    """
    if not start <= at <= end:
        raise ValueError(f"a cut at {at} m along body {body}, whose wood is from {start:.4g} to {end:.4g} m")
    if end - start < 2.0 * SHORTEST + PLACE_STEP:
        raise ValueError(f"a cut in body {body}, which has {1e3 * (end - start):.2g} mm of wood; cut a longer piece")
    least = int(np.ceil((start + SHORTEST) / PLACE_STEP - 1e-6))
    most = int(np.floor((end - SHORTEST) / PLACE_STEP + 1e-6))
    return min(max(round(at / PLACE_STEP), least), most) * PLACE_STEP


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a segment of wood, in the segment's frame."""

    mass: float
    """[kg]"""
    com: np.ndarray
    """[3] m, centre of mass."""
    inertia: np.ndarray
    """[3] kg m^2, moments about the centre of mass."""
    drag: float
    """[m^2] Drag area."""


@dataclasses.dataclass(frozen=True)
class Rod:
    """What a segment of wood consists of: a uniform rod and points on it."""

    length: float
    """[m]"""
    mass: float
    """[kg] Mass of the rod without the points."""
    points: np.ndarray
    """[k] kg, masses of the leaves, and of a weight at one end, which is the last one."""
    places: np.ndarray
    """[k] m, places of the points along the rod."""
    rest: float
    """[kg m^2] Second moment of mass along the rod that rod and points do not explain; it is spread along the rod."""
    second: np.ndarray
    """[3] kg m^2, second moments of mass of the segment about its centre, along each axis."""
    around: np.ndarray
    """[2] kg m^2, second moments of the rod's mass across it, along y and z."""
    across: np.ndarray
    """[k - 1, 2] kg m^2, those of the leaves."""


def rod_of(model: Model, segment: int) -> Rod:
    """Returns what a segment of wood consists of. Raises :class:`ValueError` if its masses are not those of a rod with
    leaves."""
    length = float(model.body_length[segment])
    mass = float(model.body_mass[segment])
    com = model.body_com[segment].astype(float)
    xx, yy, zz = model.body_inertia[segment].astype(float)
    second = 0.5 * np.array([yy + zz - xx, zz + xx - yy, xx + yy - zz])
    leaves = np.flatnonzero(model.leaf_body == segment)
    leaf_mass = model.leaf_mass[leaves].astype(float)
    leaf_at = model.leaf_pose[leaves, :3].astype(float)
    wood = mass - leaf_mass.sum()
    middle = (mass * com[0] - leaf_mass @ leaf_at[:, 0]) / wood
    end_mass = (2.0 * middle / length - 1.0) * wood  # at the tip; at the base if negative
    if abs(end_mass) < _LEAST_END_MASS * wood:
        end_mass = 0.0
    rod = wood - abs(end_mass)
    if not (wood > 0.0 and rod > 0.0):
        raise ValueError(f"body {segment}: its mass {mass:.3g} kg with leaves of {leaf_mass.sum():.3g} kg is no rod")
    points = np.append(leaf_mass, abs(end_mass))
    places = np.append(leaf_at[:, 0], length if end_mass > 0.0 else 0.0)
    known = rod * (length * length / 12.0 + (0.5 * length - com[0]) ** 2) + points @ (places - com[0]) ** 2
    across = leaf_mass[:, None] * (leaf_at[:, 1:] - com[1:]) ** 2
    around = np.maximum(second[1:] - across.sum(0), 0.0)
    return Rod(length, rod, points, places, second[0] - known, second, around, across)


def part_of(model: Model, segment: int, start: float, end: float) -> Part:
    """Returns the part of a segment's wood from ``start`` to ``end`` [m], with the leaves that grow on it.

    All parts keep the lateral offset of the segment's centre of mass, so that their products of inertia are zero, as
    those of the segment are. The true offset differs by that of leaves, which is about a centimetre.
    """
    rod = rod_of(model, segment)
    com = model.body_com[segment].astype(float)
    leaves = np.flatnonzero(model.leaf_body == segment)
    whole = rod.around + rod.across.sum(0)
    tip = rod.places[-1]
    share = (end - start) / rod.length
    grows = grows_between(model, segment, leaves, start, end)
    here = np.append(grows, start <= tip < end or (end >= rod.length and tip == rod.length))
    own = rod.points[here]
    x = rod.places[here]
    total = share * rod.mass + own.sum()
    center = (share * rod.mass * 0.5 * (start + end) + own @ x) / total
    along = share * rod.mass * ((end - start) ** 2 / 12.0 + (0.5 * (start + end) - center) ** 2)
    along += own @ (x - center) ** 2 + share * rod.rest
    if not along > 0.0:
        raise ValueError(f"body {segment}: inertia {model.body_inertia[segment]} kg m^2 is not that of a rod")
    spread = share * rod.around + rod.across[here[:-1]].sum(0)
    beside = spread * np.where(whole > 0.0, rod.second[1:] / np.where(whole > 0.0, whole, 1.0), 0.0)
    drag = model.leaf_drag[leaves].astype(float)
    bare = max(float(model.body_drag[segment]) - drag.sum(), 0.0)
    return Part(
        total,
        np.array([center, com[1], com[2]]),
        np.array([beside.sum(), along + beside[1], along + beside[0]]),
        share * bare + float(drag[here[:-1]].sum()),
    )


def grows_between(model: Model, segment: int, leaves: np.ndarray, start: float, end: float) -> np.ndarray:
    """Returns whether each of the ``leaves`` [k] of a segment grows on its part from ``start`` to ``end`` [m]."""
    base = model.leaf_base[leaves, 0]
    here = (start <= base) & (base < end)
    if start <= 0.0:
        here |= base < 0.0
    if end >= float(model.body_length[segment]):
        here |= base >= end
    return here


def without_leaves(model: Model, part: Part, leaves: np.ndarray) -> Part:
    """Returns a part of a segment without ``leaves`` [k] of it: their masses, first and second moments and drag areas
    are subtracted. Products of inertia are left out, as the generator of plants does."""
    mass = model.leaf_mass[leaves].astype(float)
    at = model.leaf_pose[leaves, :3].astype(float)
    left = part.mass - mass.sum()
    com = (part.mass * part.com - mass @ at) / left
    xx, yy, zz = part.inertia
    second = 0.5 * np.array([yy + zz - xx, zz + xx - yy, xx + yy - zz]) + part.mass * part.com**2
    second = second - mass @ at**2 - left * com**2
    second = np.maximum(second, 1e-3 * part.inertia.max() * left / part.mass)
    inertia = second.sum() - second
    return Part(left, com, inertia, max(part.drag - float(model.leaf_drag[leaves].sum()), 0.0))


CLAMPED = 2.0 * 3.0 / 1.875104**4
"""Compliance of the spring at a clamp with which a rigid rod has the first frequency of an elastic one, relative to
that of half the rod. w^2 = 3 k / (m L^2) of the rigid rod equals 1.875104^4 E I / (m L^3) of the Euler-Bernoulli beam.
"""


def joint_compliance(model: Model, segment: int, own: float, above: float) -> float:
    """Returns the compliance of a segment's joint relative to the model's, if the segment has the share ``own`` of its
    length, and its parent the share ``above``.

    A joint bends for the half of its segment and the half of the parent that meet there
    (:mod:`vinesim.scene.builder`). Each has a compliance of half its length over its flexural rigidity at the joint.
    Both are taken as the same wood; where they are not, the thicker parent's share is small. The spring of a stump at a
    clamp bends for the whole stump, which has no other joint.
    """
    share = float(own_share(model, np.array([segment]))[0])
    if share < 0.0:
        return CLAMPED * own if own < 1.0 else 1.0
    return share * own + (1.0 - share) * above


def own_share(model: Model, segments: np.ndarray) -> np.ndarray:
    """Returns the shares [k] of ``segments`` [k] in the compliances of their joints; the rest is their parents'. -1 for
    a joint at a clamp, 1 without radii."""
    parent = model.body_parent[segments]
    pair = np.stack([segments, np.maximum(parent, 0)])
    radius = np.stack([model.body_radius[segments, 0], model.body_radius[pair[1], 1]]).astype(float)
    is_round = (radius > 0.0).all(0)
    half = model.body_length[pair].astype(float) / np.where(radius > 0.0, radius, 1.0) ** 4
    clamped = (parent < 0) | (model.body_organ[pair[1]] == int(Organ.BUNCH))
    return np.where(clamped, -1.0, np.where(is_round, half[0] / half.sum(0), 1.0))


def relaxed_joint(model: Model, segment: int, compliance: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rest rotation [4] and the settled rotation [4] of a segment's joint whose compliance has become
    ``compliance`` times the model's.

    In the drawn shape the joint carries the same moment and has the same pose as before: its elastic angle is smaller
    by the factor, and the rest pose turns by the difference. So no energy comes from a change of stiffness.
    """
    settled = frames.log(model.joint_settled[segment].astype(float))
    rest = frames.multiply(model.body_rest[segment].astype(float), frames.exp((1.0 - compliance) * settled))
    return frames.normalize(rest), frames.exp(compliance * settled)
