"""Forces of a second client's actor on a tree: sends them to the client that owns the tree.

The second actor's client simulates its contacts with its copy of the tree. It sends each contact as a virtual coupling:
a spring of fixed stiffness whose anchor is chosen so that the spring applies the contact force at the copy's pose. The
owner's client holds the body with this spring and a damper, solved implicitly with the plant like a person's hand. If
copy and tree agree, the spring applies the contact force. If they differ, as after a delay, the spring pulls them
together. A force alone would not do that: fed back through two delays, errors grow
(``docs/decisions/forces-between-clients.md``). Sources: virtual coupling, J. E. Colgate et al., 1995; damping for
stable delayed springs, E. Nuno et al., 2009.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np

from vinesim.core import frames
from vinesim.net.codec.forces import Coupling
from vinesim.plants.ties import TieLimitError
from vinesim.world import Physics

STIFFNESS = 300.0
"""Stiffness of a coupling [N/m]. All clients must use the same value, because anchors are computed from it."""

DAMPING = 20.0
"""Damping of a coupling [N s/m]. Stability for a delay of 0.1 s needs 30 (stiffness times delay), but plants have
damping of their own. TUNED."""

MAX_FORCE = 100.0
"""Largest force of a coupling [N]: the largest force of a hand (CANOPIES D6.4, section 3.1.1)."""

MIN_FORCE = 1e-3
"""Smallest contact force for which a coupling is sent [N]."""

SLIDE = 0.005
"""Distance by which the point of a coupling must slide on its body before the spring is attached at the new point
[m]."""


@dataclasses.dataclass(slots=True)
class _Tie:
    """The solver's tie (spring and damper) that applies one received coupling to a body."""

    tie: int
    point: np.ndarray


class PlantCouplings:
    """Makes the couplings of this client's actors, and applies the couplings that other clients send.

    A coupling (:class:`vinesim.net.codec.forces.Coupling`) is a virtual spring. It stands for the contact of one
    client's actor with a tree that another client simulates, too. This class applies a received coupling as a tie of
    the plant solver: a spring and damper between a point of a body and an anchor in the world.
    """

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        self.refused = 0
        """Number of received couplings that were not applied, because the solver had no free tie. Each is counted
        once."""
        self._ties: dict[tuple[str, int], _Tie] = {}
        self._refused: set[tuple[str, int]] = set()

    @property
    def trees(self) -> set[int]:
        """Indices of the trees on which couplings of other clients' actors act now."""
        return {int(self.physics.model.body_tree[body]) for _, body in self._ties}

    def of_actor(self, actor: str, trees: Collection[int]) -> list[Coupling]:
        """Returns the couplings (virtual springs) to send for an actor of this client.

        There is one coupling for each body that the actor touched in the last step. ``trees``: indices of the trees
        whose contacts count. A contact with a berry cluster counts for the body of its bunch.
        """
        model = self.physics.model
        found = {}
        for contact in self.physics.contacts if trees else ():
            if contact.actor == actor and int(model.body_tree[contact.body]) in trees:
                found.setdefault(self._carrier(contact.body), []).append(contact)
        if not found:
            return []
        self.physics.update_kinematics()
        couplings = []
        for body, contacts in sorted(found.items()):
            force = -sum((contact.force for contact in contacts), np.zeros(3))
            weight = np.array([np.linalg.norm(contact.force) for contact in contacts])
            if weight.sum() < MIN_FORCE:
                continue
            at = weight @ np.array([contact.position for contact in contacts]) / weight.sum()
            force *= min(1.0, MAX_FORCE / max(float(np.linalg.norm(force)), 1e-12))
            pose = self.physics.state.body_q[body].astype(float)
            point = frames.rotate(frames.conjugate(pose[3:]), at - pose[:3])
            couplings.append(Coupling(body, point, at + force / STIFFNESS))
        return couplings

    def apply(self, couplings: Mapping[str, Collection[Coupling]]) -> None:
        """Apply the couplings (virtual springs) that other clients' actors have sent. Call it before every step.

        ``couplings``: the couplings that are valid now, by actor. Springs of couplings that are no longer in it are
        removed.
        """
        if not (couplings or self._ties or self._refused):
            return
        wanted = {
            (actor, coupling.body): coupling
            for actor, theirs in couplings.items()
            for coupling in theirs
            if self._is_attached(coupling.body)
        }
        for key in self._ties.keys() - wanted.keys():
            self._remove(key)
        self._refused &= wanted.keys()
        for key, coupling in wanted.items():
            self._hold(key, coupling)

    def _hold(self, key: tuple[str, int], coupling: Coupling) -> None:
        plants = self.physics.plants
        known = self._ties.get(key)
        if known is not None and np.linalg.norm(coupling.point - known.point) > SLIDE:
            self._remove(key)
            known = None
        if known is None:
            try:
                known = _Tie(plants.add_tie(coupling.body, coupling.point, STIFFNESS, DAMPING), coupling.point)
            except TieLimitError:
                self.refused += key not in self._refused
                self._refused.add(key)
                return
            self._ties[key] = known
        plants.wake(int(self.physics.model.body_tree[coupling.body]))
        pose = self.physics.state.body_q[coupling.body].astype(float)
        at = pose[:3] + frames.rotate(pose[3:], known.point)
        pull = coupling.anchor - at
        reach = MAX_FORCE / STIFFNESS
        plants.tie_anchor[known.tie] = at + pull * min(1.0, reach / max(float(np.linalg.norm(pull)), 1e-12))

    def _remove(self, key: tuple[str, int]) -> None:
        self.physics.plants.remove_tie(key[1], self._ties.pop(key).tie)

    def _carrier(self, body: int) -> int:
        """Returns the index of the bunch's body if ``body`` is one of its berry clusters; otherwise ``body`` itself."""
        model = self.physics.model
        tree = int(model.body_tree[body])
        while body - model.tree_first[tree] >= model.tree_core[tree]:
            body = int(model.body_parent[body])
        return body

    def _is_attached(self, body: int) -> bool:
        """Returns whether a body is still part of its plant: False for the body of a picked bunch."""
        bunch = np.flatnonzero(self.physics.model.bunch_body == body)
        return not len(bunch) or bool(self.physics.state.bunch_attached[bunch[0]])
