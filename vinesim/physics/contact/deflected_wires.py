"""Wires that give to what presses on them: the springs that contacts end at, and where their geoms are.

A wire has no mass here (see :mod:`vinesim.physics.plants.elastic_supports`). So a contact with it is one with a spring
of the wire's stiffness across itself, which both solvers treat as implicit, as they do any contact. The wire's geom
follows what presses on it, so that normals and closest points are those of the deflected wire; the spring is measured
from where the wire would be without that contact's force.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.physics.plants.elastic_supports import WIRE_DAMPING_TIME, ElasticSupports
from vinesim.scene.model import Model

MAX_DEFLECTION = 0.25
"""[m] The geom of a wire follows no further; what presses on still feels its spring. TUNED: far beyond what the law of
a taut string holds for."""
LEAST_DEFLECTION = 1e-6
"""[m] A wire that is nearer to where it was drawn is put there."""
LEAST_SPREAD = 0.1
"""[1] Of a wire's length: contacts that are further apart tilt it; others move it as a whole. TUNED."""
FOLLOWED, EXTRAPOLATED = 0.7, 0.5
"""[1] What several contacts with wires know of each other in a step: so much of the deflections by the others' forces,
and these extrapolated by so many steps; of the rest, its mean over :data:`MEMORY`. DERIVED: the largest share with
which a mass on two such springs is stable whatever it weighs, with a wire's damping."""
MEMORY, LEAST_WEIGHT = 0.5, 0.05
"""[s] over which the forces are averaged by which several contacts share a wire, and [1] the share of the largest with
which one is taken to press at least. TUNED."""
TOUCHING = 1e-3
"""[m] A contact with a larger gap to the geom of a wire does not touch it, however far others deflect it. TUNED."""
MOST_ALONG, OUT_OF_REACH = 0.5, 1e3
"""[1] Largest cosine between a contact's normal and the wire; [m] where the wire is taken to be for others."""
SAME_PLACE = 0.05
"""[m] Contacts of the same pair of shapes that are further apart in two steps are different ones. TUNED: less than any
box is long, more than anything slides in a step."""
_NONE = np.zeros(0, int)


@dataclasses.dataclass(frozen=True)
class WireSprings:
    """The springs at which contacts with wires end. [contact] unless said otherwise."""

    piece: np.ndarray
    """Fixed piece."""
    along: np.ndarray
    """[m] from its start."""
    normal: np.ndarray
    """[contact, 3] from the wire to what presses on it."""
    gap: np.ndarray
    """[m] to the geom of the wire."""
    stiffness: np.ndarray
    """[N/m] Of several that press on one wire, what is left for each."""
    shift: np.ndarray
    """[m] Gap to where the wire would be without the contact's force, less that to its geom."""
    geom: np.ndarray
    """[contact, 3] m, where the geom is there, from where it was drawn."""
    place: np.ndarray
    """[contact, 3] m, where the wire is there under the forces of the last step, from where it was drawn."""
    last_force: np.ndarray
    """[N] with which it pressed in the last step."""
    weight: np.ndarray
    """[N] the mean of that over :data:`MEMORY`."""
    others: np.ndarray
    """[m] along the normal, by which the others deflect the wire there; mean over the same time."""
    key: np.ndarray
    """Number of the pair of shapes."""


@dataclasses.dataclass(frozen=True)
class _Presses:
    """What presses on wires. [press] unless said otherwise."""

    piece: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    """[press, 3] from the wire."""
    place: np.ndarray
    """[press, 3] m, where the wire is there, from where it was drawn."""
    pressure: np.ndarray
    """[N] along the normal, as expected in the next step."""
    weight: np.ndarray
    """[N] mean of it over :data:`MEMORY`."""
    others: np.ndarray
    """[m] See :class:`WireSprings`."""
    key: np.ndarray
    owner: np.ndarray
    """The tree that presses, or -1 less the kinematic tree of the rigid world."""

    def where(self, mask: np.ndarray) -> _Presses:
        """Some of them."""
        return _Presses(**{field.name: getattr(self, field.name)[mask] for field in dataclasses.fields(self)})


_NO_PRESSES = _Presses(
    _NONE, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0), _NONE, _NONE
)


class DeflectedWires:
    """The wires of one model."""

    def __init__(self, model: Model, supports: ElasticSupports, dt: float) -> None:
        self._supports, self._dt = supports, dt
        self._recovery, self._forgetting = math.exp(-dt / WIRE_DAMPING_TIME), dt / MEMORY
        self.gives = model.fixed_tension > 0.0
        """[piece] Whether it is a wire under tension."""
        self.start, self.end = model.fixed_start.astype(float), model.fixed_end.astype(float)
        way = self.end - self.start
        self._length = np.linalg.norm(way, axis=1)
        self._axis = way / np.maximum(self._length, 1e-9)[:, None]
        self.offset = np.zeros((len(way), 2, 3))
        """[piece, 2, 3] m by which the start and the end of its geom are away from where they were drawn."""
        self.deflected = _NONE
        """Pieces [k] whose offset is not 0, sorted."""
        self._found: list[_Presses] = []
        self._presses = _NO_PRESSES

    # ------------------------------------------------------------------ within a step

    def find_springs(
        self, piece: np.ndarray, point: np.ndarray, normal: np.ndarray, gap: np.ndarray, closing: np.ndarray,
        key: np.ndarray,
    ) -> WireSprings:  # fmt: skip
        """The springs of contacts with wires.

        Args:
            piece: [k] which fixed pieces; all must give.
            point: [k, 3] m.
            normal: [k, 3] from the wire to the other side.
            gap: [k] m to the geom of the wire.
            closing: [k] m/s, how fast the gap would get smaller without the contacts.
            key: [k] number of the pair of shapes, the same in the next step.
        """
        length = self._length[piece]
        along = np.clip(((point - self.start[piece]) * self._axis[piece]).sum(1), 0.0, length)
        stiffness, rest, deflection = self._supports.wire_springs(piece, along)
        share = along / np.maximum(length, 1e-9)
        geom = (1.0 - share)[:, None] * self.offset[piece, 0] + share[:, None] * self.offset[piece, 1]
        own = self._last_presses(key, along)
        before = self._presses
        force, weight, mean = (
            np.where(own >= 0, np.append(values, 0.0)[own], 0.0)
            for values in (before.pressure, before.weight, before.others)
        )
        is_new = (own < 0) & (gap - self._dt * closing < TOUCHING)
        for k in np.flatnonzero(own < 0).tolist():  # taken to press as hard as any
            weight[k] = before.weight[before.piece == piece[k]].max(initial=1e-9)
        stiffness = stiffness / self._sharers(piece, share, normal, weight, own, is_new)
        now = (deflection * normal).sum(1) + force / stiffness  # by the others, and by the force shared with them
        mean = np.where(own >= 0, mean + self._forgetting * (now - mean), now)
        others = FOLLOWED * now + (1.0 - FOLLOWED) * mean
        shift = ((geom - rest) * normal).sum(1) - others
        shift[gap > TOUCHING] = 0.0  # another holds the wire off it
        # with its axis inside a box, the nearest way out may be along it, where a wire does not push
        shift[np.abs((normal * self._axis[piece]).sum(1)) > MOST_ALONG] = OUT_OF_REACH
        return WireSprings(
            piece, along, normal, gap, stiffness, shift, geom, rest + deflection, force, weight, mean, key
        )

    def _last_presses(self, key: np.ndarray, along: np.ndarray) -> np.ndarray:
        """[k] which press of the last step each contact was: of those with its key the nearest; -1 if it is new."""
        before = self._presses
        if len(before.key) == 0:
            return np.full(len(key), -1)
        same = (key[:, None] == before.key) & (before.pressure > 0.0)
        distance = np.where(same, np.abs(along[:, None] - before.along), np.inf)
        return np.where(distance.min(1) < SAME_PLACE, distance.argmin(1), -1)

    def _sharers(
        self, piece: np.ndarray, share: np.ndarray, normal: np.ndarray, weight: np.ndarray, own: np.ndarray,
        is_new: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """By how much less stiff a wire is taken to be for each contact [k] than for it alone: the sum of its
        deflections there by all that press, over that by the contact itself, as of a string without ties.

        What the others in fact do follows from the forces of the last step. With springs as soft as that, these forces
        converge: the sums of the rows of a matrix of compliances, weighed by any positive numbers, bound its
        eigenvalues. The weights are means of forces over some time: what follows the forces themselves feeds swings.
        """
        before = self._presses
        pieces, sides = np.append(before.piece, piece[is_new]), np.concatenate([before.normal, normal[is_new]])
        there = before.along / np.maximum(self._length[before.piece], 1e-9)
        x, y = share[:, None], np.append(there, share[is_new])
        here = np.clip(x, 1e-3, 1.0 - 1e-3)
        ratio = np.clip(np.where(y > x, (1.0 - y) / (1.0 - here), y / here), 0.0, 1.0)
        weights = (piece[:, None] == pieces) * np.append(before.weight, weight[is_new])
        least = LEAST_WEIGHT * np.maximum(weights.max(1, initial=0.0), weight)[:, None] + 1e-9
        at = np.where(is_new, len(before.piece) + np.cumsum(is_new) - 1, own)
        weights[at >= 0, at[at >= 0]] = 0.0
        return 1.0 + (weights / np.maximum(weight[:, None], least) * ratio * np.abs(normal @ sides.T)).sum(1)

    def add_presses(self, springs: WireSprings, force: np.ndarray, velocity: np.ndarray, owner: np.ndarray) -> None:
        """Note what a solve has found.

        Args:
            springs: of its contacts.
            force: [contact] N with which they press, 0 for those that are near only.
            velocity: [contact] m/s along the normal, of what presses, at the end of the step.
            owner: [contact] the tree that presses, or -1 less the kinematic tree of the rigid world.
        """
        moved = (springs.gap + self._dt * velocity)[:, None] * springs.normal
        place = np.where((force > 0.0)[:, None], springs.geom + moved, springs.place)
        pressure = np.where(force > 0.0, np.maximum(force + EXTRAPOLATED * (force - springs.last_force), 0.0), 0.0)
        weight = springs.weight + self._forgetting * (force - springs.weight)
        weight = np.where(springs.last_force > 0.0, weight, np.maximum(springs.weight, force))
        weight[force <= 0.0] = 0.0
        self._found.append(
            _Presses(
                springs.piece, springs.along, springs.normal, place, pressure, weight, springs.others, springs.key,
                owner,
            )
        )  # fmt: skip

    def end_step(self, tree_awake: np.ndarray, rigid_asleep: np.ndarray) -> None:
        """Move the geoms after what presses on them, let go those that nothing presses on, and load the supports.

        Args:
            tree_awake: [tree] What sleeps presses on as it did.
            rigid_asleep: [kinematic tree] not negative while it sleeps.
        """
        before = self._presses
        if not self._found and len(before.piece) == 0 and len(self.deflected) == 0:
            return
        if len(before.piece):
            of_tree, count = before.owner >= 0, len(rigid_asleep)
            sleeps = np.zeros(len(of_tree), bool)
            sleeps[of_tree] = ~tree_awake[before.owner[of_tree]]
            number = -1 - before.owner[~of_tree]
            sleeps[~of_tree] = (number < count) & (rigid_asleep[np.minimum(number, count - 1)] >= 0)
            self._found.append(before.where(sleeps))
        self._presses = now = _concatenate(self._found)
        self._found = []
        self._supports.set_loads(now.piece, now.along, -now.pressure[:, None] * now.normal)
        self._place(now)

    def forget_rigid(self) -> None:
        """The rigid world was compiled anew: its kinematic trees have other numbers."""
        self._presses = self._presses.where(self._presses.owner >= 0)

    def _place(self, presses: _Presses) -> None:
        held = np.unique(presses.piece)
        let_go = np.setdiff1d(self.deflected, held, assume_unique=True)
        self.offset[let_go] *= self._recovery
        for piece in held.tolist():
            of = presses.piece == piece
            self.offset[piece] = _rod_through(
                presses.along[of] / self._length[piece], presses.place[of], presses.pressure[of]
            )
        moved = np.concatenate([held, let_go]).astype(int)
        size = np.linalg.norm(self.offset[moved], axis=2, keepdims=True)
        self.offset[moved] *= np.minimum(1.0, MAX_DEFLECTION / np.maximum(size, 1e-12))
        at_rest = size.max(axis=(1, 2)) < LEAST_DEFLECTION
        self.offset[moved[at_rest]] = 0.0
        self.deflected = np.sort(moved[~at_rest])


def _rod_through(share: np.ndarray, place: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Displacements [2, 3] m of the ends of a rod that passes through points displaced to ``place`` [k, 3] m at a
    ``share`` [k] of its length; if these are too near each other, that of their mean by ``weight`` [k]."""
    if weight.any():
        share, place, weight = share[weight > 0.0], place[weight > 0.0], weight[weight > 0.0]
    else:
        weight = np.ones(len(share))
    first, last = int(np.argmin(share)), int(np.argmax(share))
    spread = share[last] - share[first]
    if spread < LEAST_SPREAD:
        return np.broadcast_to((weight[:, None] * place).sum(0) / weight.sum(), (2, 3))
    slope = (place[last] - place[first]) / spread
    return place[first] + (np.array([[0.0], [1.0]]) - share[first]) * slope


def _concatenate(parts: list[_Presses]) -> _Presses:
    if not parts:
        return _NO_PRESSES
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in dataclasses.fields(_Presses)]
    return _Presses(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
