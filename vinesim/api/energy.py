"""Energy and momentum of plants, computed from their state, for checks, plots and learning."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver


@dataclasses.dataclass(frozen=True, slots=True)
class Energy:
    """Energies of plants [J]."""

    kinetic: float
    elastic: float
    """Energy of the springs of joints and of ties, which hold canes to wires; 0 if all springs are slack."""
    gravitational: float
    """Potential energy of the bodies' weight, relative to z = 0."""

    @property
    def total(self) -> float:
        """[J] Sum of kinetic, elastic and gravitational energy."""
        return self.kinetic + self.elastic + self.gravitational


@dataclasses.dataclass(frozen=True, slots=True)
class Momentum:
    """Momentum of plants in world axes."""

    linear: np.ndarray
    """Linear momentum [3] kg m/s."""
    angular: np.ndarray
    """Angular momentum about the origin of the world [3] kg m^2/s."""


def energy(plants: ArticulationSolver, gravity: float, trees: np.ndarray | None = None) -> Energy:
    """Returns the energy of ``trees`` [k] (all unless given); ``gravity`` [m/s^2]. Poses and velocities must be up to
    date.

    Kinetic energy is the sum of m v^2 / 2 + omega I omega / 2 over the bodies. Elastic energy is the sum of k theta^2 /
    2 about each joint axis, with theta the rotation vector of the joint, and of k d^2 / 2 for each tie (spring that
    holds a cane to a wire) that is stretched by d. A tie that deflects its wire by u counts k d (d + u) / 2, which
    includes its share of the wire. If a tree grows on an arm (horizontal old wood) that it twists by u, the joint of
    its root counts less by k u (theta - theta_0) / 2, with theta_0 the rotation in equilibrium
    (``Model.joint_settled``).
    """
    model = plants.model
    state = plants.state
    bodies = _moving_bodies(plants, trees)
    mass, com, velocity, omega, inertia = _motion(plants, bodies)
    kinetic = 0.5 * float(mass @ (velocity**2).sum(1) + np.einsum("bi,bij,bj->", omega, inertia, omega))
    turned = frames.log(state.joint_q[bodies].astype(float))
    elastic = 0.5 * float((plants.joint_stiffness[bodies] * turned**2).sum())
    roots = plants.body_parent[bodies] < 0
    since = turned[roots] - frames.log(plants.joint_settled[bodies[roots]].astype(float))
    arm_turn = plants.root_rests.turn[model.body_tree[bodies[roots]]]
    elastic -= 0.5 * float((plants.joint_stiffness[bodies[roots]] * arm_turn * since).sum())
    held = plants.ties.tie_body
    ties = np.flatnonzero(np.isin(held, bodies))
    pose = state.body_q[held[ties]].astype(float)
    point = pose[:, :3] + frames.rotate(pose[:, 3:], model.tie_point[ties].astype(float))
    away = point - plants.tie_anchor[ties]
    whole = point - model.tie_anchor[ties]
    whole = np.where(np.isin(ties, plants.ties.on_wire)[:, None], whole, away)
    elastic += 0.5 * float(plants.tie_stiffness[ties] @ (away * whole).sum(1))
    return Energy(kinetic, elastic, gravity * float(mass @ com[:, 2]))


def momentum(plants: ArticulationSolver, trees: np.ndarray | None = None) -> Momentum:
    """Returns the linear and angular momentum of ``trees`` [k] (all unless given). Poses and velocities must be up to
    date."""
    mass, com, velocity, omega, inertia = _motion(plants, _moving_bodies(plants, trees))
    impulse = mass[:, None] * velocity
    spin = np.cross(com, impulse) + np.einsum("bij,bj->bi", inertia, omega)
    return Momentum(impulse.sum(0), spin.sum(0))


def _moving_bodies(plants: ArticulationSolver, trees: np.ndarray | None) -> np.ndarray:
    """Returns the indices [k] of the simulated bodies of ``trees``. Berry clusters that are locked to their bunch are
    not bodies of their own."""
    model = plants.model
    number = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree]
    moving = number < plants.tree_moving[model.body_tree]
    if trees is not None:
        moving &= np.isin(model.body_tree, trees)
    return np.flatnonzero(moving)


def _motion(plants: ArticulationSolver, bodies: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns mass [k], position [k, 3] and velocity [k, 3] of the centre of mass, angular velocity [k, 3], inertia [k,
    3, 3].
    """
    pose = plants.state.body_q[bodies].astype(float)
    speed = plants.state.body_qd[bodies].astype(float)
    arm = frames.rotate(pose[:, 3:], plants.body_com[bodies].astype(float))
    velocity = speed[:, :3] + np.cross(speed[:, 3:], arm)
    own = np.zeros((len(bodies), 3, 3))
    for axis in range(3):
        own[:, axis, axis] = plants.body_inertia[bodies, axis]
        one = (axis + 1) % 3
        two = (axis + 2) % 3
        own[:, one, two] = own[:, two, one] = plants.body_product[bodies, axis]
    turn = frames.to_matrix(pose[:, 3:])
    return (
        plants.body_mass[bodies].astype(float),
        pose[:, :3] + arm,
        velocity,
        speed[:, 3:],
        turn @ own @ turn.swapaxes(1, 2),
    )
