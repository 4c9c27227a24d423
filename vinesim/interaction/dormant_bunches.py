"""Dormant free bunches: picked bunches that are drawn, but have no body in the physics while no actor is near.

A client that joins late is informed of a thousand picked bunches at once. Creating a body for each would take
milliseconds, and time in every step. A dormant bunch costs nothing until :meth:`DormantBunches.activate`.
"""

from __future__ import annotations

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.interaction.detachment import STUB_MASS
from vinesim.interaction.stalk import leave_stump, stalk_below, with_settled_stalk
from vinesim.interaction.support_tracking import SupportTracker
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import Organ
from vinesim.scene.values import RigidVisual


class DormantBunches:
    """Picked bunches without bodies. Each bunch has a pose in the frame of its support (ground, box or link of a
    robot).
    """

    def __init__(
        self, plants: ArticulationSolver, rigid: RigidWorld, contact_solver: ContactSolver, supports: SupportTracker
    ) -> None:
        self.plants = plants
        self.rigid = rigid
        self.contact_solver = contact_solver
        self.supports = supports
        self._bunches: dict[int, FreeBunch] = {}
        self._support: dict[int, str] = {}
        self._relative: dict[int, np.ndarray] = {}
        self._passed: dict[int, tuple[int, ...]] = {}
        """Trees that each bunch passes through; see :meth:`ContactSolver.pass_through`."""
        self._place: dict[int, np.ndarray] = {}
        """World pose [7] of each bunch, which is used while the bunch's support does not exist."""
        self._visuals: tuple[RigidVisual, ...] | None = ()
        self._groups: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]] = []
        """One entry for each support (ground, box or link of a robot) with dormant bunches on it: name of the support;
        rows [k] of these bunches in :meth:`visuals`; their poses [k, 7] in the support's frame; their world poses [k,
        7], for the time in which the support does not exist.
        """
        capsules = contact_solver.capsules
        of_bunches = np.flatnonzero(
            (plants.model.body_organ[capsules.body] == int(Organ.BUNCH)) & (capsules.level != 2)
        )
        self._capsules = of_bunches[np.argsort(capsules.bunch[of_bunches], kind="stable")]
        self._first = np.searchsorted(capsules.bunch[self._capsules], np.arange(len(plants.model.bunch_body) + 1))

    def __contains__(self, bunch: int) -> bool:
        return bunch in self._bunches

    def __len__(self) -> int:
        return len(self._bunches)

    def add(
        self,
        bunches: list[int],
        supports: list[str],
        poses: np.ndarray,
        places: np.ndarray | None = None,
        passed: list[tuple[int, ...]] | None = None,
    ) -> None:
        """Add picked bunches, or move them.

        ``poses`` [k, 7]: poses in the frames of the ``supports`` (names). ``places`` [k, 7]: world poses while a
        support does not exist; default ``poses``. ``passed``: trees that each bunch passes through, as
        :meth:`ContactSolver.passed_by` returns them; default none. Bunches that still hang are removed from their
        vines, which are not woken.
        """
        plants = self.plants
        model = self.plants.model
        new = [bunch for bunch in bunches if bunch not in self._bunches]
        if new:
            bodies = model.bunch_body[new]
            plants.coarsen(np.unique(model.body_tree[bodies]))
            columns = (plants.body_mass, plants.body_com, plants.body_inertia, plants.body_product)
            rows = zip(new, *(column[bodies].astype(float) for column in columns), strict=True)
            capsules = self.contact_solver.capsules
            for bunch, mass, com, inertia, product in rows:
                of = self._capsules[self._first[bunch] : self._first[bunch + 1]]
                start, end, radius = (
                    column[of].astype(float) for column in (capsules.start, capsules.end, capsules.radius)
                )
                self._bunches[bunch] = FreeBunch(float(mass), com, inertia, product, start, end, radius)
            plants.state.bunch_attached[new] = False
            plants.body_drag[bodies] = 0.0
            for body in bodies.tolist():
                plants.set_mass(body, STUB_MASS)
            for bunch in new:
                self.restore_stalk(bunch)
        places = poses if places is None else places
        for bunch, support, pose, place in zip(bunches, supports, poses, places, strict=True):
            self._support[bunch] = support
            self._relative[bunch] = np.asarray(pose, float)
            self._place[bunch] = np.asarray(place, float)
        self._passed |= dict(zip(bunches, [()] * len(bunches) if passed is None else passed, strict=True))
        self._visuals = None

    def restore_stalk(self, bunch: int) -> None:
        """Give a dormant bunch the stalk that ``State.cut_segment`` names, if it names one."""
        state = self.plants.state
        segment = int(state.cut_segment[bunch])
        if bunch in self._bunches and segment >= 0:
            model = self.plants.model
            at = float(state.cut_at[bunch])
            leave_stump(self.plants, self.contact_solver, stalk_below(model, bunch, segment), at)
            self._bunches[bunch] = with_settled_stalk(model, bunch, self._bunches[bunch], segment, at)
            self._visuals = None

    def activate(self, bunches: list[int]) -> None:
        """Create MuJoCo bodies for ``bunches``, at their present poses and with the velocities of their supports."""
        if bunches:
            states = {bunch: self._world_state(bunch) for bunch in bunches}
            self.rigid.add_bunches({bunch: (self._bunches.pop(bunch), *states[bunch]) for bunch in bunches})
            for bunch in bunches:
                self.contact_solver.pass_through(bunch, self._passed.pop(bunch))
                del self._support[bunch], self._relative[bunch], self._place[bunch]
            self._visuals = None

    def _world_state(self, bunch: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the world pose [7] and velocity [6] of a dormant bunch."""
        state = self.supports.to_world(self._support[bunch], self._relative[bunch])
        return (self._place[bunch], np.zeros(6)) if state is None else state

    def nearest(self, actors: np.ndarray, most: int) -> list[int]:
        """Returns at most ``most`` bunches within ``dormant_radius`` of one of the ``actors`` [k, 3] m, the nearest
        first."""
        if not self._bunches or not len(actors):
            return []
        distance = np.linalg.norm(self.visual_q()[:, None, :2] - actors[None, :, :2], axis=-1).min(1)
        visuals = self.visuals()
        radius = self.rigid.parameters.dormant_radius
        return [visuals[i].index for i in np.argsort(distance, kind="stable")[:most].tolist() if distance[i] < radius]

    def visuals(self) -> tuple[RigidVisual, ...]:
        """Returns the visible shapes of all dormant bunches, as in :meth:`RigidWorld.visuals`."""
        if self._visuals is None:
            order = sorted(self._bunches)
            self._visuals = tuple(
                RigidVisual(f"bunch/{i}", Organ.BUNCH, i, self._bunches[i].shapes, self._bunches[i].stalk)
                for i in order
            )
            supports = np.array([self._support[i] for i in order])
            poses = np.array([self._relative[i] for i in order]).reshape(-1, 7)
            rows_on = [(str(support), np.flatnonzero(supports == support)) for support in np.unique(supports)]
            places = np.array([self._place[i] for i in order]).reshape(-1, 7)
            self._groups = [(support, rows, poses[rows], places[rows]) for support, rows in rows_on]
        return self._visuals

    def visual_q(self) -> np.ndarray:
        """Returns the world poses [visual, 7] of the dormant bunches, in the order of :meth:`visuals`."""
        pose = np.zeros((len(self.visuals()), 7))
        for support, rows, relative, place in self._groups:
            frame = self.supports.support_state(support)
            pose[rows] = place if frame is None else frames.compose(frame[0], relative)
        return pose
