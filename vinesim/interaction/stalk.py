"""Where a blade cuts a peduncle: the segment is split there, and the part below the cut goes with the bunch.

The segment keeps its body, joint and spring as the stump; only its length and inertia shrink. The part beyond the cut,
and whole segments between it and the bunch, join the bunch rigidly, in their present poses
([why](../decisions/cutting.md)).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.segment_parts import SHORTEST
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.values import Stalk

GHOST_SHARE = 1e-3
"""Share of its mass that a segment of stalk keeps on the tree after it has left with its bunch."""


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """A part of a segment of wood, in the segment's frame."""

    start: float
    end: float
    """[m] Where the part begins and ends along the segment."""
    mass: float
    """[kg]"""
    com: np.ndarray
    """[3] m, centre of mass."""
    inertia: np.ndarray
    """[3] kg m^2, principal moments about the centre of mass."""


def cut_place(model: Model, segment: int, at: float) -> float:
    """Returns the place [m] along a segment at which a cut at ``at`` [m] splits it: a multiple of :data:`PLACE_STEP`,
    not closer than :data:`SHORTEST` to an end.

    Raises :class:`ValueError` if ``at`` is not on the segment.
    """
    length = float(model.body_length[segment])
    if not 0.0 <= at <= length:
        raise ValueError(f"a cut at {at} m along body {segment}, which is {length:.4g} m long; cut between its ends")
    nearest = min(max(at, SHORTEST), length - SHORTEST)
    return round(nearest / PLACE_STEP) * PLACE_STEP


def split(length: float, mass: float, com: np.ndarray, inertia: np.ndarray, at: float) -> tuple[Piece, Piece]:
    """Split a segment at ``at`` [m] into the parts before and beyond the cut.

    The segment is a uniform rod, as its builder made it: ``mass`` [kg] with its centre ``com`` [3] m at half its
    ``length`` [m], and moments of inertia ``inertia`` [3] kg m^2 about the centre. Mass, first and second moments of
    the parts add up to those of the segment.
    """
    inertia = np.asarray(inertia, float)
    along = np.array([1.0, 0.0, 0.0])
    rod = mass * length * length / 12.0 * np.array([0.0, 1.0, 1.0])
    middle = np.asarray(com, float) - 0.5 * length * along
    pieces = []
    for start, end in ((0.0, at), (at, length)):
        own = end - start
        share = own / length
        moments = share * (inertia - rod) + share * mass * own * own / 12.0 * np.array([0.0, 1.0, 1.0])
        pieces.append(Piece(start, end, share * mass, middle + 0.5 * (start + end) * along, moments))
    return pieces[0], pieces[1]


def stalk_below(model: Model, bunch: int, segment: int) -> list[int]:
    """Returns the segments of a bunch's peduncle from ``segment`` to the bunch.

    Raises :class:`ValueError` if ``segment`` is not in its peduncle.
    """
    found: list[int] = []
    body = int(model.body_parent[model.bunch_body[bunch]])
    while body >= 0 and model.body_organ[body] == int(Organ.PEDUNCLE):
        found.append(body)
        if body == segment:
            return found[::-1]
        body = int(model.body_parent[body])
    raise ValueError(f"body {segment} is no segment of the peduncle of bunch {bunch}")


def is_on_stalk(model: Model, bunch: int, segment: int, at: float) -> bool:
    """Returns whether a bunch can have been cut ``at`` [m] along ``segment``."""
    try:
        return segment in stalk_below(model, bunch, segment) and abs(cut_place(model, segment, at) - at) < PLACE_STEP
    except ValueError:
        return False


def leave_stump(plants: ArticulationSolver, contact_solver: ContactSolver, segments: list[int], at: float) -> None:
    """Leave on the vine what is before a cut ``at`` [m] along the first of ``segments``: the stump, which can be
    touched. The other segments keep :data:`GHOST_SHARE` of their mass there, as the bunch leaves a stub."""
    model = plants.model
    columns = (model.body_length, model.body_mass, model.body_com, model.body_inertia)
    length, mass, com, inertia = (column[segments[0]].astype(float) for column in columns)
    stump, _ = split(float(length), float(mass), com, inertia, at)
    plants.set_inertia(segments[0], stump.mass, stump.com, stump.inertia)
    for body in segments[1:]:
        plants.set_mass(body, GHOST_SHARE * float(model.body_mass[body]))
    contact_solver.leave_stump(segments[0], at)


def with_settled_stalk(model: Model, bunch: int, free: FreeBunch, segment: int, at: float) -> FreeBunch:
    """Returns a free bunch with its stalk in the shape in which it hung at rest. A client that did not see the cut
    knows no other."""
    segments = stalk_below(model, bunch, segment)
    chain = np.array([*segments[1:], int(model.bunch_body[bunch])])
    joint = frames.pose(
        model.body_offset[chain].astype(float),
        frames.normalize(frames.multiply(model.body_rest[chain], model.joint_settled[chain]).astype(float)),
    )
    above = [frames.pose(np.zeros(3))]
    for step in joint[::-1]:
        above.append(frames.compose(above[-1], frames.inverse(step)))
    poses = np.array(above[:0:-1])
    pieces = model_pieces(model, segments, at)
    radii = model.body_radius[segments].mean(1).astype(float)
    whole, _ = with_stalk(free, np.zeros(6), segment, pieces, poses, np.zeros((len(pieces), 6)), radii)
    return whole


def model_pieces(model: Model, segments: list[int], at: float) -> list[Piece]:
    """Returns the pieces of ``segments`` beyond a cut ``at`` [m] along the first of them."""
    columns = (model.body_length, model.body_mass, model.body_com, model.body_inertia)
    pieces = []
    for number, body in enumerate(segments):
        length, mass, com, inertia = (column[body].astype(float) for column in columns)
        pieces.append(split(float(length), float(mass), com, inertia, 0.0 if number else at)[1])
    return pieces


def with_stalk(
    bunch: FreeBunch,
    velocity: np.ndarray,
    segment: int,
    pieces: list[Piece],
    poses: np.ndarray,
    rates: np.ndarray,
    radii: np.ndarray,
) -> tuple[FreeBunch, np.ndarray]:
    """Returns a free bunch with the pieces of its stalk fixed to it, and the velocity [6] of its frame with which it
    has the linear and angular momentum of its parts.

    ``velocity`` [6] m/s, rad/s: velocity of the bunch alone, in its own axes. ``segment``: body of the first piece.
    ``poses`` [piece, 7] of the segments' frames and ``rates`` [piece, 6] of their origins, both in the bunch's frame.
    ``radii`` [piece] m.
    """
    yz, zx, xy = bunch.product
    tensors = [np.diag(bunch.inertia) + np.array([[0.0, xy, zx], [xy, 0.0, yz], [zx, yz, 0.0]])]
    masses = [bunch.mass]
    centers = [bunch.com]
    speeds = [velocity[:3] + np.cross(velocity[3:], bunch.com)]
    spins = [velocity[3:]]
    for piece, pose, rate in zip(pieces, poses, rates, strict=True):
        axes = frames.to_matrix(pose[3:])
        arm = axes @ piece.com
        masses.append(piece.mass)
        centers.append(pose[:3] + arm)
        tensors.append(axes @ np.diag(piece.inertia) @ axes.T)
        speeds.append(rate[:3] + np.cross(rate[3:], arm))
        spins.append(rate[3:])
    mass = np.array(masses)
    center = np.array(centers)
    whole = float(mass.sum())
    com = mass @ center / whole
    arm = center - com
    linear = mass @ np.array(speeds)
    own = np.einsum("kij,kj->i", np.array(tensors), np.array(spins))
    angular = own + (mass[:, None] * np.cross(arm, np.array(speeds))).sum(0)
    tensors += [m * ((r @ r) * np.eye(3) - np.outer(r, r)) for m, r in zip(mass, arm, strict=True)]
    tensor = np.array(tensors).sum(0)
    spin = np.linalg.solve(tensor, angular)
    ends = [
        pose[:3] + frames.rotate(pose[3:], np.array([[piece.start, 0.0, 0.0], [piece.end, 0.0, 0.0]]))
        for piece, pose in zip(pieces, poses, strict=True)
    ]
    stalk = np.array(ends).reshape(-1, 2, 3)
    fixed = FreeBunch(
        mass=whole,
        com=com,
        inertia=np.diagonal(tensor).copy(),
        product=tensor[[1, 2, 0], [2, 0, 1]],
        start=np.concatenate([bunch.start, stalk[:, 0]]),
        end=np.concatenate([bunch.end, stalk[:, 1]]),
        radius=np.concatenate([bunch.radius, radii]),
        stalk=Stalk(segment, pieces[0].start, len(pieces)),
    )
    return fixed, np.concatenate([linear / whole - np.cross(spin, com), spin])
