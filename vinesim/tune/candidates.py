"""Simulates many candidates of one specimen at once. A candidate is the specimen with trial numbers: a tree with its
own stiffness, damping, mass and pull.

:class:`~vinesim.plants.articulation_solver.ArticulationSolver` computes the dynamics. A run begins in static
equilibrium under a pull at the tip, which the same solver finds in long steps; then the pull ends. A shaken base is the
origin of a frame that moves without rotation. In this frame the base rests, every body has an inertial force from the
base's acceleration in addition to its weight, and the air moves.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import assemble
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.state import State
from vinesim.tune.specimen import TIP, base_pose, build_tree, hanging_bends, place_markers, rest_bends

COLUMNS = ("modulus", "damping", "mass", "bow_y", "bow_z", "pull_y", "pull_z")
"""Columns of the array of candidates [n, 7], which are variants of the specimen.

They are natural logarithms of the ratios of modulus, damping and mass to the specimen's, the bow [rad], and the pull at
the tip along the base's y and z [N at the specimen's modulus; it is scaled with the modulus].
"""
STATIC_STEP = 1.0
"""[s] Step in which inertia is negligible, so that the implicit solve is a Newton step towards equilibrium."""
STATIC_STEPS = 8
_RATE = 1e4


@dataclasses.dataclass(frozen=True, slots=True)
class Motion:
    """Positions of markers at some ticks after the release, with velocity and acceleration over the following tick."""

    position: np.ndarray
    """Positions of the markers [candidate, tick, marker, 3] m."""
    velocity: np.ndarray
    """Velocities of the markers over the following tick [candidate, tick, marker, 3] m/s."""
    acceleration: np.ndarray
    """Accelerations of the markers over the following tick [candidate, tick, marker, 3] m/s^2."""

    def at(self, index: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate positions and velocities [candidate, sample, marker, 3] between ticks.

        The times are ``after`` [candidate or 1, sample] s after the ticks ``index`` [sample].
        """
        t = after[..., None, None]
        x, v, a = (rows[:, index] for rows in (self.position, self.velocity, self.acceleration))
        return x + v * t + 0.5 * a * t * t, v + a * t


class Candidates:
    """Simulates candidates of one specimen: variants with trial numbers, each as a tree of its own.

    Args:
        specimen: the specimen of which all candidates are variations.
        markers: names of the points whose motion is returned.
        dt: step [s].
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        least: smallest number of candidates for which solvers are created.
    """

    def __init__(
        self, specimen: Specimen, markers: tuple[str, ...] = (TIP,), *, dt: float, device: str = "cpu", least: int = 1
    ) -> None:
        self.specimen = specimen
        self.markers = markers
        self.dt = dt
        self.device = device
        self._tree = build_tree(specimen)
        self._body, self._point = place_markers(specimen, markers)
        tip_body, tip_point = place_markers(specimen, (TIP,))
        self._pulled, self._pulled_at = int(tip_body[0]), tip_point[0]
        self._axes = frames.to_matrix(base_pose(specimen)[3:])
        self._solvers: dict[int, tuple[ArticulationSolver, ArticulationSolver]] = {}
        self._own: dict[int, tuple[np.ndarray, ...]] = {}
        self._least = least
        self._sag = np.array([frames.log(body["settled"]) for body in self._tree.bodies]) if specimen.axis else None
        """For a specimen with an axis: rotation of each joint from its slack shape by the specimen's weight [body, 3]
        rad."""
        self.runs = 0
        """Number of candidates run so far."""

    @property
    def size(self) -> int:
        """Number of bodies of one candidate."""
        return len(self._tree.bodies)

    def pull_axes(self) -> np.ndarray:
        """World axes [2, 3] along which ``pull_y`` and ``pull_z`` act."""
        return self._axes[:, 1:].T

    def run(
        self, candidates: np.ndarray, ticks: np.ndarray, pushed: bool = False, base_velocity: np.ndarray | None = None
    ) -> Motion:
        """Simulate candidates after their release from the pull.

        Args:
            candidates: [n, 7], see :data:`COLUMNS`.
            ticks: [k] numbers of steps after the release at which motion is returned, increasing, 0 or more.
            pushed: start at rest instead; the force begins to act at tick 0 and stays.
            base_velocity: [tick, 3] m/s, velocity of the base in the world up to the tick after the last of ``ticks``;
                None: the base rests. The returned motion is relative to the base.
        """
        count = len(candidates)
        candidates = self._padded(candidates)
        still, plants = self._solvers[len(candidates)]
        self._write(still, candidates, 0.0)
        self._write(plants, candidates, 1.0)
        self._settle(still, candidates * [1, 1, 1, 1, 1, 0, 0] if pushed else candidates, count)
        self._begin(plants, count)
        for name in ("joint_q", "joint_qd"):
            getattr(plants.state, name)[:] = getattr(still.state, name)
        self.runs += count
        load = self._load(plants, candidates, pushed, base_velocity)
        rows = [np.empty((count, len(ticks), len(self.markers), 3), np.float32) for _ in range(3)]
        at = 0
        bodies = self._bodies(count)
        point = np.broadcast_to(self._point, (count, len(self.markers), 3)).astype(np.float32)
        for place, tick in enumerate(ticks.tolist()):
            _advance(plants, at, tick, load)
            if load is not None:
                load(tick)
            plants.predict()
            for row, value in zip(rows, _marker_motion(plants, bodies, point), strict=True):
                row[:, place] = value
            plants.integrate()
            at = tick + 1
        position, velocity, later = rows
        return Motion(position, velocity, (later - velocity) / np.float32(self.dt))

    def held_pose(self, candidates: np.ndarray) -> np.ndarray:
        """Returns the joint rotations [n, body, 4] of candidates [n, 7] in equilibrium under their pull."""
        self.shape(candidates)
        still, _ = self._solvers[len(self._padded(candidates))]
        return still.state.joint_q.reshape(-1, self.size, 4)[: len(candidates)].astype(float)

    def shape(self, candidates: np.ndarray) -> np.ndarray:
        """Returns the markers [n, marker, 3] m of candidates [n, 7] in equilibrium under their pull."""
        count = len(candidates)
        candidates = self._padded(candidates)
        still, _ = self._solvers[len(candidates)]
        self._write(still, candidates, 0.0)
        self._settle(still, candidates, count)
        pose = still.state.body_q[self._bodies(count)].astype(float)
        return pose[..., :3] + frames.rotate(pose[..., 3:], np.broadcast_to(self._point, (*pose.shape[:-1], 3)))

    # ------------------------------------------------------------------

    def _padded(self, candidates: np.ndarray) -> np.ndarray:
        """Returns candidates [n, 7], padded with copies of the last one to a number for which solvers exist."""
        count = len(candidates)
        sizes = [size for size in self._solvers if count <= size <= 2 * count + 8]
        size = min(sizes, default=max(count, self._least))
        if not sizes:
            self._new_solvers(size)
        return np.concatenate([candidates, np.repeat(candidates[-1:], size - count, 0)])

    def _begin(self, plants: ArticulationSolver, count: int) -> None:
        """Wake the trees of the first ``count`` candidates, and put all other trees to sleep."""
        plants.put_to_sleep(np.arange(count, len(plants.model.tree_first)))
        plants.wake(np.arange(count))

    def _bodies(self, count: int) -> np.ndarray:
        """Returns the indices [n, marker] of the bodies to which the markers of the first ``count`` candidates are
        fixed."""
        return np.arange(count)[:, None] * self.size + self._body

    def _new_solvers(self, count: int) -> None:
        """Make two solvers for ``count`` candidates: one with long steps for the start, one for the motion."""
        model = assemble([self._tree] * count)
        common = {"fast_rate": _RATE, "max_rate": _RATE, "substeps": False, "device": self.device}
        still, moving = (
            ArticulationSolver(model, State.at_rest(model), dt=dt, phi=phi, **common)
            for dt, phi in ((STATIC_STEP, 1.0), (self.dt, None))
        )
        if len(self._solvers) > 3:  # solvers have large arrays, and a fit needs two or three sizes
            self._solvers.pop(next(iter(self._solvers)))
        self._solvers[count] = (still, moving)
        self._own[count] = tuple(x.copy() for x in (moving.body_mass, moving.body_inertia, moving.body_product))

    def _write(self, plants: ArticulationSolver, candidates: np.ndarray, damped: float) -> None:
        """Write stiffness, damping, masses and slack shape of ``candidates`` [n, 7] to the trees of a solver.
        ``damped``: factor on all damping."""
        model = plants.model
        count = len(candidates)
        modulus, damping, mass = np.exp(candidates[:, :3]).T.repeat(self.size, axis=1)[..., None]
        plants.joint_stiffness[:] = model.joint_stiffness * modulus
        plants.joint_damping[:] = model.joint_damping * modulus * damping * damped
        own_mass, own_inertia, own_product = self._own[count]
        plants.body_inertia[:] = own_inertia * mass
        plants.body_product[:] = own_product * mass
        plants.body_mass[:] = own_mass * mass[:, 0]
        rest = plants.kernel_arrays()[wp.quat]["body_rest"].reshape(count, self.size, 4)
        if self._sag is None:
            rest[:, : self.specimen.segments] = frames.exp(rest_bends(self.specimen, candidates[:, 3:5]))
        # a specimen with an axis hangs along it for any modulus; the stiffer it is, the less its slack shape differs
        else:
            hanging = frames.exp(hanging_bends(self.specimen))
            rest[:] = frames.multiply(hanging[None], frames.conjugate(frames.exp(self._sags(candidates))))
        plants.launches.changed = True

    def _sags(self, candidates: np.ndarray) -> np.ndarray:
        """Returns the rotation of each joint from its slack shape by the specimen's weight [n, body, 3] rad, for
        candidates [n, 7] of a specimen with an axis."""
        assert self._sag is not None
        return self._sag * np.exp(candidates[:, 2] - candidates[:, 0])[:, None, None]

    def _settle(self, plants: ArticulationSolver, candidates: np.ndarray, count: int) -> None:
        """Find the static equilibrium of the first ``count`` trees under the pulls of ``candidates`` [n, 7]."""
        state = plants.state
        state.joint_q[:] = frames.IDENTITY
        if self._sag is not None:
            state.joint_q[:] = frames.exp(self._sags(candidates)).reshape(-1, 4)
        state.joint_qd[:] = 0.0
        self._begin(plants, count)
        plants.forward_kinematics()
        for _ in range(STATIC_STEPS):
            self._push(plants, candidates)
            plants.predict()
            plants.integrate()
            state.joint_qd[:] = 0.0
        plants.forward_kinematics()

    def _push(self, plants: ArticulationSolver, candidates: np.ndarray) -> None:
        """Apply the pulls of ``candidates`` [n, 7] at the present positions of the trees' tips."""
        body = np.arange(len(candidates)) * self.size + self._pulled
        force = (candidates[:, 5:7] * np.exp(candidates[:, :1])) @ self.pull_axes()
        turn = plants.state.body_q[body, 3:].astype(float)
        arm = frames.rotate(turn, np.broadcast_to(self._pulled_at, force.shape))
        plants.body_load[body] = np.concatenate([force, np.cross(arm, force)], -1)

    def _load(
        self, plants: ArticulationSolver, candidates: np.ndarray, pushed: bool, base_velocity: np.ndarray | None
    ) -> Callable[[int], None] | None:
        """Returns a function that applies the loads of the step after a given tick to the bodies; None if the loads are
        constant."""
        plants.body_load[:] = 0.0
        plants.tree_air[:] = 0.0
        if base_velocity is None and not pushed:
            return None
        plants.forward_kinematics()  # lever arms of the first step
        if base_velocity is None:
            return lambda _: self._push(plants, candidates)
        return functools.partial(_shake, plants, np.asarray(base_velocity, float))


def _advance(plants: ArticulationSolver, first: int, end: int, load: Callable[[int], None] | None) -> None:
    """Simulate from tick ``first`` to tick ``end``. ``load``: function that applies the loads of the step after a
    tick."""
    if load is None:
        plants.upload()
        plants.advance(end - first)
        plants.download()
        return
    for tick in range(first, end):
        load(tick)
        plants.predict()
        plants.integrate()


def _shake(plants: ArticulationSolver, base_velocity: np.ndarray, tick: int) -> None:
    """Apply to every body the inertial force of the base's mean acceleration over the step after ``tick``.

    ``base_velocity``: [tick, 3] m/s, velocity of the shaken base.
    """
    now, later = base_velocity[tick : tick + 2]
    force = plants.body_mass[:, None] * ((now - later) / plants.dt).astype(np.float32)
    plants.body_load[:, :3] = force
    plants.body_load[:, 3:] = frames.cross(frames.rotate(plants.state.body_q[:, 3:], plants.body_com), force)
    plants.tree_air[:] = -0.5 * (now + later)


def _marker_motion(
    plants: ArticulationSolver, bodies: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns positions [n, marker, 3] of markers after a prediction, their velocities, and velocities at the step's
    end."""
    pose, now, later = (rows[bodies] for rows in (plants.state.body_q, plants.state.body_qd, plants.velocity_free))
    arm = frames.rotate(pose[..., 3:], point)
    velocity = now[..., :3] + frames.cross(now[..., 3:], arm)
    turned = arm + frames.cross(now[..., 3:], arm) * np.float32(plants.dt)
    return pose[..., :3] + arm, velocity, later[..., :3] + frames.cross(later[..., 3:], turned)
