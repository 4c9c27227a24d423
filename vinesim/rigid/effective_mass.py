"""Effective mass of the rigid bodies within one step (inertia, implicit servos, constraints), from MuJoCo's arrays."""

from __future__ import annotations

import mujoco
import numpy as np

_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)
_CONE = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)


class EffectiveMass:
    """The effective mass H = M^ + Jc^T D Jc of a MuJoCo world in one step.

    M^ is the mass matrix with implicit damping and servos; Jc^T D Jc is the tangent stiffness of MuJoCo's active
    constraints: joint limits, mimic joints and contacts between rigid bodies. D is evaluated at the acceleration that
    MuJoCo computed last; for a sliding contact it is the Hessian of the friction cone. Only kinematic trees that an
    impulse can move are factored.
    """

    def __init__(self, world: mujoco.MjModel) -> None:
        self._world = world
        self._blocks: dict[bytes, _Block] = {}
        self._each = np.arange(world.ntree, dtype=np.int32)

    def impulse_response(self, d: mujoco.MjData, J: np.ndarray) -> np.ndarray:
        """Returns the change of velocity [dof, k] by unit impulses along the rows of ``J`` [k, dof]: H^-1 J^T.

        Raises numpy.linalg.LinAlgError if H is singular.
        """
        dofs = self._coupled(d, J)
        block = self._blocks.get(dofs.tobytes())
        if block is None:
            block = self._blocks[dofs.tobytes()] = _Block(self._world, dofs)
        change = np.zeros((self._world.nv, len(J)))
        change[dofs] = np.linalg.solve(block.hessian(d), J[:, dofs].T)
        return change

    def island_labels(self, d: mujoco.MjData) -> np.ndarray:
        """Returns a label [MuJoCo kinematic tree] of each tree's island. A force on a tree can move only trees with the
        same label within this step.
        """
        m = self._world
        if d.nefc == 0:
            return self._each
        return np.where(d.tree_island >= 0, m.ntree + d.tree_island, self._each) if d.nisland else 0 * self._each

    def is_constrained(self, d: mujoco.MjData, bodies: np.ndarray) -> bool:
        """Returns whether an active constraint of MuJoCo acts on one of the MuJoCo ``bodies`` [k].

        If none does, their effective mass is M^, for which MuJoCo already has the sparse factor L^T D L in ``qH``.
        """
        if d.nefc == 0:
            return False
        tree = self._world.body_treeid[bodies]
        return d.nisland == 0 or bool((d.tree_island[tree[tree >= 0]] >= 0).any())

    def _coupled(self, d: mujoco.MjData, J: np.ndarray) -> np.ndarray:
        """Returns the degrees of freedom [k] that an impulse along a row of ``J`` can move, directly or by
        constraints."""
        m = self._world
        touched = np.zeros(m.ntree, bool)
        touched[m.dof_treeid[J.any(axis=0)]] = True
        if d.nefc and d.nisland:
            island = d.tree_island
            is_coupled = np.zeros(d.nisland + 1, bool)  # the last entry is for island -1, trees without an island
            is_coupled[island[touched]] = True
            is_coupled[-1] = False
            touched |= is_coupled[island]
        return np.flatnonzero(touched[m.dof_treeid])


class _Block:
    """Builds the effective mass of a fixed set of degrees of freedom as a dense matrix, in every step."""

    def __init__(self, world: mujoco.MjModel, dofs: np.ndarray) -> None:
        self.count = len(dofs)
        self.at = np.full(world.nv, -1)
        self.at[dofs] = np.arange(len(dofs))
        self.dofs = dofs
        row = np.repeat(np.arange(world.nv), world.M_rownnz)
        column = world.M_colind
        self.entry = np.flatnonzero(self.at[row] >= 0)
        self.row = self.at[row[self.entry]]
        self.column = self.at[column[self.entry]]

    def hessian(self, d: mujoco.MjData) -> np.ndarray:
        """Returns the effective mass [k, k]: M^ plus the tangent stiffness of the active constraints."""
        H = np.zeros((self.count, self.count))
        diagonal = d.qHDiagInv[self.dofs]
        if diagonal.all():
            H[self.row, self.column] = d.qH[self.entry]
            H.ravel()[:: self.count + 1] = 1.0  # the diagonal
            H = H.T @ (H / diagonal[:, None])
        else:  # no joint is implicit: M^ is M, and MuJoCo does not compute the factor
            H[self.row, self.column] = H[self.column, self.row] = d.M[self.entry]
        if d.nefc:
            state = d.efc_state
            row = np.repeat(np.arange(d.nefc), d.efc_J_rownnz)
            column = self.at[d.efc_J_colind[: len(row)]]
            entry = np.flatnonzero(((state == _QUADRATIC) | (state == _CONE))[row] & (column >= 0))
            if len(entry):
                J = np.zeros((d.nefc, self.count))
                J[row[entry], column[entry]] = d.efc_J[: len(row)][entry]
                H += J.T @ (np.where(state == _QUADRATIC, d.efc_D, 0.0)[:, None] * J)
                first = d.contact.efc_address
                sliding = np.flatnonzero((first >= 0) & (state[first] == _CONE))
                for k in np.unique(d.contact.dim[sliding]).tolist():
                    alike = sliding[d.contact.dim[sliding] == k]
                    rows = J[first[alike, None] + np.arange(k)]
                    tangent = d.contact.H.reshape(-1, 36)[alike, : k * k].reshape(-1, k, k)
                    H += rows.reshape(-1, self.count).T @ (tangent @ rows).reshape(-1, self.count)
        return H
