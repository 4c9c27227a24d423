"""Berry clusters: bunches whose clusters move, or ride locked on their bunch as one compound body.

Locking ends the clusters' motion against their bunch in a plastic impact that lasts no time: the joints take its
impulse through the factors of inertia and springs alone.
"""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np

from vinesim import frames
from vinesim.physics.plants.validation import checked_trees

if TYPE_CHECKING:
    from vinesim.physics.plants.articulation_solver import ArticulationSolver


def spans(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The numbers ``first[i] ... first[i] + count[i] - 1``, one span after the other [sum of count]."""
    end = np.cumsum(count)
    return np.repeat(first - (end - count), count) + np.arange(end[-1] if len(end) else 0)


class BerryClusters:
    """Locks and unlocks the clusters of the bunches of one solver; see :meth:`ArticulationSolver.refine`."""

    def __init__(self, solver: ArticulationSolver) -> None:
        self._solver: ArticulationSolver = weakref.proxy(solver)  # no cycle of references
        model = solver.model
        clustered = np.flatnonzero(model.bunch_clusters > 0)
        tree = model.body_tree[model.bunch_body[clustered]]
        order = np.argsort(tree, kind="stable")
        self.bunches, self._bunch_tree = clustered[order], tree[order]
        """Bunches that have clusters, by tree [k]."""
        self.head_mass, self.head_inertia = model.bunch_head_mass.copy(), model.bunch_head_inertia.copy()
        """[bunch] kg, [bunch, 3] kg m^2 of the part of a bunch that is no cluster."""
        fine = solver.state.tree_fine[self._bunch_tree]
        self.lock(self.bunches[~fine])
        self.unlock(self.bunches[fine])

    def clustered_trees(self, trees: np.ndarray | int, *, fine: bool) -> np.ndarray:
        """Those of some trees that have clusters and are fine or not [k], sorted."""
        model, trees = self._solver.model, np.unique(checked_trees(trees, len(self._solver.state.tree_fine)))
        return trees[(self._solver.state.tree_fine[trees] == fine) & (model.tree_core[trees] < model.tree_size[trees])]

    def clusters_of(self, trees: np.ndarray) -> np.ndarray:
        """The clusters of some trees, as bodies [k]."""
        model = self._solver.model
        core = model.tree_core[trees]
        return spans(model.tree_first[trees] + core, model.tree_size[trees] - core)

    def bunches_of(self, trees: np.ndarray) -> np.ndarray:
        """The bunches of some trees that have clusters [k]."""
        start, end = (np.searchsorted(self._bunch_tree, trees, side=side) for side in ("left", "right"))
        return self.bunches[spans(start, end - start)]

    def refine(self, trees: np.ndarray | int) -> None:
        """See :meth:`ArticulationSolver.refine`."""
        solver, trees = self._solver, self.clustered_trees(trees, fine=False)
        if len(trees) == 0:
            return
        self.unlock(self.bunches_of(trees))
        solver.state.tree_fine[trees] = True
        solver.tree_moving[trees] = solver.model.tree_size[trees]
        solver.state.joint_qd[self.clusters_of(trees)] = 0.0
        solver.forward_kinematics(trees)

    def coarsen(self, trees: np.ndarray | int) -> None:
        """See :meth:`ArticulationSolver.coarsen`."""
        solver, trees = self._solver, self.clustered_trees(trees, fine=True)
        if len(trees) == 0:
            return
        bunches, riding = self.bunches_of(trees), self.clusters_of(trees)
        impulse = self.lock(bunches)
        solver.state.tree_fine[trees] = False
        solver.tree_moving[trees] = solver.model.tree_core[trees]
        solver.state.joint_qd[riding] = 0.0
        solver.velocity_free[riding] = 0.0
        solver.acceleration[riding] = 0.0
        if impulse.any():
            self._apply_impact(trees, solver.model.bunch_body[bunches], impulse)
        solver.forward_kinematics(trees)

    def _apply_impact(self, trees: np.ndarray, bodies: np.ndarray, impulse: np.ndarray) -> None:
        """Change joint rates of trees by impulses [k, 6] N s, N m s on bunches [k], about their origins, in their
        axes."""
        solver, state, launches = self._solver, self._solver.state, self._solver.launches
        solver.forward_kinematics(trees)
        axes = state.body_q[bodies, 3:].astype(float)
        solver.body_impulse[bodies, :3] = frames.rotate(axes, impulse[:, :3])
        solver.body_impulse[bodies, 3:] = frames.rotate(axes, impulse[:, 3:])
        springs = solver.joint_stiffness[bodies], solver.joint_damping[bodies]
        solver.joint_stiffness[bodies], solver.joint_damping[bodies] = 0.0, 0.0
        solver.list_subset(trees)
        launches.changed = True
        launches.upload_changed()
        launches.upload_impact(len(trees))
        launches.factor_impact(len(trees))
        solver.buffers.synchronize()
        solver.joint_stiffness[bodies], solver.joint_damping[bodies] = springs
        launches.changed = True
        moving = spans(solver.model.tree_first[trees], solver.model.tree_core[trees])
        solver.joint_qd_free[moving], solver.joint_xd_free[moving] = state.joint_qd[moving], state.joint_xd[moving]
        launches.upload_impact_rates(len(trees))
        launches.apply_impulses(len(trees))
        launches.download_impact_rates(len(trees))
        solver.buffers.synchronize()
        solver.body_impulse[bodies] = 0.0
        state.joint_qd[moving] = solver.joint_qd_free[moving]
        roots = moving[state.body_cut[moving]]
        state.joint_xd[roots] = solver.joint_xd_free[roots]

    def set_mass(self, body: int, mass: float) -> None:
        """See :meth:`ArticulationSolver.set_mass`."""
        solver, model = self._solver, self._solver.model
        bunches = self.bunches[model.bunch_body[self.bunches] == body]
        parts = spans(model.bunch_cluster[bunches], model.bunch_clusters[bunches])
        whole = solver.body_mass[body]
        if len(bunches):
            whole = self.head_mass[bunches].sum() + solver.body_mass[parts].sum()
        share = mass / float(whole)
        self.head_mass[bunches] *= share
        self.head_inertia[bunches] *= share
        parts = np.append(parts, body)
        solver.body_mass[parts] *= share
        solver.body_inertia[parts] *= share
        solver.body_product[parts] *= share
        solver.launches.changed = True

    def fuse(self, bunch: int) -> np.ndarray:
        """Give one bunch's body the mass of the compound that head and clusters are now, and return the velocity [6]
        m/s, rad/s of its frame, in world axes, with which that compound has the momentum of its parts.

        The state stays as it is: it is for a bunch that leaves its tree, see :meth:`release`. Its poses and
        velocities must be current.
        """
        solver, body = self._solver, int(self._solver.model.bunch_body[bunch])
        pose, velocity = solver.state.body_q[body].astype(float), solver.state.body_qd[body].astype(float)
        if not solver.state.tree_fine[solver.model.body_tree[body]] or solver.model.bunch_clusters[bunch] == 0:
            return velocity
        momentum = self.lock(np.array([bunch]))[0]
        mass, com = float(solver.body_mass[body]), solver.body_com[body].astype(float)
        x, y, z = solver.body_product[body].astype(float)
        tensor = np.diag(solver.body_inertia[body].astype(float)) + np.array([[0, z, y], [z, 0, x], [y, x, 0]])
        spin = np.linalg.solve(tensor, momentum[3:] - np.cross(com, momentum[:3]))
        change = np.stack([momentum[:3] / mass - np.cross(spin, com), spin])
        return velocity + frames.rotate(pose[3:], change).ravel()

    def release(self, bunch: int) -> None:
        """Let the clusters of one bunch of a fine tree move again after :meth:`fuse`."""
        self.unlock(np.array([bunch] if self._solver.model.bunch_clusters[bunch] else [], np.int64))

    def unlock(self, bunches: np.ndarray) -> None:
        """Leave to each bunch's body its head only."""
        solver, model = self._solver, self._solver.model
        bodies = model.bunch_body[bunches]
        solver.body_mass[bodies] = self.head_mass[bunches]
        solver.body_com[bodies] = model.bunch_head_com[bunches]
        solver.body_inertia[bodies] = self.head_inertia[bunches]
        solver.body_product[bodies] = 0.0
        solver.launches.changed = True

    def lock(self, bunches: np.ndarray) -> np.ndarray:
        """Make each bunch's body a compound of head and clusters as they are.

        Returns the momentum of the clusters' motion against it [bunch, 6]: N s, and N m s about its origin, its axes.
        """
        solver, model, state = self._solver, self._solver.model, self._solver.state
        n, bodies = len(bunches), model.bunch_body[bunches]
        most = int(model.bunch_clusters[bunches].max(initial=0))
        here, speed = np.zeros((n, most + 1, 7)), np.zeros((n, most + 1, 6))  # in the bunch's frame; the head first
        here[..., 6] = 1.0
        mass = np.zeros((n, most + 1))
        com, inertia = np.zeros((n, most + 1, 3)), np.zeros((n, most + 1, 3))
        mass[:, 0], com[:, 0], inertia[:, 0] = (
            self.head_mass[bunches], model.bunch_head_com[bunches], self.head_inertia[bunches]
        )  # fmt: skip
        for number in range(most):  # over the clusters of one bunch, a handful
            has = np.flatnonzero(model.bunch_clusters[bunches] > number)
            body = model.bunch_cluster[bunches[has]] + number
            parent = model.body_parent[body]
            above = np.where(parent == bodies[has], 0, parent - model.bunch_cluster[bunches[has]] + 1)
            base, motion = here[has, above], speed[has, above]
            frame = frames.compose(base, frames.pose(model.body_offset[body].astype(float), model.body_rest[body]))
            turn = frames.rotate(frame[:, 3:], state.joint_qd[body].astype(float))
            here[has, number + 1, :3] = frame[:, :3]
            here[has, number + 1, 3:] = frames.multiply(frame[:, 3:], state.joint_q[body].astype(float))
            speed[has, number + 1, :3] = motion[:, :3] + np.cross(motion[:, 3:], frame[:, :3] - base[:, :3])
            speed[has, number + 1, 3:] = motion[:, 3:] + turn
            mass[has, number + 1] = solver.body_mass[body]
            com[has, number + 1], inertia[has, number + 1] = solver.body_com[body], solver.body_inertia[body]
        axes = frames.to_matrix(here[..., 3:])
        tensor = np.einsum("...ij,...j,...kj->...ik", axes, inertia, axes)
        arm = np.einsum("...ij,...j->...i", axes, com)
        linear = mass[..., None] * (speed[..., :3] + np.cross(speed[..., 3:], arm))
        arm += here[..., :3]
        angular = np.cross(arm, linear) + np.einsum("...ij,...j->...i", tensor, speed[..., 3:])
        whole = mass.sum(1)
        center = (mass[..., None] * arm).sum(1) / whole[:, None]
        arm -= center[:, None]
        tensor += mass[..., None, None] * (
            (arm * arm).sum(-1)[..., None, None] * np.eye(3) - arm[..., :, None] * arm[..., None, :]
        )
        tensor = tensor.sum(1)
        solver.body_mass[bodies], solver.body_com[bodies] = whole, center
        solver.body_inertia[bodies] = np.diagonal(tensor, axis1=1, axis2=2)
        solver.body_product[bodies] = tensor[:, [1, 2, 0], [2, 0, 1]]
        solver.launches.changed = True
        return np.concatenate([linear.sum(1), angular.sum(1)], -1)
