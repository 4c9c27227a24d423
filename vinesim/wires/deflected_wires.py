"""Wires that deflect under contacts: the spring behind each contact, and the positions of the wires' geoms.

A wire is modelled without mass (see :mod:`vinesim.wires.elastic_supports`). So a contact with a wire is a contact with
a spring that has the wire's stiffness across the wire. The contact solver and MuJoCo both treat this spring implicitly,
as they do any contact. The wire's geom follows the deflection, so that normals and closest points belong to the
deflected wire. The deflection of a contact's spring is measured from the position that the wire would have without that
contact's force.

Several contacts share a wire. The spring of each contact is softer than the wire alone by a factor: the deflection at
the contact by all contacts, divided by the deflection by this contact alone, both computed for a string without ties.
The actual deflection by the other contacts is computed from the forces of the last step. With springs that are this
much softer, the forces converge over the steps, because the weighted row sums of a compliance matrix, for any positive
weights, bound its eigenvalues. The weights are mean forces over the time :data:`MEMORY`; present forces as weights
would excite oscillations.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.wires import wire_contacts as kernels
from vinesim.scene.model import Model
from vinesim.wires.elastic_supports import LEAST_SHARE, WIRE_DAMPING_TIME, ElasticSupports

MAX_DEFLECTION = 0.25
"""[m] Largest displacement of a wire's geom. Beyond it the wire's spring still acts on a contact. TUNED: far beyond the
range in which the law of a taut string holds."""
LEAST_DEFLECTION = 1e-6
"""[m] Deflection below which a wire is set to its undeflected position."""
LEAST_SPREAD = 0.1
"""[1] Distance between contacts, as a share of the wire's length, above which their deflections also tilt the wire's
geom. Below it they only translate the geom. TUNED."""
FOLLOWED = 0.7
"""[1] Weight of the present deflection by the forces of other contacts on the same wire. The mean of this deflection
over :data:`MEMORY` has the remaining weight. DERIVED: the largest share for which a mass on two such springs is stable,
whatever its mass, with a wire's damping."""
EXTRAPOLATED = 0.5
"""[steps] Time by which the present deflection in :data:`FOLLOWED` is extrapolated. DERIVED together with
:data:`FOLLOWED`."""
MEMORY = 0.5
"""[s] Time constant of the mean forces by which several contacts share a wire. TUNED."""
LEAST_WEIGHT = 0.05
"""[1] Smallest weight of a contact when several contacts share a wire, relative to the largest weight. TUNED."""
TOUCHING = 1e-3
"""[m] Gap to the geom of a wire above which a contact does not touch the wire, whatever deflection other contacts
cause. TUNED."""
MAX_NORMAL_ALONG_WIRE = 0.5
"""[1] Largest cosine between the normal of a contact and the wire. A contact with a larger cosine, as when the wire's
axis is inside the other shape, is ignored."""
OUT_OF_REACH = 1e3
"""[m] Shift of the wire that is assumed for an ignored contact, so that the contact exerts no force."""
SAME_PLACE = 0.05
"""[m] Distance up to which contacts of the same pair of shapes in two successive steps are the same contact. TUNED:
shorter than any box, longer than any sliding distance in a step."""
ROOM = 32
MAX_PRESSES = 512
"""Largest number of presses (forces of contacts on wires) that are stored, of plants and rigid bodies together.

``ROOM``: initial capacity for contacts with wires in one solve.
"""
NO_TREE = int(np.iinfo(np.int32).min)
"""Value of a press's tree if the press (force on a wire) ends with the step, because the pressing shape was removed or
moved elsewhere.
"""


class DeflectedWires:
    """The wires of one model, and the contacts that press on them."""

    def __init__(self, model: Model, supports: ElasticSupports, tree_awake: np.ndarray, dt: float) -> None:
        """``tree_awake``: [tree] whether each tree is awake. A sleeping tree keeps pressing on wires with its last
        force."""
        self._supports = supports
        self.is_compliant = model.fixed_tension > 0.0
        """[piece] Whether the piece is a wire under tension."""
        self.start = model.fixed_start.astype(float)
        self.end = model.fixed_end.astype(float)
        way = self.end - self.start
        count = len(self.start)
        self.offset = np.zeros((count, 2, 3))
        """[piece, 2, 3] m Displacement of the start and the end of each piece's geom from their undeflected
        positions."""
        axis = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
        self._geoms = SharedArrays.zeros(
            kernels.WireGeoms, count, start=self.start, axis=axis, offset=self.offset, count=np.zeros(2, np.int32)
        )
        self.presses, self._found = (
            SharedArrays.zeros(kernels.WirePresses, MAX_PRESSES, count=np.zeros(1, np.int32)) for _ in range(2)
        )
        self._numbers = _numbers(dt)
        self._load = share(supports.load, wp.vec3d)
        self._tree_awake = share(tree_awake, wp.bool)
        self._is_loaded = share(np.zeros(supports.count, np.bool_), wp.bool)
        self.renumber_rigid(lambda _: (0, NO_TREE), 0)

    @property
    def geoms(self) -> kernels.WireGeoms:
        """The wires as shapes for collision detection."""
        return self._geoms.struct

    @property
    def deflected(self) -> np.ndarray:
        """Pieces [k] whose offset is not 0; a view that the next step overwrites."""
        return self._geoms.deflected[: self._geoms.count[0]]

    @property
    def energy(self) -> float:
        """[J] Elastic energy of wires and ties beyond the energy that :func:`vinesim.api.energy.energy` counts for the
        ties, which is that of wires of their present, constant tension: half the sum of force times displacement for
        the contacts that press on the wires, less what wires save whose tension has grown with their length."""
        presses = self.presses
        count = int(presses.count[0])
        force = -presses.pushed[:count, None] * presses.normal[:count]
        total = -self._supports.tightening
        for j in np.flatnonzero(presses.pushed[:count] > 0.0):
            on_it = presses.piece[:count] == presses.piece[j]
            moved = self._supports.deflection_at(
                int(presses.piece[j]), float(presses.along[j]), presses.along[:count][on_it], force[on_it]
            )
            total += 0.5 * float(force[j] @ moved)
        return total

    def bind(self, contacts: SharedArrays) -> tuple[KernelGraph, KernelGraph]:
        """Returns two kernel graphs: the first finds the springs of ``contacts``, the second stores the contacts that
        press on a wire."""
        wires, nodes, bodies, springs = self._supports.wire_structs
        find = KernelLaunch(
            kernels.find_wire_springs,
            [self._numbers, wires, nodes, self._geoms.struct, bodies, springs, self._load, self.presses.struct],
            [contacts.struct],
            threads=1,
        )
        add = KernelLaunch(kernels.add_presses, [self._numbers, contacts.struct], [self._found.struct], threads=1)
        return KernelGraph(find), KernelGraph(add)

    def end_step(self, rigid_asleep: np.ndarray) -> None:
        """Update the positions of the wires' geoms at the end of a step, and pass the contact forces on wires to the
        elastic supports.

        The geom of a wire with contacts is displaced as the contacts deflect the wire. The displacement of a wire
        without contacts decays over the following steps. ``rigid_asleep``: [kinematic tree] MuJoCo's ``tree_asleep``,
        which is negative while the kinematic tree is awake.
        """
        if not (self._found.count[0] or self.presses.count[0] or self._geoms.count[0]):
            return
        self._rigid_asleep[:] = rigid_asleep
        self._deflect()
        self._supports.set_loaded(self._geoms.loaded[: self._geoms.count[1]])

    def release(self, trees: np.ndarray) -> None:
        """Remove the presses (stored forces on wires) of sleeping trees [k] that were moved to another pose. These
        trees press on no wire until they wake.
        """
        self.presses.tree[np.isin(self.presses.tree, trees)] = NO_TREE

    def renumber_rigid(self, numbers: Callable[[int], tuple[int, int]], trees: int) -> None:
        """Write new keys and trees to the stored forces on wires (presses) after the rigid world was recompiled.

        ``numbers`` maps the old key of a pair of shapes to the new key and the new tree, which is :data:`NO_TREE` if
        the shape was removed. ``trees``: new number of kinematic trees.
        """
        presses = self.presses
        for k in np.flatnonzero(presses.tree[: presses.count[0]] < 0).tolist():
            presses.key[k], presses.tree[k] = numbers(int(presses.key[k]))
        self._rigid_asleep = np.full(trees, -1, np.int32)
        deflect = KernelLaunch(
            kernels.deflect_wires,
            [self._numbers, *self._supports.wire_structs[:2], self._tree_awake, share(self._rigid_asleep, wp.int32)],
            [
                self._found.struct,
                self.presses.struct,
                self._load,
                self._is_loaded,
                self._geoms.struct,
                *self._supports.tension_arrays,
            ],
            threads=1,
        )
        self._deflect = KernelGraph(deflect)


class WireContacts:
    """The contacts with wires in the last solve of one solver (plants or rigid bodies)."""

    def __init__(self, wires: DeflectedWires) -> None:
        self._wires = wires
        self._make_room(ROOM)

    def _make_room(self, room: int) -> None:
        self._arrays = SharedArrays.zeros(kernels.WireContacts, room, count=np.zeros(1, np.int32))
        self._find, self._add = self._wires.bind(self._arrays)

    def __len__(self) -> int:
        return int(self._arrays.count[0])

    @property
    def stiffness(self) -> np.ndarray:
        """[contact] N/m Stiffness of each contact's spring. If several contacts press on one wire, each has a share of
        the wire's stiffness."""
        return self._arrays.stiffness[: len(self)]

    @property
    def shift(self) -> np.ndarray:
        """[contact] m Gap between the other shape and the position of the wire without this contact's force, minus the
        gap to the wire's geom."""
        return self._arrays.shift[: len(self)]

    @property
    def key(self) -> np.ndarray:
        """[contact] Number of the pair of shapes in contact."""
        return self._arrays.key[: len(self)]

    def find_springs(
        self,
        piece: np.ndarray,
        point: np.ndarray,
        normal: np.ndarray,
        gap: np.ndarray,
        closing: np.ndarray,
        key: np.ndarray,
        tree: np.ndarray,
    ) -> None:
        """Find the springs of contacts with wires. Poses of awake trees must be up to date.

        Args:
            piece: [k] index of the fixed piece; all must be wires under tension.
            point: [k, 3] m, contact point.
            normal: [k, 3] unit vector from the wire to the other shape.
            gap: [k] m, distance from the other shape to the wire's geom.
            closing: [k] m/s, rate at which the gap would shrink without the contacts.
            key: [k] number of the pair of shapes, the same in the next step.
            tree: [k] the tree that presses, or -1 minus the number of the kinematic tree of the rigid world.
        """
        count = len(piece)
        if count > len(self._arrays.piece):
            self._make_room(2 * count)
        a = self._arrays
        a.piece[:count] = piece
        a.point[:count] = point
        a.normal[:count] = normal
        a.gap[:count] = gap
        a.closing[:count] = closing
        a.key[:count] = key
        a.tree[:count] = tree
        a.count[0] = count
        self._find()

    def add_presses(self, force: np.ndarray, velocity: np.ndarray) -> None:
        """Store the contacts that press on wires, with the forces and velocities that the contact solve has found.

        Args:
            force: [contact] N, normal force; 0 for contacts that are near but do not press.
            velocity: [contact] m/s, velocity of the pressing shape along the normal at the end of the step.
        """
        self._arrays.force[: len(self)], self._arrays.velocity[: len(self)] = force, velocity
        self._add()


def _numbers(dt: float) -> kernels.WireNumbers:
    made = kernels.WireNumbers()
    made.dt = dt
    made.followed = FOLLOWED
    made.extrapolated = EXTRAPOLATED
    made.forgetting = dt / MEMORY
    made.recovery = math.exp(-dt / WIRE_DAMPING_TIME)
    made.least_weight = LEAST_WEIGHT
    made.least_share = LEAST_SHARE
    made.least_spread = LEAST_SPREAD
    made.least_deflection = LEAST_DEFLECTION
    made.max_deflection = MAX_DEFLECTION
    made.touching = TOUCHING
    made.same_place = SAME_PLACE
    made.max_normal_along_wire = MAX_NORMAL_ALONG_WIRE
    made.out_of_reach = OUT_OF_REACH
    return made
