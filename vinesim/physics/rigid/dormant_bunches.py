"""Bunches that lie where nobody is near: known and drawn, and without a body until somebody comes.

Whoever joins late learns of a thousand bunches at once that others have picked. A body for each would cost milliseconds
to make and something in every tick; a row here costs nothing until :meth:`Lying.embody` makes it a body.
"""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.physics.contact.contact_solver import ContactSolver
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.plants.detachment import STUB_MASS
from vinesim.physics.rigid.free_bunch import FreeBunch
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.rigid.support_tracking import SupportTracker
from vinesim.scene.ids import Organ
from vinesim.scene.values import RigidVisual

NEAR = 2.5
"""[m] A bunch gets its body when an actor is so near on the ground plan: seconds before an arm reaches it."""


class DormantBunches:
    """Picked bunches without bodies, each at a pose in the frame of its parent."""

    def __init__(
        self, plants: ArticulationSolver, rigid: RigidWorld, contact_solver: ContactSolver, riding: SupportTracker
    ) -> None:
        self.plants, self.rigid, self.contact_solver, self.riding = plants, rigid, contact_solver, riding
        self._loose: dict[int, FreeBunch] = {}
        self._parent: dict[int, str] = {}
        self._relative: dict[int, np.ndarray] = {}
        self._links: tuple[RigidVisual, ...] | None = ()
        self._groups: list[tuple[str, np.ndarray, np.ndarray]] = []
        shapes = contact_solver.capsules
        fruit = np.flatnonzero((plants.model.body_organ[shapes.body] == int(Organ.BUNCH)) & (shapes.level != 2))
        self._shape = fruit[np.argsort(shapes.bunch[fruit], kind="stable")]
        self._first = np.searchsorted(shapes.bunch[self._shape], np.arange(len(plants.model.bunch_body) + 1))

    def __contains__(self, bunch: int) -> bool:
        return bunch in self._loose

    def __len__(self) -> int:
        return len(self._loose)

    def add(self, bunches: list[int], parents: list[str], poses: np.ndarray) -> None:
        """Take bunches off their vines at once, wherever those are, and let them lie: ``poses`` [k, 7] in the frames
        of their parents. What lies already is moved.
        """
        plants, model = self.plants, self.plants.model
        new = [bunch for bunch in bunches if bunch not in self._loose]
        if new:
            bodies = model.bunch_body[new]
            plants.coarsen(np.unique(model.body_tree[bodies]))
            columns = (plants.body_mass, plants.body_com, plants.body_inertia, plants.body_product)
            rows = zip(new, *(column[bodies].astype(float) for column in columns), strict=True)
            shapes = self.contact_solver.capsules
            for bunch, mass, com, inertia, product in rows:
                of = self._shape[self._first[bunch] : self._first[bunch + 1]]
                start, end, radius = (column[of].astype(float) for column in (shapes.start, shapes.end, shapes.radius))
                self._loose[bunch] = FreeBunch(float(mass), com, inertia, product, start, end, radius)
            plants.state.bunch_attached[new] = False
            plants.body_drag[bodies] = 0.0
            for body in bodies.tolist():
                plants.set_mass(body, STUB_MASS)
        for bunch, parent, pose in zip(bunches, parents, poses, strict=True):
            self._parent[bunch], self._relative[bunch] = parent, np.asarray(pose, float)
        self._links = None

    def activate(self, bunches: list[int]) -> None:
        """Give some bunches their bodies, where they lie."""
        if bunches:
            there = {bunch: self._where(bunch) for bunch in bunches}
            self.rigid.add_bunches({bunch: (self._loose.pop(bunch), *there[bunch]) for bunch in bunches})
            for bunch in bunches:
                del self._parent[bunch], self._relative[bunch]
            self._links = None

    def _where(self, bunch: int) -> tuple[np.ndarray, np.ndarray]:
        there = self.riding.to_world(self._parent[bunch], self._relative[bunch])
        return (self._relative[bunch], np.zeros(6)) if there is None else there

    def nearest(self, actors: np.ndarray, most: int) -> list[int]:
        """At most so many bunches, nearest to one of some actors [k, 3] m, that are near enough to want a body."""
        if not self._loose or not len(actors):
            return []
        away = np.linalg.norm(self.visual_q()[:, None, :2] - actors[None, :, :2], axis=-1).min(1)
        links = self.visuals()
        return [links[i].index for i in np.argsort(away, kind="stable")[:most].tolist() if away[i] < NEAR]

    def visuals(self) -> tuple[RigidVisual, ...]:
        """As :meth:`Rigid.links`."""
        if self._links is None:
            order = sorted(self._loose)
            self._links = tuple(RigidVisual(f"bunch/{i}", Organ.BUNCH, i, self._loose[i].shapes) for i in order)
            parents = np.array([self._parent[i] for i in order])
            poses = np.array([self._relative[i] for i in order]).reshape(-1, 7)
            here = [(str(parent), np.flatnonzero(parents == parent)) for parent in np.unique(parents)]
            self._groups = [(parent, rows, poses[rows]) for parent, rows in here]
        return self._links

    def visual_q(self) -> np.ndarray:
        """Poses [link, 7] of :meth:`links`."""
        pose = np.zeros((len(self.visuals()), 7))
        for parent, rows, relative in self._groups:
            frame = self.riding.support_state(parent)
            pose[rows] = relative if frame is None else frames.compose(frame[0], relative)
        return pose
